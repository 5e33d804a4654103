"""Samples that the fit must not believe: spikes, dropouts, clipped and stuck stretches of a sensor."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fitting.errors import DataError
from fitting.logs.findings import Finding
from fitting.logs.gaps import SHORTEST
from fitting.logs.held import without_repeats
from fitting.logs.log import Log

# All thresholds are assumed: they part the practice logs from their faults by a wide margin.
SPIKE = 12.0  # robust standard deviations of what neighbours do not foretell
DROPOUT = 40.0  # likewise, of a step
LONGEST_DROPOUT = 5
CLIFF = 10.0  # times the steps around
PATTERN = 0.13
EVEN = 0.1  # of a step
CLIPPED_SHARE = 0.002
CLIPPED_MOTION = 0.02
FROZEN_SHARE = 0.05
FEWEST = 50
_LONE = np.array([-2 / 3, 1 / 6])


def masked(log: Log) -> Log:
    """The log with the samples marked that no fit should believe, and with findings that tell of them.

    The outputs of a marked row have no weight; the row's torque acts all the same. Outputs after `log.outputs_until`
    are not looked at.

    Args:
        log: as read.

    Raises:
        DataError: Hardly an output can be believed.
    """
    log = without_repeats(log)
    wrong, findings = np.zeros(len(log), dtype=bool), []
    for rows, finding in _untrusted(log):
        findings.append(finding)
        wrong[rows] = True
    if wrong.any():
        trusted = ~wrong if log.trusted is None else log.trusted & ~wrong
        log = replace(log, findings=(*log.findings, *findings), trusted=trusted)
    return _where_seen(log)


def _where_seen(log: Log) -> Log:
    """The log without the pieces in which hardly an output is believed."""
    if log.trusted is None or log.outputs_until is not None:
        return log
    pieces = log.pieces or ((0, len(log)),)
    kept = tuple((a, b) for a, b in pieces if log.trusted[a:b].sum() >= SHORTEST // 2)
    if not kept:
        raise DataError(
            f"{log.path}: only {log.trusted.sum()} of {len(log)} rows have outputs that can be believed, since "
            f"{log.findings[-1].what}; mend the sensor or record another log"
        )
    if len(kept) == len(pieces):
        return log
    what = f"{len(pieces) - len(kept)} of {len(pieces)} stretches have fewer than {SHORTEST // 2} believable rows"
    finding = Finding("warning", what, "all outputs", "they were left out")
    return replace(log, pieces=kept, findings=(*log.findings, finding))


def _untrusted(log: Log) -> Iterator[tuple[np.ndarray, Finding]]:
    until = log.outputs_until
    known = np.ones(len(log), dtype=bool) if log.trusted is None else log.trusted
    known = known[:until]
    channels = {name: getattr(log, name)[:until] for name in log.outputs}
    for name, values in channels.items():
        others = [other for key, other in channels.items() if key != name]
        # What moves meanwhile tells a stuck sensor from rest.
        yield from _of_channel(name, values, others[0] if others else None, known, log.time[:until])


def _of_channel(
    name: str, values: np.ndarray, other: np.ndarray | None, known: np.ndarray, time: np.ndarray
) -> Iterator[tuple[np.ndarray, Finding]]:
    if len(values) < 12 or np.all(values == values[0]):
        return
    mover = "the other angle" if name.endswith("_angle") else "another sensor"
    spikes = np.setdiff1d(glitches(values, time), np.flatnonzero(~known))
    if len(spikes):
        yield (
            spikes,
            Finding(
                "warning",
                f"{len(spikes)} samples stand out from those around by more than noise and motion allow",
                f"{name}, first in data row {spikes[0] + 1}",
                "they are taken for glitches of the sensor and have no weight in the fit",
            ),
        )
    calm = np.interp(np.arange(len(values)), *_without(values, spikes)) if len(spikes) else values
    for rows, level, times in clipped(calm, other):
        yield (
            rows,
            Finding(
                "warning",
                _standing(rows, values, level, times),
                f"{name}, first in data row {rows[0] + 1}",
                "the channel looks clipped, so that these samples have no weight in the fit",
            ),
        )
    rows = frozen(calm, other) if other is not None else np.zeros(0, dtype=int)
    if len(rows):
        yield (
            rows,
            Finding(
                "warning",
                f"{name} holds one value for {len(rows)} rows while {mover} moves",
                f"{name}, data rows {rows[0] + 1} to {rows[-1] + 1}",
                "the sensor is stuck there, so that these samples have no weight in the fit",
            ),
        )


def _standing(rows: np.ndarray, values: np.ndarray, level: float, times: int) -> str:
    return f"{len(rows)} samples ({100 * len(rows) / len(values):.2g} %) stand exactly at {level:g} in {times} runs"


def _without(values: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    kept = np.setdiff1d(np.arange(len(values)), rows)
    return kept, values[kept]


def glitches(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Rows whose value is an outlier to its neighbours, singly or a few in a row.

    A smooth motion, however quick, is foretold by a cubic through the neighbours; a real impact is a kink in the angle,
    and leaves another pattern than a lone wrong sample does.

    Args:
        values: of one channel, (n,), finite.
        time: its stamps [s], (n,); where they jitter, a lone sample is not judged.
    """
    found = np.zeros(len(values), dtype=bool)
    padded = np.pad(values, 2, mode="reflect", reflect_type="odd")
    foretold = (4 * (padded[1:-3] + padded[3:-1]) - padded[:-4] - padded[4:]) / 6
    off = values - foretold
    scale = _spread(off)
    step = np.pad(np.diff(time), (2, 3), mode="edge")
    uneven = np.abs(step / np.median(step) - 1) > EVEN
    uneven = np.lib.stride_tricks.sliding_window_view(uneven, 5)[: len(values)].any(axis=1)
    size = np.where(uneven, 0.0, np.abs(off))
    for k in np.flatnonzero(size > SPIKE * scale) if scale > 0 else ():
        if not 2 <= k < len(values) - 2 or size[k] < size[k - 2 : k + 3].max():
            continue
        # A lone sample is missed by its neighbours' cubics by -2/3 of it, and by those farther off by 1/6; another one
        # close by spoils this on its own side only.
        before, behind = off[[k - 1, k - 2]] / off[k], off[[k + 1, k + 2]] / off[k]
        if min(np.max(np.abs(before - _LONE)), np.max(np.abs(behind - _LONE))) < PATTERN:
            found[k] = True
    rows = np.arange(len(values))
    calm = np.interp(rows, rows[~found], values[~found])
    for start, stop in _dropouts(calm, scale):
        found[start:stop] = True
    return np.flatnonzero(found)


