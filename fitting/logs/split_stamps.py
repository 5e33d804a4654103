"""Stamps in two columns: whole seconds, and the milli-, micro- or nanoseconds since."""

import re
from dataclasses import replace

import numpy as np

from fitting.logs.drive_file import ColumnMap, DriveFile
from fitting.logs.findings import Finding
from fitting.logs.raw_table import RawColumn, RawTable
from fitting.logs.units import UnitError, convert

_WHOLE = ("s", "sec", "secs", "second", "seconds")
_PARTS = {
    "ms": ("ms", "msec", "msecs", "millis", "millisec", "millisecs", "milliseconds"),
    "us": ("us", "usec", "usecs", "micros", "microsec", "microsecs", "microseconds"),
    "ns": ("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecs", "nanoseconds"),
}
_UNIT = {word: unit for unit, words in _PARTS.items() for word in words}
_ENDING = re.compile(rf"(|.*[^a-zA-Z])({'|'.join(sorted((*_WHOLE, *_UNIT), key=len, reverse=True))})", re.IGNORECASE)


def partners(place: ColumnMap) -> tuple[str, ...]:
    """Possible names of the column with the other half of the stamps: "tv_usec" for "tv_sec".

    Args:
        place: the time column.
    """
    if place.fraction is not None:
        return (place.fraction.column,)
    ending = _ENDING.fullmatch(place.column)
    if ending is None:
        return ()
    words = tuple(_UNIT) if ending[2].lower() in _WHOLE else _WHOLE
    return tuple(ending[1] + spelled for word in words for spelled in (word, word.upper()))


def with_joined_stamps(table: RawTable, drive_file: DriveFile) -> tuple[RawTable, DriveFile, tuple[Finding, ...]]:
    """The table with stamps in one column, in seconds since the first whole one.

    Args:
        table: with both columns, if any.
        drive_file: states the time column.

    Returns:
        Table and drive file, and findings; both are unchanged where stamps are in one column.
    """
    place = drive_file.column_of("time")
    other = next((name for name in partners(place) if name in table.columns), None)
    if other is None or place.column not in table.columns:
        return table, drive_file, ()
    first, second = place.column, other
    if place.fraction is None and _unit(place.column) is not None:
        first, second = second, first
    unit = place.fraction.unit if place.fraction is not None else place.unit if first == other else None
    seconds = _joined(table.columns[first], table.columns[second], unit or table.columns[second].unit or _unit(second))
    if seconds is None:
        return table, drive_file, ()
    columns = table.columns | {place.column: RawColumn(seconds, "s")}
    del columns[other]
    in_seconds = drive_file.columns | {"time": ColumnMap(place.column, "s", 1.0)}
    finding = Finding(
        "note",
        f"the stamps are in two columns, '{first}' and '{second}'",
        place.column,
        "they were joined, and count from the first whole second",
    )
    return replace(table, columns=columns), replace(drive_file, columns=in_seconds), (finding,)


def _unit(name: str) -> str | None:
    """The unit of parts of a second in a name's suffix; None for whole seconds."""
    ending = _ENDING.fullmatch(name)
    return None if ending is None else _UNIT.get(ending[2].lower())


def _joined(whole: RawColumn, part: RawColumn, unit: str | None) -> np.ndarray | None:
    """Stamps [s] from whole seconds and parts of a second; None where the columns are not."""
    try:
        parts = convert(part.values, unit or "ns", "s")
    except UnitError:
        return None
    known = np.isfinite(whole.values) & np.isfinite(parts)
    if len(whole.values) != len(parts) or not known.any():
        return None
    are_whole = (whole.values[known] == np.rint(whole.values[known])).all()
    are_parts = ((parts[known] >= 0) & (parts[known] < 1)).all()
    # A double holds no nanoseconds beside the seconds since 1970.
    return whole.values - whole.values[known][0] + parts if are_whole and are_parts else None
