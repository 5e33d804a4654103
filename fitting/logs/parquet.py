"""Logs in Parquet."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import polars as pl

from fitting.logs.column_names import unit_in_name
from fitting.logs.raw_table import RawColumn, RawTable, not_numbers, places_of
from fitting.logs.text_cells import column_from_text


def read_parquet(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """The wanted columns of a Parquet file.

    Args:
        path: named in messages.
        source: what is read.
        wanted: names of columns.

    Raises:
        InputError: A wanted column is not a vector of numbers.
    """
    with _quiet():
        names = tuple(pl.read_parquet_schema(source))
        found = {name: names[place] for name, place in places_of(wanted, names).items()}
        frame = pl.read_parquet(source, columns=list(dict.fromkeys(found.values())), use_statistics=False)
    return RawTable(names, {name: _column(path, full, frame[full], name) for name, full in found.items()})


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Rust's terminal output on corrupt bytes; it raises an error as well."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _column(path: Path, name: str, series: pl.Series, asked: str) -> RawColumn:
    """A series as numbers, in its unit, or that stated in its name."""
    column = column_from_series(path, series)
    return column if column.unit is not None else replace(column, unit=unit_in_name(name, asked))


def column_from_series(path: Path, series: pl.Series) -> RawColumn:
    """A series as numbers.

    Args:
        path: named in messages.
        series: of numbers, text, times or durations.

    Raises:
        InputError: It is of another type.
    """
    kind = series.dtype
    if kind in (pl.String, pl.Categorical, pl.Enum):
        return column_from_text(series.cast(pl.String), comma_parts_cells=False)
    if isinstance(kind, pl.Datetime | pl.Duration | pl.Time):
        per_second = 1e9 if isinstance(kind, pl.Time) else {"ms": 1e3, "us": 1e6, "ns": 1e9}[kind.time_unit or "us"]
        seconds = series.to_physical().cast(pl.Float64) / per_second
        return RawColumn(seconds.fill_null(float("nan")).to_numpy().astype(np.float64), unit="s")
    if not (kind.is_numeric() or kind == pl.Boolean):
        raise not_numbers(path, series.name, f"is of type {kind}")
    values = series.cast(pl.Float64).fill_null(float("nan")).to_numpy()
    return RawColumn(np.array(values, dtype=np.float64))
