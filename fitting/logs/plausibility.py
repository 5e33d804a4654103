"""Plausibility checks across signals: ratio, sides, signs, units, time base."""

import math
from collections.abc import Iterator

import numpy as np

from fitting.logs.drive_file import DriveFile
from fitting.logs.findings import Finding
from fitting.logs.log import Log
from fitting.logs.momenta import FEWEST, RATIO_TOLERANCE, behind_the_gear, both_sides, closest, motor_alone, path_of

# All thresholds are assumed; they separate healthy logs from faulty ones by a wide margin.
FREE_MOTION = 0.02  # rad of the output, more than any gear's twist; below it a load may be locked
LARGE_TWIST = 5e-3  # rad, more than a gear's twist within its ratings, assumed
# Ten times the twist of strain-wave gears at peak torque (vendors' catalogues); springs of elastic joints twist more.
GEAR_TWIST = 0.1
# Largest possible twist of a spring between motor and load, unless the drive file states another.
_TURN = 2.0 * math.pi
SLOW_MODES = 8
SLOW_SHARE = 0.5
SLOW_CORRELATION = 0.999
VELOCITY_TOLERANCE = 0.02
_UNITS = {"angle": {"deg": 180 / np.pi}, "velocity": {"deg/s": 180 / np.pi, "rpm": 30 / np.pi}}
_GAP = 5.0
# Largest condition number of two columns that are to be separated.
_APART = 30.0


