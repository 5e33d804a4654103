"""What `hdjax predict` does."""

import sys
from pathlib import Path

import numpy as np

from fitting.commands.table import write_table
from fitting.drive_data import WHY_NOT_QUASI_STATIC, experiments, ready_log
from fitting.errors import DataError, InputError
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_run import WINDOW, free_run
from fitting.logs.drive_file import read_drive_file
from fitting.stored_model import read_model
from hdjax import TwoInertiaModel


def write_prediction(model: Path, log: Path, drive: Path, out: Path) -> None:
    """Run a model freely along a log and write its dynamic error.

    Args:
        model: model.json of a report.
        log: file.
        drive: drive file.
        out: CSV file.

    Raises:
        InputError: for bad files, or a log that does not suit the model.
        DataError: where the log can't be used, or the model runs away.
    """
    stored = read_model(model)
    drive_file = read_drive_file(drive)
    read = ready_log(log, drive_file, outputs_until=WINDOW)
    if read.kind == "quasi-static":
        raise InputError(f"{log}: {WHY_NOT_QUASI_STATIC}")
    if (read.kind == "drive") != isinstance(stored.model, TwoInertiaModel):
        raise InputError(
            f"{log}: a {read.kind} log, but {model} is a model of the other kind; give a log like those fitted"
        )
    warm = [e.name for e in stored.model.effects if e.needs_temperature]
    if warm and read.temperature is None:
        raise InputError(
            f"{log}: there is no temperature, on which {warm[0]} of {model} depends; add the column, or name it in "
            f"[columns] temperature of {drive}"
        )
    (ready,) = experiments(read, drive_file, stored.hold)
    (run,) = free_run(
        stored.model,
        [Stretch(ready, 0, len(ready))],
        covariance=stored.noise,
        halo=stored.halo,
        substeps=stored.substeps,
    )
    if not np.isfinite(run.predicted).all():
        raise DataError(f"{log}: the model's free run leaves the numbers; check the torque column's unit and sign")
    rows = slice(None) if ready.rows is None else ready.rows
    write_table(out, {"time": run.time[rows], "dynamic_error": run.predicted[rows] + read.zero})
    for finding in read.findings:
        if finding.severity == "warning":
            print(f"hdjax: {log}: {finding}", file=sys.stderr)
    print(f"Prediction: {out}")
