"""The report of a quasi-static fit: text for the terminal, a page, and JSON."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from fitting import formatting
from fitting.files import write_whole
from fitting.quasi_static.content import PLAIN_SHAPE
from fitting.quasi_static.drawing import Picture
from fitting.quasi_static.facts import ARCMIN
from fitting.quasi_static.loop_text import figure_line
from fitting.web_page import environment


def write_report(out: Path, report: Mapping[str, Any], shown: Sequence[Picture]) -> dict[str, Path]:
    """Write `report.html` and `report.json`: both, whole, or none.

    Args:
        out: Folder; made where absent.
        report: Of a fit or of a loop.
        shown: Its pictures.

    Returns:
        The files' paths, by name.
    """
    texts = {
        "report.html": report_page(report, shown),
        "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
    }
    paths = {file: out / file for file in texts}
    write_whole({paths[file]: text for file, text in texts.items()})
    return paths


def report_page(report: Mapping[str, Any], shown: Sequence[Picture]) -> str:
    """The page: self-contained, reads without a network."""
    filters = {
        "value": _value,
        "interval": _interval,
        "shape": PLAIN_SHAPE.__getitem__,
        "percent": formatting.percent,
        "smaller": formatting.smaller,
        "family": lambda name: name.replace("_", " "),
    }
    template = "quasi_static.html.jinja" if report["decision"] == "fit_only" else "quasi_static_loop.html.jinja"
    page = environment(filters).get_template(template)
    return page.render(report=report, pictures=shown, plotlyjs=Markup(get_plotlyjs()))


def _value(known: Mapping[str, Any]) -> str:
    if known["value"] is None:
        return "unknown"
    return formatting.measured(known["value"], known["std"], known["unit"]) + _in_arcmin(known)


def _interval(known: Mapping[str, Any]) -> str:
    if None in known["ci95"]:
        return "—"
    return formatting.interval(known["ci95"], known["std"], known["unit"])


def _in_arcmin(known: Mapping[str, Any]) -> str:
    """The unit in which vendors state small angles."""
    small = known["unit"] == "rad" and known.get("arcmin", known) is not None
    return f" ({formatting.number(ARCMIN * known['value'])} arcmin)" if small else ""


def report_text(report: Mapping[str, Any]) -> str:
    """A compact summary for the terminal."""
    rmse = report["before"]["rmse"]
    lines = ["[Fit of quasi-static logs]", f"    {report['summary']}", "[Rms error of the twist]"]
    lines += [
        f"    {name:10}{rmse[key]:12.4g} rad" for name, key in (("fitted", "training"), ("held out", "validation"))
    ]
    lines.append("[Parameters]")
    known = report["before"]["parameters"]
    width = max(map(len, known))
    lines += [f"    {name:{width}}  {figure_line(one)}" for name, one in known.items()]
    lines.append("[Shapes, by held-out error]")
    for shape, account in sorted(report["shapes"].items(), key=lambda item: item[1]["rmse"]["validation"]):
        mark = "  chosen" if shape == report["shape"] else ""
        lines.append(f"    {PLAIN_SHAPE[shape]:14}{account['rmse']['validation']:12.4g} rad{mark}")
    lines += [f"[Note] {note}" for note in report["cannot_tell"]]
    lines += [f"[{f['severity']}] {f['log']}: {f['where']}: {f['what']}; {f['consequence']}" for f in report["health"]]
    return "\n".join(lines)
