"""Text cells: splitting by polars, and conversion of columns to numbers in various notations."""

from io import BytesIO

import numpy as np
import polars as pl

from fitting.logs.raw_table import DATE, HALF_DAY, RawColumn
from fitting.logs.units import UnitError, convert

# Words for missing numbers.
_BLANKS = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---", "?", "nil", "missing")
_SECONDS_A_DAY = 86400.0
_MOST_UNITS = 8
# Groups of three digits; no number begins with a zero before them.
_THOUSANDS = r"^[-+]?[1-9][0-9]{{0,2}}({0}[0-9]{{3}})+$"
# Largest share of stamps that may be incomplete, assumed.
_TORN = 0.05
# With dots between day and month, the day is first; slashes are ambiguous.
_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%Y%m%d")


def cells(lines: list[str], delimiter: str, width: int, places: list[int]) -> pl.DataFrame:
    """The cells of some columns as text; rows that are too short end blank, longer ones are cut."""
    if delimiter == " ":
        lines = [" ".join(line.split()) for line in lines]
    lines = [line for line in lines if line.strip() and not line.startswith("#")]
    # polars takes the columns from the first row, which may have fewer or more.
    source = "\n".join([delimiter.join("0" * width), *lines]).encode()
    if b'"' in source:
        try:
            found = _parsed(source, delimiter, width, places, '"')
        except pl.exceptions.PolarsError:
            found = None
        # A single quotation mark would include the rest of the file.
        if found is not None and found.height == len(lines):
            return found
    return _parsed(source, delimiter, width, places, None)


def _parsed(source: bytes, delimiter: str, width: int, places: list[int], quote: str | None) -> pl.DataFrame:
    found = pl.read_csv(
        BytesIO(source),
        separator=delimiter,
        comment_prefix="#",
        quote_char=quote,
        has_header=False,
        schema={f"c{i}": pl.String for i in range(width)},
        columns=places,
        truncate_ragged_lines=True,
    )
    return found.slice(1)


def column_from_text(text: pl.Series, *, comma_parts_cells: bool) -> RawColumn:
    """The numbers in a column of text: any decimal sign, unambiguous thousands separators, dates.

    Args:
        text: the cells.
        comma_parts_cells: whether the comma is the delimiter, so that a comma in a quoted cell before three digits
            separates thousands.
    """
    cells = text.cast(pl.String).str.strip_chars()
    blank = (cells.is_null() | cells.str.to_lowercase().is_in(_BLANKS)).to_numpy()
    values = _numbers(cells, comma_parts_cells)
    wrong = (
        np.isnan(values) & ~blank & ~cells.str.to_lowercase().is_in(("+nan", "-nan")).fill_null(value=False).to_numpy()
    )
    if wrong.sum() > 0.5 * max(1, (~blank).sum()):
        filled = cells.filter(pl.Series(~blank))
        stamps = _stamps(filled)
        found, unit = (stamps, "s") if stamps is not None else _quantities(filled, comma_parts_cells)
        if found is not None:
            values = np.full(len(cells), np.nan)
            values[~blank] = found
            wrong = ~blank & np.isnan(values)
            return _column(cells, values, wrong, unit)
    return _column(cells, values, wrong)


def _column(cells: pl.Series, values: np.ndarray, wrong: np.ndarray, unit: str | None = None) -> RawColumn:
    rows = np.flatnonzero(wrong)
    return RawColumn(values, unit, text_rows=rows, text=str(cells[int(rows[0])])[:40] if len(rows) else "")


def _numbers(cells: pl.Series, comma_parts_cells: bool) -> np.ndarray:
    values = cells.cast(pl.Float64, strict=False)
    if values.null_count() > cells.null_count():
        # Typographic minus signs and spaces, and Fortran exponents.
        plain = cells.str.replace_all(r"[\u2212\u2013]", "-").str.replace_all(r"['’\s\u00a0\u202f]", "")
        plain = plain.str.replace(r"^([-+]?[0-9.,]+)[dD]([-+]?[0-9]+)$", "${1}e${2}")
        values = _point(plain, comma_parts_cells).cast(pl.Float64, strict=False)
    return values.fill_null(float("nan")).to_numpy().astype(np.float64)


