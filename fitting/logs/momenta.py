"""Torque against the rate of change of momentum: its sign and its unit."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from fitting.logs.drive_file import DriveFile
from fitting.logs.findings import Finding
from fitting.logs.log import Log

# All thresholds are assumed; they separate healthy logs from faulty ones by a wide margin.
RATIO_TOLERANCE = 0.02
FEWEST = 50
MOMENTUM_CORRELATION = 0.98
# Of both sides, where the spring cancels and friction at rest is all that is not described: it lowers the gain to 0.8.
_BOTH_SIDES_CORRELATION = 0.9
MOMENTUM_TOLERANCE = 0.15
# Largest factor of an inertia that may be the inertia's own error, and least one that no inertia is wrong by.
_INERTIA_FACTOR, _IMPOSSIBLE_FACTOR = 3.0, 10.0
# Windows over a log, from slow motion to quick motion. Friction and gravity are estimated as well, which takes several;
# the range in which a drive is rigid may be narrow.
_COUNTS = (16, 32, 64, 128, 256)
# Share of a regressor that must differ from the others for it to count.
_INDEPENDENT = 1e-6


def closest(factor: float, known: Mapping[str, float], usual: float, tolerance: float = RATIO_TOLERANCE) -> str | None:
    """The explanation of a factor, unless it is as close to the default."""
    words, value = min(known.items(), key=lambda item: abs(factor / item[1] - 1))
    likely = abs(value / usual - 1) > 2 * tolerance and abs(factor / value - 1) < tolerance
    return words if likely else None


def both_sides(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    """Compare the rate of change of both inertias' momenta with the external torque; the mesh torque cancels.

    N J_m theta_m'' + J_l theta_l'' = N T_m + T_l + friction + gravity, multiplied by test functions and integrated by
    parts, so that no angle is differentiated.
    """
    N, J_m, J_l = drive_file.reduction_ratio, drive_file.motor_inertia, drive_file.load_inertia
    if None in (N, J_m, J_l) or not _usable(log):
        return
    assert log.motor_angle is not None and log.load_angle is not None and log.motor_torque is not None
    assert N is not None and J_m is not None and J_l is not None
    momentum = N * J_m * (log.motor_angle - log.motor_angle[0]) + J_l * (log.load_angle - log.load_angle[0])
    torque = N * log.motor_torque + (0.0 if log.load_torque is None else log.load_torque)
    others = [*_friction(log.motor_angle, _rate(log, log.motor_angle), 1), *_gravity(log.load_angle)]
    best, gain = 0.0, 1.0
    for count in _COUNTS:
        table = _weak(log, [(momentum, 2), (torque, 0), *others], count)
        if not np.isfinite(table**2).all():
            continue
        for columns in (table[:, 2:], table[:, :0]):
            alike, slope = _slope(*_beside(table[:, 0], table[:, 1], columns))
            if alike > best:
                best, gain = alike, slope
    if best < _BOTH_SIDES_CORRELATION:
        return
    if not _has_scale(drive_file):
        gain = float(np.sign(gain))
    if 1.0 / _INERTIA_FACTOR < gain < _INERTIA_FACTOR:
        return
    what = f"both inertias together accelerate {gain:.3g} times as much as the torque explains"
    where = "motor_torque against motor_angle and load_angle"
    if gain < 0.0:
        yield _finding(what, where, _against("both angles"))
        return
    units = _torque_units(N) | {
        'both angles look like degrees, so give them unit = "deg"': 180 / np.pi,
        'both angles look like revolutions, so give them unit = "rev"': 1 / (2 * np.pi),
    }
    possible = 1.0 / _IMPOSSIBLE_FACTOR < gain < _IMPOSSIBLE_FACTOR
    mend = closest(gain, units, 1.0, MOMENTUM_TOLERANCE)
    yield _finding(what, where, mend, possible=possible)


def motor_alone(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    """Compare the motor's acceleration with its torque, where the other side's angle was not logged.

    T_m + T_l / N = J theta_m'' + friction + gravity + k theta_m, in weak form. J is J_m + J_l/N^2 in slow motion and
    J_m above the resonance. Between antiresonance and resonance J is negative without k, but not with it: the dynamic
    stiffness falls with frequency (Foster 1924). So only what both estimates agree on counts.
    """
    name = _motor_signal(log)
    if name is None or not _usable(log):
        return
    J, lost = _apparent_inertia(log, name, drive_file.reduction_ratio)
    where = f"motor_torque against {name}"
    # Any drive loses energy: what seems to gain some has a torque of the wrong sign.
    if J < 0.0 and lost < 0.0:
        yield _finding("the motor accelerates against its torque", where, _against(name))
    N, J_m, J_l = drive_file.reduction_ratio, drive_file.motor_inertia, drive_file.load_inertia
    if N is None or J_m is None or J_l is None or not J > 0.0 or not _has_scale(drive_file):
        return
    whole = J_m + J_l / N**2
    if J_m / _INERTIA_FACTOR < J < whole * _INERTIA_FACTOR:
        return
    gain = whole / J
    units = _torque_units(N) | (
        {
            'motor_angle looks like degrees, so give it unit = "deg"': 180 / np.pi,
            'motor_angle looks like revolutions, so give it unit = "rev"': 1 / (2 * np.pi),
        }
        if name == "motor_angle"
        else {
            'motor_velocity looks like degrees, so give it unit = "deg/s"': 180 / np.pi,
            'motor_velocity looks like rpm, so give it unit = "rpm"': 30 / np.pi,
        }
    )
    mend = closest(gain, units, 1.0, MOMENTUM_TOLERANCE)
    # Near the antiresonance J is large; a factor that is no unit's tells nothing.
    if mend is not None:
        yield _finding(f"motor and load accelerate {gain:.3g} times as much as the torque explains", where, mend)


def _motor_signal(log: Log) -> str | None:
    """Name of the signal that shows the motor's motion; None without one."""
    return next((s for s in ("motor_angle", "motor_velocity") if getattr(log, s) is not None), None)


