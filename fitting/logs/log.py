"""Measured logs in SI units.

Only this module and its readers open logs and convert units.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from fitting.errors import DataError, InputError
from fitting.logs.channels import Channel, channel
from fitting.logs.drive_file import SIGNALS, DriveFile
from fitting.logs.filling import input_rows, interpolated, trusted_rows
from fitting.logs.findings import Finding
from fitting.logs.gaps import SHORTEST
from fitting.logs.log_kind import (
    OPTIONAL_SIGNALS,
    OUTPUTS,
    REDUCED_SIGNALS,
    VELOCITIES,
    Kind,
    drive_outputs,
    kind_of,
    listing,
    needed_signals,
    refuse_repeated,
    told_of_subset,
)
from fitting.logs.own_clocks import later_names, mended_base, with_own_clocks
from fitting.logs.raw_table import RawColumn, RawTable
from fitting.logs.read_table import read_table
from fitting.logs.resampling import angles_together, on_one_grid
from fitting.logs.split_stamps import partners, with_joined_stamps
from fitting.logs.time_stamps import SLOWEST, TimeBase

_SAME_RATE, _OFF_RATE = 0.001, 0.1  # relative differences of sample rates, assumed
_AS_LOGGED = (
    *("motor_angle", "load_angle", "motor_torque", "load_torque", "joint_torque"),
    *("motor_velocity", "load_velocity", "temperature", "forcing"),
)
_UNTIMED = Finding(
    "note",
    "there is no time column",
    "time",
    "the rows are assumed to be in order of time, and a drift is per row",
)


@dataclass(frozen=True, eq=False)
class Log:
    """One measured log.

    Attributes:
        name: Stem of the file.
        path: The file.
        kind: "drive" (motor torque and motion), "reduced" (dynamic error and forcing) or "quasi-static" (twist and
            joint torque).
        time: Stamps [s], strictly increasing, from the file's origin, (n,).
        motor_angle: theta_m [rad], (n,), or None for a reduced log.
        load_angle: theta_l [rad], (n,), or None.
        motor_torque: T_m [N m], (n,), or None.
        load_torque: T_l [N m], positive along +theta_l, (n,), or None.
        temperature: [K], (n,), or None.
        dynamic_error: x, (n,); theta_m/N - theta_l [rad] in a drive log, less `zero`, None where it lacks an angle.
        forcing: F, (n,), or None for a drive log.
        units: Units of `dynamic_error` and, in a reduced log, of `forcing`.
        findings: Of the reader; `checks.examine` adds to them.
        motor_velocity: theta_m' [rad/s] as logged, (n,), or None; NaN where unknown; it may be used for checks only.
        load_velocity: theta_l' [rad/s], likewise.
        outputs_until: Rows in which the output columns are known, or None for all. Later outputs must not be used.
        trusted: Rows with valid outputs, (n,), or None for all. Other rows hold finite values.
        input_known: Rows in which motor torque or forcing was sampled, (n,), or None for all.
        pieces: First row and one past the last of each stretch between gaps, or None for the whole log.
        zero: Sensor offset that was subtracted from the dynamic error.
        has_own_zero: Whether it has a zero of its own, which few known outputs did not tell well.
        joint_torque: Torque behind the gear [N m], positive where it twists the drive positively, (n,), or None.
        rate_std: Relative standard deviation of the sample interval, from the rounding of the stamps.
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
    dynamic_error: np.ndarray | None
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
    has_own_zero: bool = False
    joint_torque: np.ndarray | None = None
    rate_std: float = 0.0

    def __len__(self) -> int:
        return len(self.time)

    @property
    def input(self) -> np.ndarray:
        """The motor torque, or a reduced log's forcing, (n,)."""
        found = self.motor_torque if self.kind == "drive" else self.forcing
        assert found is not None
        return found

    @property
    def twist(self) -> np.ndarray:
        """The dynamic error of a log that has one, (n,)."""
        assert self.dynamic_error is not None
        return self.dynamic_error

    @property
    def outputs(self) -> tuple[str, ...]:
        """The fitted signals, as logged."""
        if self.kind != "drive":
            return ("dynamic_error",)
        return drive_outputs([name for name, value in vars(self).items() if isinstance(value, np.ndarray)])

    def rows(self, start: int, stop: int) -> "Log":
        """Rows `start` to `stop` (exclusive) as a log, with its stretches between gaps."""
        columns = {key: value[start:stop] for key, value in vars(self).items() if isinstance(value, np.ndarray)}
        inside = [(max(a, start) - start, min(b, stop) - start) for a, b in self.pieces or ()]
        kept = tuple((a, b) for a, b in inside if b - a >= SHORTEST)
        return replace(self, pieces=None if self.pieces is None else kept, **columns)


