"""Local averages of channels and of their derivatives, by test functions, without differentiation."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

SHORTEST = 9
"""Samples of the shortest window."""

_FEWEST = 16
_MOST = 400
_GAP = 5.0
_SIGN_WINDOW = 15


@dataclass(frozen=True, eq=False)
class Uniform:
    """Channels on an even grid.

    Attributes:
        values: (n, channels).
        step: between samples [s], or 1 without a known clock.
        inside: which samples are not in a gap, (n,).
    """

    values: np.ndarray
    step: float
    inside: np.ndarray


class Scale(NamedTuple):
    """Averages over windows of one length, without the mean of each log, (windows, channels).

    Attributes:
        value: of the channels.
        rate: of their derivative [1/s].
        acceleration: of their second derivative [1/s^2].
        direction: of the sign of their derivative.
        cube: of the third power of the channels without their mean.
    """

    value: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    direction: np.ndarray
    cube: np.ndarray


def uniform(time: np.ndarray, columns: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> Uniform:
    """Channels on an even grid of the median step.

    Args:
        time: Stamps of the rows [s], (n,), rising.
        columns: Values and stamps (None: `time`) of each channel; NaN where unknown.
    """
    step = float(np.median(np.diff(time)))
    count = min(int(round((time[-1] - time[0]) / step)) + 1, 4 * len(time))
    grid = time[0] + step * np.arange(count)
    filled = np.zeros((count, len(columns)))
    for k, (values, own) in enumerate(columns):
        stamps = time if own is None else own
        known = np.isfinite(values) & np.isfinite(stamps)
        if known.sum() >= 2:
            filled[:, k] = np.interp(grid, stamps[known], values[known])
    late = np.flatnonzero(np.diff(time) > _GAP * step)
    inside = np.ones(count, dtype=bool)
    for row in late:
        inside[(grid > time[row]) & (grid < time[row + 1])] = False
    return Uniform(filled, step, inside)


def scales(logs: Sequence[Uniform]) -> tuple[Scale, ...]:
    """Averages over windows of several lengths, each half of the one before, concatenated over logs."""
    shortest = min(len(log.values) for log in logs)
    directed = [_directions(log.values) for log in logs]
    found = []
    length = shortest // (_FEWEST + 4) * 2 + 1
    while length >= SHORTEST:
        parts = [_averages(log, direction, length) for log, direction in zip(logs, directed, strict=True)]
        kept = [part for part in parts if len(part[0])]
        if sum(len(part[0]) for part in kept) >= _FEWEST:
            found.append(Scale(*(np.concatenate(both) for both in zip(*kept, strict=True))))
        length = length // 2 // 2 * 2 + 1
    return tuple(found)


def _directions(values: np.ndarray) -> np.ndarray:
    """Sign of the derivative, smoothed over a few samples."""
    kernel = _bump(_SIGN_WINDOW)[1]
    padded = np.pad(values, ((len(kernel) // 2, len(kernel) // 2), (0, 0)), mode="edge")
    slope = np.stack([np.convolve(column, kernel[::-1], mode="valid") for column in padded.T], axis=1)
    return np.sign(slope)


def _bump(length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights over a window for averages of a channel and its first two derivatives, per sample."""
    s = np.linspace(-1.0, 1.0, length)
    value = (1 - s**2) ** 4
    rate = s * (1 - s**2) ** 3
    acceleration = (1 - s**2) ** 2 * (7 * s**2 - 1)
    # Corrected so that sums over few samples are exact for lines and parabolas.
    acceleration -= acceleration.mean()
    place = np.arange(length) - (length - 1) / 2
    return value / value.sum(), rate / (rate @ place), acceleration / (0.5 * acceleration @ place**2)


def _averages(log: Uniform, direction: np.ndarray, length: int) -> tuple[np.ndarray, ...]:
    count = len(log.values)
    starts = np.arange(0, count - length + 1, max(1, length // 2))
    if len(starts) > _MOST:
        starts = starts[np.linspace(0, len(starts) - 1, _MOST).astype(int)]
    if not log.inside.all():
        outside = np.concatenate(([0], np.cumsum(~log.inside)))
        starts = starts[outside[starts + length] == outside[starts]]
    bump = _bump(length)
    cube = (log.values - log.values.mean(axis=0)) ** 3
    rows = starts[:, None] + np.arange(length)
    windows = log.values[rows]
    # Relative to the first sample, for accuracy of derivatives at large multi-turn angles.
    windows = windows - windows[:, :1]
    first = log.values[starts]
    parts = (
        first + np.einsum("l,wlc->wc", bump[0], windows),
        np.einsum("l,wlc->wc", bump[1], windows) / log.step,
        np.einsum("l,wlc->wc", bump[2], windows) / log.step**2,
        np.einsum("l,wlc->wc", bump[0], direction[rows]),
        np.einsum("l,wlc->wc", bump[0], cube[rows]),
    )
    parts = [np.nan_to_num(part, nan=0.0, posinf=0.0, neginf=0.0) for part in parts]
    return tuple(part - part.mean(axis=0) if len(part) else part for part in parts)
