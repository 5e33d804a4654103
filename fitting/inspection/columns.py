"""All columns of a log as numbers, with the meaning of their names."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fitting.errors import InputError
from fitting.logs.channels import without_fill_values
from fitting.logs.column_names import NameSense, sense
from fitting.logs.dropouts import zero_dropouts
from fitting.logs.raw_table import RawColumn, RawTable, split_unit
from fitting.logs.read_table import read_table
from fitting.logs.unwrapping import wrapping_spans

_FEWEST_ROWS = 8
_MOST_TEXT = 0.05  # largest share of rows with text or blanks for a channel
_MOST_IN_A_MATRIX = 64


@dataclass(frozen=True, eq=False)
class Column:
    """One column of numbers.

    Attributes:
        name: As used in a drive file.
        unit: As stated by the file or the name, or None.
        values: float64, (n,), NaN where unknown.
        time: Separate stamps [s], (n,), or None.
        sense: Meaning of its name.
    """

    name: str
    unit: str | None
    values: np.ndarray
    time: np.ndarray | None
    sense: NameSense

    @property
    def constant(self) -> bool:
        """Whether it is constant."""
        known = self.values[np.isfinite(self.values)]
        return len(known) == 0 or bool(np.ptp(known) == 0)


@dataclass(frozen=True, eq=False)
class Table:
    """The columns of one log.

    Attributes:
        path: Of the file, or the name of a table in memory.
        source: The table in memory, or None.
        columns: Numeric ones, in the file's order, of equal length except for separate clocks.
        left_out: Reasons why other columns are omitted, by name.
        sample_rate: Hz, if stored with the data, or None.
    """

    path: Path
    source: Any
    columns: tuple[Column, ...]
    left_out: dict[str, str]
    sample_rate: float | None

    @property
    def names(self) -> frozenset[str]:
        """Names of all columns."""
        return frozenset(column.name for column in self.columns)

    @property
    def rows(self) -> int:
        """Number of rows of the longest column."""
        return max(len(column.values) for column in self.columns)

    def column(self, name: str) -> Column:
        """The column of that name."""
        return next(column for column in self.columns if column.name == name)


def read_columns(path: Path, source: Any = None) -> Table:
    """Read all columns of a log.

    Args:
        path: File of any format of [`fitting.logs.read_table`][], or the name of a table for messages.
        source: A table in memory in place of the file, as in [`fitting.logs.frames.table_of`][].

    Raises:
        InputError: The file can't be read, or has no column of numbers.
    """
    read = _reader(path, source)
    names = tuple(dict.fromkeys(read(()).names))
    raw, left_out, rate = _all(read, names)
    kept = {name: column for name, column in raw.items() if len(column.values) >= _FEWEST_ROWS}
    counts = {name: len(column.values) for name, column in raw.items() if name not in kept}
    left_out |= {name: "a single number" if n == 1 else f"only {n} rows" for name, n in counts.items()}
    for name, column in list(kept.items()):
        reason = _no_channel(column)
        if reason:
            left_out[name] = reason
            del kept[name]
    if not kept:
        why = f" ({'; '.join(f'{name} {reason}' for name, reason in list(left_out.items())[:3])})" if left_out else ""
        raise InputError(
            f"{path}: no column holds numbers{why}; give the log file itself, or export it with its samples"
        )
    lengths = [len(column.values) for column in kept.values() if column.time is None]
    # Of arrays of several lengths, the most frequent length is used.
    usual = max(lengths, key=lambda n: (lengths.count(n), n), default=0)
    for name, column in list(kept.items()):
        if column.time is None and len(column.values) != usual:
            left_out[name] = f"{len(column.values)} rows, where most columns have {usual}"
            del kept[name]
    plain = [split_unit(name)[0] for name in names]
    columns = tuple(_column(name, column, plain) for name, column in kept.items())
    return Table(path, source, columns, left_out, rate)


Read = Callable[[Sequence[str]], RawTable]


def _reader(path: Path, source: Any) -> Read:
    if source is None:
        return lambda wanted: read_table(path, wanted)
    # Imported here: tables in memory need polars, which takes long to import.
    from fitting.logs.frames import table_of

    return lambda wanted: table_of(path, source, wanted)


def _all(read: Read, names: Sequence[str]) -> tuple[dict[str, RawColumn], dict[str, str], float | None]:
    """The readable columns, the reasons why others are not, and a stored sample rate."""
    try:
        table = read(names)
        return {name: table.columns[name] for name in names if name in table.columns}, {}, table.sample_rate
    except InputError as error:
        if len(names) > 1:
            # A column that is not a vector of numbers prevents reading all others.
            half = len(names) // 2
            first, second = _all(read, names[:half]), _all(read, names[half:])
            return first[0] | second[0], first[1] | second[1], first[2] or second[2]
        matrix = _matrix(read, names[0])
        reason = str(error).partition(f"'{names[0]}' ")[2].partition(",")[0]
        return (matrix, {}, None) if matrix else ({}, {names[0]: reason or "no numbers"}, None)


def _matrix(read: Read, name: str) -> dict[str, RawColumn]:
    """The columns of a matrix, with the names of array readers."""
    found: dict[str, RawColumn] = {}
    for k in range(1, _MOST_IN_A_MATRIX + 1):
        column = f"{name}(:,{k})"
        try:
            found |= read((column,)).columns
        except InputError:
            break
        if column not in found:
            break
    return found


def _no_channel(column: RawColumn) -> str | None:
    known = np.isfinite(column.values)
    if len(column.text_rows) > max(1, _MOST_TEXT * len(column.values)):
        return f"text such as {column.text!r}"
    return None if known.any() else "blank"


def _column(name: str, raw: RawColumn, plain: Sequence[str]) -> Column:
    said = sense(name)
    short = split_unit(name)[0]
    values, _ = without_fill_values(raw.values)
    if {"angle", "velocity"} & set(said.quantities):
        values[zero_dropouts(values, wrapping_spans(values, 360.0))] = np.nan
    return Column(
        name=short if plain.count(short) == 1 else name,
        unit=_plain_unit(raw.unit or said.unit),
        values=values,
        time=raw.time,
        sense=said if raw.unit is None else replace(said, unit=raw.unit),
    )


def _plain_unit(unit: str | None) -> str | None:
    """A unit without the marks of exports; None for an empty one."""
    unit = (unit or "").strip().strip("[]()").strip()
    return unit if unit not in ("", "-", "1", "none", "None") else None
