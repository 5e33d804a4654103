"""Preparation of quasi-static logs: motion of the joint, valid rows, and checks that refuse a log."""

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
from fitting.quasi_static.torque_sign import compliance

Motion = Literal["held", "one way", "both ways", "unknown"]
MOVES: tuple[Motion, ...] = ("one way", "both ways")

# Assumed: share of the typical speed above which the motion counts as steady.
_STEADY = 0.7
# Least correlation of means over a hundredth of the log; even a wide loop has more.
_UNRELATED = 0.3


@dataclass(frozen=True, eq=False)
class QuasiStaticData:
    """Prepared logs of one drive.

    Attributes:
        drive_file: The drive.
        logs: With valid rows only.
        motion: How the joint moved in each log.
        findings: By name of the log.
    """

    drive_file: DriveFile
    logs: tuple[Log, ...]
    motion: tuple[Motion, ...]
    findings: dict[str, tuple[Finding, ...]]


def prepare(logs: Sequence[Log], drive_file: DriveFile, *, at_rest: bool = False) -> QuasiStaticData:
    """Check quasi-static logs and omit the rows in which friction has no known sign.

    Args:
        logs: Of kind "quasi-static".
        drive_file: The drive that they were read with.
        at_rest: Whether rows at rest of a moving joint are kept, for models with friction at rest. Angle-dependent
            effects may then also mask how the twist depends on the torque.

    Returns:
        What can be fitted.

    Raises:
        DataError: A log can't be fitted; the message states why.
    """
    ready, motions, findings = [], [], {}
    for log in logs:
        seen = examine(log, drive_file)
        refuse_unfit(seen, log)
        known = believed(log)
        speed = speed_of(known, drive_file.reduction_ratio)
        motion = _motion(known, speed)
        moves = motion in MOVES
        steady, more = _steady(known, speed) if moves else (known, ())
        rows = _is_steady(speed) if moves else slice(None)
        doubt = _refuse_mix_ups(steady, speed[rows], moves=moves, must_follow=not (at_rest and moves))
        kept, more = (known, ()) if at_rest else (steady, more)
        ready.append(kept)
        motions.append(motion)
        findings[log.name] = (*seen, *doubt, *more)
    return QuasiStaticData(drive_file, tuple(ready), tuple(motions), findings)


def believed(log: Log) -> Log:
    """The rows in which torque and angles are valid; the reader's findings report the others."""
    masks = [mask for mask in (log.trusted, log.input_known) if mask is not None]
    return replace(_rows(log, np.logical_and.reduce([np.isfinite(log.time), *masks])), trusted=None, input_known=None)


def torque_of(log: Log) -> np.ndarray:
    """Joint torque of a quasi-static log, which always has one [N m], (n,)."""
    assert log.joint_torque is not None
    return log.joint_torque


def _refuse_mix_ups(log: Log, speed: np.ndarray, *, moves: bool, must_follow: bool) -> tuple[Finding, ...]:
    """Refuse a torque of the wrong sign, and a twist that does not depend on the torque; warn where only one stretch of
    the log indicates a wrong sign.

    Args:
        log: With valid rows only.
        speed: Of the joint there [rad/s].
        moves: Whether the joint moved.
        must_follow: Whether the twist must depend on the torque.
    """
    torque, twist = torque_of(log), log.twist
    slope, classical, robust = compliance(log, speed, moves=moves)
    if slope < -robust:
        raise DataError(
            f"{log.path}: the twist falls where the joint torque rises; give one of the two sign = -1 in [columns]"
        )
    size = max(1, len(log) // 100)
    with np.errstate(invalid="ignore"):
        # Constant means have no correlation.
        likeness = float(np.nan_to_num(np.corrcoef(means(torque, size), means(twist, size))[0, 1]))
    if must_follow and abs(slope) < classical and abs(likeness) < _UNRELATED:
        raise DataError(
            f"{log.path}: the twist does not follow the joint torque (their correlation is {likeness:.2g}); check "
            "which columns they are, or record larger torque cycles"
        )
    if slope >= -classical:
        return ()
    return (
        Finding(
            "warning",
            f"the twist seems to fall where the joint torque rises (by {-slope:.2g} rad/(N m)), as no spring does",
            "joint_torque",
            "the logs are not conclusive: unless another effect causes this, give the torque or the twist sign = -1 "
            "in [columns]",
        ),
    )


def speed_of(log: Log, ratio: float | None) -> np.ndarray:
    """Speed of the joint [rad/s], smoothed over a few rows; NaN where it is unknown.

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
    """Range of the joint's motion [rad]."""
    return float(np.ptp(cumulative_trapezoid(speed, log.time, initial=0)))


def _is_steady(speed: np.ndarray) -> np.ndarray:
    return np.abs(speed) > _STEADY * np.percentile(np.abs(speed), 90)


def _steady(log: Log, speed: np.ndarray) -> tuple[Log, tuple[Finding, ...]]:
    """The rows of steady motion of a moving joint.

    While a joint moves, friction is a torque of known sign. At rest it may have any value up to the breakaway torque,
    so that rows at rest do not lie on the same curve.
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