def _motion(log: Log, name: str) -> tuple[np.ndarray, np.ndarray, int]:
    """The motor's signal, its velocity, and the order of the derivative that the signal is."""
    seen = getattr(log, name)
    return (seen, seen, 1) if name == "motor_velocity" else (seen, _rate(log, seen), 0)


def _usable(log: Log) -> bool:
    """Whether momenta can be compared."""
    return log.motor_torque is not None and log.outputs_until is None


def _has_scale(drive_file: DriveFile) -> bool:
    """Whether the torque has a scale: a free torque constant has none."""
    return math.isfinite(drive_file.tolerances.get("k_T", 0.0))


def _finding(what: str, where: str, mend: str | None, *, possible: bool = True) -> Finding:
    otherwise = (
        'check motor_inertia and load_inertia in [drive], or write "fit" for one, and the units of motor_torque, '
        "angles and time in [columns]"
    )
    severity = "refusal" if mend or not possible else "warning"
    return Finding(severity, what, where, f"{mend} in [columns]" if mend else otherwise)


def _against(motion: str) -> str:
    return f"motor_torque acts against the motion, so give it, or {motion}, sign = -1"


def _torque_units(N: float) -> dict[str, float]:
    """What may be wrong with a torque or the time, by the factor by which the drive then seems to accelerate."""
    return {
        'motor_torque looks like mN m, so give it unit = "mN m"': 1e-3,
        'motor_torque looks like kN m, so give it unit = "kN m"': 1e3,
        f'motor_torque looks like that of the output side, so give it unit = "N m / {N:g}"': 1 / N,
        f'motor_torque looks too small by the ratio, so give it unit = "{N:g} N m"': N,
        'the time looks like milliseconds, so give it unit = "ms"': 1e-6,
        'the time looks like microseconds, so give it unit = "us"': 1e-12,
    }


def behind_the_gear(log: Log, drive_file: DriveFile) -> Iterator[Finding]:
    """Compare the joint torque with what the motor's torque leaves for it, in weak form.

    T_m = J_m theta_m'' + tau / N + friction + bias; the friction's coefficients and J_m are estimated as well.
    """
    name = _motor_signal(log)
    N, tau = drive_file.reduction_ratio, log.joint_torque
    if name is None or N is None or tau is None or not _usable(log) or not _has_scale(drive_file):
        return
    assert log.motor_torque is not None
    seen, velocity, order = _motion(log, name)
    friction = _friction(seen, velocity, 1 - order)
    best, gain = 0.0, 1.0
    for count in _COUNTS:
        table = _weak(log, [(log.motor_torque, 0), (tau / N, 0), (seen, 2 - order), *friction], count)
        if np.isfinite(table**2).all():
            alike, slope = _slope(*_beside(table[:, 0], table[:, 1], table[:, 2:]))
            best, gain = max((best, gain), (alike, slope))
    if best < _BOTH_SIDES_CORRELATION or 1.0 / _INERTIA_FACTOR < gain < _INERTIA_FACTOR:
        return
    units = {
        'joint_torque looks like mN m, so give it unit = "mN m"': 1e-3,
        'joint_torque looks like kN m, so give it unit = "kN m"': 1e3,
        f'joint_torque looks like that of the motor side, so give it unit = "{N:g} N m"': N,
    }
    mend = "give one of the two sign = -1" if gain < 0.0 else closest(gain, units, 1.0, MOMENTUM_TOLERANCE)
    what = f"the torque that the motor passes on is {gain:.3g} times the joint torque"
    otherwise = "check reduction_ratio in [drive], and the units of joint_torque and motor_torque in [columns]"
    yield Finding("refusal", what, "joint_torque", f"{mend} in [columns]" if mend else otherwise)


