"""Which kind of log a table is, and which of its columns that kind needs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from fitting.errors import InputError
from fitting.logs.column_names import likely_columns
from fitting.logs.drive_file import SIGNALS, DriveFile, did_you_mean
from fitting.logs.raw_table import RawColumn, RawTable, split_unit

DRIVE_SIGNALS = ("motor_angle", "load_angle", "motor_torque")
REDUCED_SIGNALS = ("dynamic_error", "forcing")
TWIST_SIGNALS = (("twist",), ("dynamic_error",), ("motor_angle", "load_angle"), ("load_angle",))
OUTPUTS = ("motor_angle", "load_angle", "dynamic_error", "twist")
OPTIONAL_SIGNALS = ("load_torque", "temperature")
VELOCITIES = ("motor_velocity", "load_velocity")

Kind = Literal["drive", "reduced", "quasi-static"]

_MOST_LIKELY = 3
_MISSPELT = 0.78
_DRIVE_KEYS = ("reduction_ratio", "motor_inertia", "load_inertia")


def refuse_repeated(path: Path, drive_file: DriveFile, table: RawTable) -> None:
    """Refuse signals whose column's name several columns have; of time columns, each is a clock."""
    for signal in SIGNALS[1:]:
        name = drive_file.column_of(signal).column
        if name in table.repeated:
            raise InputError(
                f"{path}: the column '{name}' appears twice; give [columns] {signal} of {drive_file.path} its number, "
                f"or the name '{name} (2)' for the second one"
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
    is_drive = all(signal in raw for signal in DRIVE_SIGNALS)
    is_reduced = all(signal in raw for signal in REDUCED_SIGNALS)
    if is_drive and is_reduced:
        # A drive log may carry a derived dynamic error; only a stated one displaces the angles.
        is_drive = not all(signal in drive_file.columns for signal in REDUCED_SIGNALS)
    if "joint_torque" in raw and twist_signals(raw):
        stated = drive_file.columns
        only_stated = "joint_torque" in stated and not ("motor_torque" in stated or "forcing" in stated)
        if only_stated or not (is_drive or is_reduced):
            return "quasi-static"
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
    begun = any(s in raw for s in REDUCED_SIGNALS) and not any(s in raw for s in DRIVE_SIGNALS)
    missing = [s for s in (REDUCED_SIGNALS if begun else DRIVE_SIGNALS) if s not in raw]
    taken = [drive_file.column_of(signal).column for signal in raw]
    free = [name for name in table.names if split_unit(name)[0] not in taken]
    likely = likely_columns(missing[0], free)[:_MOST_LIKELY]
    could_be = f" ({' or '.join(repr(name[:60]) for name in likely)} could be it)" if likely else ""
    example = likely[0][:60] if likely else "..."
    # The name of another signal is like this one's as well.
    hint = did_you_mean(missing[0], free, cutoff=_MISSPELT) or could_be
    velocity = missing[0].replace("angle", "velocity")
    if velocity in raw and velocity != missing[0]:
        hint = f" ({velocity} cannot stand in for it: integrated, it drifts by more than the twist)"
    raise InputError(
        f"{path}: no column for {', '.join(missing)}{hint}; {listing(table)}, so say which one it is in the drive "
        f'file, e.g. [columns] {missing[0]} = {{ column = "{example}" }}, or let `hdjax init` guess'
    )


def listing(table: RawTable) -> str:
    if not table.names:
        return "the file has no columns"
    more = f" and {len(table.names) - 12} more" if len(table.names) > 12 else ""
    return f"the file has {', '.join(name[:60] for name in table.names[:12])}{more}"


def needed_signals(kind: Kind, raw: Mapping[str, RawColumn]) -> tuple[str, ...]:
    """The signals of a log, its input last."""
    if kind == "quasi-static":
        return (*twist_signals(raw), "joint_torque")
    return DRIVE_SIGNALS if kind == "drive" else REDUCED_SIGNALS


def twist_signals(raw: Mapping[str, RawColumn]) -> tuple[str, ...]:
    """What the twist is made of in a quasi-static log; nothing where it is not there."""
    return next((signals for signals in TWIST_SIGNALS if all(s in raw for s in signals)), ())