def _dropouts(values: np.ndarray, noise: float) -> Iterator[tuple[int, int]]:
    """First row and one past the last of each few samples in a row that stand off between two cliffs."""
    change = np.diff(values)
    step = np.abs(change)
    high = step > DROPOUT * max(noise, _resolution(values))
    # Few steps have another one behind them that takes back what they did: only there the steps around are looked at.
    near = np.zeros(len(step), dtype=bool)
    for behind in range(1, min(LONGEST_DROPOUT, len(step) - 1) + 1):
        down = np.flatnonzero(high[:-behind] & high[behind:])
        for between in range(behind + 1):
            near[down[_returns(values, change, down, down + behind)] + between] = True
    rows = np.flatnonzero(high & near)
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(step, 2 * LONGEST_DROPOUT, mode="edge"), 4 * LONGEST_DROPOUT + 1
    )
    cliffs = rows[step[rows] > CLIFF * np.median(around[rows], axis=1)]
    down, up = cliffs[:-1], cliffs[1:]
    found = (up - down <= LONGEST_DROPOUT) & _returns(values, change, down, up)
    yield from zip((down[found] + 1).tolist(), (up[found] + 1).tolist(), strict=True)


def _returns(values: np.ndarray, change: np.ndarray, down: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Whether a later step brings back the value from before an earlier one."""
    smaller = np.minimum(np.abs(change[down]), np.abs(change[up]))
    return (change[down] * change[up] < 0) & (np.abs(values[up + 1] - values[down]) < 0.3 * smaller)


def _spread(off: np.ndarray) -> float:
    """Standard deviation of the body of a distribution, as if it were normal."""
    # A few wrong samples are a large share of a short record.
    share, deviations = (0.95, 1.960) if len(off) > 200 else (0.8, 1.282)
    return float(np.quantile(np.abs(off), share)) / deviations


def _resolution(values: np.ndarray) -> float:
    step = np.abs(np.diff(values))
    return float(np.min(step[step > 0], initial=np.inf)) if (step > 0).any() else np.inf


def runs(same: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First index and one past the last of each run of True."""
    edges = np.diff(np.concatenate(([0], same.astype(np.int8), [0])))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


def clipped(values: np.ndarray, other: np.ndarray | None) -> Iterator[tuple[np.ndarray, float, int]]:
    """Rows that stand at the lowest or the highest value longer than a motion would, that value, and how many runs.

    Args:
        values: of one channel, (n,).
        other: the other angle, which must move meanwhile, or None.
    """
    levels, counts = np.unique(values, return_counts=True)
    # A switched input of a few levels sits at its ends by design.
    if len(levels) <= 10:
        return
    for level, neighbours in ((levels[0], counts[1:3]), (levels[-1], counts[-3:-1])):
        starts, stops = runs(values == level)
        long = stops - starts >= 3
        starts, stops = starts[long], stops[long]
        held = int(np.sum(stops - starts))
        # Rest at zero is no clipping, nor is the turning point of a coarsely quantised signal.
        if level == 0 or held < max(5, CLIPPED_SHARE * len(values)) or held < 5 * neighbours.max():
            continue
        if other is not None:
            moved = sum(np.ptp(other[a:b]) for a, b in zip(starts, stops, strict=True))
            if moved < CLIPPED_MOTION * np.ptp(other):
                continue
        rows = np.concatenate([np.arange(a, b) for a, b in zip(starts, stops, strict=True)])
        yield rows, float(level), len(starts)


def frozen(values: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Rows of the longest stretch in which a channel stands still while the other moves."""
    starts, stops = runs(np.diff(values) == 0)
    if len(starts) == 0:
        return np.zeros(0, dtype=int)
    longest = int(np.argmax(stops - starts))
    start, stop = int(starts[longest]), int(stops[longest]) + 1
    still = stop - start < max(FEWEST, FROZEN_SHARE * len(values))
    if still or np.ptp(other[start:stop]) <= FROZEN_SHARE * np.ptp(other):
        return np.zeros(0, dtype=int)
    return np.arange(start, stop)
