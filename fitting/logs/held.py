"""Channels that are refreshed at a lower rate than the log is written: what they repeat is no measurement."""

from dataclasses import dataclass, replace

import numpy as np

from fitting.logs.findings import Finding
from fitting.logs.log import Log
from fitting.logs.resampling import angles_together

# All assumed. A sensor that is read in every row repeats no value where it moves by several of its steps a row.
_MOVING = 3.0  # steps of the sensor a row, on the mean over a window
_WINDOW = 4  # typical runs of one value
_SHORTEST_WINDOW, _FEWEST_CHANGES = 16, 50
_SHARE = 0.05  # of the changes, that end a run of repeated values
_LONGEST = 3.0  # times the typical run; what is longer is rest, or a sensor that is stuck
_ROUNDING = 1e-9  # of a channel's span


@dataclass(frozen=True, eq=False)
class _Held:
    """What a channel repeats.

    Attributes:
        repeated: rows that repeat the value of the row before since the channel was not refreshed, (n,).
        every: rows from one fresh value to the next, the median where the channel moves.
    """

    repeated: np.ndarray
    every: float


def without_repeats(log: Log) -> Log:
    """The log whose outputs count only in rows in which all of them were fresh.

    A quicker angle is interpolated to the slower one's fresh rows where the two are rarely fresh together. Outputs
    after `log.outputs_until` are not looked at.

    Args:
        log: A drive log or a reduced log, as read.
    """
    until = len(log) if log.outputs_until is None else min(log.outputs_until, len(log))
    names, angles = log.outputs, ("motor_angle", "load_angle")
    known = np.ones(len(log), dtype=bool) if log.trusted is None else log.trusted
    channels, findings, moved = {}, [], ()
    for name in names:
        values = np.where(known, getattr(log, name), np.nan)
        held = _held(values[:until])
        if held is not None:
            rows = np.flatnonzero(held.repeated)
            values[rows] = np.nan
            findings.append(_told(name, held))
        channels[name] = values
    if not findings:
        return log
    if names == angles and log.outputs_until is None:
        ratio = _ratio(log)
        motor, load, moved = angles_together(log.time, channels["motor_angle"], channels["load_angle"], ratio, log.path)
        channels = {"motor_angle": motor, "load_angle": load}
    trusted = known & np.all([np.isfinite(values) | (np.arange(len(log)) >= until) for values in channels.values()], 0)
    filled = {
        name: np.where(np.isfinite(v), v, np.interp(log.time, log.time[np.isfinite(v)], v[np.isfinite(v)]))
        for name, v in channels.items()
    }
    if names == angles:
        change = {name: filled[name] - getattr(log, name) for name in names}
        filled["dynamic_error"] = log.twist + change["motor_angle"] / _ratio(log) - change["load_angle"]
    return replace(log, trusted=trusted, findings=(*log.findings, *findings, *moved), **filled)


def _ratio(log: Log) -> float:
    """N, as the dynamic error was made with it."""
    assert log.motor_angle is not None and log.load_angle is not None
    output = log.twist + log.zero + log.load_angle
    most = int(np.argmax(np.abs(output)))
    return float(log.motor_angle[most] / output[most]) if output[most] else 1.0


def _told(name: str, held: _Held) -> Finding:
    count, first = int(held.repeated.sum()), int(np.argmax(held.repeated))
    return Finding(
        "warning",
        f"{name} is refreshed about every {held.every:.3g} rows and repeats its last value in between, in {count} rows "
        f"({100 * np.mean(held.repeated):.2g} %)",
        f"{name}, first in data row {first + 1}",
        "it is slower than the log: only rows in which it is fresh are fitted",
    )


def _held(values: np.ndarray) -> _Held | None:
    """What a channel repeats though it moves; None where it is refreshed in every row.

    Args:
        values: of one channel, (n,), NaN where unknown.
    """
    rows = np.flatnonzero(np.isfinite(values))
    if len(rows) < _FEWEST_CHANGES:
        return None
    known = values[rows]
    step = np.abs(np.diff(known))
    changes = np.flatnonzero(step > 0) + 1
    if len(changes) < _FEWEST_CHANGES:
        return None
    length = np.diff(changes)
    window = int(np.clip(_WINDOW * np.median(length), _SHORTEST_WINDOW, len(known) // 4))
    # The way that the channel goes in the rows around, per row.
    way = np.convolve(np.append(0.0, step), np.full(window, 1.0 / window), mode="same")
    moving = way >= _MOVING * _resolution(known)
    # Each run of one value that is followed by a change, both where the channel moves.
    own = moving[changes[:-1]] & moving[changes[1:]]
    if own.sum() < _FEWEST_CHANGES or np.mean(length[own] > 1) <= _SHARE:
        return None
    longest = _LONGEST * float(np.quantile(length[own], 0.9))
    bounds = np.concatenate(([0], changes, [len(known)]))
    whole = np.diff(bounds)
    since = np.arange(len(known)) - np.repeat(bounds[:-1], whole)
    repeated = np.zeros(len(values), dtype=bool)
    repeated[rows] = (since > 0) & (np.repeat(whole, whole) <= longest)
    return _Held(repeated, float(np.median(length[own])) if np.median(length[own]) > 1 else float(np.mean(length[own])))


def _resolution(values: np.ndarray) -> float:
    """The smallest step between values of a channel, beyond rounding."""
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > _ROUNDING * np.ptp(values)]
    return float(gaps.min()) if len(gaps) else np.inf
