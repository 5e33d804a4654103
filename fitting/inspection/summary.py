"""An inspection as text."""

from collections.abc import Iterator, Sequence

import numpy as np

from fitting.inspection.drive_text import unknowns
from fitting.inspection.excitation import Excitation
from fitting.inspection.inspection import Inspection, JointInspection, confidence_percent
from fitting.inspection.resonances import COHERENT
from fitting.logs.findings import Finding

_GAP = 5.0  # in median steps; a longer pause is a gap
_MOST_NAMES = 12

Row = tuple[str, str, str, str, str, str]
HEAD: Row = ("column", "signal", "unit", "sign", "confidence", "why")


def column_rows(inspection: Inspection) -> list[Row]:
    """One row per column that is or may be a signal, with the columns of [`HEAD`][]."""
    joint, time = inspection.joint, inspection.time
    rows: list[Row] = []
    if time.column is not None:
        rows.append((time.column, "time", time.unit, "", confidence_percent(time.confidence), "; ".join(time.reasons)))
    for signal, guess in joint.signals.items():
        unit = guess.unit or (
            "?" if signal.endswith("_angle") else "as logged" if signal in _ANY_UNIT else "SI assumed"
        )
        sign = "-1" if guess.sign < 0 else ""
        rows.append((guess.column, signal, unit, sign, confidence_percent(guess.confidence), guess.why))
    for column, shares in joint.open.items():
        could_be = " or ".join(f"{s} ({confidence_percent(w)})" for s, w in shares.items())
        rows.append((column, "?", "", "", "", f"could be {could_be}"))
    for column, (other, times) in joint.copies.items():
        rows.append((column, "", "", "", "", f"follows '{other}', times {times:.4g}"))
    return rows


_ANY_UNIT = ("dynamic_error", "forcing")


def inspection_text(
    inspection: Inspection,
    findings: Sequence[Sequence[Finding]],
    moved: Sequence[Excitation],
    told: Sequence[str],
) -> str:
    """The inspection as text for a terminal.

    Args:
        inspection: Columns and signals.
        findings: Of the health check, by log.
        moved: Excitation and response of each log.
        told: Sentences on what a fit could determine.
    """
    lines = [_sampling(inspection, k) for k in range(len(inspection.tables))]
    lines += ["", *_table([HEAD, *column_rows(inspection)]), *_rest(inspection), *_joints(inspection)]
    if inspection.joint.ratio is not None:
        ratio = inspection.joint.ratio
        lines += ["", f"Reduction ratio: {ratio.value:.6g} (the angles admit {ratio.low:.4g} to {ratio.high:.4g})"]
    lines += ["", *_health(inspection, findings), "", *_excitation(inspection, moved)]
    lines += ["", "What a fit of such a log can determine:", *(f"  {sentence}" for sentence in told)]
    missing = unknowns(inspection)
    if missing:
        lines += ["", "To fill in in the drive file:", *(f"  {key}: {why}" for key, why in missing.items())]
    return "\n".join(lines)


def _sampling(inspection: Inspection, k: int) -> str:
    table, time, rate = inspection.tables[k], inspection.clocks[k].base.time, inspection.rates[k]
    if rate is None:
        return f"{table.path}: {table.rows} rows, at an unknown rate"
    step = np.diff(time)
    median = float(np.median(step))
    gaps = step > _GAP * median
    words = [f"{table.path}: {table.rows} rows, {np.ptp(time):.4g} s at {rate:.5g} Hz"]
    jitter = float(np.std(step[~gaps])) / median
    words.append(f"jitter {100 * jitter:.2g} % of the step" if jitter > 1e-3 else "even")
    words.append(f"{gaps.sum()} gaps, the longest {step.max():.3g} s" if gaps.any() else "no gaps")
    return ", ".join(words)


def _table(rows: Sequence[Row]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEAD) - 1)]
    return [
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]).rstrip()
        for row in rows
    ]


def _rest(inspection: Inspection) -> Iterator[str]:
    shown = {row[0] for row in column_rows(inspection)}
    rest = [c.name[:60] for c in inspection.tables[0].columns if c.name not in shown]
    if rest:
        yield f"Not used: {_some(rest)}"
    left_out = [f"{name[:60]} ({reason})" for name, reason in inspection.tables[0].left_out.items()]
    if left_out:
        yield f"No channels: {_some(left_out)}"


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"{', '.join(names[:_MOST_NAMES])}{more}"


def _joints(inspection: Inspection) -> Iterator[str]:
    if inspection.joint.label is None:
        return
    yield ""
    yield f"The log has {len(inspection.joints)} joints; the table shows joint {inspection.joint.label}."
    yield from (_joint(joint) for joint in inspection.joints)


def _joint(joint: JointInspection) -> str:
    ratio = f", ratio {joint.ratio.value:.5g}" if joint.ratio is not None else ""
    kind = f"a {joint.kind} log" if joint.kind else "no log that can be fitted"
    return f"  joint {joint.label}: {kind} ({', '.join(joint.signals) or 'nothing recognised'}){ratio}"


def _health(inspection: Inspection, findings: Sequence[Sequence[Finding]]) -> Iterator[str]:
    if not any(findings):
        yield "Health: nothing to report."
        return
    yield "Health:"
    for table, own in zip(inspection.tables, findings, strict=True):
        name = f"{table.path.name}: " if len(inspection.tables) > 1 else ""
        yield from (f"  {name}{finding}" for finding in own)


def _excitation(inspection: Inspection, moved: Sequence[Excitation]) -> Iterator[str]:
    yield "Excitation:"
    for table, one in zip(inspection.tables, moved, strict=True):
        name = f"{table.path.name}: " if len(inspection.tables) > 1 else ""
        ranges = [f"{s} {low:.4g} to {high:.4g} {unit}".rstrip() for s, (low, high, unit) in one.ranges.items()]
        yield f"  {name}{'; '.join(ranges) or 'no signal was recognised'}"
        if one.band is not None and inspection.joint.kind != "quasi-static":
            yield f"  {name}90 % of the power of {one.driver} lies from {one.band[0]:.4g} to {one.band[1]:.4g} Hz"
            if one.response is not None:
                yield f"  {name}{_coherence(one)}"


def _coherence(one: Excitation) -> str:
    what = {"both angles": "the twist"}.get(one.response or "", one.response)
    if one.coherent is None:
        return f"the coherence of {one.driver} and {what} is nowhere above {COHERENT:g}"
    low, high = one.coherent
    return f"the coherence of {one.driver} and {what} is above {COHERENT:g} from {low:.4g} to {high:.4g} Hz"
