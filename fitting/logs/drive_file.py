"""The drive file: data of the drive, and columns, units and signs of its logs."""

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from fitting.errors import InputError
from fitting.logs.raw_table import numbered
from fitting.logs.units import UnitError, parse_number
from hdjax import HOLDS, Hold

SIGNALS = (
    "time",
    "motor_angle",
    "load_angle",
    "motor_torque",
    "motor_current",
    "load_torque",
    "temperature",
    "dynamic_error",
    "forcing",
    "motor_velocity",
    "load_velocity",
    "twist",
    "joint_torque",
)
_MOST_COLUMNS = 9999
_DRIVE_UNITS = {
    "reduction_ratio": "1",
    "motor_inertia": "kg m^2",
    "load_inertia": "kg m^2",
    "rated_torque": "N m",
    "largest_twist": "rad",
}
# Parameters that may have a tolerance or be unknown, and their symbols.
_SYMBOLS = {"motor_inertia": "J_m", "load_inertia": "J_l", "torque_constant": "k_T"}
_KEYS = {
    "drive": ("name", *_DRIVE_UNITS),
    "signals": ("torque_hold", "sample_rate"),
    "columns": SIGNALS,
}
# Keys that may be sought in another table, and where they belong.
_PLACES = {key: f"[{table}]" for table, keys in _KEYS.items() for key in keys} | {
    "torque_constant": 'motor_current in [columns], as in { column = "iq", torque_constant = 0.12 }'
}


@dataclass(frozen=True)
class ColumnMap:
    """Column of a signal in the log.

    Attributes:
        column: Name of the column; in HDF5 the path of the dataset; "column 3" is the third one.
        unit: Unit of the column's numbers, or None for that of the file, else SI.
        sign: +1.0 or -1.0, multiplies the column.
        offset: Subtracted before conversion, in the column's unit.
        time: Name of the column with this channel's stamps, in the unit of [columns] time, or None.
        fraction: Of stamps in two columns: the column with the parts of a second, or None.
        torque_constant: Torque of a current [N m/A], or None for other signals.
    """

    column: str
    unit: str | None
    sign: float
    offset: float = 0.0
    time: str | None = None
    fraction: "ColumnMap | None" = None
    torque_constant: float | None = None


@dataclass(frozen=True)
class DriveFile:
    """Content of a drive file.

    Attributes:
        path: The file.
        name: Name of the drive; the file's stem where none is stated.
        reduction_ratio: N, motor angle over load angle, or None where not stated.
        motor_inertia: J_m [kg m^2], or None.
        load_inertia: J_l [kg m^2], or None.
        torque_hold: Inter-sample behaviour of the torque, one of `HOLDS`, or None.
        sample_rate: Samples per second [Hz] of a log without time column, or None.
        columns: Column of each signal that the drive file states, by signal name.
        rated_torque: At the output [N m], or None; lost motion is defined by it.
        largest_twist: Of the joint [rad], or None for that of a strain-wave gear.
        tolerances: Relative standard deviation of each of J_m, J_l and k_T (the torque constant over its value here)
            with a tolerance, by its symbol; infinite for a free one.
    """

    path: Path
    name: str
    reduction_ratio: float | None
    motor_inertia: float | None
    load_inertia: float | None
    torque_hold: Hold | None
    sample_rate: float | None
    columns: dict[str, ColumnMap]
    rated_torque: float | None = None
    largest_twist: float | None = None
    tolerances: dict[str, float] = field(default_factory=dict)

    def column_of(self, signal: str) -> ColumnMap:
        """Column of `signal` in a log: the stated one, else the column of that name, in SI."""
        return self.columns.get(signal, ColumnMap(signal, None, 1.0))

    def states(self, key: str) -> bool:
        """Whether [drive] states `key`: as a value, with a tolerance, or as free."""
        return getattr(self, key) is not None or _SYMBOLS.get(key) in self.tolerances


def did_you_mean(word: str, known: Iterable[str], *, cutoff: float = 0.6) -> str:
    """A suggestion in brackets, or nothing when no known name is close.

    Args:
        word: The unknown word.
        known: Known names.
        cutoff: Least similarity, 0 to 1.

    Returns:
        " (did you mean 'time'?)" or "".
    """
    by_lower = {name.lower(): name for name in known}
    close = get_close_matches(word.lower(), list(by_lower), n=1, cutoff=cutoff)
    return f" (did you mean '{by_lower[close[0]]}'?)" if close else ""


