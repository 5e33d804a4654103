"""Kind of a log, and the columns that it needs."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Literal

from fitting.errors import InputError
from fitting.logs.column_names import likely_columns
from fitting.logs.drive_file import SIGNALS, DriveFile, did_you_mean
from fitting.logs.findings import Finding
from fitting.logs.raw_table import RawColumn, RawTable, split_unit

DRIVE_SIGNALS = ("motor_angle", "load_angle", "motor_torque")
REDUCED_SIGNALS = ("dynamic_error", "forcing")
_BOTH_ANGLES = ("motor_angle", "load_angle")
TWIST_SIGNALS = (("twist",), ("dynamic_error",), _BOTH_ANGLES, ("load_angle",))
OUTPUTS = ("motor_angle", "load_angle", "dynamic_error", "twist", "motor_velocity", "load_velocity")
OPTIONAL_SIGNALS = ("load_torque", "temperature")
VELOCITIES = ("motor_velocity", "load_velocity")
SIDES = (("motor_angle", "motor_velocity"), ("load_angle", "load_velocity"))

Kind = Literal["drive", "reduced", "quasi-static"]

_MOST_LIKELY = 3
_MISSPELT = 0.78
_DRIVE_KEYS = ("reduction_ratio", "motor_inertia", "load_inertia")


def refuse_repeated(path: Path, drive_file: DriveFile, table: RawTable) -> None:
    """Refuse signals whose column name is not unique; several time columns are separate clocks."""
    for signal in SIGNALS[1:]:
        name = drive_file.column_of(signal).column
        if name in table.repeated:
            raise InputError(
                f"{path}: the column '{name}' appears twice; give [columns] {signal} of {drive_file.path} its number, "
                f"or the name '{name} (1)' or '{name} (2)'"
            )


def kind_of(path: Path, drive_file: DriveFile, table: RawTable, raw: dict[str, RawColumn]) -> Kind:
    clocked = any(column.time is not None for column in raw.values())
    stated_but_absent = [s for s in drive_file.columns if s not in raw and not (s == "time" and clocked)]
    if stated_but_absent:
        signal = stated_but_absent[0]
        column = drive_file.columns[signal].column
        raise InputError(
            f"{path}: there is no column '{column}'{did_you_mean(column, table.names)}, which "
            f"[columns] {signal} of {drive_file.path} names; {listing(table)}"
        )
    stated = drive_file.columns
    has_angles = all(signal in raw for signal in DRIVE_SIGNALS)
    is_reduced = all(signal in raw for signal in REDUCED_SIGNALS)
    if has_angles and is_reduced:
        # A drive log may contain a derived dynamic error; only a stated one replaces the angles.
        has_angles = not all(signal in stated for signal in REDUCED_SIGNALS)
    if "joint_torque" in raw and twist_signals(raw, drive_file):
        only_stated = "joint_torque" in stated and not ("motor_torque" in stated or "forcing" in stated)
        if only_stated or not (has_angles or is_reduced or "motor_torque" in stated):
            return "quasi-static"
    is_drive = has_angles or (not is_reduced and "motor_torque" in raw and sees_motor(raw))
    if is_drive:
        for key in _DRIVE_KEYS:
            if not drive_file.states(key):
                raise InputError(
                    f"{drive_file.path}: [drive] {key} is missing, which a log with angles and "
                    f"torque such as {path} needs; add it"
                )
        return "drive"
    if is_reduced:
        return "reduced"
    missing = _missing(raw)
    free = _unnamed(drive_file, table, raw)
    likely = likely_columns(missing[0], free)[:_MOST_LIKELY]
    could_be = f" ({' or '.join(repr(name[:60]) for name in likely)} could be it)" if likely else ""
    example = likely[0][:60] if likely else "..."
    # The name also resembles that of another signal.
    hint = did_you_mean(missing[0], free, cutoff=_MISSPELT) or could_be
    raise InputError(
        f"{path}: no column for {', '.join(missing)}{hint}; {listing(table)}, so say which one it is in the drive "
        f'file, e.g. [columns] {missing[0]} = {{ column = "{example}" }}, or let `hdjax init` guess'
    )


def _missing(raw: Mapping[str, RawColumn]) -> list[str]:
    """Missing signals of a log, for its most likely kind."""
    if any(s in raw for s in REDUCED_SIGNALS) and not any(s in raw for s in DRIVE_SIGNALS):
        return [s for s in REDUCED_SIGNALS if s not in raw]
    if sees_motor(raw) and "motor_torque" not in raw:
        return ["motor_torque"]
    return [s for s in ("motor_angle", "motor_torque") if s not in raw]


def _unnamed(drive_file: DriveFile, table: RawTable, raw: Mapping[str, RawColumn]) -> list[str]:
    """Columns that are not assigned to a signal."""
    taken = [drive_file.column_of(signal).column for signal in raw]
    return [name for name in table.names if split_unit(name)[0] not in taken]


def told_of_subset(drive_file: DriveFile, table: RawTable, raw: Mapping[str, RawColumn]) -> tuple[Finding, ...]:
    """Finding on a drive log that lacks an angle: its fitted outputs, and columns that may be the angle."""
    seen, lacks = drive_outputs(raw), [angle for angle, _ in SIDES if angle not in raw]
    if not lacks or not seen:
        return ()
    free = _unnamed(drive_file, table, raw)
    likely = [(angle, name) for angle in lacks for name in likely_columns(angle, free)[:1]]
    could_be = "".join(f"; the column '{name[:60]}' could be {angle}, so name it if it is" for angle, name in likely)
    what = f"there is no {' and no '.join(lacks)}"
    consequence = f"the drive is fitted to {' and '.join(seen)} under motor_torque{could_be}"
    return (Finding("warning" if likely else "note", what, "all columns", consequence),)


def listing(table: RawTable) -> str:
    if not table.names:
        return "the file has no columns"
    more = f" and {len(table.names) - 12} more" if len(table.names) > 12 else ""
    return f"the file has {', '.join(name[:60] for name in table.names[:12])}{more}"


def needed_signals(kind: Kind, raw: Mapping[str, RawColumn], drive_file: DriveFile) -> tuple[str, ...]:
    """The signals of a log, its input last."""
    if kind == "quasi-static":
        return (*twist_signals(raw, drive_file), "joint_torque")
    return (*drive_outputs(raw), "motor_torque") if kind == "drive" else REDUCED_SIGNALS


def sees_motor(signals: Collection[str]) -> bool:
    """Whether the motor's motion was logged, which every drive log needs."""
    return any(signal in signals for signal in SIDES[0])


def drive_outputs(signals: Collection[str]) -> tuple[str, ...]:
    """The outputs that a drive log is fitted to, the principal one last.

    Both angles suffice. A velocity beside the angle of its side is mostly the angle's derivative, and used for checks
    only.
    """
    sides = [next((s for s in side if s in signals), None) for side in SIDES]
    if sides == ["motor_angle", "load_angle"]:
        return ("motor_angle", "load_angle")
    return (*(s for s in sides if s is not None), *(s for s in ("joint_torque",) if s in signals))


def twist_signals(raw: Mapping[str, RawColumn], drive_file: DriveFile) -> tuple[str, ...]:
    """Signals that give the twist of a quasi-static log; empty where they are missing.

    Both angles also tell how the joint moved. Beside them only a stated twist counts.
    """
    found = [signals for signals in TWIST_SIGNALS if all(s in raw for s in signals)]
    stated = any(s in drive_file.columns for s in ("twist", "dynamic_error"))
    if _BOTH_ANGLES in found and drive_file.states("reduction_ratio") and not stated:
        return _BOTH_ANGLES
    return found[0] if found else ()
