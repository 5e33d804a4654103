"""Block means over short runs of rows, which reduce noise on both axes and the number of points.

The noise of each axis is estimated from third differences of the log.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import find_peaks

from fitting.logs.log import Log
from fitting.quasi_static.torque_twist import Blocks

# Assumed: fine enough to place a knee to a few per cent, coarse enough to average noise away.
BLOCKS_PER_CYCLE = 100
MOST_BLOCKS = 1500
# A reversal by less than this share of the torque's range hardly changes the branch.
_REVERSAL = 0.05
# Least number of blocks in a branch for those at its ends to be omitted.
_LONG_BRANCH = 6
_MEDIAN_TO_STD = 1.4826
_THIRD_DIFFERENCE = math.sqrt(20.0)


def average(logs: Sequence[Log]) -> Blocks:
    """Means over blocks in which the torque is nearly linear and changes by more than its noise.

    No block crosses a torque reversal. The extreme torque there is kept with the blocks, since the hysteresis depends
    on it.
    """
    parts = [_average(log, MOST_BLOCKS // len(logs)) for log in logs]
    sizes = [len(part["torque"]) for part in parts]
    before = np.repeat(np.cumsum([0, *(len(part["path"]) for part in parts[:-1])]), sizes)
    whole = {key: np.concatenate([part[key] for part in parts]) for key in ("torque", "twist", "time", "seat")}
    torque_noise, twist_noise = np.mean([part["noise"] for part in parts], axis=0).tolist()
    course = float(np.median(np.abs(np.diff(whole["torque"]))))
    return Blocks(
        torque=whole["torque"],
        twist=whole["twist"],
        time=whole["time"],
        log=np.repeat(np.arange(len(logs)), sizes),
        paths=tuple(part["path"] for part in parts),
        seat=whole["seat"] + before,
        names=tuple(log.name for log in logs),
        torque_noise=torque_noise,
        # A floor for the noise of exact data, whose weights would be infinite.
        twist_noise=max(twist_noise, 1e-7 * float(np.ptp(whole["twist"]))),
        # The rows of a block are evenly distributed over its range.
        blur=math.hypot(torque_noise, course / math.sqrt(12.0)),
        rows=tuple(round(len(log) / size) for log, size in zip(logs, sizes, strict=True)),
        reversals=tuple(len(part["path"]) - len(part["blocks"]) for part in parts),
    )


def _average(log: Log, most: int) -> dict[str, np.ndarray]:
    torque = log.joint_torque
    assert torque is not None
    cycles = max(1.0, len(turns(torque, max(1, len(torque) // 1000))) / 2)
    most = min(most, round(BLOCKS_PER_CYCLE * cycles))
    size = max(1, round(len(log) / most))
    while len(log) / size > 0.4 * most and _moves_little(means(torque, size)):
        size = math.ceil(1.2 * size)
    branches = np.array([0, *turns(torque, size), len(log)])
    counts = np.maximum(1, np.rint(np.diff(branches) / size)).astype(int)
    edges = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(branches, branches[1:], counts, strict=False)]
    edge = np.append(np.rint(np.concatenate(edges)), len(log)).astype(int)
    columns = {"torque": torque, "twist": log.dynamic_error, "time": log.time}
    found = {key: np.add.reduceat(values, edge[:-1]) / np.diff(edge) for key, values in columns.items()}
    firsts, blocks = np.cumsum(counts)[:-1], np.arange(len(edge) - 1)
    # The torque between the two blocks beside a reversal, extrapolated from both sides.
    edged = np.pad(found["torque"], 1, mode="edge")
    extremes = 0.75 * (edged[firsts] + edged[firsts + 1]) - 0.25 * (edged[firsts - 1] + edged[firsts + 2])
    # Next to a reversal the branch changes within a block, so that its mean is not on the curve.
    kept = ~np.isin(blocks, [firsts, firsts - 1]) if np.min(counts) >= _LONG_BRANCH else blocks >= 0
    seat = blocks + np.searchsorted(firsts, blocks, side="right")
    return {key: values[kept] for key, values in (found | {"seat": seat}).items()} | {
        "path": np.insert(found["torque"], firsts, extremes),
        "blocks": blocks,
        # Blocks of equal size, whose centres are evenly spaced, as third differences need.
        "noise": np.array([noise(means(values, size)) for values in (torque, log.twist)]),
    }


def means(values: np.ndarray, size: int) -> np.ndarray:
    """Means over runs of `size` values; a shorter remainder at the end is omitted."""
    count = len(values) // size
    return values[: count * size].reshape(count, size).mean(axis=1)


def noise(values: np.ndarray) -> float:
    """Standard deviation of the noise on a smooth signal, robustly from third differences."""
    differences = np.abs(np.diff(values, 3))
    typical = float(np.median(differences)) * _MEDIAN_TO_STD
    # More than half of the differences of a coarsely quantised channel may be zero.
    return (typical or float(np.sqrt(np.mean(differences**2)))) / _THIRD_DIFFERENCE


def _moves_little(torque: np.ndarray) -> bool:
    return float(np.median(np.abs(np.diff(torque)))) < 3.0 * noise(torque)


def turns(torque: np.ndarray, size: int) -> list[int]:
    """Rows of torque reversals that exceed the noise and a small share of the range.

    Args:
        torque: In order of time, (n,).
        size: Rows over which it is averaged first.
    """
    smooth = means(torque, size)
    least = max(_REVERSAL * float(np.ptp(smooth)), 8.0 * noise(smooth))
    found = sorted((int(i), sign) for sign in (1, -1) for i in find_peaks(sign * smooth, prominence=least)[0])
    running, rows = uniform_filter1d(torque, size, mode="nearest"), []
    for (_, before), (i, sign) in zip([(0, 0), *found], found, strict=False):
        # Of equal maxima in a row, as in quantised channels, the first one counts.
        if sign != before:
            first = max(0, (i - 1) * size) + size // 2
            rows.append(first + int(np.argmax(sign * running[first : (i + 1) * size + size // 2 + 1])))
    return rows
