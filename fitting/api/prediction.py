"""Free runs of identified models along logs, and comparison of models."""

import html
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fitting.api.data import Data
from fitting.api.results import Result
from fitting.drive_data import WHY_NOT_QUASI_STATIC, experiments
from fitting.errors import DataError, InputError
from fitting.estimation.experiment import fitted_outputs, whole
from fitting.estimation.free_run import FreeRun, as_logged, free_run
from fitting.estimation.initial_states import WINDOW
from fitting.files import write_whole
from fitting.logs.findings import Finding
from fitting.logs.log import Log
from fitting.logs.masks import masked
from fitting.logs.zeroing import counted_from
from fitting.report.plots.axes import MEASURED
from fitting.stored_model import StoredModel, read_model
from fitting.validation.goodness_of_fit import fit_percent
from hdjax import TwoInertiaModel

AnyModel = str | PathLike[str] | StoredModel | Result


@dataclass(frozen=True, eq=False)
class Prediction:
    """A model's free run along a log.

    Attributes:
        run: Predicted and measured outputs.
        rows: Of the run that are rows of the log.
        zero: Offset that was subtracted from the measured dynamic error; the predicted one includes it.
        findings: On the log.
        is_judged: Whether outputs are known beyond those that the run starts from.
    """

    run: FreeRun
    rows: np.ndarray | slice
    zero: float
    findings: tuple[Finding, ...]
    is_judged: bool

    @property
    def table(self) -> pl.DataFrame:
        """Time [s] and predicted outputs [SI, or a reduced log's unit], the principal one first, one row per sample."""
        zeros = {"dynamic_error": self.zero}
        found = {name: (predicted + zeros.get(name, 0.0)) for name, (predicted, _) in self.run.outputs.items()}
        return pl.DataFrame({"time": self.run.time[self.rows]} | {name: v[self.rows] for name, v in found.items()})

    def save(self, path: str | PathLike[str]) -> Path:
        """Write the table as CSV."""
        write_whole({Path(path): self.table.write_csv(float_precision=None)})
        return Path(path)

    def plot(self, axes: Any = None) -> Any:
        """Draw measured and predicted principal output on axes of matplotlib; created where not given."""
        return _drawn({"predicted": self.run}, axes)

    def summary(self) -> str:
        """The error in a sentence; where no output is known beyond the first ones, that."""
        if not self.is_judged:
            return f"{self.run.name}: {self.run.time.size} samples predicted, with no measured output to compare with"
        return f"{self.run.name}: rms error {self.run.rmse:.4g}, fit {fit_percent([self.run]):.4g} %"

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(self.summary(), quote=False)}</p>{self.table._repr_html_()}"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of models on the same logs.

    Attributes:
        runs: Free runs by model, one per log.
        noise: Rms measurement noise of the principal output stored with each model.
    """

    runs: dict[str, tuple[FreeRun, ...]]
    noise: dict[str, float]

    @property
    def table(self) -> pl.DataFrame:
        """One row per model and log: rms error, fit in percent, and the error over the noise."""
        rows = [
            [name, run.name, run.rmse, fit_percent([run]), run.rmse / self.noise[name]]
            for name, runs in self.runs.items()
            for run in runs
        ]
        columns = ("model", "log", "rmse", "fit_percent", "times_noise")
        return pl.DataFrame(rows, schema=columns, orient="row")

    def plot(self, axes: Any = None) -> Any:
        """Draw the first log and each model's prediction on axes of matplotlib; created where not given."""
        return _drawn({name: runs[0] for name, runs in self.runs.items()}, axes)

    def summary(self) -> str:
        """The table as text."""
        return str(self.table)

    def _repr_html_(self) -> str:
        return self.table._repr_html_()


def predict(model: AnyModel, data: Data) -> Prediction:
    """Run a model freely along a log.

    The log's outputs are used in the first 50 samples only, for the initial state. The others, where they were loaded,
    are those that the prediction is compared with.

    Args:
        model: A `model.json` of a report, a result, or its model.
        data: One log, and its drive.

    Raises:
        InputError: The log does not suit the model.
        DataError: The log can't be used, or the simulation diverges.
    """
    if len(data.logs) != 1:
        raise InputError(f"a prediction follows one log, but there are {len(data.logs)}; load it alone")
    stored, name = _stored(model)
    log = data.ready(data.logs[0], outputs_until=WINDOW, zeros=stored.zeros)
    known = None
    if data.outputs_until is None:
        known = replace(counted_from(masked(data.logs[0]), log.zero), pieces=None)
        # Doubled rows may be told by the later outputs alone.
        known = known if np.array_equal(known.time, log.time) else None
    (run,), rows = _runs(stored, name, data, log, judged=known)
    if not np.isfinite(run.predicted).all():
        raise DataError(f"{log.path}: the model's free run diverges; check the torque column's unit and sign")
    return Prediction(run, rows, log.zero, log.findings, known is not None)


