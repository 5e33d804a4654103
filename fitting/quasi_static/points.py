"""Points of a quasi-static log for the loop, at rest and moving, with smoothed torque.

Rows are averaged only down to a few thousand points, since ripples and relaxations are fast. The torque is smoothed by
local cubics (Savitzky and Golay 1964) of a width chosen by Stein's estimate of the risk (Stein 1981). Otherwise
candidates that smooth the torque would seem to gain. The estimate also gives the remaining error of the torque.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from fitting.logs.log import Log
from fitting.quasi_static.blocks import means, noise, turns
from fitting.quasi_static.preparation import MOVES, Motion, speed_of, torque_of

MOST_POINTS = 2000
# Half-widths of local cubics, in rows; a log holds ten of even the widest.
_WIDTHS = (5, 7, 9, 13, 19, 27, 37, 53, 75, 105, 149, 211, 299)
# Share of the usual speed below which a joint is at rest.
_AT_REST = 0.05
# Least number of points in a rest with its own level.
_SHORTEST_REST = 5


@dataclass(frozen=True, eq=False)
class Points:
    """Means over a few rows each, of one log or of several.

    Attributes:
        torque: Joint torque without its noise [N m], (n,).
        logged_torque: With noise [N m], (n,).
        twist: [rad], less its mean in its log, (n,).
        time: From the start of its log [s], (n,).
        log: Number of each point's log, (n,), rising.
        motor_angle: theta_m [rad], (n,), or None where a log has none.
        load_angle: theta_l [rad], (n,), or None.
        direction: Sign of the joint's speed, zero at rest, (n,), or None where no joint moved.
        rest: Number of each point's rest, -1 while the joint moves or where no joint does, (n,).
        temperature: [K], (n,), or None.
        motion: How the joint moved, by log.
        names: Of the logs.
        torque_noise: Standard deviation of the noise of one row's torque [N m].
        torque_error: Rms error of `torque` [N m]: remaining noise and smoothing error.
        twist_noise: Of a point's twist [rad].
        rows: Rows in a point, by log.
        reversals: Of the torque, by log.
        ratio: Reduction ratio, or None.
        reference: Points that supply middle torque and mean temperature; these points where None.
    """

    torque: np.ndarray
    logged_torque: np.ndarray
    twist: np.ndarray
    time: np.ndarray
    log: np.ndarray
    motor_angle: np.ndarray | None
    load_angle: np.ndarray | None
    direction: np.ndarray | None
    rest: np.ndarray
    temperature: np.ndarray | None
    motion: tuple[Motion, ...]
    names: tuple[str, ...]
    torque_noise: float
    torque_error: float
    twist_noise: float
    rows: tuple[int, ...]
    reversals: tuple[int, ...]
    ratio: float | None = None
    reference: "Points | None" = None

    @cached_property
    def logs(self) -> tuple[np.ndarray, ...]:
        """The points of each log."""
        return tuple(np.flatnonzero(self.log == i) for i in range(len(self.names)))

    def in_each_log(self, of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """A function of one log's points, evaluated for all logs, (n,)."""
        return np.concatenate([of(own) for own in self.logs])

    @cached_property
    def torque_rate(self) -> np.ndarray:
        """Rate of the joint torque [N m/s], (n,)."""
        return self.in_each_log(lambda own: np.gradient(self.torque[own], self.time[own]))

    @cached_property
    def duration(self) -> float:
        """Of the longest log [s]."""
        return max(float(np.ptp(self.time[own])) for own in self.logs)

    @cached_property
    def step(self) -> float:
        """Usual time between points [s]."""
        return float(np.median(np.concatenate([np.diff(self.time[own]) for own in self.logs])))

    @cached_property
    def centre(self) -> float:
        """Reference torque of nonlinear terms [N m]: zero where both signs occur, else the middle of the range."""
        if self.reference is not None:
            return self.reference.centre
        low, high = float(np.min(self.torque)), float(np.max(self.torque))
        return 0.0 if low < 0 < high else 0.5 * (low + high)

    @cached_property
    def warmth(self) -> np.ndarray:
        """Temperature above its mean [K], (n,)."""
        reference = self.temperature if self.reference is None else self.reference.temperature
        assert self.temperature is not None and reference is not None
        return self.temperature - np.mean(reference)

    @cached_property
    def reach(self) -> float:
        """Half the range of the torque [N m]."""
        return 0.5 * float(np.ptp(self.torque))


