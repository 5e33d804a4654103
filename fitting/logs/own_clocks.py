"""Channels with separate stamps: their clock columns and time bases."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from fitting.errors import InputError
from fitting.logs.channels import SI, channel
from fitting.logs.drive_file import DriveFile, did_you_mean
from fitting.logs.findings import Finding
from fitting.logs.log_kind import listing
from fitting.logs.raw_table import RawColumn, RawTable, places_of
from fitting.logs.time_stamps import TimeBase, time_base
from fitting.logs.units import convert

_MOST_CLOCKS = 64


def later_names(name: str) -> tuple[str, ...]:
    """Names of the second and later columns of a name, as given by this package, pandas and polars.

    Args:
        name: of a column.
    """
    numbers = range(2, _MOST_CLOCKS + 1)
    forms = ((f"{name} ({n})", f"{name}.{n - 1}", f"{name}_duplicated_{n - 2}") for n in numbers)
    return tuple(form for several in forms for form in several)


def with_own_clocks(
    path: Path, drive_file: DriveFile, table: RawTable, raw: Mapping[str, RawColumn]
) -> tuple[dict[str, RawColumn], tuple[Finding, ...]]:
    """The columns with their stamps [s], as stated in the drive file, or from the preceding time column.

    Args:
        path: The log, for messages.
        drive_file: Names the clocks.
        table: With the clocks.
        raw: Columns by signal.

    Returns:
        The columns, and findings on their stamps.

    Raises:
        InputError: A clock is missing or invalid, or a name is not unique.
    """
    clocks = _repeated_clocks(table, drive_file.column_of("time").column)
    if not clocks and all(drive_file.column_of(s).time is None and c.time is None for s, c in raw.items()):
        return _merged(raw), ()
    found, findings = dict(raw), []
    for signal, column in raw.items():
        place = drive_file.column_of(signal)
        if signal == "time":
            continue
        name = place.time or _nearest(clocks, table.names, place.column)
        if name is not None:
            stamps, unit = _stamps(path, drive_file, table, signal, name)
        elif column.time is not None:
            stamps, unit = column.time, "s"
        else:
            continue
        found[signal], mended = _clocked(path, drive_file, signal, column, stamps, name or place.column, unit)
        findings += [finding for finding in mended if finding not in findings]
    if clocks:
        what = f"{len(clocks)} columns are called '{drive_file.column_of('time').column}'"
        findings.append(Finding("note", what, "time", "each is the clock of the columns that follow it"))
    return found, tuple(findings)


def _merged(raw: Mapping[str, RawColumn]) -> dict[str, RawColumn]:
    """The columns with one row an instant, where rows with the same stamp hold different signals, as in a table of
    several senders' messages."""
    if "time" not in raw or len({len(column.values) for column in raw.values()}) > 1:
        return dict(raw)
    same = np.diff(raw["time"].values) == 0.0
    place = np.concatenate(([0], np.cumsum(~same)))
    known = {signal: np.isfinite(column.values) for signal, column in raw.items() if signal != "time"}
    if not same.any() or any(np.bincount(place[own]).max(initial=0) > 1 for own in known.values()):
        return dict(raw)

    def one(signal: str, column: RawColumn) -> RawColumn:
        own = known.get(signal, slice(None))
        values = np.full(place[-1] + 1, np.nan)
        values[place[own]] = column.values[own]
        return replace(column, values=values, text_rows=np.unique(place[column.text_rows]))

    return {signal: one(signal, column) for signal, column in raw.items()}


def _repeated_clocks(table: RawTable, name: str) -> dict[int, str]:
    """The time columns of a table with several, by index; empty where there is one."""
    names = [name, *(later for later in later_names(name) if later in table.columns)]
    found = {place: asked for asked, place in places_of(names, table.names).items()}
    return found if len(found) > 1 else {}


def _nearest(clocks: Mapping[int, str], names: tuple[str, ...], column: str) -> str | None:
    """The clock before a column, or after it where the table begins with a signal."""
    place = places_of([column], names).get(column)
    if not clocks or place is None:
        return None
    if min(clocks) == 0 or max(clocks) < len(names) - 1:
        before = [p for p in clocks if p < place]
        return clocks[max(before)] if before else clocks[min(clocks)]
    return clocks[min(p for p in clocks if p > place)]


def _stamps(
    path: Path, drive_file: DriveFile, table: RawTable, signal: str, name: str
) -> tuple[np.ndarray, str | None]:
    """The clock of a signal [s], and its unit in the file."""
    if name not in table.columns:
        raise InputError(
            f"{path}: there is no column '{name}'{did_you_mean(name, table.names)}, which "
            f"time in [columns] {signal} of {drive_file.path} names; {listing(table)}"
        )
    return channel(path, drive_file, "time", table.columns[name]).values, table.columns[name].unit


def _clocked(
    path: Path, drive_file: DriveFile, signal: str, column: RawColumn, stamps: np.ndarray, name: str, unit: str | None
) -> tuple[RawColumn, tuple[Finding, ...]]:
    """The column with a strictly rising clock."""
    if len(stamps) != len(column.values):
        raise InputError(
            f"{path}: {signal} has {len(column.values)} rows and its time column {len(stamps)}; export them with one "
            "stamp a sample"
        )
    # In a table of text, the shorter channel ends in blanks.
    filled = np.flatnonzero(np.isfinite(stamps) | np.isfinite(column.values))
    last = int(filled[-1]) + 1 if len(filled) else 0
    base = mended_base(path, drive_file, stamps[:last], column.values[:last, None], name, unit)
    if len(base.restarts):
        raise InputError(f"{path}: the column '{name}', the clock of {signal}, restarts; cut the log there")
    places = np.full(len(column.values), -1)
    places[base.rows] = np.arange(len(base.rows))
    text = places[column.text_rows]
    own = replace(
        column,
        values=column.values[base.rows],
        time=base.time,
        text_rows=np.sort(text[text >= 0]),
        rate_std=base.rate_std,
    )
    return own, base.findings


def mended_base(
    path: Path,
    drive_file: DriveFile,
    stamps: np.ndarray,
    samples: np.ndarray,
    name: str,
    unit: str | None,
    first_row: int = 0,
) -> TimeBase:
    """The time base of a column of stamps; arguments as in [`fitting.logs.time_stamps.time_base`][].

    Args:
        path: The log, for messages.
        drive_file: States the unit of the stamps.
        stamps: [s], (n,).
        samples: All other columns, (n, columns).
        name: The column.
        unit: That the file states, or None.
        first_row: Of the stamps in the file.
    """
    unit = drive_file.column_of("time").unit or unit or "s"
    second = 1.0 / float(convert(np.array(1.0), unit, SI["time"]))
    return time_base(stamps, samples, path=path, name=name, second=second, first_row=first_row)
