"""The reports of quasi-static logs: a page and JSON on disk, and text for the terminal."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from fitting import formatting
from fitting.files import write_whole
from fitting.formatting import plain
from fitting.quasi_static.content import plain_shape
from fitting.quasi_static.facts import ARCMIN
from fitting.report.plots import Plot
from fitting.report.web_page import environment
from fitting.report.write import REPORT_FILES


def write_report(out: Path, report: Mapping[str, Any], shown: Sequence[Plot]) -> Path:
    """Write `report.html` and `report.json`, both or neither; other files of an earlier report are removed.

    Args:
        out: Folder; created where absent.
        report: Of a fit or of a loop.
        shown: Its plots.

    Returns:
        The page's path.
    """
    page = out / "report.html"
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    write_whole(
        {page: report_page(report, shown), out / "report.json": text}, older=[out / file for file in REPORT_FILES]
    )
    return page


def report_page(report: Mapping[str, Any], shown: Sequence[Plot]) -> str:
    """The page, self-contained, without network access."""
    filters = {
        "value": _value,
        "interval": lambda k: "—" if None in k["ci95"] else formatting.interval(k["ci95"], k["std"], k["unit"]),
        "shape": plain_shape,
        "percent": formatting.percent,
        "smaller": formatting.smaller,
        "family": lambda name: name.replace("_", " "),
    }
    template = "quasi_static.html.jinja" if report["decision"] == "fit_only" else "quasi_static_loop.html.jinja"
    page = environment(filters).get_template(template)
    return page.render(report=report, plots=shown, plotlyjs=Markup(get_plotlyjs()))


def _value(known: Mapping[str, Any]) -> str:
    """A figure; small angles in arcmin as well, as vendors state them."""
    if known["value"] is None:
        return "unknown"
    small = known["unit"] == "rad" and known.get("arcmin", known) is not None
    arcmin = f" ({formatting.number(ARCMIN * known['value'])} arcmin)" if small else ""
    return formatting.measured(known["value"], known["std"], known["unit"]) + arcmin


def report_text(report: Mapping[str, Any]) -> str:
    """A compact summary for the terminal.

    Args:
        report: Of a fit or of a loop.
    """
    lines = _fit_lines(report) if report["decision"] == "fit_only" else _loop_lines(report)
    lines += [f"[Note] {note}" for note in report["cannot_tell"]]
    lines += [f"[{f['severity']}] {f['log']}: {f['where']}: {f['what']}; {f['consequence']}" for f in report["health"]]
    return "\n".join(lines)


def _fit_lines(report: Mapping[str, Any]) -> list[str]:
    lines = ["[Fit of quasi-static logs]", f"    {report['summary']}", "[Rms error of the twist]"]
    lines += [*_errors([report["before"]], 12), "[Parameters]", *_figures(report["before"]["parameters"])]
    lines.append("[Shapes, by held-out error]")
    for shape, one in sorted(report["shapes"].items(), key=lambda item: item[1]["rmse"]["validation"]):
        mark = "  chosen" if shape == report["shape"] else ""
        lines.append(f"    {plain_shape(shape):14}{one['rmse']['validation']:12.4g} rad{mark}")
    return lines


def _loop_lines(report: Mapping[str, Any]) -> list[str]:
    shown = {"line": report["before"]}
    if report["after"]["effects"]:
        shown = {"before": report["before"], "after": report["after"]}
    lines = ["[Decision]", f"    {report['decision']}: {report['summary']}", "[Rms error of the twist]"]
    lines.append(" " * 14 + "".join(f"{name:>14}" for name in shown))
    lines += [*_errors(list(shown.values()), 14), "[Parameters]", *_figures(list(shown.values())[-1]["parameters"])]
    for one in report["after"]["effects"]:
        gain = formatting.percent(one["validation_gain"])
        if one["at_rest"] is not None:
            gain += f" (at rest {formatting.percent(one['at_rest']['gain'])})"
        lines.append(f"[Effect: {one['family']}] {one['name']}, gain {gain}, p = {plain(one['p_value'], 2)}")
        lines += _figures(one["parameters"])
    for other in report["alternatives"]:
        kind = "ruled out" if other["separable"] else "TIE"
        lines.append(f"[Alternative: {other['name']}] {kind}. {other['separating_experiment']}")
    return lines


def _errors(accounts: list[Mapping[str, Any]], width: int) -> list[str]:
    parts = {"fitted": "training", "held out": "selection", "test": "test"}
    values = {
        label: "".join(f"{plain(a['rmse'][key]):>{width}}" for a in accounts)
        for label, key in parts.items()
        if accounts[0]["rmse"][key] is not None
    }
    return [f"    {label:10}{shown} rad" for label, shown in values.items()]


def _figures(known: Mapping[str, Any]) -> list[str]:
    width = max((len(name) for name in known), default=0)
    return [f"    {name:{width}}  {_figure(one)}" for name, one in known.items()]


def _figure(known: Mapping[str, Any]) -> str:
    """A figure with its standard error and interval, in plain characters."""
    value, std, small = known["value"], known["std"], known.get("arcmin")
    if value is None:
        return "unknown"
    share = f" ({100 * std / abs(value):.2g} %)" if value and std is not None else ""
    unit = "" if known["unit"] == "1" else f" {known['unit']}"
    ends = "" if None in known["ci95"] else "  [{:.4g}, {:.4g}]".format(*known["ci95"])
    if small is not None:
        ends += f" = {small['value']:.3g} arcmin"
        ends += "" if None in small["ci95"] else " [{:.3g}, {:.3g}]".format(*small["ci95"])
    return f"{value:.5g} +/- {plain(std, 2)}{share}{unit}{ends}{'' if known['identifiable'] else '  NOT IDENTIFIABLE'}"