def read_log(
    path: str | PathLike[str], drive_file: DriveFile, *, outputs_until: int | None = None, table: Any = None
) -> Log:
    """Read a log from a file or a table in memory, in SI units.

    Args:
        path: File of any format of [`fitting.logs.read_table`][], or a table's name in messages.
        drive_file: States column and unit of each signal.
        outputs_until: Number of first rows in which angles and dynamic error must be known; the input must be known in
            all. None for the requirements of a fit.
        table: In place of the file: a frame, a dataset, or arrays by name ([`fitting.logs.frames`][]).

    Returns:
        The log; its findings report corrected, masked and omitted data.

    Raises:
        InputError: The file cannot be read, lacks a column, or has no numbers where they are needed.
        DataError: The log is too short, or has too many gaps.
    """
    # Files may contain numbers of any size; those that overflow count as blank.
    with np.errstate(all="ignore"):
        return _read(Path(path), drive_file, outputs_until, table)


def _read(path: Path, drive_file: DriveFile, outputs_until: int | None, source: Any) -> Log:
    places = [drive_file.column_of(signal) for signal in SIGNALS]
    wanted = [name for place in places for name in (place.column, place.time) if name is not None]
    stamps = drive_file.column_of("time")
    wanted += [*partners(stamps), *later_names(stamps.column)]
    table = read_table(path, wanted) if source is None else _in_memory(path, source, wanted)
    table, drive_file, joined = with_joined_stamps(table, drive_file)
    raw = {s: table.columns[c] for s in SIGNALS if (c := drive_file.column_of(s).column) in table.columns}
    # A single number under a usual name describes the log.
    if any(len(column.values) > 1 for column in raw.values()):
        raw = {s: column for s, column in raw.items() if s in drive_file.columns or len(column.values) > 1}
    refuse_repeated(path, drive_file, table)
    kind = kind_of(path, drive_file, table, raw)
    required = needed_signals(kind, raw, drive_file)
    joined = (*joined, *(told_of_subset(drive_file, table, raw) if kind == "drive" else ()))
    raw, start, stop, told = _inhabited(path, drive_file, table, raw, required)
    asked, outputs_until = outputs_until, _rows_until(outputs_until, raw, required[:-1], start)
    channels = {}
    for signal in raw:
        if signal != "time":
            is_output = outputs_until is not None and signal in (*required[:-1], *OUTPUTS)
            column = _cut(raw[signal], start, stop, start + outputs_until if is_output and outputs_until else stop)
            channels[signal] = channel(path, drive_file, signal, column, first_row=start)
    channels = _without_empty_rows(channels, required[-1])
    base = _time(path, drive_file, table, kind, raw.get("time"), channels, slice(start, stop))
    if len(base.time) < SHORTEST:
        raise DataError(f"{path}: only {len(base.time)} rows have a valid stamp; a fit needs {SHORTEST}")
    findings = [*joined, *told, *(f for c in channels.values() for f in c.findings), *base.findings]
    signals = {name: found.values[base.rows] for name, found in channels.items()}
    findings += _put_together(path, drive_file, base.time, signals, outputs_until)
    own_clocks = "time" in raw and raw["time"].time is not None
    seen = required[:-1]
    trusted, untold = trusted_rows(path, drive_file, signals, seen, outputs_until, asked, own_clocks=own_clocks)
    known, spans, gaps = input_rows(path, drive_file, base, signals, required[-1], outputs_until)
    findings += [*untold, *gaps, *interpolated(path, drive_file, base.time, signals)]
    as_logged: dict[str, Any] = {name: signals.get(name) for name in _AS_LOGGED}
    log = Log(
        name=path.stem,
        path=path,
        kind=kind,
        time=base.time,
        dynamic_error=_twist(path, drive_file, kind, signals),
        units={s: channels[s].unit for s in REDUCED_SIGNALS} if kind == "reduced" else {"dynamic_error": "rad"},
        findings=tuple(findings),
        outputs_until=outputs_until,
        trusted=None if trusted.all() else trusted,
        input_known=None if known.all() else known,
        pieces=None if [*spans] == [(0, len(known))] or outputs_until is not None else spans,
        rate_std=base.rate_std,
        **as_logged,
    )
    for array in (log.time, log.dynamic_error, *signals.values()):
        if array is not None:
            array.setflags(write=False)
    return log


