"""Invalid samples of a sensor: spikes, dropouts, clipped and stuck runs."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fitting.errors import DataError
from fitting.logs.dropouts import CLIFF
from fitting.logs.findings import Finding
from fitting.logs.gaps import SHORTEST
from fitting.logs.held import without_repeats
from fitting.logs.log import Log

# All thresholds are assumed; they separate healthy logs from faulty ones by a wide margin.
SPIKE = 12.0  # robust standard deviations of the prediction error from neighbours
DROPOUT = 40.0  # robust standard deviations of a step
LONGEST_DROPOUT = 5
PATTERN = 0.13
EVEN = 0.1  # of a step
CLIPPED_SHARE = 0.002
CLIPPED_MOTION = 0.02
FROZEN_SHARE = 0.05
FEWEST = 50
_LONE = np.array([-2 / 3, 1 / 6])


def masked(log: Log) -> Log:
    """The log with invalid samples marked, and findings on them.

    Outputs of a marked row have weight zero; its torque is used. Outputs after `log.outputs_until` are not checked.

    Args:
        log: as read.

    Raises:
        DataError: Too few valid outputs.
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
    """The log without pieces that have too few valid outputs."""
    if log.trusted is None or log.outputs_until is not None:
        return log
    pieces = log.pieces or ((0, len(log)),)
    kept = tuple((a, b) for a, b in pieces if log.trusted[a:b].sum() >= SHORTEST // 2)
    if not kept:
        raise DataError(
            f"{log.path}: only {log.trusted.sum()} of {len(log)} rows have valid outputs, since "
            f"{log.findings[-1].what}; repair the sensor or record another log"
        )
    if len(kept) == len(pieces):
        return log
    what = f"{len(pieces) - len(kept)} of {len(pieces)} stretches have fewer than {SHORTEST // 2} valid rows"
    finding = Finding("warning", what, "all outputs", "they were left out")
    return replace(log, pieces=kept, findings=(*log.findings, finding))


def _untrusted(log: Log) -> Iterator[tuple[np.ndarray, Finding]]:
    until = log.outputs_until
    known = np.ones(len(log), dtype=bool) if log.trusted is None else log.trusted
    known = known[:until]
    channels = {name: getattr(log, name)[:until] for name in log.outputs}
    for name, values in channels.items():
        others = [other for key, other in channels.items() if key != name]
        # Motion of another channel distinguishes a stuck sensor from rest.
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
                f"{len(spikes)} samples differ from their neighbours by more than noise and motion explain",
                f"{name}, first in data row {spikes[0] + 1}",
                "they count as glitches of the sensor and have weight zero in the fit",
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
                "the channel looks clipped, so that these samples have weight zero in the fit",
            ),
        )
    held = np.setdiff1d(stuck(calm), np.flatnonzero(~known))
    if len(held):
        yield (
            held,
            Finding(
                "warning",
                f"{len(held)} samples hold one value until it jumps",
                f"{name}, first in data row {held[0] + 1}",
                "the sensor is stuck there, so that these samples have weight zero in the fit",
            ),
        )
    rows = np.setdiff1d(frozen(calm, other), held) if other is not None else np.zeros(0, dtype=int)
    if len(rows):
        yield (
            rows,
            Finding(
                "warning",
                f"{name} holds one value for {len(rows)} rows while {mover} moves",
                f"{name}, data rows {rows[0] + 1} to {rows[-1] + 1}",
                "the sensor is stuck there, so that these samples have weight zero in the fit",
            ),
        )


def _standing(rows: np.ndarray, values: np.ndarray, level: float, times: int) -> str:
    return f"{len(rows)} samples ({100 * len(rows) / len(values):.2g} %) stand exactly at {level:g} in {times} runs"


