"""Measured logs in SI units, checked to be whole.

The only place, with the readers below it, that opens a log, and the only one that converts its units.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fitting.errors import DataError, InputError
from fitting.logs.channels import SI, Channel, channel
from fitting.logs.drive_file import SIGNALS, DriveFile, did_you_mean
from fitting.logs.findings import Finding
from fitting.logs.gaps import SHORTEST, pieces
from fitting.logs.raw_table import RawColumn, RawTable
from fitting.logs.read_table import read_table
from fitting.logs.resampling import angles_together, on_one_grid
from fitting.logs.time_stamps import TimeBase, time_base
from fitting.logs.units import convert

DRIVE_SIGNALS = ("motor_angle", "load_angle", "motor_torque")
REDUCED_SIGNALS = ("dynamic_error", "forcing")
TWIST_SIGNALS = (("twist",), ("dynamic_error",), ("motor_angle", "load_angle"), ("load_angle",))
OUTPUTS = ("motor_angle", "load_angle", "dynamic_error", "twist")
OPTIONAL_SIGNALS = ("load_torque", "temperature")
VELOCITIES = ("motor_velocity", "load_velocity")

Kind = Literal["drive", "reduced", "quasi-static"]

_DRIVE_KEYS = ("reduction_ratio", "motor_inertia", "load_inertia")
_SYMBOLS = {"motor_inertia": "J_m", "load_inertia": "J_l"}
_SLOWEST = 60.0  # s between samples; no drive's resonance is that slow, but nanoseconds taken for seconds are
_FEWEST_INPUTS = 50
_UNTIMED = Finding(
    "note",
    "there is no time column",
    "time",
    "the rows are taken to be in order of time, and a drift is counted per row",
)


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
        dynamic_error: x, (n,); theta_m/N - theta_l [rad] in a drive log, less `zero`.
        forcing: F, (n,), or None for a drive log.
        units: Units of `dynamic_error` and, in a reduced log, of `forcing`.
        findings: What was seen while reading; `health.examine` adds to it.
        motor_velocity: theta_m' [rad/s] as logged, (n,), NaN where unknown, or None; only checked against.
        load_velocity: theta_l' [rad/s], likewise.
        outputs_until: Rows in which the output columns are known, or None for all. Nothing may look at later outputs.
        trusted: Rows whose outputs were measured and are believed, (n,), or None for all. Others hold something finite.
        input_known: Rows in which motor torque or forcing was sampled, (n,), or None for all.
        pieces: First row and one past the last of each stretch between gaps, or None for the whole log.
        zero: What was taken off the dynamic error, since no torque explains it.
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
    load_velocity: np.ndarray | None = None
    outputs_until: int | None = None
    trusted: np.ndarray | None = None
    input_known: np.ndarray | None = None
    pieces: tuple[tuple[int, int], ...] | None = None
    zero: float = 0.0
    joint_torque: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, start: int, stop: int) -> "Log":
        """Rows `start` to `stop` (exclusive) as a log of their own, with the stretches between gaps that lie there."""
        columns = {key: value[start:stop] for key, value in vars(self).items() if isinstance(value, np.ndarray)}
        inside = [(max(a, start) - start, min(b, stop) - start) for a, b in self.pieces or ()]
        kept = tuple((a, b) for a, b in inside if b - a >= SHORTEST)
        return replace(self, pieces=None if self.pieces is None else kept, **columns)


def read_log(
    path: str | PathLike[str], drive_file: DriveFile, *, outputs_until: int | None = None, table: Any = None
) -> Log:
    """The log that a file or a table in memory holds, in SI units.

    Args:
        path: File of any format of [`fitting.logs.read_table`][], or what messages call a table.
        drive_file: Says which column is which signal, and in which unit.
        outputs_until: The angles and the dynamic error need to be known in the first so many
            rows only, and the input in all of them; None asks for what a fit needs.
        table: What takes the place of the file: a frame, a dataset, or arrays by name ([`fitting.logs.frames`][]).

    Returns:
        The log; what was mended, masked or left out stands in its findings.

    Raises:
        InputError: The file cannot be read, lacks a column, or holds no numbers where they are needed.
        DataError: The log is too short, or has too many gaps.
    """
    # Numbers of any size may stand in a file; what overflows is counted as blank.
    with np.errstate(all="ignore"):
        return _read(Path(path), drive_file, outputs_until, table)


def _read(path: Path, drive_file: DriveFile, outputs_until: int | None, source: Any) -> Log:
    places = [drive_file.column_of(signal) for signal in SIGNALS]
    wanted = [name for place in places for name in (place.column, place.time) if name is not None]
    table = read_table(path, wanted) if source is None else _in_memory(path, source, wanted)
    raw = {s: table.columns[c] for s in SIGNALS if (c := drive_file.column_of(s).column) in table.columns}
    kind = _kind(path, drive_file, table, raw)
    required = _needed(kind, raw)
    raw, start, stop, blank = _inhabited(path, drive_file, table, raw, required)
    channels = {}
    for signal in raw:
        if signal != "time":
            is_output = outputs_until is not None and signal in (*OUTPUTS, *VELOCITIES)
            column = _cut(raw[signal], start, stop, start + outputs_until if is_output and outputs_until else stop)
            channels[signal] = channel(path, drive_file, signal, column, first_row=start)
    if kind == "quasi-static" and "time" not in raw and not (drive_file.sample_rate or table.sample_rate):
        # The curve does not depend on the rate.
        rows = np.arange(start, stop)
        base = TimeBase(rows - start, rows.astype(float), np.zeros(0, dtype=int), (_UNTIMED,))
    else:
        base = _time(path, drive_file, table, raw.get("time"), channels, start, stop)
    if len(base.time) < SHORTEST:
        raise DataError(f"{path}: only {len(base.time)} rows have a stamp of their own; a fit needs {SHORTEST}")
    findings = [*blank, *(f for c in channels.values() for f in c.findings), *base.findings]
    signals = {name: found.values[base.rows] for name, found in channels.items()}
    ratio = drive_file.reduction_ratio or 1.0
    if "motor_angle" in signals and "load_angle" in signals and outputs_until is None:
        motor, load, moved = angles_together(base.time, signals["motor_angle"], signals["load_angle"], ratio, path)
        signals |= {"motor_angle": motor, "load_angle": load}
        findings += moved
    trusted, untold = _trusted(path, drive_file, signals, outputs_until)
    known, spans, gaps = _input(path, drive_file, base, signals, required[-1], outputs_until)
    findings += [*untold, *gaps, *_interpolate(path, drive_file, base.time, signals)]
    log = Log(
        name=path.stem,
        path=path,
        kind=kind,
        time=base.time,
        motor_angle=signals.get("motor_angle"),
        load_angle=signals.get("load_angle"),
        motor_torque=signals.get("motor_torque"),
        load_torque=signals.get("load_torque"),
        temperature=signals.get("temperature"),
        dynamic_error=_twist(path, drive_file, kind, signals),
        forcing=signals.get("forcing"),
        units={s: channels[s].unit for s in REDUCED_SIGNALS} if kind == "reduced" else {"dynamic_error": "rad"},
        findings=tuple(findings),
        motor_velocity=signals.get("motor_velocity"),
        load_velocity=signals.get("load_velocity"),
        outputs_until=outputs_until,
        trusted=None if trusted.all() else trusted,
        input_known=None if known.all() else known,
        pieces=None if [*spans] == [(0, len(known))] or outputs_until is not None else spans,
        joint_torque=signals.get("joint_torque"),
    )
    for array in (log.time, log.dynamic_error, *signals.values()):
        array.setflags(write=False)
    return log


def _in_memory(path: Path, source: Any, wanted: list[str]) -> RawTable:
    # Loaded here: tables in memory need polars, which takes long to load.
    from fitting.logs.frames import table_of

    return table_of(path, source, wanted)


def _needed(kind: Kind, raw: Mapping[str, RawColumn]) -> tuple[str, ...]:
    """The signals of a log, its input last."""
    if kind == "quasi-static":
        return (*_twist_signals(raw), "joint_torque")
    return DRIVE_SIGNALS if kind == "drive" else REDUCED_SIGNALS


def _twist_signals(raw: Mapping[str, RawColumn]) -> tuple[str, ...]:
    """What the twist is made of in a quasi-static log; nothing where it is not there."""
    return next((signals for signals in TWIST_SIGNALS if all(s in raw for s in signals)), ())


def _twist(path: Path, drive_file: DriveFile, kind: Kind, signals: Mapping[str, np.ndarray]) -> np.ndarray:
    """The dynamic error, which in a quasi-static log is a twist."""
    if kind == "reduced" or "load_angle" not in signals:
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


def _column(drive_file: DriveFile, signal: str) -> str:
    return f"the column '{drive_file.column_of(signal).column}' ({signal})"


def _with_own_clock(path: Path, drive_file: DriveFile, table: RawTable, signal: str, column: RawColumn) -> RawColumn:
    """The column with the stamps [s] that the drive file gives it."""
    name = drive_file.column_of(signal).time
    if name is None or signal == "time":
        return column
    if name not in table.columns:
        raise InputError(
            f"{path}: there is no column '{name}'{did_you_mean(name, table.names)}, which "
            f"time in [columns] {signal} of {drive_file.path} names; {_listing(table)}"
        )
    clock = channel(path, drive_file, "time", table.columns[name]).values
    # In a table of text, the shorter channel ends in blanks.
    filled = np.isfinite(clock)
    return (
        replace(column, values=column.values[filled], time=clock[filled])
        if len(clock) == len(column.values)
        else (replace(column, time=clock))
    )


def _cut(column: RawColumn, start: int, stop: int, known_until: int) -> RawColumn:
    """Rows `start` to `stop` of a column, blank from `known_until` on."""
    values = column.values[start:stop].copy()
    values[max(0, known_until - start) :] = np.nan
    rows = column.text_rows
    return replace(column, values=values, text_rows=rows[(rows >= start) & (rows < min(stop, known_until))] - start)


def _trusted(
    path: Path, drive_file: DriveFile, signals: dict[str, np.ndarray], outputs_until: int | None
) -> tuple[np.ndarray, tuple[Finding, ...]]:
    """Rows in which all outputs are known; the others are filled, so that nothing meets a NaN."""
    outputs = [name for name in OUTPUTS if name in signals]
    count = len(signals[outputs[0]])
    trusted, findings = np.ones(count, dtype=bool), []
    rows = np.arange(count)
    until = count if outputs_until is None else min(outputs_until, count)
    for name in outputs:
        known = np.isfinite(signals[name])
        needed = min(SHORTEST, (until + 1) // 2)
        if known.sum() < needed:
            raise InputError(
                f"{path}: {_column(drive_file, name)} is a number in {known.sum()} rows only, where {needed} are "
                "needed; name the right column or mend the log"
            )
        blank = np.flatnonzero(~known[:until])
        if len(blank):
            what = f"{name} is blank or not finite in {len(blank)} rows ({100 * len(blank) / until:.2g} %)"
            where = f"{drive_file.column_of(name).column}, first in row {blank[0] + 1}"
            findings.append(Finding("warning", what, where, "they have no weight in the fit"))
        signals[name] = signals[name] if known.all() else np.interp(rows, rows[known], signals[name][known])
        trusted &= known
    if trusted.sum() < min(SHORTEST, (until + 1) // 2):
        raise DataError(f"{path}: only {trusted.sum()} rows hold all of {', '.join(outputs)}; a fit needs {SHORTEST}")
    return trusted, tuple(findings)


def _input(
    path: Path,
    drive_file: DriveFile,
    base: TimeBase,
    signals: Mapping[str, np.ndarray],
    name: str,
    outputs_until: int | None,
) -> tuple[np.ndarray, tuple[tuple[int, int], ...], tuple[Finding, ...]]:
    """In which rows the input is known, the pieces in which it is or can be bridged, and what there is to tell."""
    known = np.isfinite(signals[name])
    if known.sum() < _FEWEST_INPUTS:
        raise InputError(
            f"{path}: {_column(drive_file, name)} is a number in {known.sum()} rows only; name the right column"
        )
    whole = outputs_until is not None
    if name == "joint_torque":
        # No torque acts between the samples of a log without motion.
        return known, ((0, len(known)),), ()
    spans, gaps = pieces(base.time, signals[name], known, base.restarts, name, whole=whole)
    # A sample or two at the ends may be held.
    lacks = len(spans) != 1 or spans[0][0] > 2 or spans[0][1] < len(known) - 2
    if not spans or (whole and lacks):
        seen = gaps[0].what if gaps else f"{name} is unknown at its ends"
        wanted = "a prediction needs it throughout" if whole else f"no stretch of {SHORTEST} rows is left"
        raise DataError(f"{path}: {seen}, so that {name} is not known there and {wanted}; record the log without gaps")
    return known, spans, gaps


def _interpolate(
    path: Path, drive_file: DriveFile, time: np.ndarray, signals: dict[str, np.ndarray]
) -> tuple[Finding, ...]:
    """Fill what is unknown of the inputs; the fit looks at the main one where it was sampled only."""
    findings = []
    for name in ("motor_torque", "forcing", "joint_torque", *OPTIONAL_SIGNALS):
        if name not in signals:
            continue
        known = np.isfinite(signals[name])
        if known.sum() < 2:
            raise InputError(
                f"{path}: {_column(drive_file, name)} holds no numbers; name the right column or leave it out"
            )
        if not known.all() and name in OPTIONAL_SIGNALS:
            what = f"{name} is blank in {(~known).sum()} rows ({100 * np.mean(~known):.2g} %)"
            findings.append(Finding("note", what, name, "it was interpolated between the rows that have it"))
        if not known.all():
            signals[name] = np.interp(time, time[known], signals[name][known])
    return tuple(findings)


def _kind(path: Path, drive_file: DriveFile, table: RawTable, raw: dict[str, RawColumn]) -> Kind:
    clocked = any(column.time is not None for column in raw.values())
    stated_but_absent = [s for s in drive_file.columns if s not in raw and not (s == "time" and clocked)]
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
            if getattr(drive_file, key) is None and _SYMBOLS.get(key) not in drive_file.tolerances:
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
    velocity = missing[0].replace("angle", "velocity")
    if velocity in raw and velocity != missing[0]:
        hint = f" ({velocity} cannot stand in for it: integrated, it drifts by more than the twist)"
    raise InputError(
        f"{path}: no column for {', '.join(missing)}{hint}; {_listing(table)}, so say which one "
        f'it is in the drive file, e.g. [columns] {missing[0]} = {{ column = "..." }}'
    )


def _listing(table: RawTable) -> str:
    if not table.names:
        return "the file has no columns"
    more = f" and {len(table.names) - 12} more" if len(table.names) > 12 else ""
    return f"the file has {', '.join(name[:60] for name in table.names[:12])}{more}"


def _refuse_unequal(path: Path, drive_file: DriveFile, raw: dict[str, RawColumn], used: Sequence[str]) -> None:
    first = used[0]
    for signal, column in raw.items():
        if len(column.values) != len(raw[first].values):
            raise InputError(
                f"{path}: the columns '{drive_file.column_of(first).column}' and "
                f"'{drive_file.column_of(signal).column}' have {len(raw[first].values)} and "
                f"{len(column.values)} rows; export them with one row per sample"
            )


def _inhabited(
    path: Path, drive_file: DriveFile, table: RawTable, raw: dict[str, RawColumn], required: Sequence[str]
) -> tuple[dict[str, RawColumn], int, int, tuple[Finding, ...]]:
    """The columns that matter on one grid, and the first row and one past the last in which any has something."""
    used = [s for s in (*required, *OPTIONAL_SIGNALS) if s in raw]
    velocities = () if "forcing" in required else VELOCITIES
    raw = {s: raw[s] for s in (*used, *velocities, "time") if s in raw}
    raw = on_one_grid({s: _with_own_clock(path, drive_file, table, s, c) for s, c in raw.items()}, path)
    _refuse_unequal(path, drive_file, raw, used)
    filled = np.zeros(len(raw[used[0]].values), dtype=bool)
    for signal in used:
        filled |= ~np.isnan(raw[signal].values)
        filled[raw[signal].text_rows] = True
    rows = np.flatnonzero(filled)
    if len(rows) == 0:
        raise InputError(f"{path}: the log has no rows with numbers; export it again")
    start, stop = int(rows[0]), int(rows[-1]) + 1
    if stop - start < SHORTEST:
        raise DataError(
            f"{path}: the log has {stop - start} rows, which is fewer than the {SHORTEST} that "
            "a fit needs; record a longer one"
        )
    return raw, start, stop, _blank_rows(start, len(filled) - stop)


def _blank_rows(leading: int, trailing: int) -> tuple[Finding, ...]:
    if leading + trailing == 0:
        return ()
    what = f"{leading} blank rows before the data and {trailing} after it"
    return (Finding("note", what, "all columns", "they were left out"),)


def _time(
    path: Path,
    drive_file: DriveFile,
    table: RawTable,
    column: RawColumn | None,
    channels: Mapping[str, Channel],
    start: int,
    stop: int,
) -> TimeBase:
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
        rows = np.arange(start, stop)
        return TimeBase(rows - start, rows / rate, np.zeros(0, dtype=int), ())
    stamps = channel(path, drive_file, "time", _cut(column, start, stop, stop), first_row=start)
    unit = drive_file.column_of("time").unit or column.unit or "s"
    name = drive_file.column_of("time").column
    found = time_base(
        stamps.values,
        np.stack([c.values for c in channels.values()], axis=1),
        path=path,
        name=name,
        second=1.0 / float(convert(np.array(1.0), unit, SI["time"])),
        first_row=start,
    )
    median = float(np.median(np.diff(found.time)))
    if rate is not None and abs(median * rate - 1) > 0.1:
        raise InputError(
            f"{path}: the column '{name}' steps by {median:g} s but the sample rate is "
            f"{rate:g} Hz; give [columns] time its unit or remove the sample rate"
        )
    if median > _SLOWEST:
        raise InputError(
            f"{path}: the column '{name}' steps by {median:g} s, which is no sampling of a drive; "
            'give [columns] time its unit, such as "us" or "ns"'
        )
    return replace(found, findings=(*stamps.findings, *found.findings))
