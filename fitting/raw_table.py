"""What a log file holds, before anyone says what it means: columns of numbers in the file's own names and units."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from fitting.errors import InputError

# What loggers write where they have no number.
_BLANKS = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---", "?", "nil", "missing")
_SECONDS_A_DAY = 86400.0
# Day first is the custom wherever a dot parts day and month; a slash says nothing, so such stamps are refused.
_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%Y%m%d")


@dataclass(frozen=True, eq=False)
class RawColumn:
    """One column as numbers.

    Attributes:
        values: float64, (n,), NaN where the file has nothing or text.
        unit: as the file states it (unit row, "name [unit]", attribute), or None.
        time: own stamps [s], (n,), of a channel that brings its own clock; None for the table's rows.
        text_rows: rows that hold text where a number was expected.
        text: of the first of them.
    """

    values: np.ndarray
    unit: str | None = None
    time: np.ndarray | None = None
    text_rows: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    text: str = ""


@dataclass(frozen=True, eq=False)
class RawTable:
    """What one file holds of what was asked for.

    Attributes:
        names: All columns of the file.
        columns: The asked columns that the file has, by the name asked for.
        sample_rate: Hz, a scalar `fs` beside the data (MAT and HDF5 only), or None.
    """

    names: tuple[str, ...]
    columns: dict[str, RawColumn] = field(default_factory=dict)
    sample_rate: float | None = None


def not_numbers(path: Path, name: str, what: str, mend: str = "save it as one") -> InputError:
    """The refusal of a column that is no vector."""
    return InputError(f"{path}: the column '{name}' {what}, where a plain vector of numbers is needed; {mend}")


def split_unit(name: str) -> tuple[str, str | None]:
    """A header such as "torque [N m]" or "time (ms)" as name and unit; the unit is None where there is none."""
    match = re.fullmatch(r"\s*(.+?)\s*[\[(]([^\[\]()]*[A-Za-zµ°%][^\[\]()]*)[\])]\s*", name)
    return (name.strip(), None) if match is None else (match[1], match[2].strip())


def column_from_text(text: pl.Series, *, comma_parts_cells: bool) -> RawColumn:
    """The numbers in a column of text: any decimal sign, thousands separators where they can't be mistaken, dates.

    Args:
        text: the cells.
        comma_parts_cells: whether the comma is the file's delimiter, so that a comma inside a (quoted) cell with three
            digits behind it parts thousands.
    """
    cells = text.cast(pl.String).str.strip_chars()
    blank = (cells.is_null() | cells.str.to_lowercase().is_in(_BLANKS)).to_numpy()
    values = _numbers(cells, comma_parts_cells)
    wrong = (
        np.isnan(values) & ~blank & ~cells.str.to_lowercase().is_in(("+nan", "-nan")).fill_null(value=False).to_numpy()
    )
    if wrong.sum() > 0.5 * max(1, (~blank).sum()):
        stamps = _stamps(cells.filter(pl.Series(~blank)))
        if stamps is not None:
            values = np.full(len(cells), np.nan)
            values[~blank] = stamps
            return RawColumn(values, unit="s")
    rows = np.flatnonzero(wrong)
    return RawColumn(values, text_rows=rows, text=str(cells[int(rows[0])])[:40] if len(rows) else "")


def _numbers(cells: pl.Series, comma_parts_cells: bool) -> np.ndarray:
    values = cells.cast(pl.Float64, strict=False)
    if values.null_count() > cells.null_count():
        # Minus signs, spaces and exponents that typesetters and Fortran write.
        plain = cells.str.replace_all(r"[\u2212\u2013]", "-").str.replace_all(r"['’\s\u00a0\u202f]", "")
        plain = plain.str.replace(r"^([-+]?[0-9.,]+)[dD]([-+]?[0-9]+)$", "${1}e${2}")
        values = _point(plain, comma_parts_cells).cast(pl.Float64, strict=False)
    return values.fill_null(float("nan")).to_numpy().astype(np.float64)


def _point(cells: pl.Series, comma_parts_cells: bool) -> pl.Series:
    """The cells with a decimal point and no thousands separators."""
    comma, point = cells.str.contains(",", literal=True), cells.str.contains(".", literal=True)
    if not comma.any():
        several = cells.str.count_matches(r"\.").fill_null(0)
        return cells.str.replace_all(".", "", literal=True) if (several > 1).any() else cells
    both = comma & point
    if both.any():
        example = str(cells.filter(both.fill_null(value=False))[0])
        grouping = "," if example.rfind(".") > example.rfind(",") else "."
    else:
        grouped = cells.filter(comma.fill_null(value=False)).str.contains(r"^[-+]?[0-9]{1,3}(,[0-9]{3})+$")
        several = (cells.str.count_matches(",").fill_null(0) > 1).any()
        # A lone "1,234" is a decimal comma unless commas part the cells.
        grouping = "," if grouped.all() and (several or comma_parts_cells) else "."
    return cells.str.replace_all(grouping, "", literal=True).str.replace(",", ".", literal=True)


def _stamps(cells: pl.Series) -> np.ndarray | None:
    """Seconds of dates, since 1970, or of times of day; None where they are neither."""
    # Digits beyond the ninth are dropped, a zone is taken off: only differences matter.
    plain = cells.str.replace(",", ".", literal=True).str.replace(r"\s*(Z|UTC|[-+][0-9]{2}:?[0-9]{2})$", "")
    parts = plain.str.extract_groups(r"^(?:([0-9./-]+)[T\s_]+)?([0-9]{1,2}):([0-9]{2})(?::([0-9]{2}(?:\.[0-9]*)?))?$")
    date, hour, minute, second = (parts.struct.field(f) for f in ("1", "2", "3", "4"))
    if hour.null_count() or len(cells) == 0:
        return None
    clock = [p.cast(pl.Float64, strict=False).fill_null(0.0).to_numpy() for p in (hour, minute, second)]
    seconds = clock[0] * 3600.0 + clock[1] * 60.0 + clock[2]
    if date.null_count() == len(date):
        # The clock starts anew at midnight.
        return seconds + _SECONDS_A_DAY * np.cumsum(np.diff(seconds, prepend=seconds[0]) < -0.5 * _SECONDS_A_DAY)
    for form in _DATES:
        days = date.str.to_date(form, strict=False)
        if days.null_count() == 0:
            number = days.cast(pl.Int32).to_numpy()
            return seconds + _SECONDS_A_DAY * number
    return None
