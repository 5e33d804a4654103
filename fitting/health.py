"""The health gate: what is wrong with a log, and what that does to a fit."""

from collections.abc import Iterable, Iterator

import numpy as np

from fitting.drive_file import DriveFile
from fitting.errors import DataError
from fitting.findings import Finding
from fitting.logs import OUTPUTS, Log

# All thresholds are assumed: they part the practice logs from their mix-ups by a wide margin.
RATIO_TOLERANCE = 0.02
FREE_MOTION = 0.02  # rad of the output, more than any gear twists; below it a load may be locked
SLOW_MODES = 8
SLOW_SHARE = 0.5
SLOW_CORRELATION = 0.999
CLIPPED_SHARE = 0.005
FROZEN_SHARE = 0.05
JITTER = 0.01
DISTINCT_SHARE = 0.2
COARSE_STEP = 0.1
FEWEST = 50

_INPUTS = {"drive": "motor_torque", "reduced": "forcing", "quasi-static": "joint_torque"}
_UNITS = {"motor_torque": "N m", "load_torque": "N m", "joint_torque": "N m", "motor_angle": "rad", "load_angle": "rad"}


def examine(log: Log, drive_file: DriveFile) -> tuple[Finding, ...]:
    """Everything worth saying about a log before it is fitted.

    Args:
        log: The log. Outputs after `log.outputs_until` rows are not looked at.
        drive_file: The drive that it was read with.

    Returns:
        The findings of the reader, then those of the checks; refusals are among them.
    """
    checks = [_jitter(log), _excitation(log), _response(log), _channels(log, drive_file)]
    if log.motor_angle is not None and log.load_angle is not None:
        checks += [_wrapped(log), _ratio(log, drive_file), _velocity(log)]
    return (*log.findings, *(finding for check in checks for finding in check))


def refuse_unfit(findings: Iterable[Finding], log: Log) -> None:
    """Nothing when the log can be fitted.

    Args:
        findings: What `examine` gave.
        log: The log they are about.

    Raises:
        DataError: There is a refusal among the findings; the first one is told.
    """
    for finding in findings:
        if finding.severity == "refusal":
            raise DataError(f"{log.path}: {finding.where}: {finding.what}; {finding.consequence}")


def _known(log: Log, signal: str) -> np.ndarray | None:
    """The values of a signal that checks may look at."""
    values = getattr(log, signal)
    if values is None or signal not in OUTPUTS:
        return values
    return values[: log.outputs_until]


def _is_constant(values: np.ndarray | None) -> bool:
    return values is None or len(values) == 0 or bool(np.all(values == values[0]))


def _jitter(log: Log) -> Iterator[Finding]:
    step = np.diff(log.time)
    median = float(np.median(step))
    # A gap is told by the reader and would hide how regular the rest is.
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
        "only the load torque excites the drive, so that the motor side is seen poorly"
        if driven
        else "a constant input excites nothing, so check the column or record another log",
    )


def _response(log: Log) -> Iterator[Finding]:
    outputs = ("motor_angle", "load_angle") if log.kind == "drive" else ("dynamic_error",)
    stuck = [name for name in outputs if _is_constant(_known(log, name))]
    for name in stuck:
        hopeless = stuck == list(outputs)
        yield Finding(
            "refusal" if hopeless else "warning",
            f"{name} never changes",
            name,
            "there is no response to fit, so check the column or record another log"
            if hopeless
            else "unless that side was locked, the sensor is stuck and the dynamic error is wrong",
        )


