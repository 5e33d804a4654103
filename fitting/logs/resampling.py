"""Resampling of channels with separate clocks onto one grid."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fitting.errors import DataError, InputError
from fitting.logs.findings import Finding
from fitting.logs.raw_table import RawColumn

# Assumed: interpolation errors over the rms twist that cause a warning, and a refusal.
_NOTICED = 0.01
_SPOILT = 0.2
_RESOLVED = 0.3
_PAUSE = 2.5  # times the usual step, assumed: more than one sample is missing
_SAME = 1e-4  # of a step; stamps closer than this are equal for a fit


def on_one_grid(columns: Mapping[str, RawColumn], required: Sequence[str], path: object) -> dict[str, RawColumn]:
    """Columns on the union of their stamps; each is unknown where it was not sampled.

    Args:
        columns: by signal; all or none with separate stamps, which rise.
        required: signals that must be logged; rows outside their common time are dropped.
        path: the log, for messages.

    Raises:
        InputError: only some columns have stamps.
        DataError: the signals were not logged at the same time.
    """
    clocks = {s: c.time for s, c in columns.items() if c.time is not None}
    if not clocks:
        return dict(columns)
    bare = [s for s in columns if s not in clocks and s != "time"]
    if bare:
        raise InputError(
            f"{path}: {bare[0]} has no time column of its own while {next(iter(clocks))} has one; "
            f'give [columns] {bare[0]} time = "..." as well'
        )
    every = np.unique(np.concatenate(list(clocks.values())))
    # Stamps of one clock that two loggers rounded differently are equal.
    apart = _SAME * min(float(np.median(np.diff(clock))) if len(clock) > 1 else np.inf for clock in clocks.values())
    own = np.diff(every, prepend=-np.inf) > apart
    grid, number = every[own], np.cumsum(own) - 1
    # A sample is valid for half a step to either side.
    reach = {s: float(np.median(np.diff(clocks[s]))) if len(clocks[s]) > 1 else 0.0 for s in required}
    begin, end = max(clocks[s][0] - reach[s] for s in required), min(clocks[s][-1] + reach[s] for s in required)
    if begin >= end:
        early, late = min(required, key=lambda s: clocks[s][-1]), max(required, key=lambda s: clocks[s][0])
        raise DataError(
            f"{path}: {early} ends at {clocks[early][-1]:g} s, before {late} begins at {clocks[late][0]:g} s; give "
            "their stamps one clock"
        )
    kept = slice(*np.searchsorted(grid, [begin, end + apart]))
    least_known = max(columns[signal].rate_std for signal in clocks)
    found = {"time": RawColumn(grid[kept], unit="s", time=grid[kept], rate_std=least_known)}
    for signal, clock in clocks.items():
        values = np.full(len(grid), np.nan)
        place = number[np.searchsorted(every, clock)]
        values[place] = columns[signal].values
        text = place[columns[signal].text_rows] - kept.start
        text = text[(text >= 0) & (text < kept.stop - kept.start)]
        found[signal] = replace(columns[signal], values=values[kept], time=None, text_rows=text)
    return found


def angles_together(
    time: np.ndarray, motor: np.ndarray, load: np.ndarray, ratio: float, path: object
) -> tuple[np.ndarray, np.ndarray, tuple[Finding, ...]]:
    """Both angles at the stamps of the slower one, if sampled at different times.

    Args:
        time: stamps [s], (n,).
        motor: theta_m [rad], NaN where unknown.
        load: theta_l [rad], likewise.
        ratio: N.
        path: the log, for messages.

    Returns:
        Both angles, and a finding.

    Raises:
        DataError: interpolation error dominates the twist.
    """
    knows_motor, knows_load = np.isfinite(motor), np.isfinite(load)
    fewest = min(knows_motor.sum(), knows_load.sum())
    if fewest < 8 or (knows_motor & knows_load).sum() >= 0.5 * fewest:
        return motor, load, ()
    # Imported here: most logs do not need it.
    from scipy.interpolate import CubicSpline

    motor_is_quicker = knows_motor.sum() >= knows_load.sum()
    quick, slow = (motor, load) if motor_is_quicker else (load, motor)
    known, wanted = np.isfinite(quick), np.isfinite(slow)
    spline = CubicSpline(time[known], quick[known])
    at = time[wanted]
    inside = (at >= time[known][0]) & (at <= time[known][-1])
    # A cubic does not span a pause of the quicker encoder.
    own = np.diff(time[known])
    place = np.clip(np.searchsorted(time[known], at, side="right") - 1, 0, len(own) - 1)
    inside &= own[place] < _PAUSE * np.median(own)
    moved = np.full(len(time), np.nan)
    moved[np.flatnonzero(wanted)[inside]] = spline(at[inside])
    # Half of the samples predict the other half; the error of a cubic decreases sixteenfold with half the step, if the
    # motion is resolved.
    sparse = CubicSpline(time[known][::2], quick[known][::2])
    error = float(np.std(sparse(time[known][1:-1:2]) - quick[known][1:-1:2]))
    error /= 16 if error < _RESOLVED * np.std(np.diff(quick[known])) else 1
    error /= ratio if motor_is_quicker else 1
    motor, load = (moved, load) if motor_is_quicker else (motor, moved)
    twist = float(np.nanstd(motor / ratio - load))
    if error > _SPOILT * twist:
        raise DataError(
            f"{path}: the two angles are sampled at different times and too slowly for interpolation, whose error is "
            f"{error:.2g} rad where the twist is {twist:.2g} rad; log them with one clock"
        )
    finding = Finding(
        "warning" if error > _NOTICED * twist else "note",
        "the two angles are sampled at different times",
        "motor_angle" if motor_is_quicker else "load_angle",
        f"it was interpolated to the other one's stamps, with an error of {error:.2g} rad of twist",
    )
    return motor, load, (finding,)
