"""Measured logs in SI units, checked to be whole.

The only place, with `log_table`, that opens a log, and the only one that converts its units.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np

from fitting.drive_file import SIGNALS, DriveFile, did_you_mean
from fitting.errors import DataError, InputError
from fitting.findings import Finding
from fitting.log_table import LogTable, RawColumn, read_table
from fitting.unit_strings import UnitError, convert, to_base

DRIVE_SIGNALS = ("motor_angle", "load_angle", "motor_torque")
REDUCED_SIGNALS = ("dynamic_error", "forcing")
TWIST_SIGNALS = (("twist",), ("dynamic_error",), ("motor_angle", "load_angle"), ("load_angle",))
OUTPUTS = ("motor_angle", "load_angle", "dynamic_error")
OPTIONAL_SIGNALS = ("load_torque", "temperature")
SHORTEST = 200

Kind = Literal["drive", "reduced", "quasi-static"]

_SI = {
    "time": "s",
    "motor_angle": "rad",
    "load_angle": "rad",
    "motor_torque": "N m",
    "load_torque": "N m",
    "temperature": "K",
    "motor_velocity": "rad/s",
    "twist": "rad",
    "joint_torque": "N m",
}
_UNSTATED = {"dynamic_error": "rad", "forcing": "rad/s^2"}
_DRIVE_KEYS = ("reduction_ratio", "motor_inertia", "load_inertia")
_UNTIMED = Finding(
    "note",
    "there is no time column",
    "time",
    "the rows are taken to be in order of time, and a drift is counted per row",
)
_GAP = 5.0  # median steps, assumed; above it the hold of the torque is anybody's guess


@dataclass(frozen=True, eq=False)
class Log:
    """One measured log.

    Attributes:
        name: Stem of the file.
        path: The file.
        kind: "drive" (angles and torque), "reduced" (dynamic error and forcing) or "quasi-static" (twist and joint
            torque).
        time: Stamps [s], strictly increasing, in the file's own origin, (n,).
        motor_angle: theta_m [rad], (n,), or None for a reduced log.
        load_angle: theta_l [rad], (n,), or None.
        motor_torque: T_m [N m], (n,), or None.
        load_torque: T_l [N m], positive along +theta_l, (n,), or None.
        temperature: [K], (n,), or None.
        dynamic_error: x, (n,); theta_m/N - theta_l [rad] in a drive log.
        forcing: F, (n,), or None for a drive log.
        units: Units of `dynamic_error` and, in a reduced log, of `forcing`.
        findings: What was seen while reading; `health.examine` adds to it.
        motor_velocity: theta_m' [rad/s] as logged, (n,), or None; only checked against.
        outputs_until: Rows in which the output columns are known, or None for all. Later
            outputs may be NaN and nothing may look at them.
        joint_torque: That the drive passes on [N m], positive where it twists the drive positively, (n,), or None
            but for a quasi-static log.
    """

    name: str
    path: Path
    kind: Kind
    time: np.ndarray
    motor_angle: np.ndarray | None
    load_angle: np.ndarray | None
    motor_torque: np.ndarray | None
    load_torque: np.ndarray | None
    temperature: np.ndarray | None
    dynamic_error: np.ndarray
    forcing: np.ndarray | None
    units: dict[str, str]
    findings: tuple[Finding, ...] = ()
    motor_velocity: np.ndarray | None = None
    outputs_until: int | None = None
    joint_torque: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)


def read_log(path: str | PathLike[str], drive_file: DriveFile, *, outputs_until: int | None = None) -> Log:
    """The log that a file holds, in SI units.

    Args:
        path: CSV, TSV, TXT, MAT, HDF5 or Parquet file.
        drive_file: Says which column is which signal, and in which unit.
        outputs_until: The angles and the dynamic error need to be known in the first so many
            rows only; None asks for all rows.

    Returns:
        The log; nothing in it is repaired, and what is left out stands in its findings.

    Raises:
        InputError: The file cannot be read, lacks a column, or has rows that are not numbers.
        DataError: The log is too short.
    """
    path = Path(path)
    table = read_table(path, [drive_file.column_of(signal).column for signal in SIGNALS])
    raw = {s: table.columns[c] for s in SIGNALS if (c := drive_file.column_of(s).column) in table.columns}
    kind = _kind(path, drive_file, table, raw)
    used = [*_needed(kind, raw), *OPTIONAL_SIGNALS]
    used = [signal for signal in used if signal in raw]
    _refuse_unequal(path, drive_file, raw, used)
    start, stop = _inhabited(path, [raw[signal] for signal in used])
    findings = _blank_rows(start, len(raw[used[0]].values) - stop)
    if stop - start < SHORTEST:
        raise DataError(
            f"{path}: the log has {stop - start} rows, which is fewer than the {SHORTEST} that "
            "a fit needs; record a longer one"
        )
    signals: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    for signal in [*used, *(["motor_velocity"] if "motor_velocity" in raw else [])]:
        rows = stop
        if signal in OUTPUTS and outputs_until is not None:
            rows = min(stop, start + outputs_until)
        if signal != "motor_velocity":
            _refuse_holes(path, drive_file, signal, raw[signal], start, rows)
        signals[signal], units[signal] = _to_si(path, drive_file, signal, raw[signal], start, stop)
    if kind == "quasi-static" and "time" not in raw and not (drive_file.sample_rate or table.sample_rate):
        # The curve does not depend on the rate; only a drift is then counted per row.
        time, time_findings = np.arange(start, stop, dtype=float), (_UNTIMED,)
    else:
        time, time_findings = _time(path, drive_file, table, raw.get("time"), start, stop)
    if kind == "quasi-static":
        twist, units = _twist(path, drive_file, signals), {"dynamic_error": "rad"}
    elif kind == "drive":
        assert drive_file.reduction_ratio is not None
        twist = signals["motor_angle"] / drive_file.reduction_ratio - signals["load_angle"]
        units = {"dynamic_error": "rad"}
    else:
        twist = signals["dynamic_error"]
        units = {signal: units[signal] for signal in REDUCED_SIGNALS}
    for array in (time, twist, *signals.values()):
        array.setflags(write=False)
    return Log(
        name=path.stem,
        path=path,
        kind=kind,
        time=time,
        motor_angle=signals.get("motor_angle"),
        load_angle=signals.get("load_angle"),
        motor_torque=signals.get("motor_torque"),
        load_torque=signals.get("load_torque"),
        temperature=signals.get("temperature"),
        dynamic_error=twist,
        forcing=signals.get("forcing"),
        units=units,
        findings=(*findings, *time_findings),
        motor_velocity=signals.get("motor_velocity"),
        outputs_until=outputs_until,
        joint_torque=signals.get("joint_torque") if kind == "quasi-static" else None,
    )


def _needed(kind: Kind, raw: dict[str, RawColumn]) -> tuple[str, ...]:
    if kind == "quasi-static":
        return (*_twist_signals(raw), "joint_torque")
    return DRIVE_SIGNALS if kind == "drive" else REDUCED_SIGNALS


def _twist_signals(raw: dict[str, RawColumn]) -> tuple[str, ...]:
    """What the twist is made of in a quasi-static log; nothing where it is not there."""
    return next((signals for signals in TWIST_SIGNALS if all(s in raw for s in signals)), ())


def _twist(path: Path, drive_file: DriveFile, signals: dict[str, np.ndarray]) -> np.ndarray:
    """Twist [rad] of a quasi-static log."""
    if "load_angle" not in signals:
        return signals["twist"] if "twist" in signals else signals["dynamic_error"]
    if "motor_angle" not in signals:
        # A locked motor: the output turns by the twist alone, against it.
        return -signals["load_angle"]
    if drive_file.reduction_ratio is None:
        raise InputError(
            f"{drive_file.path}: [drive] reduction_ratio is missing, which the motor and load angles of {path} need to "
            "become a twist; add it"
        )
    return signals["motor_angle"] / drive_file.reduction_ratio - signals["load_angle"]


def _kind(path: Path, drive_file: DriveFile, table: LogTable, raw: dict[str, RawColumn]) -> Kind:
    stated_but_absent = [s for s in drive_file.columns if s not in raw]
    if stated_but_absent:
        signal = stated_but_absent[0]
        column = drive_file.columns[signal].column
        raise InputError(
            f"{path}: there is no column '{column}'{did_you_mean(column, table.names)}, which "
            f"[columns] {signal} of {drive_file.path} names; {_listing(table)}"
        )
    is_drive = all(signal in raw for signal in DRIVE_SIGNALS)
    is_reduced = all(signal in raw for signal in REDUCED_SIGNALS)
    if is_drive and is_reduced:
        # A drive log may carry a derived dynamic error; only a stated one displaces the angles.
        is_drive = not all(signal in drive_file.columns for signal in REDUCED_SIGNALS)
    if "joint_torque" in raw and _twist_signals(raw):
        stated = drive_file.columns
        only_stated = "joint_torque" in stated and not ("motor_torque" in stated or "forcing" in stated)
        if only_stated or not (is_drive or is_reduced):
            return "quasi-static"
    if is_drive:
        for key in _DRIVE_KEYS:
            if getattr(drive_file, key) is None:
                raise InputError(
                    f"{drive_file.path}: [drive] {key} is missing, which a log with angles and "
                    f"torque such as {path} needs; add it"
                )
        return "drive"
    if is_reduced:
        return "reduced"
    begun = any(s in raw for s in REDUCED_SIGNALS) and not any(s in raw for s in DRIVE_SIGNALS)
    missing = [s for s in (REDUCED_SIGNALS if begun else DRIVE_SIGNALS) if s not in raw]
    hint = did_you_mean(missing[0], table.names)
    raise InputError(
        f"{path}: no column for {', '.join(missing)}{hint}; {_listing(table)}, so say which one "
        f'it is in the drive file, e.g. [columns] {missing[0]} = {{ column = "..." }}'
    )


def _listing(table: LogTable) -> str:
    if not table.names:
        return "the file has no columns"
    more = f" and {len(table.names) - 12} more" if len(table.names) > 12 else ""
    return f"the file has {', '.join(table.names[:12])}{more}"


def _refuse_unequal(path: Path, drive_file: DriveFile, raw: dict[str, RawColumn], used: Sequence[str]) -> None:
    first = used[0]
    for signal, column in raw.items():
        if signal not in (*used, "time", "motor_velocity"):
            continue
        if len(column.values) != len(raw[first].values):
            raise InputError(
                f"{path}: the columns '{drive_file.column_of(first).column}' and "
                f"'{drive_file.column_of(signal).column}' have {len(raw[first].values)} and "
                f"{len(column.values)} rows; export them with one row per sample"
            )


def _inhabited(path: Path, columns: Sequence[RawColumn]) -> tuple[int, int]:
    """First row and one past the last row in which any column has something."""
    filled = np.zeros(len(columns[0].values), dtype=bool)
    for column in columns:
        filled |= ~np.isnan(column.values)
        if column.bad_row is not None:
            filled[column.bad_row] = True
    rows = np.flatnonzero(filled)
    if len(rows) == 0:
        raise InputError(f"{path}: the log has no rows with numbers; export it again")
    return int(rows[0]), int(rows[-1]) + 1


def _blank_rows(leading: int, trailing: int) -> tuple[Finding, ...]:
    if leading + trailing == 0:
        return ()
    what = f"{leading} blank rows before the data and {trailing} after it"
    return (Finding("note", what, "all columns", "they were left out"),)


def _refuse_holes(path: Path, drive_file: DriveFile, signal: str, column: RawColumn, start: int, stop: int) -> None:
    name = drive_file.column_of(signal).column
    if column.bad_row is not None and start <= column.bad_row < stop:
        raise InputError(
            f"{path}: the column '{name}' holds {column.bad_text!r} in data row "
            f"{column.bad_row + 1}, where a number is needed; remove or mend the row"
        )
    holes = np.flatnonzero(~np.isfinite(column.values[start:stop]))
    if len(holes):
        raise InputError(
            f"{path}: the column '{name}' is blank or not finite in {len(holes)} rows, first in "
            f"data row {start + holes[0] + 1}; remove or mend these rows"
        )


def _to_si(
    path: Path, drive_file: DriveFile, signal: str, column: RawColumn, start: int, stop: int
) -> tuple[np.ndarray, str]:
    place = drive_file.column_of(signal)
    values = column.values[start:stop] * place.sign
    if place.unit is None:
        return values, _SI.get(signal) or _UNSTATED[signal]
    try:
        if signal in _SI:
            return convert(values, place.unit, _SI[signal]), _SI[signal]
        return to_base(values, place.unit)
    except UnitError as error:
        example = ', such as "deg", or "rev / 16777216" for counts' if "angle" in signal else ""
        raise InputError(
            f"{drive_file.path}: the column '{place.column}' cannot be used as {signal}, because "
            f"{error}; give [columns] {signal} a unit{example}"
        ) from error


def _time(
    path: Path,
    drive_file: DriveFile,
    table: LogTable,
    column: RawColumn | None,
    start: int,
    stop: int,
) -> tuple[np.ndarray, tuple[Finding, ...]]:
    stated, beside = drive_file.sample_rate, table.sample_rate
    if stated and beside and abs(stated / beside - 1) > 0.001:
        raise InputError(
            f"{drive_file.path}: sample_rate is {stated:g} Hz but {path} says {beside:g} Hz; correct one of them"
        )
    rate = stated or beside
    if column is None:
        if rate is None:
            raise InputError(
                f"{path}: no time column and no sample rate; name the column in [columns] time "
                f"or give [signals] sample_rate in {drive_file.path} ({_listing(table)})"
            )
        return np.arange(start, stop) / rate, ()
    _refuse_holes(path, drive_file, "time", column, start, stop)
    time, _ = _to_si(path, drive_file, "time", column, start, stop)
    return time, _check_time(path, drive_file, time, rate, start)


def _check_time(
    path: Path, drive_file: DriveFile, time: np.ndarray, rate: float | None, start: int
) -> tuple[Finding, ...]:
    name = drive_file.column_of("time").column
    step = np.diff(time)
    bad = np.flatnonzero(step <= 0)
    if len(bad):
        row = int(bad[0])
        how = "repeats the stamp" if step[row] == 0 else "goes back behind the stamp"
        raise InputError(
            f"{path}: the column '{name}' {how} of the row before in data row {start + row + 2} "
            f"(and {len(bad) - 1} more); sort the log and remove repeated rows"
        )
    median = float(np.median(step))
    if rate is not None and abs(median * rate - 1) > 0.1:
        raise InputError(
            f"{path}: the column '{name}' steps by {median:g} s but the sample rate is "
            f"{rate:g} Hz; give [columns] time its unit or remove the sample rate"
        )
    gaps = np.flatnonzero(step > _GAP * median)
    if len(gaps) == 0:
        return ()
    longest = int(gaps[np.argmax(step[gaps])])
    return (
        Finding(
            "warning",
            f"{len(gaps)} gaps in the time stamps, the longest {step[longest]:.4g} s where the "
            f"median step is {median:.4g} s",
            f"{name}, data row {start + longest + 2}",
            "the torque inside a gap is unknown, so that the fit is disturbed after it",
        ),
    )
