"""Steady sampling behind rounded stamps, and the uncertainty of its rate."""

from dataclasses import dataclass
from typing import Any

import numpy as np

# Points at which the density of the interval is evaluated.
_GRID = 101
# Remaining freedom of the clock, as a share of the rounding, below which rounding alone does not explain the stamps.
_EXACT = 1e-5


@dataclass(frozen=True, eq=False)
class SteadyClock:
    """Equal sample intervals that explain rounded stamps.

    Attributes:
        interval: between samples [s], the mean over all admissible ones.
        rate_std: relative standard deviation of admissible intervals.
        time: of the samples [s], (n,).
        slack: largest excess of stamps over their rounding [s].
    """

    interval: float
    rate_std: float
    time: np.ndarray
    slack: float


def steady_clock(stamps: np.ndarray, run: np.ndarray, quantum: float) -> SteadyClock | None:
    """The clock of steady sampling that agrees with rounded stamps; None without one.

    A stamp rounded to `quantum` confines `t_0 + i dt` to an interval of that width, so that the admissible `(t_0, dt)`
    form a polygon. The density is uniform in it: that of `dt` is the polygon's height in `t_0`. Pauses of unknown
    length give a product of such densities. Where no steady clock agrees with the stamps, their error is assumed to be
    up to twice the least one needed, and at most a sample interval or the rounding.

    Args:
        stamps: [s], (n,), not decreasing.
        run: number of each stamp's run between pauses, (n,), rising from zero.
        quantum: of the rounding [s].
    """
    # Imported here: most stamps are exact.
    from scipy.optimize import brentq, minimize_scalar

    time, row = stamps - stamps[0], np.arange(len(stamps), dtype=float)
    starts = np.flatnonzero(np.diff(run, prepend=-1))
    length = np.diff(np.append(starts, len(run)))
    longest = int(np.argmax(length))
    first, last = starts[longest], starts[longest] + length[longest] - 1
    if last - first < 2:
        return None
    mean = (time[last] - time[first]) / (last - first)
    reach = 2 * quantum / (last - first)

    def bounds(interval: float) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest admissible start of each run."""
        off = time - interval * row
        return np.maximum.reduceat(off, starts), np.minimum.reduceat(off, starts) + quantum

    def room(interval: float) -> np.ndarray:
        low, high = bounds(interval)
        return high - low

    best: Any = minimize_scalar(
        lambda interval: -np.min(room(interval)) / quantum,
        bounds=(mean - reach, mean + reach),
        method="bounded",
        options={"xatol": 1e-6 * reach},
    )
    slack = max(0.0, 0.5 * best.fun * quantum)
    # The least error admits one clock only; even if it is zero, errors below a sample interval are possible.
    wider = 4 * slack + 2 * min(mean, quantum) if best.fun > -_EXACT else 0.0

    def edge(far: float) -> float:
        found: Any = brentq(lambda interval: np.min(room(interval)) + wider, best.x, far)
        return found

    low, high = edge(mean - 2 * reach - wider / (last - first)), edge(mean + 2 * reach + wider / (last - first))
    grid = np.linspace(low, high, _GRID)
    interval, spread = _mean_and_spread(grid, np.array([(room(dt) + wider) / quantum for dt in grid]))
    if not interval > 0:
        return None
    early, late = bounds(interval)
    # As if rounded to nearest: truncation shifts all stamps equally.
    middle = 0.5 * (early + late) - 0.5 * quantum
    return SteadyClock(interval, spread / interval, stamps[0] + middle[run] + interval * row, slack)


def _mean_and_spread(grid: np.ndarray, heights: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of a density given as a product of factors, zero where one is not positive."""
    with np.errstate(divide="ignore"):
        likely = np.sum(np.log(np.maximum(heights, 0.0)), axis=1)
    if not np.isfinite(likely.max()):
        return np.nan, np.nan
    density = np.exp(likely - likely.max())
    density /= np.sum(density)
    mean = float(grid @ density)
    return mean, float(np.sqrt((grid - mean) ** 2 @ density))
