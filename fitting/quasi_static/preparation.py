"""Quasi-static logs made ready for their fit: how the joint moved, which rows count, and what is refused."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.integrate import cumulative_trapezoid

from fitting.errors import DataError
from fitting.logs.checks import examine, refuse_unfit
from fitting.logs.drive_file import DriveFile
from fitting.logs.findings import Finding
from fitting.logs.gaps import SHORTEST
from fitting.logs.log import Log
from fitting.logs.plausibility import FREE_MOTION
from fitting.quasi_static.blocks import means

Motion = Literal["held", "one way", "both ways", "unknown"]
MOVES: tuple[Motion, ...] = ("one way", "both ways")

# More than any gear bears: vendors' drives twist by less than 0.01 rad at their peak torque.
LARGEST_TWIST = 0.1
# Assumed: the part of the typical speed above which friction is that of steady motion.
_STEADY = 0.7
# Correlation of means over a hundredth of the log; even a wide loop stays above it.
_UNRELATED = 0.3


@dataclass(frozen=True, eq=False)
class QuasiStaticData:
    """Logs of one drive, ready to be fitted.

    Attributes:
        drive_file: The drive.
        logs: Of the rows that count.
        motion: How the joint moved in each log.
        findings: By name of the log.
    """

    drive_file: DriveFile
    logs: tuple[Log, ...]
    motion: tuple[Motion, ...]
    findings: dict[str, tuple[Finding, ...]]


def prepare(logs: Sequence[Log], drive_file: DriveFile, *, at_rest: bool = False) -> QuasiStaticData:
    """Check quasi-static logs and leave out the rows in which friction has no known sign.

    Args:
        logs: Of kind "quasi-static".
        drive_file: The drive that they were read with.
        at_rest: Whether rows at rest of a joint that moved stay, for who reckons with friction of their own. What
            depends on the angle may then hide how the twist follows the torque, too.

    Returns:
        What can be fitted.

    Raises:
        DataError: A log can't be fitted; the sentence says why.
    """
    ready, motions, findings = [], [], {}
    for log in logs:
        seen = examine(log, drive_file)
        refuse_unfit(seen, log)
        # The findings of the reader tell of the rows in which torque or angles were not measured.
        masks = [mask for mask in (log.trusted, log.input_known) if mask is not None]
        known = replace(
            _rows(log, np.logical_and.reduce([np.isfinite(log.time), *masks])), trusted=None, input_known=None
        )
        speed = speed_of(known, drive_file.reduction_ratio)
        motion = _motion(known, speed)
        _refuse_mix_ups(log, must_follow=not (at_rest and motion in MOVES))
        kept, more = _steady(known, speed) if motion in MOVES and not at_rest else (known, ())
        ready.append(kept)
        motions.append(motion)
        findings[log.name] = (*seen, *more)
    return QuasiStaticData(drive_file, tuple(ready), tuple(motions), findings)


def torque_of(log: Log) -> np.ndarray:
    """Joint torque of a quasi-static log, which always has one [N m], (n,)."""
    assert log.joint_torque is not None
    return log.joint_torque


def _refuse_mix_ups(log: Log, *, must_follow: bool) -> None:
    torque, twist = torque_of(log), log.dynamic_error
    span = float(np.ptp(twist))
    if span > LARGEST_TWIST:
        moved = log.motor_angle is not None
        remedy = (
            "correct reduction_ratio, or the units and signs of the two angles in [columns]"
            if moved
            else 'give the column unit = "deg" or "arcmin" in [columns] if that is what it is; if it is a joint angle, '
            "lock the motor or log both angles"
        )
        raise DataError(
            f"{log.path}: the twist spans {span:.3g} rad, which is more than the {LARGEST_TWIST} rad that any gear "
            f"bears; {remedy}"
        )
    size = max(1, len(log) // 100)
    with np.errstate(invalid="ignore"):
        # Means that never change have no correlation.
        likeness = float(np.nan_to_num(np.corrcoef(means(torque, size), means(twist, size))[0, 1]))
    if abs(likeness) < _UNRELATED and must_follow:
        raise DataError(
            f"{log.path}: the twist does not follow the joint torque (their correlation is {likeness:.2g}); check "
            "which columns they are, or record larger torque cycles"
        )
    if likeness < -_UNRELATED:
        raise DataError(
            f"{log.path}: the twist falls where the joint torque rises; give one of the two sign = -1 in [columns]"
        )


def speed_of(log: Log, ratio: float | None) -> np.ndarray:
    """Speed of the joint [rad/s], smoothed over a few rows; not a number where nothing tells it.

    Args:
        log: The log.
        ratio: Reduction ratio, or None.
    """
    rows = max(3, len(log) // 200)
    if log.motor_angle is not None and ratio is not None:
        at = np.arange(len(log))
        ends = np.minimum(at + rows, len(log) - 1), np.maximum(at - rows, 0)
        angle, time = (values[ends[0]] - values[ends[1]] for values in (log.motor_angle / ratio, log.time))
        return angle / time
    velocity = np.full(len(log), np.nan) if log.motor_velocity is None else log.motor_velocity
    return np.convolve(velocity / (ratio or 1.0), np.ones(rows) / rows, mode="same")


def _motion(log: Log, speed: np.ndarray) -> Motion:
    if not np.all(np.isfinite(speed)):
        return "unknown"
    if _travel(log, speed) < FREE_MOTION:
        return "held"
    steady = speed[_is_steady(speed)]
    return "both ways" if min(np.mean(steady > 0), np.mean(steady < 0)) > 0.05 else "one way"


def _travel(log: Log, speed: np.ndarray) -> float:
    """How far the joint got [rad]."""
    return float(np.ptp(cumulative_trapezoid(speed, log.time, initial=0)))


def _is_steady(speed: np.ndarray) -> np.ndarray:
    return np.abs(speed) > _STEADY * np.percentile(np.abs(speed), 90)


def _steady(log: Log, speed: np.ndarray) -> tuple[Log, tuple[Finding, ...]]:
    """The rows of steady motion of a joint that moved.

    While a joint moves, friction is a torque of known sign. At rest it takes any value up to sticking, so that rows at
    rest don't belong to the same curve.
    """
    steady = _is_steady(speed)
    left_out = int(np.sum(~steady))
    if left_out == 0:
        return log, ()
    if len(log) - left_out < SHORTEST:
        raise DataError(
            f"{log.path}: the joint moves steadily in only {len(log) - left_out} rows, which is fewer than the "
            f"{SHORTEST} that a fit needs; record a longer sweep at constant speed, or hold the joint"
        )
    told = Finding(
        "note",
        f"the joint moved by {_travel(log, speed):.3g} rad, and in {left_out} rows it was at rest or slower than "
        f"{100 * _STEADY:.0f} % of its usual speed",
        "all columns",
        "these rows were left out, since friction at rest has no known sign",
    )
    return _rows(log, steady), (told,)


def _rows(log: Log, kept: np.ndarray) -> Log:
    return replace(log, **{name: v[kept] for name, v in vars(log).items() if isinstance(v, np.ndarray)})