def _point(cells: pl.Series, comma_parts_cells: bool) -> pl.Series:
    """The cells with a decimal point and no thousands separators."""
    comma, point = cells.str.contains(",", literal=True), cells.str.contains(".", literal=True)
    if not comma.any():
        several = cells.str.count_matches(r"\.").fill_null(0)
        grouped = cells.filter(several > 0).str.contains(_THOUSANDS.format(r"\."))
        return cells.str.replace_all(".", "", literal=True) if (several > 1).any() and grouped.all() else cells
    both = comma & point
    if both.any():
        example = str(cells.filter(both.fill_null(value=False))[0])
        grouping = "," if example.rfind(".") > example.rfind(",") else "."
    else:
        grouped = cells.filter(comma.fill_null(value=False)).str.contains(_THOUSANDS.format(","))
        several = (cells.str.count_matches(",").fill_null(0) > 1).any()
        # "1,234" has a decimal comma unless the comma is the delimiter.
        grouping = "," if grouped.all() and (several or comma_parts_cells) else "."
    return cells.str.replace_all(grouping, "", literal=True).str.replace(",", ".", literal=True)


def _quantities(cells: pl.Series, comma_parts_cells: bool) -> tuple[np.ndarray | None, str | None]:
    """Numbers followed by a unit, such as "12 ms", in the first one's unit, NaN for others; None where few are."""
    parts = cells.str.extract_groups(r"^([-+\u2212]?[0-9.,]+(?:[eE][-+]?[0-9]+)?)\s*([a-zA-Zµμ°%].*)$")
    number, unit = (parts.struct.field(f) for f in ("1", "2"))
    units = unit.drop_nulls().unique(maintain_order=True).to_list()
    if unit.null_count() > 0.5 * len(cells) or not 0 < len(units) <= _MOST_UNITS:
        return None, None
    values = _numbers(number, comma_parts_cells)
    for other in units[1:]:
        try:
            factor = float(convert(np.array(1.0), other, units[0]))
        except UnitError:
            factor = np.nan
        values = np.where((unit == other).fill_null(value=False).to_numpy(), values * factor, values)
    return values, units[0]


def _stamps(cells: pl.Series) -> np.ndarray | None:
    """Seconds of dates (since 1970), times of day or durations, NaN for few others; None where many are."""
    # Digits beyond the ninth and time zones are dropped: only differences matter.
    plain = cells.str.replace(",", ".", literal=True).str.replace(r"\s*(Z|UTC|[-+][0-9]{2}:?[0-9]{2})$", "")
    plain = plain.str.replace(r"^([0-9]+):([0-9]{2}\.[0-9]*)$", "0:${1}:${2}")
    parts = plain.str.extract_groups(
        rf"^(?:([0-9]+) days?\.?,?\s+)?(?:({DATE})[T\s_]+)?"
        rf"([0-9]{{1,4}}):([0-9]{{1,2}})(?::([0-9]{{1,2}}(?:\.[0-9]*)?))?{HALF_DAY}$"
    )
    known = parts.struct.field("4").is_not_null()
    if known.sum() < (1.0 - _TORN) * len(cells) or not known.any():
        return None
    since, date, hour, minute, second, half = (parts.struct.field(f).filter(known) for f in "123456")
    clock = [p.cast(pl.Float64, strict=False).fill_null(0.0).to_numpy() for p in (since, hour, minute, second)]
    if half.null_count() == 0:
        clock[1] = clock[1] % 12.0 + 12.0 * (half.str.to_lowercase() == "p").to_numpy()
    seconds = clock[0] * _SECONDS_A_DAY + clock[1] * 3600.0 + clock[2] * 60.0 + clock[3]
    read = (date.str.to_date(form, strict=False) for form in _DATES)
    days = next((found.cast(pl.Int32).to_numpy() for found in read if found.null_count() == 0), None)
    if days is None:
        # The clock restarts at midnight. Dates in another form only have to change there.
        midnight = np.diff(seconds, prepend=seconds[0]) < -0.5 * _SECONDS_A_DAY
        changed = (date != date.shift(1)).fill_null(value=False).to_numpy()
        if date.null_count() < len(date) and not np.array_equal(changed, midnight):
            return None
        days = np.cumsum(midnight)
    stamps = np.full(len(cells), np.nan)
    stamps[known.to_numpy()] = seconds + _SECONDS_A_DAY * days
    return stamps
