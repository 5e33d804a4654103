"""The clock column of a log, and its unit."""

import re
from dataclasses import dataclass, field, replace

import numpy as np

from fitting.errors import InputError
from fitting.inspection.columns import Column, Table
from fitting.logs.findings import Finding
from fitting.logs.time_stamps import SLOWEST, TimeBase, time_base
from fitting.logs.units import UnitError, convert, is_unit

# Log odds, assumed.
_NAMED, _MAYBE, _ANONYMOUS, _OTHERWISE, _COUNTER = 3.0, 0.5, -1.0, -6.0, -2.0
_UNIT_FITS, _UNIT_CONTRADICTS = 2.0, -8.0
_EPOCH = 8.0
# Typical sampling rate of loggers: some hundreds of hertz, within a factor of ten; assumed.
_USUAL_RATE, _RATE_SPREAD = 500.0, np.log(10.0)
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# Clocks that count since a date: its year, their units in seconds, and the seconds from the date to 1970. These are
# Unix, Windows, .NET, spreadsheets and MATLAB's datenum.
_DATED = (
    ("1970", _SECONDS, 0.0),
    ("1601", {"100 ns": 1e-7}, 11644473600.0),
    ("the year 1", {"100 ns": 1e-7}, 62135596800.0),
    ("1900", {"d": 86400.0}, 25569 * 86400.0),
    ("the year 0", {"d": 86400.0}, 719529 * 86400.0),
)
_EPOCHS = (0.9e9, 2.5e9)  # s since 1970, of the years 1998 to 2049
_MOST_BACK = 0.01
_NEARLY_ALL = 0.9  # of a second, which the largest part of one exceeds


@dataclass(frozen=True, eq=False)
class TimeGuess:
    """The clock of a log.

    Attributes:
        column: Its name; None if channels have separate clocks, a sample rate is stated, or there is none.
        unit: Of its stamps.
        confidence: Of the column, 0 to 1.
        reasons: For both.
        fraction: Column with the parts of a second, and their unit; None where the stamps are in one column.
        clocks: For a table with several time columns: the clock of each column with a later one, by name.
    """

    column: str | None
    unit: str
    confidence: float
    reasons: tuple[str, ...]
    clocks: dict[str, str] = field(default_factory=dict)
    fraction: tuple[str, str] | None = None


@dataclass(frozen=True, eq=False)
class Clock:
    """The stamps of one log.

    Attributes:
        base: Stamps [s] and their rows.
        known: Whether the unit of time is known; if not, a row counts as a second.
        own: Of the columns with separate clocks, by name; without rows where the stamps are no clock.
    """

    base: TimeBase
    known: bool
    own: dict[str, TimeBase]


def guess_time(table: Table) -> TimeGuess:
    """The clock column of a table."""
    if any(column.time is not None for column in table.columns):
        return TimeGuess(None, "s", 1.0, ("each channel has separate stamps",))
    # Of several equal time columns, the first represents all.
    named = [column for column in table.columns if _first_name(column.name, table) is None]
    scored = [(_log_odds(column, _is_repeated(column, table)), column) for column in named]
    score, column = max(scored, key=lambda pair: pair[0], default=(-np.inf, None))
    pair = _pair(table, column)
    if pair is not None:
        whole, part, unit = pair
        why = f"whole seconds, which change where '{part}' begins anew"
        return TimeGuess(whole, "s", 1.0, (why,), fraction=(part, unit))
    if column is None or score <= 0.0:
        why = "a sample rate is stored with the data" if table.sample_rate else "no column rises like a clock"
        return TimeGuess(None, "s", 1.0 if table.sample_rate else 0.0, (why,))
    # Channels may be stored with a copy of the clock each.
    rivals = [s for s, c in scored if c is not column and not np.array_equal(c.values, column.values, equal_nan=True)]
    weights = np.exp(np.clip([0.0, score, *rivals], -30.0, 30.0))
    rising = _rising(column.values)[0]
    reasons = [f"rises in {100 * rising:.4g} % of its rows"]
    if "time" in column.sense.quantities:
        reasons.insert(0, f"the name '{column.name}'")
    unit, why = _unit(column)
    confidence = float(np.exp(min(score, 30.0)) / weights.sum())
    return TimeGuess(column.name, unit, confidence, (*reasons, why), _clocks(table, column.name))


