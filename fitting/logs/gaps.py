"""Gaps in a log's torque: short ones are bridged by interpolation, long ones cut the log into pieces."""

from collections.abc import Sequence

import numpy as np

from fitting.logs.findings import Finding

SHORTEST = 200
"""Least rows of a log, or of a piece between gaps, for a fit."""

# All thresholds are assumed.
_REGULAR = 0.3
_LATE = 1.5  # typical steps; a longer one lacks a sample, for regular sampling
_GAP = 5.0  # likewise, for jittering sampling
_LONGEST_BRIDGE = 16
_BRIDGE_ERROR = 0.02
_ENOUGH = 0.9


class Sampling:
    """When an input was sampled.

    Attributes:
        time: stamps at which it is known [s], (n,).
        step: the typical one [s].
        gaps: indices in `time` after which samples are missing.
        missing: number of missing samples in each.
    """

    def __init__(self, time: np.ndarray):
        self.time = time
        step = np.diff(time)
        self.step = float(np.median(step))
        regular = np.mean(np.abs(step / self.step - 1) < _REGULAR) > 0.9
        steps = np.minimum(step / self.step, 1e9)
        # A late stamp has a long step before it and a short one after it; no sample is missing.
        around = np.pad(steps, 1, constant_values=1.0)
        lacking = np.rint(around[:-2] + around[1:-1] + around[2:]) - 3
        lacking = np.where(steps > _GAP, np.rint(steps) - 1, np.minimum(lacking, np.rint(steps) - 1))
        self.gaps = np.flatnonzero((steps > (_LATE if regular else _GAP)) & (lacking > 0))
        self.missing = lacking[self.gaps].astype(int)