def read_drive_file(path: str | PathLike[str]) -> DriveFile:
    """Read a drive file.

    Args:
        path: A file with the tables [drive], [signals] and [columns], all optional. Physical
            numbers are SI, or strings with a unit such as "5.26 g m^2".

    Returns:
        The drive, in SI units.

    Raises:
        InputError: The file is missing, is not TOML, or has unknown or wrong entries.
    """
    return drive_of(_load(Path(path)), Path(path))


def drive_of(tables: Mapping[str, Any], path: Path) -> DriveFile:
    """The drive that tables describe; see [`read_drive_file`][].

    Args:
        tables: [drive], [signals] and [columns] by name.
        path: Their source, for messages.
    """
    _refuse_unknown(path, "table", tables, _KEYS)
    for table, known in _KEYS.items():
        if not isinstance(tables.get(table, {}), dict):
            raise InputError(f"{path}: '{table}' must be a table, so write it as [{table}]")
        _refuse_unknown(path, f"key in [{table}]", tables.get(table, {}), known)
    drive, signals = tables.get("drive", {}), tables.get("signals", {})
    stated = {k: _stated(path, k, drive.get(k)) for k in _DRIVE_UNITS}
    numbers = {k: _positive(path, "drive", k, stated[k].value, u) for k, u in _DRIVE_UNITS.items()}
    ratio = numbers["reduction_ratio"]
    if ratio is not None and ratio < 1.0:
        raise InputError(
            f"{path}: [drive] reduction_ratio is the motor's angle over the load's, at least 1, but is {ratio:g}; "
            f"write {1.0 / ratio:g} if it is inverted"
        )
    columns = {s: _column_map(path, s, e) for s, e in tables.get("columns", {}).items()}
    tolerances = {_SYMBOLS[k]: one.tolerance for k, one in stated.items() if one.tolerance is not None}
    if "motor_current" in columns:
        columns, constant = _torque_of_current(path, columns, tables["columns"]["motor_current"])
        tolerances |= {"k_T": constant.tolerance} if constant.tolerance is not None else {}
    return DriveFile(
        path=path,
        name=_text(path, "[drive] name", drive.get("name", path.stem)),
        torque_hold=_hold(path, signals.get("torque_hold")),
        sample_rate=_positive(path, "signals", "sample_rate", signals.get("sample_rate"), "Hz"),
        columns=columns,
        tolerances=tolerances,
        **numbers,
    )


class _Stated(NamedTuple):
    """A number of the drive file, and its relative standard deviation: infinite for "fit", None if exact."""

    value: object
    tolerance: float | None = None


def _stated(path: Path, key: str, entry: object, where: str = "[drive] ") -> _Stated:
    """A number that may have a tolerance.

    Args:
        path: Of the drive file.
        key: Of the number.
        entry: A number; or, for an inertia or a torque constant, `{ value = ..., tolerance = "5 %" }` or "fit".
        where: Of the key, for messages.
    """
    if key not in _SYMBOLS:
        return _Stated(entry)
    if entry == "fit":
        return _Stated(None, math.inf)
    if not isinstance(entry, dict):
        return _Stated(entry)
    place = f"{where}{key}"
    _refuse_unknown(path, f"key in {place}", entry, ("value", "tolerance"))
    if "value" not in entry:
        example = '{ value = 5.26e-4, tolerance = "5 %" }'
        raise InputError(f'{path}: {place} needs a value, as in {example}, or write "fit"')
    share = _share(path, place, entry.get("tolerance", 0.0))
    return _Stated(entry["value"], share or None)


def _share(path: Path, place: str, entry: object) -> float:
    """A relative tolerance: "5 %" or 0.05."""
    text = entry.strip() if isinstance(entry, str) else ""
    try:
        value = 0.01 * float(text[:-1]) if text.endswith("%") else math.nan if text else entry
    except ValueError:
        value = math.nan
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1:
        raise InputError(
            f'{path}: tolerance in {place} must be a share of the value below one, such as "5 %" or 0.05, but is '
            f"{_short(entry)}"
        )
    return float(value)


def _torque_of_current(
    path: Path, columns: Mapping[str, ColumnMap], entry: object
) -> tuple[dict[str, ColumnMap], _Stated]:
    """The columns with the motor's torque in place of its current, and the torque constant."""
    if "motor_torque" in columns:
        raise InputError(f"{path}: [columns] has both motor_torque and motor_current; keep the one that was measured")
    given = entry.get("torque_constant") if isinstance(entry, dict) else None
    where = "[columns] motor_current "
    if given is None:
        raise InputError(f"{path}: {where}needs a torque_constant in N m / A, as in {{ torque_constant = 0.12 }}")
    stated = _stated(path, "torque_constant", given, where)
    # A free constant is relative to one.
    value = 1.0 if math.isinf(stated.tolerance or 0.0) else stated.value
    constant = _positive(path, "columns", "torque_constant", value, "N m/A")
    others = {signal: place for signal, place in columns.items() if signal != "motor_current"}
    return others | {"motor_torque": replace(columns["motor_current"], torque_constant=constant)}, stated