def points_of(logs: Sequence[Log], motion: Sequence[Motion], ratio: float | None) -> Points:
    """The points of quasi-static logs of one drive.

    Args:
        logs: With all their rows, as [`fitting.quasi_static.preparation.prepare`][] leaves them.
        motion: How the joint moved in each.
        ratio: Reduction ratio, or None.
    """
    parts = [_points(log, how, ratio, MOST_POINTS // len(logs)) for log, how in zip(logs, motion, strict=True)]
    shared = [key for key in parts[0] if all(key in part for part in parts)]
    columns: dict[str, Any] = {key: np.concatenate([part[key] for part in parts]) for key in shared}
    sizes, moved = [len(part["torque"]) for part in parts], [how in MOVES for how in motion]
    log, noises = np.repeat(np.arange(len(logs)), sizes), columns.pop("noises").reshape(len(logs), 3)
    torque_noise, torque_error, twist_noise = np.mean(noises, axis=0).tolist()
    at_rest = (columns["direction"] == 0) & np.repeat(moved, sizes)
    columns = dict.fromkeys(("motor_angle", "load_angle", "temperature")) | columns
    if not any(moved):
        columns["direction"] = None
    return Points(
        **columns,
        log=log,
        rest=_rests(at_rest, log),
        motion=tuple(motion),
        names=tuple(one.name for one in logs),
        torque_noise=torque_noise,
        torque_error=torque_error,
        twist_noise=max(twist_noise, 1e-7 * max(float(np.ptp(part["twist"])) for part in parts)),
        rows=tuple(round(len(one) / size) for one, size in zip(logs, sizes, strict=True)),
        # Coarse enough for reversals to exceed the torque's noise.
        reversals=tuple(len(turns(torque_of(one), max(1, len(one) // 200))) for one in logs),
        ratio=ratio,
    )


def _points(log: Log, motion: Motion, ratio: float | None, most: int) -> dict[str, np.ndarray]:
    size = math.ceil(len(log) / most)
    smooth, error = without_noise(torque_of(log))
    twist = means(log.twist - np.mean(log.twist), size)
    columns = {
        "torque": smooth,
        "logged_torque": torque_of(log),
        "time": log.time - log.time[0],
        "motor_angle": log.motor_angle,
        "load_angle": log.load_angle,
        "temperature": log.temperature,
    }
    found = {key: means(values, size) for key, values in columns.items() if values is not None}
    speed = means(speed_of(log, ratio), size) if motion in MOVES else np.zeros_like(twist)
    return found | {
        "twist": twist - np.mean(twist),
        "direction": np.sign(speed) * (np.abs(speed) > _AT_REST * np.percentile(np.abs(speed), 90)),
        "noises": np.array([noise(torque_of(log)), error, noise(twist)]),
    }


def without_noise(values: np.ndarray) -> tuple[np.ndarray, float]:
    """A signal without its white noise, estimated from third differences, and the remaining rms error.

    The smoother of least expected squared error among local cubics of all widths, and no smoothing.

    References:
        Stein 1981, Annals of Statistics 9(6), equation 2.5; Savitzky and Golay 1964, Analytical Chemistry 36(8).
    """
    variance = noise(values) ** 2
    best, least, error = values, variance, variance
    for width in _WIDTHS:
        if 10 * width > len(values):
            break
        smooth = np.asarray(savgol_filter(values, width, 3))
        own_share = float(savgol_coeffs(width, 3)[width // 2])
        risk = float(np.mean((values - smooth) ** 2)) + (2.0 * own_share - 1.0) * variance
        if risk < least:
            # The error is at least the variance of the local cubic. That must not choose the width: the risks of all
            # widths share the error of the noise variance, and the floor is lowest for the widest one.
            best, least, error = smooth, risk, max(risk, own_share * variance)
    return best, math.sqrt(error)


def _rests(at_rest: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Number of each point's rest, -1 elsewhere; short rests are reversals of the motion."""
    run = np.cumsum((np.diff(log, prepend=0) != 0) | np.diff(at_rest, prepend=at_rest[0]))
    lasting = np.flatnonzero(np.bincount(run, at_rest) >= _SHORTEST_REST)
    return np.where(np.isin(run, lasting), np.searchsorted(lasting, run), -1)
