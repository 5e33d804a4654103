"""The health check: faults of a log and their effect on a fit."""

from collections.abc import Iterable, Iterator

import numpy as np

from fitting.errors import DataError
from fitting.logs.drive_file import DriveFile
from fitting.logs.findings import Finding
from fitting.logs.log import Log
from fitting.logs.log_kind import OUTPUTS
from fitting.logs.lost_rows import lost_rows
from fitting.logs.masks import clipped, glitches
from fitting.logs.plausibility import mix_ups, wide_twist

# All thresholds are assumed; they separate healthy logs from faulty ones by a wide margin.
JITTER = 0.01
DISTINCT_SHARE = 0.2
COARSE_STEP = 0.1
FEWEST = 50

_INPUTS = {"drive": "motor_torque", "reduced": "forcing", "quasi-static": "joint_torque"}
_UNITS = {"motor_torque": "N m", "load_torque": "N m", "joint_torque": "N m", "motor_angle": "rad", "load_angle": "rad"}


def examine(log: Log, drive_file: DriveFile) -> tuple[Finding, ...]:
    """All findings on a log before it is fitted.

    Args:
        log: The log. Outputs after `log.outputs_until` rows are not used.
        drive_file: The drive that it was read with.

    Returns:
        The findings of the reader, then those of the checks; refusals are among them.
    """
    checks = [_jitter(log), lost_rows(log), _excitation(log), _response(log), _channels(log, drive_file)]
    if log.kind == "drive" or (log.motor_angle is not None and log.load_angle is not None):
        checks += [_wrapped(log), mix_ups(log, drive_file)]
    if log.kind != "reduced" and log.dynamic_error is not None:
        checks.append(wide_twist(log, drive_file))
    # Files may contain numbers of any size; overflow is handled like other wrong values.
    with np.errstate(all="ignore"):
        return (*log.findings, *(finding for check in checks for finding in check))


def refuse_unfit(findings: Iterable[Finding], log: Log) -> None:
    """Raise if a log can't be fitted.

    Args:
        findings: From `examine`.
        log: The log they are about.

    Raises:
        DataError: The first refusal among the findings.
    """
    for finding in findings:
        if finding.severity == "refusal":
            raise DataError(f"{log.path}: {finding.where}: {finding.what}; {finding.consequence}")


def _known(log: Log, signal: str) -> np.ndarray | None:
    """The values of a signal that checks may use."""
    values = getattr(log, signal)
    if values is None or signal not in (*log.outputs, *OUTPUTS):
        return values
    return values[: log.outputs_until]


def _is_constant(values: np.ndarray | None) -> bool:
    return values is None or len(values) == 0 or bool(np.all(values == values[0]))


def _jitter(log: Log) -> Iterator[Finding]:
    # Channels with separate clocks share a union of stamps; sampling is judged by the input's.
    step = np.diff(log.time if log.input_known is None else log.time[log.input_known])
    median = float(np.median(step))
    # The reader reports gaps, which would mask the regularity of the rest.
    spread = float(np.std(step[step <= 5 * median])) / median
    if spread > JITTER:
        yield Finding(
            "note",
            f"the sampling jitters by {100 * spread:.2g} % of the median step of {median:.4g} s",
            "time",
            "the stamps are used as they are",
        )


def _excitation(log: Log) -> Iterator[Finding]:
    name = _INPUTS[log.kind]
    values = _known(log, name)
    if values is None or not _is_constant(values):
        return
    driven = not _is_constant(log.load_torque)
    yield Finding(
        "warning" if driven else "refusal",
        f"{name} is {values[0]:g} in all {len(values)} rows",
        name,
        "only the load torque excites the drive, so that the motor side is poorly identifiable"
        if driven
        else "a constant input does not excite the drive, so check the column or record another log",
    )


def _response(log: Log) -> Iterator[Finding]:
    stuck = [name for name in log.outputs if _is_constant(_known(log, name))]
    for name in stuck:
        hopeless = stuck == list(log.outputs)
        yield Finding(
            "refusal" if hopeless else "warning",
            f"{name} never changes",
            name,
            "there is no response to fit, so check the column or record another log"
            if hopeless
            else "unless that side was locked, the sensor is stuck and what is fitted to it is wrong",
        )


