"""From a raw column to a signal in SI units: unit, sign, offset, blanks, wrapped counts."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fitting.errors import InputError
from fitting.logs.drive_file import ColumnMap, DriveFile
from fitting.logs.dropouts import zero_dropouts
from fitting.logs.findings import Finding
from fitting.logs.raw_table import RawColumn
from fitting.logs.units import UnitError, convert, to_base
from fitting.logs.unwrapping import unwrapped_angle, unwrapped_overflow, wrapping_spans

SI = {
    "time": "s",
    "motor_angle": "rad",
    "load_angle": "rad",
    "motor_torque": "N m",
    "load_torque": "N m",
    "temperature": "K",
    "motor_velocity": "rad/s",
    "load_velocity": "rad/s",
    "twist": "rad",
    "joint_torque": "N m",
}
_UNSTATED = {"dynamic_error": "rad", "forcing": "rad/s^2"}
_FILL = 1e30  # larger values are fill values, as in NetCDF
_NINES = tuple(sign * (10.0**digits - 1.0) for digits in range(3, 8) for sign in (-1, 1))
_MOST_TEXT = 0.05


@dataclass(frozen=True, eq=False)
class Channel:
    """One signal of a log.

    Attributes:
        values: in `unit`, (n,), NaN where unknown.
        unit: SI, or that of the drive file for a reduced log.
        findings: on corrections.
        dropouts: rows in which the sensor gave zero for want of a value.
    """

    values: np.ndarray
    unit: str
    findings: tuple[Finding, ...] = ()
    dropouts: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))


def channel(path: Path, drive_file: DriveFile, signal: str, column: RawColumn, *, first_row: int = 0) -> Channel:
    """The signal that a column holds.

    Args:
        path: the log, for messages.
        drive_file: unit, sign and offset of the column.
        signal: its name.
        column: raw column.
        first_row: of the column, in the file.

    Raises:
        InputError: a unit of another quantity, or a column of text.
    """
    place = drive_file.column_of(signal)
    findings = [*_text(path, place.column, column, first_row)]
    values, filled = without_fill_values(column.values)
    if filled is not None:
        rows = np.flatnonzero(column.values == filled)
        where = f"{place.column}, first in data row {first_row + rows[0] + 1}"
        what = f"{len(rows)} cells hold the fill value {filled:.10g}"
        findings.append(Finding("warning", what, where, "they count as blank"))
    unit, disagreement = _unit(place, column, signal)
    findings += disagreement
    values, dropouts = _without_dropouts(drive_file, signal, place, values, unit)
    if len(dropouts):
        where = f"{place.column}, first in data row {first_row + dropouts[0] + 1}"
        what = f"{len(dropouts)} samples are exactly zero, far from those before and behind"
        findings.append(Finding("warning", what, where, "they are dropouts, and count as blank"))
    values, wrapped = _unwrapped(drive_file, signal, place, values, unit, first_row)
    converted, name = _convert(drive_file, signal, place, (values - place.offset) * place.sign, unit)
    # The conversion may overflow or underflow.
    converted = np.where(np.abs(converted) < _FILL, converted, np.nan)
    return Channel(converted, name, (*findings, *wrapped), dropouts)


def without_fill_values(values: np.ndarray) -> tuple[np.ndarray, float | None]:
    """The values, NaN for fill values; and the fill value of nines, or None.

    All beyond 1e30 are fill values, and so is a number of nines, such as -999, that is farther from all others than
    these are apart.
    """
    values = np.where(np.abs(values) < _FILL, values, np.nan)
    for level in np.intersect1d(values, _NINES):
        others = values[np.isfinite(values) & (values != level)]
        if len(others) and 0 < np.ptp(others) < np.min(np.abs(others - level)):
            return np.where(values == level, np.nan, values), float(level)
    return values, None


def _without_dropouts(
    drive_file: DriveFile, signal: str, place: ColumnMap, values: np.ndarray, unit: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """The values of an angle or velocity, NaN where the sensor dropped out; and the rows of these."""
    if not signal.endswith(("_angle", "_velocity")):
        return values, np.zeros(0, dtype=int)
    spans = wrapping_spans(values, _revolution(drive_file, signal, place, unit)) if signal.endswith("_angle") else []
    rows = zero_dropouts(values, spans)
    values = values.copy()
    values[rows] = np.nan
    return values, rows


def _revolution(drive_file: DriveFile, signal: str, place: ColumnMap, unit: str | None) -> float:
    """A revolution in the column's unit; infinite where it has none."""
    radian = float(_convert(drive_file, signal, place, np.array(1.0), unit)[0])
    return 2 * np.pi / abs(radian) if radian else np.inf


