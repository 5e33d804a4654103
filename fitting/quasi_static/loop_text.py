"""The loop's report on a terminal."""

from collections.abc import Mapping
from typing import Any

from fitting import formatting
from fitting.formatting import plain


def loop_text(report: Mapping[str, Any]) -> str:
    """A compact summary for the terminal.

    Args:
        report: From [`fitting.quasi_static.loop_content.loop_report`][].
    """
    final = report["after"] if report["after"]["effects"] else report["before"]
    lines = ["[Decision]", f"    {report['decision']}: {report['summary']}", "[Rms error of the twist]"]
    shown = {"before": report["before"], "after": report["after"]} if report["after"]["effects"] else {"line": final}
    lines.append(" " * 14 + "".join(f"{name:>14}" for name in shown))
    for label, key in (("fitted", "training"), ("held out", "validation")):
        lines.append(f"    {label:10}" + "".join(f"{plain(one['rmse'][key]):>14}" for one in shown.values()) + " rad")
    lines.append("[Parameters]")
    lines += _figures(final["parameters"])
    for one in report["after"]["effects"]:
        gain = formatting.percent(one["validation_gain"])
        if one["at_rest"] is not None:
            gain += f" (at rest {formatting.percent(one['at_rest']['gain'])})"
        lines.append(f"[Effect: {one['family']}] {one['name']}, gain {gain}, p = {plain(one['p_value'], 2)}")
        lines += _figures(one["parameters"])
    for other in report["alternatives"]:
        kind = "ruled out" if other["separable"] else "TIE"
        lines.append(f"[Alternative: {other['name']}] {kind}. {other['separating_experiment']}")
    lines += [f"[Note] {note}" for note in report["cannot_tell"]]
    lines += [f"[{f['severity']}] {f['log']}: {f['where']}: {f['what']}; {f['consequence']}" for f in report["health"]]
    return "\n".join(lines)


def _figures(known: Mapping[str, Any]) -> list[str]:
    width = max((len(name) for name in known), default=0)
    return [f"    {name:{width}}  {figure_line(one)}" for name, one in known.items()]


def figure_line(known: Mapping[str, Any]) -> str:
    """A figure with its standard error and interval, in plain characters."""
    if known["value"] is None:
        return "unknown"
    low, high = known["ci95"]
    ends = "" if low is None or high is None else f"  [{low:.4g}, {high:.4g}]"
    share = (
        f" ({100 * known['std'] / abs(known['value']):.2g} %)" if known["value"] and known["std"] is not None else ""
    )
    unit = "" if known["unit"] == "1" else f" {known['unit']}"
    flag = "" if known["identifiable"] else "  NOT IDENTIFIABLE"
    return f"{known['value']:.5g} +/- {plain(known['std'], 2)}{share}{unit}{ends}{_arcmin(known)}{flag}"


def _arcmin(known: Mapping[str, Any]) -> str:
    if known.get("arcmin") is None:
        return ""
    value, (low, high) = known["arcmin"]["value"], known["arcmin"]["ci95"]
    ends = "" if low is None or high is None else f" [{low:.3g}, {high:.3g}]"
    return f" = {value:.3g} arcmin{ends}"
