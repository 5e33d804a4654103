"""Unwrapping of channels: angles modulo a revolution, counters and integers that overflow."""

import numpy as np

_BITS = (8, 10, 12, 13, 14, 16, 17, 18, 19, 20, 21, 22, 23, 24, 31, 32)
_OVERFLOWS = (12, 16, 32)
_FINEST = 1e-9
# Largest share of samples that may be wrong one by one, assumed.
_RARE = 0.01


def unwrapped_angle(values: np.ndarray, revolution: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Unwrap an angle.

    Args:
        values: as logged, NaN where unknown, (n,).
        revolution: in the unit of the values.

    Returns:
        The continuous angle, the span of a jump (0 without any), and the rows that jump.
    """
    spans = wrapping_spans(values, revolution)
    ordered = np.sort(values[np.isfinite(values)])
    if len(ordered) < 3:
        return values, 0.0, np.zeros(0, dtype=int)
    # Nearly all samples of a wrapped angle are within one span, and they fill it.
    most = int(_RARE * len(ordered))
    narrowest = np.min(ordered[len(ordered) - 1 - most :] - ordered[: most + 1])
    for span in sorted(spans):
        if np.ptp(ordered) <= 0.5 * span or narrowest > span * (1 + _FINEST):
            continue
        counted = values.copy()
        counted[_lone(values, ordered, span)] = np.nan
        jumps = _jumps(counted, span)
        if jumps is None:
            continue
        step = _step(counted)
        folded = step - span * np.rint(step / span)
        change = np.abs(np.diff(folded))
        # A shaft's speed does not jump by an eighth of a revolution from one sample to the next.
        if np.max(np.abs(folded)) < span / 4 and np.quantile(change, 0.999) < span / 8:
            return values - _turned(counted, jumps, span), span, np.flatnonzero(jumps) + 1
    return values, 0.0, np.zeros(0, dtype=int)


def wrapping_spans(values: np.ndarray, revolution: float) -> list[float]:
    """Spans at which an angle may wrap; arguments as in [`unwrapped_angle`][]."""
    return [revolution, *(2.0**bits for bits in _BITS if _whole(values, 1.0))]


def unwrapped_overflow(values: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Unwrap a slow signal whose integers overflowed; arguments and returns as in [`unwrapped_angle`][]."""
    grid = _grid(values)
    for bits in _OVERFLOWS if grid > 0 else ():
        span = grid * 2.0**bits
        jumps = _jumps(values, span)
        if jumps is None:
            continue
        step = np.abs(_step(values))
        folded = np.abs(step - span)[jumps]
        usual = np.quantile(step[~jumps], 0.99)
        # A switched input jumps as far, but does not end at the other limit, and is not smooth elsewhere.
        if usual < span / 20 and folded.max() <= 3 * usual + grid:
            return values - _turned(values, jumps, span), span, np.flatnonzero(jumps) + 1
    return values, 0.0, np.zeros(0, dtype=int)


def _step(values: np.ndarray) -> np.ndarray:
    """Differences of the known values; those across unknown ones at the following row."""
    known = np.flatnonzero(np.isfinite(values))
    step = np.zeros(len(values) - 1)
    step[known[1:] - 1] = np.diff(values[known])
    return step


def _jumps(values: np.ndarray, span: float) -> np.ndarray | None:
    """Steps longer than half a span, if the values are within one span; None without any."""
    known = values[np.isfinite(values)]
    if len(known) < 3 or not 0.5 * span < np.ptp(known) <= span * (1 + _FINEST):
        return None
    jumps = np.abs(_step(values)) > 0.5 * span
    return jumps if jumps.any() else None


def _turned(values: np.ndarray, jumps: np.ndarray, span: float) -> np.ndarray:
    """The part of values that the jumps have added up to each row."""
    turns = np.where(jumps, np.rint(_step(values) / span), 0.0)
    return span * np.concatenate(([0.0], np.cumsum(turns)))


def _lone(values: np.ndarray, ordered: np.ndarray, span: float) -> np.ndarray:
    """Rows of single wrong samples: off from both neighbours, or outside the one span that holds nearly all samples,
    where the neighbours agree.

    Args:
        values: as logged, NaN where unknown, (n,).
        ordered: the known ones in rising order, three at least.
        span: of a jump.
    """
    rows = np.flatnonzero(np.isfinite(values))
    known = values[rows]

    def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        step = one - other
        return np.abs(step - span * np.rint(step / span))

    before, own, after = known[:-2], known[1:-1], known[2:]
    width = span * (1 + _FINEST)
    low = ordered[np.argmax(np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered)))]
    outside = (known < low) | (known > low + width)
    off = outside[1:-1] | (np.minimum(apart(own, before), apart(after, own)) > span / 8)
    alone = off & ~outside[:-2] & ~outside[2:] & (apart(after, before) < span / 8)
    return rows[1:-1][alone] if np.mean(alone) <= _RARE else rows[:0]


def _whole(values: np.ndarray, grid: float) -> bool:
    known = values[np.isfinite(values)] / grid
    return len(known) > 0 and bool(
        np.all(np.abs(known - np.rint(known)) < 1e-6 * np.maximum(1.0, np.abs(known) * 1e-6))
    )


def _grid(values: np.ndarray) -> float:
    """The resolution of a channel of integer origin, or 0."""
    levels = np.unique(values[np.isfinite(values)])
    if len(levels) < 16:
        return 0.0
    gaps = np.diff(levels)
    grid = float(gaps[gaps > _FINEST * np.ptp(levels)].min(initial=np.inf))
    if not np.isfinite(grid):
        return 0.0
    counts = levels / grid
    return grid if np.mean(np.abs(counts - np.rint(counts)) < 0.05) > 0.99 else 0.0
