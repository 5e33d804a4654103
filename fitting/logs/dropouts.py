"""Dropouts to zero: runs of exact zeros that a motion neither enters nor leaves."""

from collections.abc import Sequence

import numpy as np

# All thresholds are assumed.
CLIFF = 10.0  # times the steps nearby
_RESOLUTIONS = 40.0
_NEARBY = 5


def zero_dropouts(values: np.ndarray, spans: Sequence[float]) -> np.ndarray:
    """Rows in which a quantity that moves is exactly zero, and far from the values before and behind.

    Motion through zero, rest at zero and a wrap have small steps on one side at least. Where a sensor has dropouts, its
    other zeros in runs as short are dropouts too.

    Args:
        values: of an angle or velocity as logged, NaN where unknown, (n,).
        spans: at which the values may wrap.

    Returns:
        The rows, rising.
    """
    kept = np.flatnonzero(np.isfinite(values) & (values != 0.0))
    zero = np.flatnonzero(values == 0.0)
    if len(zero) == 0 or len(kept) < 2 * _NEARBY:
        return zero[:0]
    # Steps within runs of other values; those across zeros are left out.
    step = np.where(np.diff(kept) == 1, np.abs(np.diff(values[kept])), np.nan)
    if not (step > 0).any():
        return zero[:0]
    least = _RESOLUTIONS * np.min(step[step > 0])
    behind = np.searchsorted(kept, zero)
    # Zeros at either end of the log have one neighbour only.
    neighbours = [values[kept[np.clip(side, 0, len(kept) - 1)]] for side in (behind - 1, behind)]
    jump = np.minimum(*(_jump(value, spans) for value in neighbours))
    padded = np.pad(step, _NEARBY, constant_values=np.nan)
    # The step from the value before a run of zeros to the one behind it is not counted.
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEARBY - 1)[behind]
    usual = np.nanmax(np.where(np.isnan(around), 0.0, around), axis=1)
    far = jump > np.maximum(CLIFF * usual, least)
    run = np.cumsum(np.diff(zero, prepend=zero[0]) > 1)
    length = np.bincount(run)[run]
    return zero[length <= np.max(length[far], initial=0)]


def _jump(value: np.ndarray, spans: Sequence[float]) -> np.ndarray:
    """Distance from zero, also around by one span."""
    distance = np.abs(value)
    return np.min([distance, *(np.abs(distance - span) for span in spans)], axis=0)