def compare(models: Mapping[str, AnyModel], data: Data) -> Comparison:
    """Run several models freely along the same logs.

    Args:
        models: Each as in [`predict`][], by name.
        data: The logs; preferably not those that a model was fitted to.

    Raises:
        InputError: A log does not suit a model.
        DataError: A log can't be used.
    """
    stored = {name: _stored(model)[0] for name, model in models.items()}
    runs = {name: tuple(_along_all(one, name, data)) for name, one in stored.items()}
    factors = {name: as_logged(one.model)[1][-1] for name, one in stored.items()}
    noise = {name: factors[name] * float(np.sqrt(np.asarray(one.noise)[-1, -1])) for name, one in stored.items()}
    return Comparison(runs, noise)


def _along_all(stored: StoredModel, name: str, data: Data) -> Iterator[FreeRun]:
    """Free runs along all logs, with the zero of those that the model was fitted to; where they differ, each with its
    own."""
    for raw in (*data.logs, *data.test):
        log = replace(data.ready(raw, zeros=stored.zeros), has_own_zero=len({*stored.zeros}) > 1)
        yield from _runs(stored, name, data, log)[0]


def _drawn(runs: Mapping[str, FreeRun], axes: Any) -> Any:
    """The measured principal output of one log, and models' predictions of it."""
    import matplotlib.pyplot as plt

    place = plt.subplots()[1] if axes is None else axes
    first = next(iter(runs.values()))
    measured = np.where(first.counts, first.measured, np.nan)
    place.plot(first.time, measured, color=MEASURED, linewidth=3.0, label="measured")
    for name, run in runs.items():
        place.plot(run.time, run.predicted, linewidth=1.2, label=name)
    place.set(xlabel="time [s]", ylabel=first.output.replace("_", " "), title=first.name)
    place.legend(frameon=False)
    return place


def _stored(model: AnyModel) -> tuple[StoredModel, str]:
    """A model, and its name in messages."""
    if isinstance(model, StoredModel):
        return model, "the model"
    if isinstance(model, Result):
        if model.model is None:
            raise InputError(WHY_NOT_QUASI_STATIC)
        return model.model, "the model"
    return read_model(Path(model)), str(model)


def _runs(
    stored: StoredModel, name: str, data: Data, log: Log, *, judged: Log | None = None
) -> tuple[tuple[FreeRun, ...], np.ndarray | slice]:
    """Free runs along a log, compared with its outputs or with those of another reading of it; and their rows."""
    if log.kind == "quasi-static":
        raise InputError(f"{log.path}: {WHY_NOT_QUASI_STATIC}")
    if (log.kind == "drive") != isinstance(stored.model, TwoInertiaModel):
        raise InputError(
            f"{log.path}: a {log.kind} log, but {name} is a model of another kind; give a log of the fitted kind"
        )
    needed, seen = as_logged(stored.model)[0], log.outputs
    if stored.model.measured != fitted_outputs(log):
        raise InputError(
            f"{log.path}: the log has {' and '.join(seen)}, but {name} was fitted to {' and '.join(needed)}; give a "
            "log with these"
        )
    warm = [e.name for e in stored.model.effects if e.needs_temperature]
    if warm and log.temperature is None:
        raise InputError(
            f"{log.path}: there is no temperature, on which {warm[0]} of {name} depends; add the column, or name it in "
            f"[columns] temperature of {data.drive.path}"
        )
    along = whole(experiments(log, data.drive, stored.hold))
    known = None if judged is None else whole(experiments(judged, data.drive, stored.hold))
    how = {"covariance": stored.noise, "halo": stored.halo, "substeps": stored.substeps}
    runs = free_run(stored.model, along, judged=known, **how)
    rows = along[0].experiment.rows
    return runs, slice(None) if rows is None else rows
