"""Logs in spreadsheets: sheet and rows of the table, and its cells in full precision."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fitting.errors import InputError
from fitting.logs.extras import needing
from fitting.logs.raw_table import RawColumn, RawTable, places_of
from fitting.logs.text import Head, head_of
from fitting.logs.text_cells import column_from_text

# Number of rows that are searched for the header of a table.
_LOOKED_AT = 1000


def read_sheets(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """The wanted columns of a workbook, from the sheet that has most of them.

    Args:
        path: named in messages.
        source: what is read.
        wanted: names of columns, as in a text log.

    Raises:
        InputError: The extra is not installed, or no sheet holds a table.
    """
    with needing(path, "spreadsheets need fastexcel; install it", "xlsx", "save the table as CSV"):
        import fastexcel  # pyright: ignore[reportMissingImports]
    book = fastexcel.read_excel(source.getvalue() if isinstance(source, BytesIO) else source)
    best: tuple[int, str, Head] | None = None
    for name in book.sheet_names:
        lines = ["\t".join(_plain(cell) for cell in row) for row in _cells(book, name, n_rows=_LOOKED_AT).iter_rows()]
        head = head_of(path, lines, wanted)
        found = 0 if head is None else len(places_of(wanted, head.names))
        if head is not None and (best is None or found > best[0]):
            best = found, name, head
    if best is None:
        raise InputError(f"{path}: no sheet of the workbook holds a table of numbers; save the table as CSV")
    _, sheet, head = best
    texts = _cells(book, sheet, skip_rows=head.first)
    numbers = _cells(book, sheet, skip_rows=head.first, dtypes="float")
    places = set(head.places(wanted).values())
    return head.table(wanted, {p: _column(texts.to_series(p), numbers.to_series(p)) for p in places})


def _cells(book: Any, sheet: str, **options: Any) -> pl.DataFrame:
    options = {"dtypes": "string", "skip_rows": 0} | options
    return book.load_sheet(sheet, header_row=None, **options).to_polars()


def _plain(cell: str | None) -> str:
    return "" if cell is None else " ".join(cell.split())


def _column(text: pl.Series, numbers: pl.Series) -> RawColumn:
    """A column in full precision; the cells' text has fewer digits."""
    column = column_from_text(text, comma_parts_cells=False)
    exact = numbers.fill_null(float("nan")).to_numpy()
    # A date is a number of days.
    known = np.isfinite(exact) & (column.unit is None)
    return replace(column, values=np.where(known, exact, column.values))