def _pair(table: Table, column: Column | None) -> tuple[str, str, str] | None:
    """A column of whole seconds, that of their parts, and the latter's unit; one of both is given."""
    if column is None:
        return None
    for other in table.columns:
        for whole, part in ((column, other), (other, column)):
            unit = _unit_of_parts(whole.values, part.values) if whole is not part else None
            if unit is not None:
                return whole.name, part.name, unit
    return None


def _unit_of_parts(whole: np.ndarray, part: np.ndarray) -> str | None:
    """Unit of the parts of whole seconds; None where the values are not."""
    known = np.isfinite(whole) & np.isfinite(part) if len(whole) == len(part) else np.zeros(0, dtype=bool)
    whole, part = whole[: len(known)][known], part[: len(known)][known]
    if len(whole) < 2 or np.any(whole != np.rint(whole)) or part.min() < 0:
        return None
    seconds = np.diff(whole)
    # Each second begins with a smaller part, which rises within it.
    if not (seconds > 0).any() or np.any(seconds < 0) or np.any((np.diff(part) < 0) != (seconds > 0)):
        return None
    sizes = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
    return next((unit for unit, size in sizes.items() if _NEARLY_ALL * size < part.max() < size), None)


def _first_name(name: str, table: Table) -> str | None:
    """The name that a numbered column repeats; None if it repeats none."""
    match = re.fullmatch(r"(.+?)(?: \([0-9]+\)|\.[0-9]+|_duplicated_[0-9]+)", name)
    return match[1] if match is not None and match[1] in table.names else None


def _clocks(table: Table, first: str) -> dict[str, str]:
    """The clock of each column after a repeated time column."""
    clocks, clock = {}, first
    for column in table.columns:
        if _first_name(column.name, table) == first:
            clock = column.name
        elif clock != first:
            clocks[column.name] = clock
    return clocks


def _own_base(table: Table, column: Column, guess: TimeGuess) -> TimeBase | None:
    """The time base of a column with a separate clock, without rows where it is none; None if it has the table's."""
    stamps = column.time
    if column.name in guess.clocks:
        stamps = table.column(guess.clocks[column.name]).values * float(convert(np.array(1.0), guess.unit, "s"))
    if stamps is None:
        return None
    # The shorter channel of a table ends in blanks.
    stamps = stamps[: int(np.max(np.flatnonzero(np.isfinite(stamps)), initial=-1)) + 1]
    rows = np.arange(len(stamps))
    try:
        return time_base(stamps, rows[:, None], path=table.path, name=column.name, second=1.0, first_row=0)
    except InputError:
        return TimeBase(rows[:0], stamps[:0], rows[:0], ())


def clock_of(table: Table, guess: TimeGuess) -> Clock:
    """The stamps of a table by the guessed clock column."""
    rows = np.arange(table.rows)
    own = {c.name: base for c in table.columns if (base := _own_base(table, c, guess)) is not None}
    if guess.column is not None:
        try:
            return Clock(_base(table, guess), True, own)
        except InputError:
            pass
    step = 1.0 / table.sample_rate if table.sample_rate else 1.0
    # The fastest clock has the finest grid.
    finest = max(own.values(), key=lambda base: len(base.rows), default=None)
    if finest is not None and len(finest.rows):
        return Clock(finest, True, own)
    return Clock(TimeBase(rows, rows * step, np.zeros(0, dtype=int), ()), table.sample_rate is not None, own)


def _base(table: Table, guess: TimeGuess) -> TimeBase:
    """The time base of a guess that has a column."""
    assert guess.column is not None
    column, second = table.column(guess.column), float(convert(np.array(1.0), guess.unit, "s"))
    others = [other.values for other in table.columns if other is not column]
    if guess.fraction is not None:
        part, unit = guess.fraction
        parts = convert(table.column(part).values, unit, "s")
        column = replace(column, values=column.values - np.nanmin(column.values) + parts)
    samples = np.stack(others or [np.arange(len(column.values))], axis=1)
    return time_base(
        column.values * second, samples, path=table.path, name=column.name, second=1.0 / second, first_row=0
    )