def bridged(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An input with its gaps filled by cubics through two samples on either side.

    Args:
        time: stamps at which it is known [s], (n,), rising.
        values: samples.

    Returns:
        Stamps and samples, those in gaps included.
    """
    sampling = Sampling(time)
    if len(sampling.gaps) == 0:
        return time, values
    stamps, samples = [], []
    for gap, missing in zip(sampling.gaps, sampling.missing, strict=True):
        around = np.arange(max(0, gap - 1), min(len(time), gap + 3))
        # Relative to the middle of the gap, for accuracy at large times.
        middle, width = 0.5 * (time[gap] + time[gap + 1]), time[gap + 1] - time[gap]
        own = time[gap] + width * np.arange(1, missing + 1) / (missing + 1)
        stamps.append(own)
        samples.append(_through((time[around] - middle) / width, values[around], (own - middle) / width))
    places = np.repeat(sampling.gaps + 1, sampling.missing)
    return np.insert(time, places, np.concatenate(stamps)), np.insert(values, places, np.concatenate(samples))


def _through(nodes: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The polynomial through some nodes (Lagrange)."""
    total = np.zeros(len(at))
    for i, node in enumerate(nodes):
        others = np.delete(nodes, i)
        total += values[i] * np.prod((at[:, None] - others) / (node - others), axis=1)
    return total


def bridge_error(values: np.ndarray, missing: int) -> float:
    """Error of bridging missing samples, measured where none is missing.

    Args:
        values: samples of an input, (n,).
        missing: number of missing samples.

    Returns:
        Rms error in the middle of the bridge over the input's standard deviation; infinite for a bridge too long.
    """
    span = missing + 4
    if missing > _LONGEST_BRIDGE or len(values) < 4 * span:
        return np.inf
    windows = np.lib.stride_tricks.sliding_window_view(values, span)
    nodes = np.array([0.0, 1.0, missing + 2.0, missing + 3.0])
    middle = 2 + (missing - 1) // 2
    weights = np.array([_through(nodes, unit, np.array([float(middle)]))[0] for unit in np.eye(4)])
    error = windows[:, [0, 1, -2, -1]] @ weights - windows[:, middle]
    spread = float(np.std(values))
    return float(np.sqrt(np.mean(error**2))) / spread if spread > 0 else 0.0


def pieces(
    time: np.ndarray,
    values: np.ndarray,
    known: np.ndarray,
    restarts: Sequence[int] | np.ndarray,
    name: str,
    *,
    whole: bool = False,
) -> tuple[tuple[tuple[int, int], ...], tuple[Finding, ...]]:
    """Pieces of a log in which its input is known or can be bridged.

    Args:
        time: stamps of the rows [s], (n,), rising.
        values: the input, (n,); used where it is known.
        known: rows in which it is known.
        restarts: rows in which a recording restarts.
        name: of the input.
        whole: whether the log is needed in one piece, so that short gaps are bridged in any case.

    Returns:
        First row and one past the last of each piece, and findings. There are no pieces where the log is mostly gaps.
    """
    rows = np.flatnonzero(known)
    if len(rows) < 2:
        return (), ()
    sampling = Sampling(time[rows])
    errors = {m: bridge_error(values[rows], m) for m in set(sampling.missing.tolist())}
    wide = np.array([errors[m] > _BRIDGE_ERROR for m in sampling.missing.tolist()], dtype=bool)
    fresh = np.isin(rows[sampling.gaps + 1], restarts)
    breaks = sampling.gaps[wide | fresh]
    spans = _between(rows, breaks)
    if whole or sum(b - a for a, b in spans) < _ENOUGH * len(time):
        # Where gaps are everywhere, cutting at them would leave little.
        wide &= np.diff(sampling.time)[sampling.gaps] > _GAP * sampling.step
        breaks = sampling.gaps[wide | fresh]
        spans = _between(rows, breaks)
    findings = []
    if len(breaks):
        findings.append(_of_breaks(sampling, rows, breaks, spans, len(time)))
    bridges = np.setdiff1d(sampling.gaps, breaks)
    if len(bridges):
        findings.append(_of_bridges(sampling, rows, bridges, errors, name))
    return spans, tuple(findings)


def _between(rows: np.ndarray, breaks: np.ndarray) -> tuple[tuple[int, int], ...]:
    starts = rows[np.concatenate(([0], breaks + 1))]
    stops = rows[np.concatenate((breaks, [len(rows) - 1]))] + 1
    return tuple((int(a), int(b)) for a, b in zip(starts, stops, strict=True) if b - a >= SHORTEST)


def _of_breaks(sampling: Sampling, rows: np.ndarray, breaks: np.ndarray, spans: Sequence, count: int) -> Finding:
    step = np.diff(sampling.time)[breaks]
    longest = int(np.argmax(step))
    left_out = count - sum(b - a for a, b in spans)
    rest = f"; {left_out} rows between gaps that are too close are omitted" if left_out else ""
    return Finding(
        "warning",
        f"{len(breaks)} gaps in the time stamps, the longest {step[longest]:.4g} s where the median step is "
        f"{sampling.step:.4g} s",
        f"time, data row {rows[breaks[longest] + 1] + 1}",
        f"the torque inside a gap is unknown, so that the log is fitted as {len(spans)} stretches{rest}",
    )


def _of_bridges(sampling: Sampling, rows: np.ndarray, bridges: np.ndarray, errors: dict, name: str) -> Finding:
    missing = sampling.missing[np.isin(sampling.gaps, bridges)]
    worst = max(errors[m] for m in missing.tolist())
    known = np.isfinite(worst) and worst <= _BRIDGE_ERROR
    return Finding(
        "note" if known else "warning",
        f"{int(missing.sum())} samples of {name} are missing in {len(bridges)} places, up to {missing.max()} in a row",
        f"time, first in data row {rows[bridges[0] + 1] + 1}",
        f"they were interpolated, with an error of {100 * worst:.2g} % of its rms elsewhere"
        if known
        else "they are not predictable, but omitting them would lose too much data: the torque there is a guess",
    )
