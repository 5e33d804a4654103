"""Curves with more samples than a screen resolves."""

import numpy as np

from fitting.report.plots.axes import line_trace
from fitting.report.plots.plot import Figure

_MOST_POINTS = 4000


def long_trace(
    time: np.ndarray, values: np.ndarray, window: tuple[float, float], *, name: str, color: str, width: float = 1.5
) -> Figure:
    """A long curve: complete in the first view, decimated with its peaks elsewhere."""
    first, last = np.searchsorted(time, window)
    inside = decimated(time[first:last], values[first:last], _MOST_POINTS // 2)
    left = decimated(time[:first], values[:first], _MOST_POINTS // 4)
    right = decimated(time[last:], values[last:], _MOST_POINTS // 4)
    x, y = (np.concatenate(part) for part in zip(left, inside, right, strict=True))
    return line_trace(x, y, name=name, color=color, width=width)


def decimated(time: np.ndarray, values: np.ndarray, most: int = _MOST_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most so many points of a curve, with all peaks: the lowest and highest of each of equal bins."""
    if time.size <= most:
        return time, values
    bins = most // 2
    edges = np.linspace(0, time.size, bins + 1).astype(int)
    kept = np.empty(2 * bins, dtype=int)
    for i, (start, stop) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        part = np.nan_to_num(values[start:stop])
        kept[2 * i : 2 * i + 2] = start + np.sort([np.argmin(part), np.argmax(part)])
    return time[kept], values[kept]
