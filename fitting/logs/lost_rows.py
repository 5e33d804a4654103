"""Rows that were lost or written twice without a trace in the time stamps, and stamps that tell of a loss wrongly."""

from collections.abc import Iterator

import numpy as np

from fitting.logs.findings import Finding
from fitting.logs.log import Log

# All thresholds are assumed, and tried on logs with and without lost rows (`tests/logs/test_lost_rows.py`).
# Robust standard deviations of a step's prediction that the step itself must exceed, so that noise never doubles it.
_CLEAR = 10.0
_AS_FAR = 0.2  # of a step
_ALIKE = 0.3  # largest deviation of the steps on either side, of the predicted one; else the motion has a kink
_FEWEST = 3
# A segment has some 250 rows; where most contain a lost row, their frequencies are wrong.
_MOST = 1e-3
_STEADY = 0.01  # of a step
_REPEATED = "leave out the rows that repeat"
_ROUNDED = "remove the time column and give [signals] sample_rate"
_NEAR = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6.0


def lost_rows(log: Log) -> Iterator[Finding]:
    """Rows between which an angle goes twice as far as before and behind, or not at all, at steady stamps; and rows
    between which the stamps alone go twice as far.

    Args:
        log: With the angle of either side. Outputs after `log.outputs_until` rows are not used.
    """
    time = log.time[: log.outputs_until]
    angle = log.motor_angle if log.motor_angle is not None else log.load_angle
    if angle is None or len(time) < 50:
        return
    step, interval = np.diff(angle[: log.outputs_until]), np.diff(time)
    known = np.ones(len(time), dtype=bool) if log.trusted is None else log.trusted[: len(time)]
    interval = interval / np.median(interval)
    # A step counts where it and two on either side are between valid rows, and those at equal intervals.
    valid, even = known[1:] & known[:-1], np.abs(interval - 1.0) < _STEADY
    beside = _in_all(valid, [-2, -1, 0, 1, 2]) & _in_all(even, [-2, -1, 1, 2])
    good, long = beside & even, beside & (np.abs(interval - 2.0) < _AS_FAR)
    foretold = np.convolve(step, _NEAR, mode="same")
    if good.sum() < 50:
        return
    noise = float(np.quantile(np.abs(step - foretold)[good], 0.8)) / 1.282
    alike = [np.abs(np.roll(step, shift) - foretold) < _ALIKE * np.abs(foretold) for shift in (1, -1)]
    clear = alike[0] & alike[1] & (np.abs(foretold) > _CLEAR * noise)
    share = np.divide(step, foretold, out=np.ones_like(step), where=clear)
    for where, factor, what, remedy in (
        (good, 2.0, "twice as far as before and behind: rows were lost, and the stamps do not show it", _REPEATED),
        (good, 0.0, "not at all: rows repeat, and the stamps do not show it", _REPEATED),
        (long, 1.0, "as far as before and behind, and the stamps go twice as far: they are rounded", _ROUNDED),
    ):
        rows = np.flatnonzero(where & clear & (np.abs(share - factor) < _AS_FAR))
        if len(rows) >= _FEWEST:
            yield Finding(
                "refusal" if len(rows) > _MOST * len(time) else "warning",
                f"in {len(rows)} of {len(time)} rows a moving angle goes {what}",
                f"time, first in data row {rows[0] + 2}",
                f"the time base is wrong there, so log the stamps of the samples, or {remedy}",
            )


def _in_all(mask: np.ndarray, places: list[int]) -> np.ndarray:
    """Where a mask holds at all places, counted from each element; it does not hold beyond its ends."""
    padded = np.pad(mask, 2)
    return np.all([padded[2 + place : 2 + place + len(mask)] for place in places], axis=0)
