"""Channels with clocks of their own, on one grid."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fitting.errors import DataError, InputError
from fitting.logs.findings import Finding
from fitting.logs.raw_table import RawColumn

# Assumed: an interpolation error of this share of the rms twist is worth a warning, or spoils the fit.
_NOTICED = 0.01
_SPOILT = 0.2
_RESOLVED = 0.3


def on_one_grid(columns: Mapping[str, RawColumn], path: object) -> dict[str, RawColumn]:
    """Columns of one length, on the union of their stamps; each is unknown where it was not sampled.

    Args:
        columns: by signal; all or none with stamps of their own.
        path: the log, for messages.

    Raises:
        InputError: where only some columns have stamps, or a clock does not rise.
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
    for signal, clock in clocks.items():
        if len(clock) != len(columns[signal].values):
            raise InputError(
                f"{path}: {signal} has {len(columns[signal].values)} rows and its time column {len(clock)}; "
                "export them with one stamp a sample"
            )
        if not np.isfinite(clock).all() or (np.diff(clock) <= 0).any():
            raise InputError(f"{path}: the time column of {signal} is blank or does not rise; sort it and mend it")
    grid = np.unique(np.concatenate(list(clocks.values())))
    found = {"time": RawColumn(grid, unit="s")}
    for signal, clock in clocks.items():
        values = np.full(len(grid), np.nan)
        place = np.searchsorted(grid, clock)
        values[place] = columns[signal].values
        found[signal] = replace(columns[signal], values=values, time=None, text_rows=place[columns[signal].text_rows])
    return found


def angles_together(
    time: np.ndarray, motor: np.ndarray, load: np.ndarray, ratio: float, path: object
) -> tuple[np.ndarray, np.ndarray, tuple[Finding, ...]]:
    """Both angles at the stamps of the slower one, where they were sampled at different times.

    Args:
        time: stamps [s], (n,).
        motor: theta_m [rad], NaN where unknown.
        load: theta_l [rad], likewise.
        ratio: N.
        path: the log, for messages.

    Returns:
        Both angles, and what was done.

    Raises:
        DataError: where the twist would be little but the error of interpolation.
    """
    knows_motor, knows_load = np.isfinite(motor), np.isfinite(load)
    fewest = min(knows_motor.sum(), knows_load.sum())
    if fewest < 8 or (knows_motor & knows_load).sum() >= 0.5 * fewest:
        return motor, load, ()
    # Loaded here, and not by every log that has no use for it.
    from scipy.interpolate import CubicSpline

    motor_is_quicker = knows_motor.sum() >= knows_load.sum()
    quick, slow = (motor, load) if motor_is_quicker else (load, motor)
    known, wanted = np.isfinite(quick), np.isfinite(slow)
    spline = CubicSpline(time[known], quick[known])
    at = time[wanted]
    inside = (at >= time[known][0]) & (at <= time[known][-1])
    moved = np.full(len(time), np.nan)
    moved[np.flatnonzero(wanted)[inside]] = spline(at[inside])
    # Half of the samples foretell the other half; a cubic's error falls by sixteen with half the step, if it resolves
    # the motion at all.
    sparse = CubicSpline(time[known][::2], quick[known][::2])
    error = float(np.std(sparse(time[known][1:-1:2]) - quick[known][1:-1:2]))
    error /= 16 if error < _RESOLVED * np.std(np.diff(quick[known])) else 1
    error /= ratio if motor_is_quicker else 1
    motor, load = (moved, load) if motor_is_quicker else (motor, moved)
    twist = float(np.nanstd(motor / ratio - load))
    if error > _SPOILT * twist:
        raise DataError(
            f"{path}: the two angles are sampled at different times and too slowly to put them together, since "
            f"interpolation is uncertain by {error:.2g} rad where the twist is {twist:.2g} rad; log them with one clock"
        )
    finding = Finding(
        "warning" if error > _NOTICED * twist else "note",
        "the two angles are sampled at different times",
        "motor_angle" if motor_is_quicker else "load_angle",
        f"it was interpolated to the other one's stamps, uncertain by {error:.2g} rad of twist",
    )
    return motor, load, (finding,)