def _put_together(
    path: Path, drive_file: DriveFile, time: np.ndarray, signals: dict[str, np.ndarray], outputs_until: int | None
) -> tuple[Finding, ...]:
    """Interpolate two angles to the same stamps, in the rows that may be used."""
    if "motor_angle" not in signals or "load_angle" not in signals:
        return ()
    seen, ratio = slice(outputs_until), drive_file.reduction_ratio or 1.0
    motor, load = signals["motor_angle"], signals["load_angle"]
    *angles, moved = angles_together(time[seen], motor[seen], load[seen], ratio, path)
    for name, values in zip(("motor_angle", "load_angle"), angles, strict=True):
        signals[name] = np.concatenate([values, signals[name][len(values) :]])
    return moved


def _without_empty_rows(channels: dict[str, Channel], driven_by: str) -> dict[str, Channel]:
    """The channels, without the input's zeros where a sensor dropped out and the others are zero: the row is empty."""
    motion = [found for name, found in channels.items() if name.endswith(("_angle", "_velocity"))]
    empty = channels[driven_by].values == 0.0
    for found in motion:
        dropped = np.isin(np.arange(len(empty)), found.dropouts)
        empty &= dropped | (found.values == 0.0)
    empty &= np.isin(np.arange(len(empty)), [row for found in motion for row in found.dropouts])
    if not empty.any():
        return channels
    source = channels[driven_by]
    what = f"{empty.sum()} rows are zero throughout"
    finding = Finding("warning", what, driven_by, "it counts as unknown there")
    values = np.where(empty, np.nan, source.values)
    return channels | {driven_by: replace(source, values=values, findings=(*source.findings, finding))}


def _rows_until(asked: int | None, raw: Mapping[str, RawColumn], outputs: Sequence[str], start: int) -> int | None:
    """Number of rows with a given number of samples of each output; larger where a channel is slower than the log."""
    if asked is None:
        return None
    known = [np.flatnonzero(np.isfinite(raw[s].values[start:])) for s in outputs]
    return max((int(rows[asked - 1]) + 1 for rows in known if len(rows) >= asked), default=asked)


def _in_memory(path: Path, source: Any, wanted: list[str]) -> RawTable:
    # Imported here: tables in memory need polars, which takes long to import.
    from fitting.logs.frames import table_of

    return table_of(path, source, wanted)