def _load(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such drive file; check the path given to --drive") from error
    except OSError as error:
        raise InputError(f"{path}: the drive file cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: the drive file is not text; save it as UTF-8 TOML") from error
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: the drive file is not valid TOML, correct it: {reason}") from error


def _refuse_unknown(path: Path, kind: str, given: Iterable[str], known: Iterable[str]) -> None:
    for name in given:
        if name not in known:
            if name in _PLACES:
                raise InputError(f"{path}: '{name}' is no {kind}; it belongs to {_PLACES[name]}")
            raise InputError(
                f"{path}: unknown {kind} '{name}'{did_you_mean(name, known)}; known are {', '.join(known)}"
            )


def _text(path: Path, where: str, value: object) -> str:
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{path}: {where} must be a non-empty string, but is {_short(value)}")
    return value


def _short(value: object) -> str:
    try:
        shown = repr(value)
    except ValueError:
        # Python refuses to write out an integer of thousands of digits.
        shown = "a number of thousands of digits"
    return shown if len(shown) <= 60 else f"{shown[:57]}..."


def _positive(path: Path, table: str, key: str, value: object, unit: str) -> float | None:
    if value is None:
        return None
    shown = "" if unit == "1" else f" in {unit}"
    wanted = f"[{table}] {key} must be a positive number{shown}"
    if isinstance(value, str):
        try:
            value = parse_number(value, unit)
        except UnitError as error:
            raise InputError(f"{path}: {wanted}, but is {_short(value)} ({error})") from error
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{path}: {wanted}, but is {_short(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not (math.isfinite(number) and number > 0):
        raise InputError(f"{path}: {wanted}, but is {_short(value)}")
    return number


def _hold(path: Path, value: object) -> Hold | None:
    if value is None:
        return None
    for hold in HOLDS:
        if value == hold:
            return hold
    hint = did_you_mean(value, HOLDS) if isinstance(value, str) else ""
    raise InputError(f"{path}: [signals] torque_hold must be one of {', '.join(HOLDS)}, but is {_short(value)}{hint}")


def _column_map(path: Path, signal: str, entry: object, key: str = "") -> ColumnMap:
    where = f"[columns] {signal}{key}"
    if not isinstance(entry, dict):
        if isinstance(entry, str | int) and not isinstance(entry, bool):
            return ColumnMap(_column_name(path, where, entry), None, 1.0)
        raise InputError(
            f"{path}: {where} must be a column's name, its number, or a table such as "
            f'{{ column = "name", unit = "deg", sign = 1 }}, but is {_short(entry)}'
        )
    known = ("column", "unit") if key else ("column", "unit", "sign", "offset", "time")
    further = {"time": ("fraction",), "motor_current": ("torque_constant",)}.get("" if key else signal, ())
    _refuse_unknown(path, f"key in {where}", entry, (*known, *further))
    sign = entry.get("sign", 1)
    if isinstance(sign, bool) or not isinstance(sign, int | float) or sign not in (1, -1):
        raise InputError(f"{path}: sign in {where} must be 1 or -1, but is {_short(sign)}")
    offset = entry.get("offset", 0)
    # An integer of a thousand digits is valid TOML, and no float.
    if isinstance(offset, bool) or not isinstance(offset, int | float) or not abs(offset) < 1e30:
        raise InputError(
            f"{path}: offset in {where} must be a number in the column's own unit, but is {_short(offset)}"
        )
    unit, time, fraction = entry.get("unit"), entry.get("time"), entry.get("fraction")
    return ColumnMap(
        column=_column_name(path, f"column in {where}", entry.get("column", signal)),
        unit=None if unit is None else _text(path, f"unit in {where}", unit),
        sign=float(sign),
        offset=float(offset),
        time=None if time is None else _column_name(path, f"time in {where}", time),
        fraction=None if fraction is None else _column_map(path, signal, fraction, " fraction"),
    )


def _column_name(path: Path, where: str, value: object) -> str:
    """A column's name, also for a number counted from one."""
    if isinstance(value, bool) or not isinstance(value, int):
        return _text(path, where, value)
    if not 0 < value <= _MOST_COLUMNS:
        raise InputError(f"{path}: {where} must be a column's number from 1 on, but is {_short(value)}")
    return numbered(value)