def _channels(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    inputs = ("motor_torque", "load_torque") if log.kind == "drive" else (_INPUTS[log.kind],)
    for name in inputs:
        values = _known(log, name)
        if values is not None and not _is_constant(values):
            yield from _clipped(name, values, None)
            yield from _quantised(log, name, values, 1.0, float(np.std(values)))
    if log.kind != "drive":
        twist = _known(log, "dynamic_error")
        assert twist is not None
        if not _is_constant(twist):
            yield from _clipped("dynamic_error", twist, None)
            yield from _quantised(log, "dynamic_error", twist, 1.0, float(np.std(twist)))
        return
    motor, load = _known(log, "motor_angle"), _known(log, "load_angle")
    assert motor is not None and load is not None
    if _is_constant(motor) or _is_constant(load) or len(motor) < FEWEST:
        return
    spread = float(np.std(log.dynamic_error[: log.outputs_until]))
    ratio = drive_file.reduction_ratio or 1.0
    for name, values, other, side in (
        ("motor_angle", motor, load, ratio),
        ("load_angle", load, motor, 1.0),
    ):
        yield from _clipped(name, values, other)
        yield from _frozen(name, values, other)
        yield from _quantised(log, name, values, side, spread)


def _runs(same: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First index and one past the last of each run of True."""
    edges = np.diff(np.concatenate(([0], same.astype(np.int8), [0])))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


def _clipped(name: str, values: np.ndarray, other: np.ndarray | None) -> Iterator[Finding]:
    levels, counts = np.unique(values, return_counts=True)
    # A switched input of a few levels sits at its ends by design.
    if len(levels) <= 10:
        return
    for level, neighbours in ((levels[0], counts[1:3]), (levels[-1], counts[-3:-1])):
        starts, stops = _runs(values == level)
        long = stops - starts >= 3
        starts, stops = starts[long], stops[long]
        held = int(np.sum(stops - starts))
        # Rest at zero is no clipping, nor is the turning point of a coarsely quantised signal.
        if level == 0 or held < CLIPPED_SHARE * len(values) or held < 5 * neighbours.max():
            continue
        if other is not None:
            moved = sum(np.ptp(other[a:b]) for a, b in zip(starts, stops, strict=True))
            if moved < FROZEN_SHARE * np.ptp(other):
                continue
        yield Finding(
            "warning",
            f"{held} samples ({100 * held / len(values):.2g} %) stand exactly at {level:g} in {len(starts)} runs",
            f"{name}, first in data row {starts[0] + 1}",
            "the channel looks clipped, which bends the fitted stiffness and damping",
        )


def _frozen(name: str, values: np.ndarray, other: np.ndarray) -> Iterator[Finding]:
    starts, stops = _runs(np.diff(values) == 0)
    if len(starts) == 0:
        return
    longest = int(np.argmax(stops - starts))
    start, stop = int(starts[longest]), int(stops[longest]) + 1
    if stop - start < max(FEWEST, FROZEN_SHARE * len(values)):
        return
    if np.ptp(other[start:stop]) > FROZEN_SHARE * np.ptp(other):
        yield Finding(
            "warning",
            f"{name} holds one value for {stop - start} rows while the other angle moves",
            f"{name}, data rows {start + 1} to {stop}",
            "the sensor is stuck there, so that the dynamic error of these rows is wrong",
        )


def _quantised(log: Log, name: str, values: np.ndarray, side: float, spread: float) -> Iterator[Finding]:
    """A note on the step of a channel.

    Args:
        log: For the unit.
        name: Signal.
        values: Its values.
        side: What divides a step of this channel to give one of the quantity that matters.
        spread: rms of the quantity that matters.
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
    about = "of the rms dynamic error" if name.endswith("_angle") else "of its own rms"
    yield Finding(
        "note",
        f"the values lie {step:.4g} {unit} apart, which is {100 * share:.2g} % {about}",
        name,
        "steps of a sensor act like noise of a twelfth of the squared step, and not quite white",
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


def _slow(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Amplitudes of the slowest cosines over the log, and their share in the variance.

    A wrong ratio shows at all frequencies, but near and above the resonance the two sides of a
    healthy drive disagree as well; in slow motion they cannot.
    """
    phase = (np.arange(len(values)) + 0.5) * (np.pi / len(values))
    centred = values - values.mean()
    modes = np.array([np.cos(k * phase) @ centred for k in range(1, SLOW_MODES + 1)])
    modes *= 2 / len(values)
    variance = float(centred @ centred) / len(values)
    return modes, float(modes @ modes) / 2 / variance if variance > 0 else 0.0


def _ratio(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    """Slope of the load angle against the motor angle in slow motion, against 1/N."""
    motor, load = _known(log, "motor_angle"), _known(log, "load_angle")
    ratio = drive_file.reduction_ratio
    if motor is None or load is None or ratio is None or len(motor) < 4 * FEWEST:
        return
    (slow_motor, motor_share), (slow_load, load_share) = _slow(motor), _slow(load)
    if min(motor_share, load_share) < SLOW_SHARE:
        return
    cross = float(slow_motor @ slow_load)
    norms = float(slow_motor @ slow_motor), float(slow_load @ slow_load)
    if abs(cross) < SLOW_CORRELATION * np.sqrt(norms[0] * norms[1]):
        return
    slope = cross / norms[0]
    where = "load_angle against motor_angle"
    if ratio > 1.5 and abs(abs(slope) / ratio - 1) < RATIO_TOLERANCE:
        yield Finding(
            "refusal",
            f"the load angle moves {abs(slope):.4g} times as far as the motor angle",
            where,
            "the motor and load columns seem swapped, so exchange them in [columns]",
        )
        return
    if slope < 0:
        yield Finding(
            "refusal",
            "the load angle moves against the motor angle",
            where,
            "give one of the two sign = -1 in [columns]",
        )
        return
    says = 1 / slope
    deviation = abs(slope * ratio - 1)
    span = max(float(np.ptp(load)), float(np.ptp(motor)) / ratio)
    neighbour = round(says) != ratio and abs(says - round(says)) < 0.02
    drifts = neighbour and deviation * span > FREE_MOTION
    if deviation <= RATIO_TOLERANCE and not drifts:
        return
    moved_freely = span > FREE_MOTION
    yield Finding(
        "refusal" if moved_freely else "warning",
        f"reduction_ratio says {ratio:g} but the angles say {_shown(says)}",
        where,
        _mend(says, ratio) if moved_freely else f"unless it was locked, {_mend(says, ratio)}",
    )


def _shown(ratio: float) -> str:
    return f"{ratio:.1f}" if 0.95 <= ratio < 1e5 else f"{ratio:.3g}"


def _mend(says: float, ratio: float) -> str:
    factor = says / ratio
    degrees = 180 / np.pi
    if abs(factor / degrees - 1) < RATIO_TOLERANCE:
        return 'motor_angle looks like degrees, so give it unit = "deg" in [columns]'
    if abs(factor * degrees - 1) < RATIO_TOLERANCE:
        return 'load_angle looks like degrees, so give it unit = "deg" in [columns]'
    if abs(says - 1) < RATIO_TOLERANCE:
        return f'both angles seem to be referred to one side, so give motor_angle unit = "{ratio:g} rad" in [columns]'
    return "correct the ratio in [drive] or the units of the angles in [columns]"


def _velocity(log: Log) -> Iterator[Finding]:
    """The logged velocity, integrated over the stamps, against the angle."""
    motor, velocity = _known(log, "motor_angle"), log.motor_velocity
    if motor is None or velocity is None or len(motor) < 4 * FEWEST:
        return
    velocity, time = velocity[: len(motor)], log.time[: len(motor)]
    if not np.all(np.isfinite(velocity)) or _is_constant(motor):
        return
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    path = np.concatenate(([0.0], np.cumsum(mean * np.diff(time))))
    moved, gone = motor - motor.mean(), path - path.mean()
    norms = float(moved @ moved), float(gone @ gone)
    if norms[1] == 0 or abs(moved @ gone) < 0.99 * np.sqrt(norms[0] * norms[1]):
        return
    factor = float(moved @ gone) / norms[1]
    if abs(factor - 1) > 0.02:
        yield Finding(
            "refusal" if abs(factor - 1) > 0.2 else "warning",
            f"the motor angle moves {factor:.4g} times as far as motor_velocity over time says",
            "motor_velocity",
            "the time base, the side or a unit is wrong, so correct [columns] time, motor_angle or motor_velocity",
        )
