"""Rising time base from logged stamps: corrects wrapped counters, repeated, swapped and rounded stamps."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from fitting.errors import InputError
from fitting.logs.findings import Finding
from fitting.logs.steady_clock import steady_clock

# All thresholds are assumed: no timer or logger states them.
_COUNTERS = tuple(2.0**bits for bits in (16, 24, 31, 32, 53))
_DAY = 86400.0
_PARTS = (1.0, 60.0, 3600.0)  # s
_SCALES = (1.0, 1e-3, 1e-6, 1e-9)
_FAR = 20.0  # typical steps; largest distance of a wrap's two stamps from the counter's limits
_NEAR = 0.1  # likewise, of the counter's span
_DOUBLED = 0.9  # least share of identical rows among those with equal stamps, for them to be duplicates
_LONG = 50  # least rows of a restarted recording, as opposed to a late packet
_IRREGULAR = 0.3
_WORST = 0.2  # largest share of lost rows for a column to be a clock
_COARSE = 1e-4  # stamps this much finer than the step count as exact
_MOST_STEPS = 64
_LATEST = 1e30  # larger values are fill values
_FEW = 0.02
_FEWEST_DIGITS = 256  # of the last place in a step; rounding changes a longer one by less than 0.2 %

SLOWEST = 60.0
"""Largest interval of samples [s], assumed: too slow for a resonance, so that the unit of time must be wrong."""


@dataclass(frozen=True, eq=False)
class TimeBase:
    """Stamps that rise strictly.

    Attributes:
        rows: rows of the table with a stamp, in order of time.
        time: [s], like `rows`.
        restarts: indices in `rows` where a recording restarts after a pause of unknown length.
        findings: on corrections.
        rate_std: relative standard deviation of the sample interval, from rounding.
    """

    rows: np.ndarray
    time: np.ndarray
    restarts: np.ndarray
    findings: tuple[Finding, ...]
    rate_std: float = 0.0


class _Mender:
    """Stamps of one column under correction; each step keeps or drops rows and reports it."""

    def __init__(self, name: str, stamps: np.ndarray, first_row: int):
        self.name, self.first_row = name, first_row
        self.time = np.where(np.abs(stamps) < _LATEST, stamps, np.nan)
        self.rows = np.arange(len(stamps))
        self.restarts = np.zeros(0, dtype=int)
        self.findings: list[Finding] = []
        self.lost = 0
        self.rate_std = 0.0

    def say(self, severity, what: str, place: int | None, consequence: str) -> None:
        where = (
            self.name if place is None else f"{self.name}, first in data row {self.first_row + self.rows[place] + 1}"
        )
        self.findings.append(Finding(severity, what, where, consequence))

    def keep(self, kept: np.ndarray) -> None:
        """Keep some rows (a mask)."""
        self.restarts = np.searchsorted(np.flatnonzero(kept), self.restarts)
        self.rows, self.time = self.rows[kept], self.time[kept]

    def lose(self, lost: np.ndarray) -> None:
        """Drop rows (a mask), counted as lost."""
        self.lost += int(lost.sum())
        self.keep(~lost)


def time_base(
    stamps: np.ndarray, samples: np.ndarray, *, path: object, name: str, second: float, first_row: int
) -> TimeBase:
    """The time base of a column of stamps.

    Args:
        stamps: [s] as logged, (n,), NaN where blank.
        samples: all other columns, (n, columns); a row that repeats them and its stamp is a duplicate.
        path: the log, for messages.
        name: the column, for messages.
        second: the column's units per second; counters wrap in these.
        first_row: row of the file with the first stamp.

    Returns:
        The time base.

    Raises:
        InputError: The column is not a clock: it is constant, or too few of its rows are usable.
    """
    mender = _Mender(name, stamps, first_row)
    _unwrap(mender, second)
    _drop_doubled(mender, samples)
    _order(mender)
    _fill_blanks(mender)
    _spread_coarse(mender)
    _tell_of_counting(mender)
    _drop_repeated(mender)
    if len(mender.time) < 2 or mender.lost > _WORST * len(stamps):
        lost = mender.lost / max(1, len(stamps))
        raise InputError(
            f"{path}: the column '{name}' is not a clock, since it is constant, runs backwards or is blank in "
            f"{100 * lost:.0f} % of its rows; name the right column in [columns] time, export its stamps with all "
            "their digits, or remove it and give [signals] sample_rate"
        )
    return TimeBase(mender.rows, mender.time, mender.restarts, tuple(mender.findings), mender.rate_std)


def _typical(time: np.ndarray) -> float:
    """Median magnitude of the nonzero steps."""
    step = np.abs(np.diff(time[np.isfinite(time)]))
    return float(np.median(step[step > 0])) if (step > 0).any() else 0.0


def _unwrap(mender: _Mender, second: float) -> None:
    ticks = mender.time * second
    step = np.diff(ticks)
    typical = _typical(ticks)
    back = np.flatnonzero(step < 0)
    if typical == 0 or len(back) == 0:
        return
    clocks = [c * s for c in _COUNTERS for s in _SCALES] + [_DAY * s for s in (1.0, 1e3, 1e6, 1e9)]
    # A clock of the seconds in a minute, or the parts of a second.
    parts = [span * second for span in _PARTS]
    for span in (*clocks, *parts):
        reach = min(_FAR * typical, _NEAR * span)
        if reach < 2 * typical:
            continue
        for low in (0.0, -span / 2):
            from_end = np.abs(ticks[back] - (low + span)) < reach
            to_begin = np.abs(ticks[back + 1] - low) < reach
            wraps = back[from_end & to_begin]
            if len(wraps) == 0 or np.nanmin(ticks) < low - 1 or np.nanmax(ticks) > low + span:
                continue
            # Consecutive recordings of a second each also begin at zero.
            if span in parts and (low < 0 or ticks[np.isfinite(ticks)][0] < reach):
                continue
            turns = np.zeros(len(ticks))
            turns[wraps + 1] = 1.0
            mender.time = (ticks + span * np.cumsum(turns)) / second
            mender.say(
                "note", f"the clock wraps at {span:.10g} in {len(wraps)} places", int(wraps[0]) + 1, "it was unwrapped"
            )
            return


def _drop_doubled(mender: _Mender, samples: np.ndarray) -> None:
    """Drop rows that repeat an earlier row completely: a buffer was written twice."""
    known = np.flatnonzero(np.isfinite(mender.time))
    order = known[np.argsort(mender.time[known], kind="stable")]
    same = np.diff(mender.time[order]) == 0
    alike = np.all((samples[order][1:] == samples[order][:-1]) | np.isnan(samples[order][1:]), axis=1)
    # Coarsely rounded stamps are shared by rows that differ, and by some that are equal, as at rest.
    told = same & np.all(np.isfinite(samples[order][1:]), axis=1)
    if told.any() and np.mean(alike[told]) < _DOUBLED:
        return
    doubled = order[1:][same & alike]
    if len(doubled) == 0:
        return
    mender.say("warning", f"twice the same row, stamp and all, {len(doubled)} times", int(doubled.min()), "one is used")
    kept = np.ones(len(mender.rows), dtype=bool)
    kept[doubled] = False
    mender.keep(kept)


def _irregular(step: np.ndarray, typical: float) -> int:
    return int(np.sum(np.abs(step / typical - 1) > _IRREGULAR))


def _order(mender: _Mender) -> None:
    """Sort late rows in; append a restarted recording to the one before."""
    known = np.flatnonzero(np.isfinite(mender.time))
    time = mender.time[known]
    step, typical = np.diff(time), _typical(time)
    back = np.flatnonzero(step < 0)
    if len(back) == 0 or typical == 0:
        return
    order = np.argsort(time, kind="stable")
    sorted_step = np.diff(time[order])
    if (sorted_step > 0).all() and _irregular(sorted_step, typical) < _irregular(step, typical):
        mender.say(
            "warning", f"{len(back)} times a row comes late", int(known[back[0]]) + 1, "rows were sorted by stamp"
        )
        mender.rows, mender.time = mender.rows[known[order]], time[order]
        return
    runs = np.diff(np.concatenate(([0], back + 1, [len(time)])))
    wild = ~_rising(time)
    if wild.mean() > _FEW and runs.min() >= _LONG:
        # The length of the pause is unknown; the following rows are fitted as a separate stretch.
        shift = np.zeros(len(time))
        shift[back + 1] = -step[back] + 100 * typical
        mender.time[known] = time + np.cumsum(shift)
        mender.say(
            "warning",
            f"the clock restarts in {len(back)} places",
            int(known[back[0]]) + 1,
            "each part is fitted as a separate stretch, and its stamps were shifted after those before",
        )
        mender.restarts = known[back] + 1
        return
    # Drop single stamps that are out of order: the longest rising part is kept.
    mender.time[known[wild]] = np.nan


def _rising(time: np.ndarray) -> np.ndarray:
    """Which stamps belong to the longest rising subsequence (patience sorting)."""
    tails: list[float] = []
    ends: list[int] = []
    before = np.full(len(time), -1)
    for i, value in enumerate(time.tolist()):
        place = bisect_right(tails, value)
        before[i] = ends[place - 1] if place else -1
        tails[place : place + 1] = [value]
        ends[place : place + 1] = [i]
    kept = np.zeros(len(time), dtype=bool)
    at = ends[-1]
    while at >= 0:
        kept[at] = True
        at = int(before[at])
    return kept


def _fill_blanks(mender: _Mender) -> None:
    """Interpolate blank or wild stamps where the sampling is regular; else drop the row."""
    blank = np.isnan(mender.time)
    if not blank.any() or blank.all():
        mender.lose(blank)
        return
    typical = _typical(mender.time)
    place = np.arange(len(blank))
    filled = np.interp(place, place[~blank], mender.time[~blank])
    around = (
        np.interp(place, place[~blank][:-1] + 0.5, np.diff(mender.time[~blank]) / np.diff(place[~blank]))
        if ((~blank).sum() > 1)
        else np.zeros(len(blank))
    )
    inside = (place > place[~blank][0]) & (place < place[~blank][-1])
    fits = blank & inside & (np.abs(around - typical) < _IRREGULAR * typical)
    first = int(np.flatnonzero(blank)[0])
    mender.say(
        "warning",
        f"{int(blank.sum())} stamps are blank or out of order",
        first,
        f"{int(fits.sum())} were interpolated, the rows of the others were omitted",
    )
    mender.time = np.where(fits, filled, mender.time)
    mender.lose(blank & ~fits)


def _spread_coarse(mender: _Mender) -> None:
    """Replace rounded stamps by those of steady sampling that agrees with them.

    Stamps in milliseconds of samples at 2 kHz repeat; single-precision stamps of a long uptime step by their last bit.
    If equal sample intervals explain every stamp to within its rounding, they are more accurate.
    """
    time = mender.time
    step = np.diff(time)
    if len(step) < 2 or (step < 0).any() or len(mender.restarts):
        return
    as_good_as_it_gets = 4 * np.spacing(np.max(np.abs(time)))
    quantum = _quantum(step, as_good_as_it_gets)
    mean = float(np.mean(step[step <= np.median(step) + 2 * quantum]))
    if quantum <= as_good_as_it_gets or mean <= 0 or quantum < _COARSE * mean:
        return
    # The length of a pause is known to the rounding only, so that the count restarts after it.
    late = step > (mean + 1.2 * quantum if quantum > 0.4 * mean else 1.5 * mean)
    run = np.concatenate(([0], np.cumsum(late)))
    clock = steady_clock(time, run, quantum)
    if clock is None:
        return
    off = time - clock.time
    # Steps of one and two quanta may also be those of an exact clock with a few missing samples.
    missing = (step > 0).all() and quantum > 0.75 * np.median(step)
    loosest = 0.01 if missing else 0.15
    if clock.slack > loosest * quantum or np.max(np.abs(off)) < _COARSE * clock.interval:
        return
    doubled = np.sum((step > 1.5 * quantum) & ~late)
    # Each pause lets the clock begin anew, so that a few doubled steps say nothing.
    if missing and doubled < 5 + 2 * late.sum() or (np.diff(clock.time) <= 0).any():
        return
    mender.time, mender.rate_std = clock.time, clock.rate_std
    mender.say(
        "note",
        f"the stamps are rounded to {quantum:.4g} s and agree with steady sampling every {clock.interval:.7g} s, "
        f"known to {100 * clock.rate_std:.1g} %",
        None,
        "the steady clock was used, and standard errors include its uncertainty",
    )


def _tell_of_counting(mender: _Mender) -> None:
    """Warn of stamps counted up in single precision: each sum is rounded alike, so that their rate is another one."""
    time = mender.time
    if len(time) < _LONG or not np.array_equal(time, time.astype(np.float32)):
        return
    place = np.spacing(time.astype(np.float32)).astype(float)
    step, usual = np.diff(time), np.median(place)
    digits = step[(place[1:] == usual) & (place[:-1] == usual)] / usual
    # A rate such as 1024 Hz has the same step at all magnitudes.
    exact = np.ptp(step) == 0 and np.ptp(place) > 0
    if len(digits) < _LONG or np.ptp(digits) > 0 or not 0 < digits[0] <= _FEWEST_DIGITS or exact:
        return
    mender.say(
        "warning",
        f"the stamps step by exactly {digits[0]:.0f} of the last digit of single precision, as if counted up in it, so "
        f"that the sample rate may be off by {50 / digits[0]:.1g} %",
        None,
        "a stiffness is off by twice as much, unless [signals] sample_rate is stated",
    )


def _quantum(step: np.ndarray, digits: float) -> float:
    """The quantum of the steps, or 0 without one; `digits` is the value of the stamps' last digit."""
    scale = float(np.median(np.abs(step))) or float(np.mean(np.abs(step)))
    if not scale > 0:
        return 0.0
    # Differences closer than a fraction of the step, or double rounding, are equal.
    gaps = np.diff(np.unique(step))
    gaps = gaps[gaps > max(_COARSE * scale, digits)]
    if not 1 <= len(gaps) < _MOST_STEPS:
        return 0.0
    quantum = float(gaps.min())
    count = np.rint(step / quantum)
    # A very fine grid is given by the distances of the steps.
    if quantum < 0.01 * scale:
        return quantum
    return float(step.sum() / count.sum()) if np.mean(np.abs(step / quantum - count) < 0.05) > 0.98 else 0.0


def _drop_repeated(mender: _Mender) -> None:
    repeated = np.concatenate(([False], np.diff(mender.time) <= 0))[: len(mender.time)]
    if not repeated.any():
        return
    mender.say(
        "warning",
        f"{int(repeated.sum())} rows repeat the stamp of the row before with other numbers",
        int(np.argmax(repeated)),
        "they were left out",
    )
    mender.lose(repeated)