def sampling_findings(table: Table, guess: TimeGuess, clock: Clock) -> tuple[Finding, ...]:
    """Corrections of the stamps, or why there are none."""
    if guess.column is None:
        told = "the stamps are constant, run backwards or are blank"
        wrong = [name for name, base in clock.own.items() if not len(base.rows)]
        return tuple(Finding("refusal", told, name, "the column has no time base") for name in wrong)
    try:
        return _base(table, guess).findings
    except InputError as error:
        return (Finding("refusal", str(error).partition(": ")[2], guess.column, "there is no time base"),)


def _stated(column: Column) -> str | None:
    """The stated unit if it is one of time."""
    try:
        convert(np.array(1.0), column.unit or "", "s")
    except UnitError:
        return None
    return column.unit


def _rising(values: np.ndarray) -> tuple[float, float, float]:
    """Shares of rising and falling rows, and the relative spread of the increments."""
    step = np.diff(values[np.isfinite(values)])
    if len(step) == 0 or not (step > 0).any():
        return 0.0, 1.0, np.inf
    up = step[step > 0]
    low, high = np.quantile(up, (0.1, 0.9))
    return float(np.mean(step > 0)), float(np.mean(step < 0)), float((high - low) / np.median(up))


def _is_repeated(column: Column, table: Table) -> bool:
    """Whether later columns have the name and the values of this one."""
    later = (other for other in table.columns if _first_name(other.name, table) == column.name)
    return any(np.array_equal(column.values, other.values, equal_nan=True) for other in later)


def _log_odds(column: Column, repeated: bool) -> float:
    """Log odds that the column is the clock; one that is repeated may be called anything."""
    known = np.isfinite(column.values)
    if known.mean() < 1.0 - 0.2 or column.constant:
        return -np.inf
    rising, falling, uneven = _rising(column.values)
    if falling > _MOST_BACK:
        return -np.inf
    said = column.sense.quantities
    counts = said[:1] == ("counter",)
    if repeated and "time" not in said and not counts:
        said = ()
    name = _NAMED if said == ("time",) else _MAYBE if "time" in said else _OTHERWISE if said else _ANONYMOUS
    unit = 0.0
    if _stated(column) or _since(column.values):
        unit = _UNIT_FITS
    elif counts or (not said and np.all(np.diff(column.values[known]) == 1.0)):
        # The number of the row, or of the cycle, tells no rate.
        return -np.inf
    elif column.unit is not None and is_unit(column.unit):
        unit = _UNIT_CONTRADICTS
    name = _COUNTER if counts else name
    return name + unit + 4.0 * rising + (1.0 if falling == 0 else -2.0) + (1.0 if uneven < 1.0 else -1.0)


def _unit(column: Column) -> tuple[str, str]:
    """Unit of a clock, with the reason."""
    stated = _stated(column)
    if stated is not None:
        return stated, f"the unit '{stated}'"
    typical, dated = _step(column.values), _since(column.values)
    sizes = _SECONDS | {unit: second for unit, (second, _) in dated.items()}
    scores = {}
    for unit, second in sizes.items():
        rate = 1.0 / (typical * second) if typical > 0 else np.inf
        scores[unit] = -0.5 * (np.log(rate / _USUAL_RATE) / _RATE_SPREAD) ** 2 + (_EPOCH if unit in dated else 0.0)
    best = max(scores, key=lambda unit: scores[unit])
    rate = 1.0 / (typical * sizes[best])
    since = f" since {dated[best][1]}" if best in dated else ""
    return best, f"as {best}{since} the rate is {rate:.4g} Hz"


def _step(values: np.ndarray) -> float:
    """The typical step of a clock."""
    known = values[np.isfinite(values)]
    step = np.abs(np.diff(known))
    # Repeated stamps are coarse: the mean step is more accurate than the typical one.
    return float(np.ptp(known)) / max(1, len(known) - 1) if (step == 0).mean() > 0.1 else float(np.median(step))


def _since(values: np.ndarray) -> dict[str, tuple[float, str]]:
    """Units in which a clock counts since a usual date: their size [s], and the date's year."""
    start, step = float(values[np.isfinite(values)][0]), _step(values)
    return {
        unit: (second, year)
        for year, units, before in _DATED
        for unit, second in units.items()
        if _EPOCHS[0] < start * second - before < _EPOCHS[1] and step * second < SLOWEST
    }
