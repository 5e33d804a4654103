"""Unit of an angle or a velocity: stated, or from grids, wraps and magnitudes."""

from dataclasses import dataclass

import numpy as np

from fitting.inspection.columns import Column
from fitting.logs.channels import SI
from fitting.logs.units import UnitError, convert
from fitting.logs.unwrapping import unwrapped_angle

# Log odds, assumed: prior frequency of unstated angle units.
_ANGLES = {"rad": 0.0, "deg": -0.7, "rev": -2.5, "mrad": -4.0}
_VELOCITIES = {"rad/s": 0.0, "deg/s": -0.7, "rpm": -1.0, "rev/s": -3.0}
_USUAL_BITS = {12: -1.0, 13: -1.0, 14: -0.5, 16: -0.5, 17: 0.0, 18: -0.5, 19: 0.0, 20: 0.0, 22: -1.0, 23: -0.5, 24: 0.0}
_OWN_NAME = 3.0  # that a column named like a signal is in SI
_COUNTS = 1.0  # that integers are counts
_WHOLE_ANGLE = -5.0  # that integers are radians or degrees
_GRID = 4.0
_WRAP = 6.0
_WORDS = (2.0**16, 2.0**32)  # counters of so many wrap at any angle
_GRID_TOLERANCE = 2e-3  # of a bit
_MOST_BITS = 26
# Largest angle and speed of a shaft in a log, in radians and radians per second; assumed.
_FASTEST, _FARTHEST = 2000.0, 1e5


@dataclass(frozen=True)
class UnitChoice:
    """A possible unit of a channel.

    Attributes:
        unit: in drive-file notation.
        size: of the unit in SI.
        odds: log odds against the other choices.
        reason: as text.
    """

    unit: str
    size: float
    odds: float
    reason: str


def is_counts(unit: str | None) -> bool:
    """Whether a unit is that of a counter of increments."""
    return (unit or "").strip(".").lower() in (
        "counts",
        "count",
        "cnt",
        "cts",
        "inc",
        "incs",
        "increments",
        "ticks",
        "lsb",
    )


def si_size(unit: str, target: str) -> float | None:
    """Size of a unit in SI; None for another quantity."""
    try:
        return float(convert(np.array(1.0), unit, target))
    except UnitError:
        return None


def angle_units(column: Column) -> tuple[UnitChoice, ...]:
    """The possible units of an angle, the most likely first."""
    if column.unit is not None and not is_counts(column.unit):
        size = si_size(column.unit, "rad")
        if size is not None:
            return (UnitChoice(column.unit, size, 0.0, "stated"),)
    known = column.values[np.isfinite(column.values)]
    whole = len(known) > 0 and bool(np.all(known == np.rint(known))) and np.ptp(known) > 16
    odds: dict[str, tuple[float, str]] = {}
    if not is_counts(column.unit):
        penalty = _WHOLE_ANGLE if whole else 0.0
        odds |= {unit: (value + penalty, "usual") for unit, value in _ANGLES.items()}
        if column.name.lower() in SI:
            odds["rad"] = (odds["rad"][0] + _OWN_NAME, "usual under this name")
    if whole or is_counts(column.unit):
        odds |= {f"rev / {1 << bits}": (_COUNTS + value - 2.0, "whole numbers") for bits, value in _USUAL_BITS.items()}
    for unit, (value, reason) in _given_away(column).items():
        odds[unit] = (odds.get(unit, (0.0, ""))[0] + value, reason)
    choices = [_choice(unit, value, reason, "rad") for unit, (value, reason) in odds.items()]
    moved = float(np.ptp(known)) if len(known) else 0.0
    possible = [c for c in choices if moved * c.size < _FARTHEST] or choices
    return tuple(sorted(possible, key=lambda c: -c.odds))


def velocity_units(column: Column) -> tuple[UnitChoice, ...]:
    """The possible units of a velocity, the most likely first."""
    if column.unit is not None:
        size = si_size(column.unit, "rad/s")
        if size is not None:
            return (UnitChoice(column.unit, size, 0.0, "stated"),)
    known = np.abs(column.values[np.isfinite(column.values)])
    fastest = float(np.quantile(known, 0.99)) if len(known) else 0.0
    choices = [_choice(unit, value, "usual", "rad/s") for unit, value in _VELOCITIES.items()]
    return tuple(c for c in choices if fastest * c.size < _FASTEST) or tuple(choices)


def _choice(unit: str, odds: float, reason: str, target: str) -> UnitChoice:
    size = si_size(unit, target)
    assert size is not None
    return UnitChoice(unit, size, odds, reason)


def _given_away(column: Column) -> dict[str, tuple[float, str]]:
    """Units from the values: a wrap at one revolution, a grid of a power of two."""
    found: dict[str, tuple[float, str]] = {}
    values = column.values
    for unit, revolution in (("rad", 2 * np.pi), ("deg", 360.0), ("rev", 1.0)):
        _, span, rows = unwrapped_angle(values, revolution)
        if len(rows) and np.isclose(span, revolution):
            found[unit] = (_WRAP, f"wraps at {revolution:.5g}")
        elif len(rows) and span == 2.0 ** round(np.log2(span)):
            unit = f"rev / {int(span)}"
            found[unit] = (_COUNTS if span in _WORDS else _WRAP, f"wraps at {int(span)}")
        if found:
            return found
    step = _grid(values)
    for unit, revolution in (("rad", 2 * np.pi), ("deg", 360.0)):
        bits = np.log2(revolution / step) if step > 0 else 0.0
        if 8 <= bits <= _MOST_BITS and abs(bits - round(bits)) < _GRID_TOLERANCE:
            found[unit] = (_GRID, f"lies on a grid of a revolution over 2^{round(bits)}")
    return found


def _grid(values: np.ndarray) -> float:
    """The resolution of a channel, or 0 without a grid."""
    known = values[np.isfinite(values)]
    levels = np.unique(known)
    if len(levels) < 8 or len(levels) > 0.9 * len(known):
        return 0.0
    gaps = np.diff(levels)
    step = float(gaps.min())
    if step <= 1e-9 * np.ptp(levels):
        return 0.0
    near = gaps[gaps < 1000 * step]
    counts = np.rint(near / step)
    # The mean over many levels is exact, while single gaps are rounded.
    refined = float(near.sum() / counts.sum())
    off = np.abs(near / refined - np.rint(near / refined))
    return refined if np.mean(off < 0.05) > 0.98 else 0.0