def _twist(path: Path, drive_file: DriveFile, kind: Kind, signals: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """The dynamic error (in a quasi-static log the twist); None for a drive log that lacks an angle."""
    if kind == "drive" and not ("motor_angle" in signals and "load_angle" in signals):
        return None
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


def _cut(column: RawColumn, start: int, stop: int, known_until: int) -> RawColumn:
    """Rows `start` to `stop` of a column, blank from `known_until` on."""
    values = column.values[start:stop].copy()
    values[max(0, known_until - start) :] = np.nan
    rows = column.text_rows
    return replace(column, values=values, text_rows=rows[(rows >= start) & (rows < min(stop, known_until))] - start)


def _refuse_unequal(path: Path, drive_file: DriveFile, raw: dict[str, RawColumn], used: Sequence[str]) -> None:
    first = used[0]
    for signal, column in raw.items():
        if len(column.values) != len(raw[first].values):
            raise InputError(
                f"{path}: the columns '{drive_file.column_of(first).column}' and "
                f"'{drive_file.column_of(signal).column}' have {len(raw[first].values)} and "
                f"{len(column.values)} rows; export them with one row per sample"
            )


def _without_unequal(
    drive_file: DriveFile, raw: dict[str, RawColumn], required: Sequence[str]
) -> tuple[dict[str, RawColumn], tuple[Finding, ...]]:
    """The columns without optional ones of another length that the drive file doesn't name; and notes on these."""
    rows, kept = len(raw[required[0]].values), {*required, *drive_file.columns, "time"}
    counts = {s: len(column.values) for s, column in raw.items() if s not in kept and len(column.values) != rows}
    findings = [
        Finding("note", f"{signal} has {count} rows, where {required[0]} has {rows}", signal, "it was left out")
        for signal, count in counts.items()
    ]
    return {s: column for s, column in raw.items() if s not in counts}, tuple(findings)


def _inhabited(
    path: Path, drive_file: DriveFile, table: RawTable, raw: dict[str, RawColumn], required: Sequence[str]
) -> tuple[dict[str, RawColumn], int, int, tuple[Finding, ...]]:
    """The needed columns on one grid, and the first row and one past the last with any data."""
    used = [s for s in (*required, *OPTIONAL_SIGNALS) if s in raw]
    velocities = () if "forcing" in required else VELOCITIES
    raw = {s: raw[s] for s in (*used, *velocities, "time") if s in raw}
    raw, mended = with_own_clocks(path, drive_file, table, raw)
    raw = on_one_grid(raw, required, path)
    raw, spare = _without_unequal(drive_file, raw, required)
    used = [s for s in used if s in raw]
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
    return raw, start, stop, (*mended, *spare, *_blank_rows(start, len(filled) - stop))


def _blank_rows(leading: int, trailing: int) -> tuple[Finding, ...]:
    if leading + trailing == 0:
        return ()
    what = f"{leading} blank rows before the data and {trailing} after it"
    return (Finding("note", what, "all columns", "they were left out"),)


def _time(
    path: Path,
    drive_file: DriveFile,
    table: RawTable,
    kind: Kind,
    column: RawColumn | None,
    channels: Mapping[str, Channel],
    seen: slice,
) -> TimeBase:
    start, stop = seen.start, seen.stop
    if kind == "quasi-static" and column is None and not (drive_file.sample_rate or table.sample_rate):
        # The torque-twist curve does not depend on the rate.
        rows = np.arange(start, stop)
        return TimeBase(rows - start, rows.astype(float), np.zeros(0, dtype=int), (_UNTIMED,))
    stated, beside = drive_file.sample_rate, table.sample_rate
    if stated and beside and abs(stated / beside - 1) > _SAME_RATE:
        raise InputError(
            f"{drive_file.path}: sample_rate is {stated:g} Hz but {path} says {beside:g} Hz; correct one of them"
        )
    rate = stated or beside
    if column is None:
        if rate is None:
            raise InputError(
                f"{path}: no time column and no sample rate; name the column in [columns] time "
                f"or give [signals] sample_rate in {drive_file.path} ({listing(table)})"
            )
        return _counted(start, stop, rate)
    if column.time is not None:
        rows = np.arange(start, stop)
        return TimeBase(rows - start, column.time[start:stop], np.zeros(0, dtype=int), (), column.rate_std)
    stamps = channel(path, drive_file, "time", _cut(column, start, stop, stop), first_row=start)
    name = drive_file.column_of("time").column
    samples = np.stack([c.values for c in channels.values()], axis=1)
    try:
        found = mended_base(path, drive_file, stamps.values, samples, name, column.unit, start)
    except InputError as error:
        if rate is None or "time" in drive_file.columns:
            raise
        reason = str(error).partition(": ")[2].partition("; ")[0]
        return _counted(start, stop, rate, Finding("note", reason, name, "the sample rate was used in its place"))
    median = float(np.median(np.diff(found.time)))
    if rate is not None and abs(median * rate - 1) > _OFF_RATE:
        raise InputError(
            f"{path}: the column '{name}' steps by {median:g} s but the sample rate is "
            f"{rate:g} Hz; give [columns] time its unit or remove the sample rate"
        )
    if median > SLOWEST:
        raise InputError(
            f"{path}: the column '{name}' steps by {median:g} s, which is no sampling of a drive; "
            'give [columns] time its unit, such as "us" or "ns"'
        )
    found = replace(found, findings=(*stamps.findings, *found.findings))
    return found if stated is None else _at_rate(found, stated, name)


def _counted(start: int, stop: int, rate: float, *findings: Finding) -> TimeBase:
    """Rows at a sample rate [Hz]."""
    rows = np.arange(start, stop)
    return TimeBase(rows - start, rows / rate, np.zeros(0, dtype=int), findings)


def _at_rate(base: TimeBase, rate: float, name: str) -> TimeBase:
    """Steady stamps at the stated sample rate [Hz]; others unchanged."""
    step = np.diff(base.time) * rate
    if len(base.restarts) or np.max(np.abs(step - 1.0)) > _OFF_RATE:
        return base
    time = base.time[0] + np.arange(len(base.time)) / rate
    findings = base.findings
    if abs(np.mean(step) - 1.0) > _SAME_RATE:
        what = f"the stamps give {rate / np.mean(step):.6g} Hz and [signals] sample_rate {rate:.6g} Hz"
        findings = (*findings, Finding("warning", what, name, "the latter was used"))
    return replace(base, time=time, findings=findings, rate_std=0.0)
