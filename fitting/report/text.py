"""The report on a terminal."""

from collections.abc import Mapping
from typing import Any

from fitting.formatting import open_interval, plain
from fitting.report.fit_text import fit_lines, health_line, rounded
from fitting.report.intervals import is_withheld
from fitting.report.outputs import final_account, in_words, others, principal
from fitting.report.parameters import parts_of
from fitting.report.proposal import next_lines
from fitting.report.separating import plain_family
from fitting.report.summary import chance, gain

_HEAD = 14
"""Width of the heads of rows; "motor velocity" fits."""


def report_text(report: Mapping[str, Any]) -> str:
    """A compact summary for the terminal.

    Args:
        report: from [`report_dict`][].
    """
    return "\n".join(fit_lines(report) if report["decision"] == "fit_only" else _loop_lines(report))


def _loop_lines(report: Mapping[str, Any]) -> list[str]:
    output, unit, noise = principal(report)
    lines = ["[Decision]", f"    {report['summary']}", f"[Rms error of the {output} in free runs]"]
    shown = [("model", report["before"])]
    if report["after"]["effects"]:
        shown = [("before", report["before"]), ("after", report["after"])]
    lines.append("    " + " " * _HEAD + "".join(f"{n:>14}" for n, _ in shown))
    for part in parts_of(report):
        values = "".join(f"{plain(a['rmse'][part]):>14}" for _, a in shown)
        lines.append(f"    {part:{_HEAD}}{values} {unit}")
    on = report["judged_on"]
    for other in others(report):
        values = "".join(f"{plain(a['rmse_of_outputs'][other][on]):>14}" for _, a in shown)
        lines.append(f"    {in_words(other):{_HEAD}}{values} {report['units'][other]}, {on}")
    lines.append(f"    {'noise':{_HEAD}}{plain(noise):>14} {unit}")
    lines.append("[Parameters]")
    lines += _parameter_lines(final_account(report)["parameters"])
    for effect in report["after"]["effects"]:
        family = plain_family(effect["family"])
        lines.append(f"[Effect: {effect['name']}] {family}: {gain(effect)}; {chance(effect, report)}")
        if effect["family"] != "unknown":
            lines += _parameter_lines(effect["parameters"])
    if report["unknown"]:
        learned = report["unknown"]
        lines += [f"[Learned {learned['quantity']}: {learned['name']}]", f"    {learned['says']}"]
    # The notes tell ties.
    for other in (o for o in report["alternatives"] if o["separable"]):
        lines.append(f"[Ruled out] {other['name']}: the selection data distinguish it from {other['instead_of']}.")
    for note in report["cannot_tell"]:
        lines.append(f"[Note] {note}")
    for seen in (h for h in report["health"] if h["severity"] != "note"):
        lines.append(f"[Log health] {health_line(seen)}")
    lines += [f"[Next experiment] {sentence}" for sentence in next_lines(report)]
    return lines


def _parameter_lines(parameters: Mapping[str, Any]) -> list[str]:
    width = max((len(p) for p in parameters), default=0)
    return [f"    {path:{width}}  {_parameter_line(estimate)}" for path, estimate in parameters.items()]


def _parameter_line(estimate: Mapping[str, Any]) -> str:
    std = estimate["std"]
    value, *ends = rounded([estimate["value"], *(e for e in estimate["ci95"] if e is not None)], std)
    span = f"[{', '.join(ends)}]" if len(ends) == 2 else open_interval(estimate["ci95"]).format(*ends)
    span = "interval withheld" if is_withheld(estimate) else span
    share = f" ({100 * std / abs(estimate['value']):.2g} %)" if estimate["value"] and std is not None else ""
    flag = f"  {estimate['flag'].upper()}" if estimate["flag"] else ""
    unit = "" if estimate["unit"] == "1" else f" {estimate['unit']}"
    return f"{value} +/- {plain(std, 2)}{share}{unit}  {span}{flag}"