def _channels(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    inputs = ("motor_torque", "load_torque") if log.kind == "drive" else (_INPUTS[log.kind],)
    for name in inputs:
        values = _known(log, name)
        if values is not None and not _is_constant(values):
            yield from _inputs(name, values, log.time, log.input_known if name == _INPUTS[log.kind] else None)
            yield from _quantised(log, name, values, 1.0, float(np.std(values)))
    if log.dynamic_error is None or log.kind != "drive":
        for name in log.outputs:
            values = _known(log, name)
            if values is not None and not _is_constant(values):
                yield from _quantised(log, name, values, 1.0, float(np.std(values)))
        return
    motor, load = _known(log, "motor_angle"), _known(log, "load_angle")
    assert motor is not None and load is not None
    if _is_constant(motor) or _is_constant(load) or len(motor) < FEWEST:
        return
    spread = float(np.std(log.dynamic_error[: log.outputs_until]))
    ratio = drive_file.reduction_ratio or 1.0
    for name, values, side in (("motor_angle", motor, ratio), ("load_angle", load, 1.0)):
        yield from _quantised(log, name, values, side, spread)


def _inputs(name: str, values: np.ndarray, time: np.ndarray, known: np.ndarray | None) -> Iterator[Finding]:
    """Findings on an input, which the fit uses as logged where it is known (None for all rows)."""
    for rows, level, count in clipped(values, None):
        yield Finding(
            "warning",
            f"{len(rows)} samples ({100 * len(rows) / len(values):.2g} %) stand exactly at {level:g} in {count} runs",
            f"{name}, first in data row {rows[0] + 1}",
            "the channel looks clipped, which biases stiffness and damping unless the drive was at its limit",
        )
    spikes = glitches(values, time)
    spikes = spikes if known is None else spikes[known[spikes]]
    if len(spikes):
        yield Finding(
            "note",
            f"{len(spikes)} samples are far from their neighbours",
            f"{name}, first in data row {spikes[0] + 1}",
            "the fit uses them as logged, so correct them if the logger caused them",
        )


def _quantised(log: Log, name: str, values: np.ndarray, side: float, spread: float) -> Iterator[Finding]:
    """A note on the resolution of a channel.

    Args:
        log: For the unit.
        name: Signal.
        values: Its values.
        side: Divisor from a step of this channel to one of the reference quantity.
        spread: rms of the reference quantity.
    """
    levels = np.unique(values)
    if len(levels) < 3 or len(values) < FEWEST:
        return
    gaps = np.diff(levels)
    step = float(gaps.min())
    on_grid = float(np.mean(np.abs(gaps / step - np.rint(gaps / step)) < 0.05)) > 0.99
    share = step / abs(side) / spread if spread > 0 else np.inf
    few = len(levels) < DISTINCT_SHARE * len(values) and share > COARSE_STEP / 10
    if not on_grid or not (few or share > COARSE_STEP):
        return
    unit = _UNITS.get(name) or log.units.get(name, "")
    about = (
        "of the rms dynamic error" if name.endswith("_angle") and log.dynamic_error is not None else "of its own rms"
    )
    yield Finding(
        "note",
        f"the values lie {step:.4g} {unit} apart, which is {100 * share:.2g} % {about}",
        name,
        "quantisation acts like noise with a variance of a twelfth of the squared step, not quite white",
    )


def _wrapped(log: Log) -> Iterator[Finding]:
    for name in ("motor_angle", "load_angle"):
        values = _known(log, name)
        if values is None or len(values) < FEWEST:
            continue
        jump = np.abs(np.diff(values))
        turns = np.flatnonzero(np.abs(jump / (2 * np.pi) - 1) < 0.1)
        if len(turns) and np.median(jump) < 0.5 and np.ptp(values) < 2.2 * np.pi:
            yield Finding(
                "refusal",
                f"{name} jumps by one revolution in {len(turns)} places",
                f"{name}, first in data row {turns[0] + 2}",
                "the angle is wrapped, so unwrap it before it is logged or exported",
            )
