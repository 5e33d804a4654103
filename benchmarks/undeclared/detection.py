"""When is an effect there to be found at all? The benchmark's definition of the detection limit.

The logs are cut into segments of six natural periods, as a fit would. Each is simulated without the effect from its
true state under the torque that was commanded. What then differs in the two encoders' readings, less what other base
parameters (K, K alpha, B_sp, one set for all logs) and other initial states (for each segment) would absorb, is the
effect's trace. Its norm in units of the encoders' noise, sqrt(trace' C^-1 trace) with the noise's covariance C, is the
distance d between "with" and "without" that the best possible test has. Of it the held-out fifth of the data sees
d sqrt(0.2).

At the limit that is 5.5: 3.9 for an error of the first kind of 1e-4 (one percent over about a hundred forms and shapes)
and 1.6 for finding it in 95 of 100 cases.
"""

import functools
from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular

from undeclared.mechanism import Mechanism
from undeclared.noise import Encoders

LIMIT = 5.5
_HELD_OUT = 0.2
_PERIODS = 6.0
_STEPS_A_PERIOD = 60
# Steps of Gauss and Newton at most, and the share of the trace that a further one must leave at most: quick creep adds
# several percent to K, far beyond the first order.
_PASSES, _FALLS = 8, 0.9
# A typical twist [rad].
_TWIST = 1e-3


def detectability(
    base: Mechanism,
    logs: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
    *,
    encoders: Encoders,
    dt: float,
) -> float:
    """Strength of what is hidden in units of the detection limit.

    Args:
        base: the drive without it.
        logs: for each, the true states (samples, at least 4), what noiseless encoders read (samples, 2), motor torque
            and load torque.
        encoders: with their noise.
        dt: sampling interval [s].
    """
    length = int(round(_PERIODS * 2 * np.pi / base.omega_0 / dt))
    substeps = max(1, int(np.ceil(_STEPS_A_PERIOD * dt * base.omega_0 / (2 * np.pi))))
    starts = [np.arange(0, len(torque) - length, length) for _, _, torque, _ in logs]
    factors = np.linalg.cholesky(encoders.covariances(length))
    states = [own[first, :4] for (own, *_), first in zip(logs, starts, strict=True)]
    least = np.inf
    for _ in range(_PASSES):
        seen = [
            _trace(base, own, log, first[:, None] + np.arange(length), factors, dt, substeps)
            for log, first, own in zip(logs, starts, states, strict=True)
        ]
        # A step too far ends in a simulation that diverges.
        if not all(np.isfinite(part).all() for parts in seen for part in parts):
            break
        step, trace = _absorbed(seen)
        if not trace < _FALLS * least:
            break
        least = trace
        base, states = _moved(base, states, step, seen)
    return float(np.sqrt(_HELD_OUT * max(least, 0.0)) / LIMIT)


def _trace(
    base: Mechanism,
    states: np.ndarray,
    log: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    window: np.ndarray,
    factors: np.ndarray,
    dt: float,
    substeps: int,
) -> tuple[np.ndarray, np.ndarray]:
    """What differs in each segment's readings (segments, rows), and its derivatives by base parameters and initial
    states, (segments, rows, 7)."""
    _, readings, torque, brake = log
    variants = _variants(base, states)
    with np.errstate(all="ignore"):
        runs = [_segments(p, y, torque[window], brake[window], dt, substeps) for p, y, _ in variants]
        moves = [(run - runs[0]) / size for run, (_, _, size) in zip(runs[1:], variants[1:], strict=True)]
        slopes = np.stack([_white(move, factors) for move in moves], axis=-1)
    return _white(readings[window] - runs[0], factors), slopes


def _absorbed(seen: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, float]:
    """The change of the base parameters that absorbs most, and the sum of squares that is left."""
    normal, right, left = np.zeros((3, 3)), np.zeros(3), 0.0
    for difference, slopes in seen:
        both = np.concatenate([slopes[..., :3], difference[..., None]], axis=-1)
        local = np.linalg.qr(slopes[..., 3:]).Q
        both = both - local @ (np.swapaxes(local, 1, 2) @ both)
        normal += np.einsum("sir,sic->rc", both[..., :3], both[..., :3])
        right += np.einsum("sir,si->r", both[..., :3], both[..., 3])
        left += float(np.sum(both[..., 3] ** 2))
    step = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
    return step, float(left - right @ step)


def _moved(
    base: Mechanism, states: Sequence[np.ndarray], step: np.ndarray, seen: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[Mechanism, list[np.ndarray]]:
    """Base parameters and initial states after a step of Gauss and Newton."""
    scales, moved = _scales(base), []
    for own, (difference, slopes) in zip(states, seen, strict=True):
        found = np.linalg.qr(slopes[..., 3:])
        rest = np.swapaxes(found.Q, 1, 2) @ (difference - slopes[..., :3] @ step)[..., None]
        moved.append(own + np.linalg.solve(found.R, rest)[..., 0] * scales)
    k1, k3, c1 = base.k1 * (1 + step[0]), base.k3 + step[1] * base.k1 / _TWIST**2, base.c1 * (1 + step[2])
    return base._replace(k1=k1, k3=k3, c1=c1), moved


def _white(readings: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Both readings of a segment in one row, with their noise made white, from Cholesky factors of its covariance."""
    # What diverges is not finite, and is told from that.
    whitened = functools.partial(solve_triangular, lower=True, check_finite=False)
    both = [whitened(own, readings[..., i].T).T for i, own in enumerate(factors)]
    return np.concatenate(both, axis=1)


def _variants(base: Mechanism, states: np.ndarray) -> list[tuple[Mechanism, np.ndarray, float]]:
    """The base as it is, with each parameter and with each initial state moved; and by how much in what unit."""
    moved = [
        (base._replace(k1=base.k1 * (1 + 1e-4)), states, 1e-4),
        (base._replace(k3=base.k3 + 1e-3 * base.k1 / _TWIST**2), states, 1e-3),
        (base._replace(c1=base.c1 * 1.01), states, 1e-2),
    ]
    for i, scale in enumerate(_scales(base)):
        other = states.copy()
        other[:, i] += 1e-4 * scale
        moved.append((base, other, 1e-4))
    return [(base, states, 1.0), *moved]


def _scales(base: Mechanism) -> np.ndarray:
    """Units of the states."""
    return _TWIST * np.array([base.ratio, base.ratio * base.omega_0, 1.0, base.omega_0])


def _segments(p: Mechanism, states: np.ndarray, torque: np.ndarray, brake: np.ndarray, dt: float, substeps: int):
    """Readings (segments, samples, 2) of the base drive from given states, by RK4 over all segments at once."""
    h = dt / substeps
    y = states.T.copy()
    kept = np.empty((*torque.shape, 2))

    def slope(y, u, b):
        x, v = y[0] / p.ratio - y[2], y[1] / p.ratio - y[3]
        force = x * (p.k1 + p.k3 * x * x) + p.c1 * v
        return np.stack([y[1], (u - force / p.ratio) / p.motor_inertia, y[3], (force + b) / p.load_inertia])

    for k in range(torque.shape[1]):
        kept[:, k, 0], kept[:, k, 1] = y[0], y[2]
        u, b = torque[:, k], brake[:, k]
        for _ in range(substeps):
            k1 = slope(y, u, b)
            k2 = slope(y + 0.5 * h * k1, u, b)
            k3 = slope(y + 0.5 * h * k2, u, b)
            k4 = slope(y + h * k3, u, b)
            y = y + h / 6 * (k1 + 2 * (k2 + k3) + k4)
    return kept