def _apparent_inertia(log: Log, name: str, ratio: float | None) -> tuple[float, float]:
    """Inertia at the motor [kg m^2], zero where the log does not tell it, and the work of the torque less the kinetic
    energy of this inertia [J]."""
    assert log.motor_torque is not None
    seen, velocity, order = _motion(log, name)
    path = path_of(log, seen) if order else seen - seen[0]
    torque = log.motor_torque + (0.0 if log.load_torque is None or ratio is None else log.load_torque / ratio)
    friction = _friction(seen, velocity, 1 - order)
    position = [(path, 0), *(() if ratio is None else _gravity(path / ratio))]
    best, inertia = MOMENTUM_CORRELATION, 0.0
    for count in _COUNTS:
        table = _weak(log, [(torque, 0), (seen, 2 - order), *friction, *position], count)
        if not np.isfinite(table**2).all():
            continue
        pushes, changes = table[:, 0], table[:, 1]
        found = [_slope(*_beside(pushes, changes, table[:, 2:stop])) for stop in (2 + len(friction), table.shape[1])]
        (rigid, J), (alike, J_beside) = found
        agree = J * J_beside > 0.0 and abs(J_beside / J - 1.0) < MOMENTUM_TOLERANCE
        if agree and min(rigid, alike) > best:
            best, inertia = min(rigid, alike), J
    lost = 0.0
    for a, b in _pieces(log):
        work = np.sum(0.5 * (torque[a + 1 : b] + torque[a : b - 1]) * np.diff(path[a:b]))
        lost += float(work - 0.5 * inertia * (velocity[b - 1] ** 2 - velocity[a] ** 2))
    return inertia, lost


def path_of(log: Log, velocity: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Integral of a velocity from the first row [rad]."""
    return np.cumsum(np.append(0.0, 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(log.time)))


def _rate(log: Log, angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Rate of change inside each stretch [rad/s]."""
    rate = np.zeros_like(angle)
    for a, b in _pieces(log):
        rate[a:b] = np.gradient(angle[a:b], log.time[a:b])
    return rate


def _friction(seen: np.ndarray, velocity: np.ndarray, order: int) -> list[tuple[np.ndarray, int]]:
    """Regressors of dry and viscous friction and a bias, with orders of derivatives."""
    return [(np.sign(velocity), 0), (seen, order), (np.ones_like(seen), 0)]


def _gravity(angle: np.ndarray) -> list[tuple[np.ndarray, int]]:
    """Regressors of gravity on the load at its angle."""
    return [(np.sin(angle), 0), (np.cos(angle), 0)]


def _beside(
    pushes: Float[np.ndarray, " windows"],
    changes: Float[np.ndarray, " windows"],
    others: Float[np.ndarray, "windows others"],
) -> tuple[Float[np.ndarray, " windows"], Float[np.ndarray, " windows"]]:
    """Two series less what other regressors explain (Frisch and Waugh 1933); zero where nothing of them is left."""
    norms = np.linalg.norm(others, axis=0)
    others = others[:, norms > 0] / norms[norms > 0]
    both = np.stack([pushes, changes], axis=1)
    left = both - others @ np.linalg.lstsq(others, both, rcond=_INDEPENDENT)[0]
    left[:, np.linalg.norm(left, axis=0) < _INDEPENDENT * np.linalg.norm(both, axis=0)] = 0.0
    return left[:, 0], left[:, 1]


def _slope(one: Float[np.ndarray, " windows"], other: Float[np.ndarray, " windows"]) -> tuple[float, float]:
    """Size of the correlation of two series about zero, and the slope of the first over the second."""
    norms = float(one @ one), float(other @ other)
    if min(norms) == 0 or not np.isfinite(norms).all():
        return 0.0, 1.0
    together = float(one @ other)
    return abs(together) / np.sqrt(norms[0] * norms[1]), together / norms[1]


def _weak(
    log: Log, signals: Sequence[tuple[Float[np.ndarray, " n"], int]], count: int
) -> Float[np.ndarray, "windows signals"]:
    """Integrals of derivatives of signals times phi = (1 - s^2)^4 over windows; zero where these are short.

    Args:
        log: for its stamps [s], and its pieces, which no window leaves.
        signals: each with the order of its derivative, which is moved to phi.
        count: number of windows of a log without gaps.
    """
    windows = _windows(log, count)
    found = np.zeros((len(windows), len(signals)))
    for i, (a, b) in enumerate(windows):
        if b - a < 16:
            continue
        t = log.time[a:b]
        half = 0.5 * (t[-1] - t[0])
        s = (t - t[0]) / half - 1.0
        weight = np.gradient(t)
        phi = (1 - s**2) ** 4, 8 * s * (1 - s**2) ** 3 / half, 8 * (1 - s**2) ** 2 * (7 * s**2 - 1) / half**2
        for k, (values, order) in enumerate(signals):
            found[i, k] = np.sum(weight * phi[order] * (values[a:b] - (values[a] if order else 0.0)))
    return found


def _windows(log: Log, count: int) -> list[tuple[int, int]]:
    """First row of each window and one past its last; pieces have windows in proportion to their length."""
    total = sum(b - a for a, b in _pieces(log))
    edges = [
        np.linspace(a, b, max(1, round(count * (b - a) / total)) + 1).astype(int).tolist() for a, b in _pieces(log)
    ]
    return [window for piece in edges for window in pairwise(piece)]


def _pieces(log: Log) -> tuple[tuple[int, int], ...]:
    """The stretches without gaps."""
    return log.pieces or ((0, len(log)),)
