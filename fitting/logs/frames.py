"""Tables in memory as logs: data frames, datasets, and arrays by name."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fitting.errors import InputError
from fitting.logs.column_names import unit_in_name
from fitting.logs.parquet import column_from_series
from fitting.logs.raw_table import RawColumn, RawTable, not_numbers, places_of


def table_of(path: Path, source: Any, wanted: Iterable[str]) -> RawTable:
    """The wanted columns of a table in memory.

    Args:
        path: Its name in messages.
        source: A frame of pandas or polars, a dataset of xarray, or arrays by name. Its columns may state their unit as
            in "torque [N m]", variables of xarray in the attribute `units`.
        wanted: Names of columns; those that the table lacks are omitted.

    Raises:
        InputError: A wanted column is not a vector of numbers.
    """
    found = source.variables if hasattr(source, "variables") else source
    labels = list(source.columns if hasattr(source, "columns") else found)
    names = tuple(map(str, labels))
    places = places_of(dict.fromkeys(wanted), names)
    return RawTable(names, {name: _column(path, names[at], found[labels[at]], name) for name, at in places.items()})


def _column(path: Path, name: str, values: Any, asked: str) -> RawColumn:
    unit = getattr(values, "attrs", {}).get("units") or unit_in_name(name, asked)
    series = values if isinstance(values, pl.Series) else _series(path, name, values)
    column = column_from_series(path, series)
    return column if column.unit is not None else replace(column, unit=unit)


def _series(path: Path, name: str, values: Any) -> pl.Series:
    array = np.asarray(values)
    if array.ndim != 1:
        raise not_numbers(path, name, f"has {array.ndim} dimensions")
    if array.dtype.kind in "mM":
        # Polars knows days, and milliseconds or finer.
        array = array.astype(f"{array.dtype.kind}8[ns]")
    try:
        return pl.Series(name, array.tolist() if array.dtype == object else array)
    except (TypeError, pl.exceptions.PolarsError) as error:
        raise InputError(f"{path}: the column '{name}' mixes numbers with other things; keep numbers only") from error