def _text(path: Path, name: str, column: RawColumn, first_row: int) -> Sequence[Finding]:
    rows = column.text_rows
    if len(rows) == 0:
        return ()
    if len(rows) > max(1, _MOST_TEXT * len(column.values)):
        raise InputError(
            f"{path}: the column '{name}' holds text such as {column.text!r} in {len(rows)} rows, first in data row "
            f"{first_row + rows[0] + 1}, where numbers are needed; name another column or mend these rows"
        )
    what = f"{len(rows)} cells hold text such as {column.text!r}"
    where = f"{name}, first in data row {first_row + rows[0] + 1}"
    return (Finding("warning", what, where, "they count as blank"),)


def _unit(place: ColumnMap, column: RawColumn, signal: str) -> tuple[str | None, Sequence[Finding]]:
    """The unit of the drive file, else of the log."""
    if place.unit is None or column.unit is None:
        return place.unit or column.unit, ()
    try:
        same = np.isclose(convert(np.array(1.0), place.unit, column.unit), 1.0, rtol=1e-6)
    except UnitError:
        same = False
    if same:
        return place.unit, ()
    what = f"the file gives the unit {column.unit[:40]!r} and the drive file {place.unit!r}"
    return place.unit, (Finding("note", what, signal, "the unit of the drive file was used"),)


def _unwrapped(
    drive_file: DriveFile, signal: str, place: ColumnMap, values: np.ndarray, unit: str | None, first_row: int
) -> tuple[np.ndarray, Sequence[Finding]]:
    if np.isfinite(values).sum() < 3:
        return values, ()
    if signal in ("motor_angle", "load_angle"):
        found, span, rows = unwrapped_angle(values, _revolution(drive_file, signal, place, unit))
        severity, what = "note", "wraps"
    elif signal in ("motor_torque", "load_torque", "joint_torque", "forcing"):
        found, span, rows = unwrapped_overflow(values)
        severity, what = "warning", "overflows its integers"
    else:
        return values, ()
    if len(rows) == 0:
        return values, ()
    where = f"{place.column}, first in data row {first_row + rows[0] + 1}"
    return found, (
        Finding(severity, f"{signal} {what} at {span:.10g} in {len(rows)} places", where, "it was unwrapped"),
    )


def _convert(
    drive_file: DriveFile,
    signal: str,
    place: ColumnMap,
    values: np.ndarray,
    unit: str | None,
    si: str | None = None,
) -> tuple[np.ndarray, str]:
    if place.torque_constant is not None:
        torque, _ = _convert(drive_file, signal, replace(place, torque_constant=None), values, unit, si="A")
        return place.torque_constant * torque, SI[signal]
    if unit is None:
        return values, SI.get(signal) or _UNSTATED[signal]
    try:
        wanted = si or SI.get(signal)
        return to_base(values, unit) if wanted is None else (convert(values, unit, wanted), wanted)
    except UnitError as error:
        example = ', such as "deg", or "rev / 16777216" for counts' if "angle" in signal else ""
        raise InputError(
            f"{drive_file.path}: the column '{place.column}' cannot be used as {signal}, because "
            f"{error}; give [columns] {signal} a unit{example}"
        ) from error
