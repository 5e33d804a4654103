"""Health check of logs with guessed signals, before anything is filled in."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fitting.errors import DataError, InputError
from fitting.inspection.drive_text import column_place, drive_tables
from fitting.inspection.inspection import Inspection
from fitting.inspection.settling import RatioGuess
from fitting.inspection.time_column import sampling_findings
from fitting.logs.checks import examine
from fitting.logs.drive_file import drive_of
from fitting.logs.findings import Finding
from fitting.logs.log import read_log
from fitting.logs.masks import masked

# Placeholder of unknown values; no finding depends on it.
_ANY_INERTIA = 1.0
_ANY_RATE = 1.0
_ANY_CONSTANT = 1.0
_DRIVE_FILE = Path("the drive file")


def health(inspection: Inspection) -> tuple[tuple[Finding, ...], ...]:
    """The findings for each log."""
    tables = drive_tables(inspection)
    current = inspection.joint.signals.get("motor_current")
    if current is not None and "motor_torque" not in inspection.joint.signals:
        place = {"unit": "A"} | column_place(inspection, current)
        tables["columns"]["motor_current"] = place | {"torque_constant": _ANY_CONSTANT}
    readable = inspection.joint.kind is not None and _complete(inspection, tables)
    return tuple(
        _of_log(inspection, k, tables) if readable else _of_columns(inspection, k)
        for k in range(len(inspection.tables))
    )


def _complete(inspection: Inspection, tables: Mapping[str, Any]) -> bool:
    """Whether every signal has a unit, so that the log can be read as for a fit."""
    signals = set(inspection.joint.signals)
    return all(s in tables["columns"] for s in signals - ({"motor_current"} if "motor_torque" in signals else set()))


def _of_log(inspection: Inspection, k: int, tables: Mapping[str, Any]) -> tuple[Finding, ...]:
    path, source, ratio = inspection.tables[k].path, inspection.tables[k].source, inspection.joint.ratio
    if ratio is not None and ratio.inverted:
        return (_inverted(ratio), *_of_columns(inspection, k))
    known = dict(tables["drive"]) | ({} if ratio is None else {"reduction_ratio": float(ratio.value)})
    filled = {"reduction_ratio": 1.0, "motor_inertia": _ANY_INERTIA, "load_inertia": _ANY_INERTIA} | known
    signals = {} if inspection.rates[k] is not None else {"sample_rate": _ANY_RATE}
    wanted = drive_of({**tables, "drive": filled, "signals": signals}, _DRIVE_FILE)
    try:
        log = read_log(path, wanted, table=source)
        log = log if log.kind == "quasi-static" else masked(log)
    except (InputError, DataError) as error:
        return (Finding("refusal", str(error).removeprefix(f"{path}: "), path.name, "`hdjax fit` refuses this"),)
    if ratio is None and log.motor_angle is not None and log.load_angle is not None:
        return (*log.findings, *_constants(inspection, k))
    # Without inertias, findings on them are dropped.
    return examine(log, drive_of({**tables, "drive": known, "signals": signals}, _DRIVE_FILE))


def _inverted(ratio: RatioGuess) -> Finding:
    return Finding(
        "refusal",
        f"the load angle moves {1.0 / ratio.value:.4g} times as far as the motor angle",
        "load_angle against motor_angle",
        "the columns seem swapped, or one unit is wrong",
    )


def _of_columns(inspection: Inspection, k: int) -> tuple[Finding, ...]:
    """Findings on the columns where they do not make up a log."""
    table, time = inspection.tables[k], inspection.time
    found = [*sampling_findings(table, time, inspection.clocks[k])]
    for guess in inspection.joint.signals.values():
        values = table.column(guess.column).values
        blank = int((~np.isfinite(values)).sum())
        if blank:
            what = f"blank in {blank} rows ({100 * blank / len(values):.3g} %)"
            found.append(Finding("note", what, guess.column, "they will have weight zero in a fit"))
    return (*found, *_constants(inspection, k))


def _constants(inspection: Inspection, k: int) -> Iterator[Finding]:
    for guess in inspection.joint.signals.values():
        if inspection.tables[k].column(guess.column).constant:
            yield Finding("warning", "it is constant", guess.column, "it has no information in this log")