def mix_ups(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    """Contradictions between the signals of a drive log.

    Args:
        log: A drive log, or one of both angles; a log of one side has no contradictions with the other. Outputs
            after `log.outputs_until` rows are not used.
        drive_file: The drive that it was read with.
    """
    if len(log.time[: log.outputs_until]) < 4 * FEWEST:
        return
    both = log.motor_angle is not None and log.load_angle is not None
    found = list(_ratio(log, drive_file))
    yield from found
    yield from _velocity(log, drive_file, "motor")
    yield from _velocity(log, drive_file, "load")
    # With a wrong ratio or side the sum of momenta adds no information.
    if not any(finding.severity == "refusal" for finding in found):
        yield from both_sides(log, drive_file) if both else motor_alone(log, drive_file)
        yield from behind_the_gear(log, drive_file)


def wide_twist(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    """A twist that exceeds that of gears, unless the drive file states the largest twist.

    Args:
        log: With a twist in radians. Outputs after `log.outputs_until` rows are not used.
        drive_file: The drive that it was read with.
    """
    twist = log.twist[: log.outputs_until]
    known = np.isfinite(twist) if log.trusted is None else np.isfinite(twist) & log.trusted[: len(twist)]
    most = drive_file.largest_twist
    span = float(np.ptp(twist[known])) if known.any() else 0.0
    if span <= (most or GEAR_TWIST):
        return
    moved = log.motor_angle is not None and log.load_angle is not None
    remedy = (
        "check reduction_ratio, and the columns, units and signs of the two angles in [columns]"
        if moved
        else 'give the column unit = "deg" or "arcmin" in [columns] if that is what it is; if it is a joint angle, '
        "lock the motor or log both angles"
    )
    if span > (most or _TURN):
        known_as = "a full turn" if most is None else f"the largest_twist of {most:.3g} rad in [drive]"
        yield Finding("refusal", f"the twist spans {span:.3g} rad, which is more than {known_as}", "twist", remedy)
        return
    yield Finding(
        "warning",
        f"the twist spans {span:.3g} rad, more than ten times the range of strain-wave gears",
        "twist",
        f"unless its spring is so soft (then state largest_twist in [drive]), {remedy}",
    )


def _slow(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Amplitudes of the slowest cosines over the log, and their share in the variance.

    A wrong ratio has an effect at all frequencies. Near and above the resonance both sides of a healthy drive differ as
    well; in slow motion they do not.
    """
    phase = (np.arange(len(values)) + 0.5) * (np.pi / len(values))
    centred = values - values.mean()
    modes = np.array([np.cos(k * phase) @ centred for k in range(1, SLOW_MODES + 1)])
    modes *= 2 / len(values)
    variance = float(centred @ centred) / len(values)
    return modes, float(modes @ modes) / 2 / variance if variance > 0 else 0.0


def _at_rest(slow_motor: np.ndarray, slow_load: np.ndarray) -> float:
    """Load angle over motor angle in motion so slow that the twist is negligible.

    The twist is a share of the motion that grows with the square of the frequency. Where the modes do not separate the
    two, their mean ratio is used.
    """
    squares = np.arange(1.0, SLOW_MODES + 1) ** 2
    columns = np.stack([slow_motor, squares * slow_motor], axis=1)
    norms = np.linalg.norm(columns, axis=0)
    if np.linalg.cond(columns / norms) > _APART:
        return float(slow_motor @ slow_load / norms[0] ** 2)
    return float((np.linalg.lstsq(columns / norms, slow_load)[0] / norms)[0])


def _motion(log: Log, side: str) -> tuple[str, np.ndarray] | None:
    """Signal and angle of a side, or else the integral of its velocity; None where that is unknown."""
    until, angle, velocity = log.outputs_until, getattr(log, f"{side}_angle"), getattr(log, f"{side}_velocity")
    if angle is not None:
        return f"{side}_angle", angle[:until]
    if velocity is None or log.pieces is not None or not np.isfinite(velocity[:until]).all():
        return None
    return f"{side}_velocity", path_of(log, velocity)[:until]


def _ratio(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    """Slope of the load's motion against the motor's in slow motion, against 1/N."""
    ratio = drive_file.reduction_ratio
    sides = [_motion(log, side) for side in ("motor", "load")]
    if ratio is None or None in sides:
        return
    (motor_name, motor), (load_name, load) = (side for side in sides if side is not None)
    if not motor_name.endswith("angle") or not load_name.endswith("angle"):
        # The integral of a velocity's zero error is a drift.
        motor, load = (values - np.linspace(values[0], values[-1], len(values)) for values in (motor, load))
    (slow_motor, motor_share), (slow_load, load_share) = _slow(motor), _slow(load)
    if min(motor_share, load_share) < SLOW_SHARE:
        return
    cross = float(slow_motor @ slow_load)
    norms = float(slow_motor @ slow_motor), float(slow_load @ slow_load)
    if abs(cross) < SLOW_CORRELATION * np.sqrt(norms[0] * norms[1]):
        return
    slope = _at_rest(slow_motor, slow_load)
    where, (of_motor, of_load) = (
        f"{load_name} against {motor_name}",
        (n.replace("_", " ") for n in (motor_name, load_name)),
    )
    if ratio > 1.5 and abs(abs(slope) / ratio - 1) < RATIO_TOLERANCE:
        yield Finding(
            "refusal",
            f"the {of_load} moves {abs(slope):.4g} times as far as the {of_motor}",
            where,
            "the motor and load columns seem swapped, so exchange them in [columns]",
        )
        return
    if slope < 0:
        yield Finding(
            "refusal",
            f"the {of_load} moves against the {of_motor}",
            where,
            "give one of the two sign = -1 in [columns]",
        )
        return
    says = 1 / slope
    deviation = abs(slope * ratio - 1)
    span = max(float(np.ptp(load)), float(np.ptp(motor)) / ratio)
    neighbour = round(says) != ratio and abs(says - round(says)) < 0.02
    drifts = neighbour and deviation * span > LARGE_TWIST
    if deviation <= RATIO_TOLERANCE and not drifts:
        return
    mend = _mend(says, ratio, motor_name, load_name)
    possible = LARGE_TWIST if deviation > RATIO_TOLERANCE else FREE_MOTION
    if span <= FREE_MOTION:
        severity, consequence = "warning", f"unless it was locked, {mend}"
    elif deviation * span <= (drive_file.largest_twist or possible):
        severity, consequence = "warning", f"unless slow torque twists the gear by {deviation * span:.2g} rad, {mend}"
    else:
        soft = "if its spring is so soft, state the largest_twist of the joint in [drive]"
        severity, consequence = "refusal", f"{mend}; {soft}"
    yield Finding(
        severity,
        f"reduction_ratio is {ratio:g} but the {_both(motor_name, load_name)} give {_shown(says)}",
        where,
        consequence,
    )


def _shown(ratio: float) -> str:
    return f"{ratio:.1f}" if 0.95 <= ratio < 1e5 else f"{ratio:.3g}"


def _both(motor: str, load: str) -> str:
    kinds = {name.split("_")[1] for name in (motor, load)}
    return {"angle": "angles", "velocity": "velocities"}[kinds.pop()] if len(kinds) == 1 else f"{motor} and {load}"


def _mend(says: float, ratio: float, motor: str, load: str) -> str:
    factor = says / ratio
    for name, seen in ((motor, factor), (load, 1.0 / factor)):
        for unit, size in _UNITS[name.split("_")[1]].items():
            if abs(seen / size - 1) < RATIO_TOLERANCE:
                looks = {"deg": "degrees", "deg/s": "degrees"}.get(unit, unit)
                return f'{name} looks like {looks}, so give it unit = "{unit}" in [columns]'
    if abs(says - 1) < RATIO_TOLERANCE:
        unit = f"{ratio:g} rad" if motor.endswith("angle") else f"{ratio:g} rad/s"
        return (
            f'both {_both(motor, load)} seem to be referred to one side, so give {motor} unit = "{unit}" in [columns]'
        )
    return f"correct the ratio in [drive] or the units of {motor} and {load} in [columns]"


def _velocity(log: Log, drive_file: DriveFile, side: str) -> Iterator[Finding]:
    """Compare a logged velocity, integrated over time, with the angle."""
    name, ratio = f"{side}_velocity", drive_file.reduction_ratio or 1.0
    angle, velocity = getattr(log, f"{side}_angle"), getattr(log, name)
    if velocity is None or angle is None or np.all(angle == angle[0]):
        return
    velocity = velocity[: log.outputs_until]
    known = np.isfinite(velocity)
    if log.trusted is not None:
        known &= log.trusted[: len(known)]
    if known.sum() < 4 * FEWEST:
        return
    time, angle, velocity = log.time[: len(known)][known], angle[: len(known)][known], velocity[known]
    step = np.diff(time)
    through = step < _GAP * np.median(step)
    path = np.cumsum(np.where(through, 0.5 * (velocity[1:] + velocity[:-1]) * step, 0.0))
    moved = np.cumsum(np.where(through, np.diff(angle), 0.0))
    moved, gone = moved - moved.mean(), path - path.mean()
    norms = float(moved @ moved), float(gone @ gone)
    if norms[1] == 0 or abs(moved @ gone) < 0.99 * np.sqrt(norms[0] * norms[1]):
        return
    factor = float(moved @ gone) / norms[1]
    if abs(factor - 1) <= VELOCITY_TOLERANCE:
        return
    units = {
        "is of the other sign, so give it sign = -1": -1.0,
        f'looks like the output side\'s, so give it unit = "{ratio:g} rad/s"': ratio,
        f'looks like the motor side\'s, so give it unit = "rad/s / {ratio:g}"': 1.0 / ratio,
        'looks like rpm, so give it unit = "rpm"': 2 * np.pi / 60,
        'looks like degrees, so give it unit = "deg/s"': np.pi / 180,
    }
    mend = closest(factor, units, 1.0)
    harmless = mend is not None or abs(factor - 1) <= 0.2
    yield Finding(
        "warning" if harmless else "refusal",
        f"the {side} angle moves {factor:.4g} times as far as the integral of {name}",
        name,
        f"{name} {mend}; it is not fitted"
        if mend
        else f"the time base, the side or a unit is wrong, so correct [columns] time, {side}_angle or {name}",
    )
