"""Implementation of `hdjax predict`."""

import sys
from pathlib import Path

from fitting.api.data import load
from fitting.api.prediction import predict
from fitting.commands.spinner import spinning
from fitting.estimation.initial_states import WINDOW


def write_prediction(model: Path, log: Path, drive: Path, out: Path) -> None:
    """Run a model freely along a log and write the outputs that it predicts.

    Args:
        model: model.json of a report.
        log: file.
        drive: drive file.
        out: CSV file.

    Raises:
        InputError: bad files, or a log that does not suit the model.
        DataError: the log can't be used, or the simulation diverges.
    """
    with spinning("simulating"):
        found = predict(model, load(log, drive, outputs_until=WINDOW))
    found.save(out)
    for finding in found.findings:
        if finding.severity == "warning":
            print(f"hdjax: {log}: {finding}", file=sys.stderr)
    print(f"Prediction: {out}")