def _without(values: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    kept = np.setdiff1d(np.arange(len(values)), rows)
    return kept, values[kept]


def glitches(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Rows with outliers relative to their neighbours, single or a few in a row.

    A smooth motion is predicted by a cubic through the neighbours. A real impact is a kink in the angle, and has
    another error pattern than an isolated outlier.

    Args:
        values: of one channel, (n,), finite.
        time: its stamps [s], (n,); where they jitter, isolated samples are not checked.
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
        # An isolated outlier causes errors of -2/3 of its size in the cubics of its neighbours, and of 1/6 in those
        # farther away. Another one close by changes this on its side only.
        before, behind = off[[k - 1, k - 2]] / off[k], off[[k + 1, k + 2]] / off[k]
        if min(np.max(np.abs(before - _LONE)), np.max(np.abs(behind - _LONE))) < PATTERN:
            found[k] = True
    rows = np.arange(len(values))
    calm = np.interp(rows, rows[~found], values[~found])
    for start, stop in _dropouts(calm, scale):
        found[start:stop] = True
    return np.flatnonzero(found)


def _dropouts(values: np.ndarray, noise: float) -> Iterator[tuple[int, int]]:
    """First row and one past the last of each short run that is offset by two opposite steps."""
    change = np.diff(values)
    step = np.abs(change)
    high = step > DROPOUT * max(noise, _resolution(values))
    # Few steps are reversed by a later one: only there neighbouring steps are compared.
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
    """Whether a later step reverses an earlier one."""
    smaller = np.minimum(np.abs(change[down]), np.abs(change[up]))
    return (change[down] * change[up] < 0) & (np.abs(values[up + 1] - values[down]) < 0.3 * smaller)


def _spread(off: np.ndarray) -> float:
    """Robust standard deviation, as if normal."""
    # In a short record, a few outliers are a large share.
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
    """Rows that stay at the lowest or highest value longer than a motion explains, that value, and the number of runs.

    Args:
        values: of one channel, (n,).
        other: the other angle, which must move at the same time, or None.
    """
    levels, counts = np.unique(values, return_counts=True)
    # A switched input of a few levels stays at its limits by design.
    if len(levels) <= 10:
        return
    for level, neighbours in ((levels[0], counts[1:3]), (levels[-1], counts[-3:-1])):
        starts, stops = runs(values == level)
        long = stops - starts >= 3
        starts, stops = starts[long], stops[long]
        held = int(np.sum(stops - starts))
        # Rest at zero is not clipping, nor is the turning point of a coarsely quantised signal.
        if level == 0 or held < max(5, CLIPPED_SHARE * len(values)) or held < 5 * neighbours.max():
            continue
        if other is not None:
            moved = sum(np.ptp(other[a:b]) for a, b in zip(starts, stops, strict=True))
            if moved < CLIPPED_MOTION * np.ptp(other):
                continue
        rows = np.concatenate([np.arange(a, b) for a, b in zip(starts, stops, strict=True)])
        yield rows, float(level), len(starts)


def stuck(values: np.ndarray) -> np.ndarray:
    """Rows of runs in which a channel is constant, and after which it jumps by much more than its steps nearby.

    A drive that is held by friction sets off with small steps, and so does a coarse encoder.

    Args:
        values: of one channel, (n,).
    """
    step = np.abs(np.diff(values))
    starts, stops = runs(step == 0)
    long = (stops - starts >= LONGEST_DROPOUT) & (stops + LONGEST_DROPOUT < len(step))
    found = [np.zeros(0, dtype=int)]
    for start, stop in zip(starts[long].tolist(), stops[long].tolist(), strict=True):
        nearby = np.append(step[stop + 1 : stop + 1 + LONGEST_DROPOUT], step[max(0, start - LONGEST_DROPOUT) : start])
        if step[stop] > CLIFF * max(np.max(nearby), _resolution(values)):
            # The first sample of the run is the last one that was measured.
            found.append(np.arange(start + 1, stop + 1))
    return np.concatenate(found)


def frozen(values: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Rows of the longest run in which a channel is constant while the other moves."""
    starts, stops = runs(np.diff(values) == 0)
    if len(starts) == 0:
        return np.zeros(0, dtype=int)
    longest = int(np.argmax(stops - starts))
    start, stop = int(starts[longest]), int(stops[longest]) + 1
    still = stop - start < max(FEWEST, FROZEN_SHARE * len(values))
    if still or np.ptp(other[start:stop]) <= FROZEN_SHARE * np.ptp(other):
        return np.zeros(0, dtype=int)
    return np.arange(start, stop)
