"""Results of fits and loops: tables, a summary, plots, a report on disk."""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

from fitting.api.drawing import draw
from fitting.drive_data import WHY_NOT_QUASI_STATIC, Rig
from fitting.errors import InputError
from fitting.outcome import Loop
from fitting.progress import Progress, silent
from fitting.report import Report
from fitting.report.outputs import final_account
from fitting.report.parameters import PARTS
from fitting.report.plots import Plot
from fitting.stored_model import StoredModel

if TYPE_CHECKING:
    # Imported on demand: few results are used as tables.
    import polars as pl

_COLUMNS = ("value", "std", "low", "high", "unit", "identifiable", "flag")


class Told(Protocol):
    """The report of an outcome: a [`fitting.report.Report`][], or that of quasi-static logs."""

    @property
    def content(self) -> dict[str, Any]:
        """The content of `report.json`."""
        ...

    @property
    def pictures(self) -> Sequence[Plot]:
        """Plots in the order of the page."""
        ...

    @property
    def text(self) -> str:
        """Text for a terminal."""
        ...

    def write(self, folder: str | PathLike[str]) -> Any:
        """Write the files of the report into a folder."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Result of a fit or a loop.

    Attributes:
        told: The report.
        rig: The logs as fitted; None for quasi-static ones.
    """

    told: Told
    rig: Rig | None = None

    @property
    def report(self) -> dict[str, Any]:
        """The content of `report.json`."""
        return self.told.content

    @property
    def model(self) -> StoredModel | None:
        """The identified model; None for quasi-static logs, which have no dynamics."""
        return self.told.outcome.stored if isinstance(self.told, Report) else None

    @property
    def parameters(self) -> "pl.DataFrame":
        """The drive's parameters in the final model: value, standard error, 95 % interval, unit, flag."""
        return _estimates(final_account(self.report)["parameters"])

    @property
    def rmse(self) -> dict[str, float]:
        """Rms error of the final model on each part of the data, in the unit of the dynamic error."""
        final = final_account(self.report)
        return {part: final["rmse"][part] for part in PARTS if final["rmse"].get(part) is not None}

    @property
    def plots(self) -> tuple[str, ...]:
        """Names of the plots for [`plot`][]."""
        return tuple(plot.key for plot in self.told.pictures)

    def summary(self) -> str:
        """The result as text."""
        return self.told.text

    def plot(self, name: str = "prediction", axes: Any = None) -> Any:
        """Draw one of the plots of the report on axes of matplotlib.

        Args:
            name: One of `plots`, or its beginning.
            axes: To draw on, one for each pair of axes of the plot; created where not given.

        Returns:
            The axes, or an array of them.

        Raises:
            ValueError: There is no such plot.
        """
        found = next((plot for plot in self.told.pictures if plot.key.startswith(name)), None)
        if found is None:
            raise ValueError(f"there is no plot '{name}'; choose one of {', '.join(self.plots)}")
        return draw(found, axes)

    def save(self, folder: str | PathLike[str]) -> Path:
        """Write the report (`report.html`, `report.json`, and `model.json` where there is a model) into a folder."""
        self.told.write(folder)
        return Path(folder)

    def with_next_experiment(self, limits: Mapping[str, float] | None = None, *, progress: Progress = silent) -> Self:
        """Search for the motor torque of a next experiment, which separates tied explanations, or after a fit
        determines alpha.

        Args:
            limits: Any of `torque` [N m], `speed` [rad/s], `travel` [rad], `twist` [rad] and `duration` [s]; those
                reached in the logs where not given.
            progress: Receives messages.

        Returns:
            The same with the experiment in its report; without one where none is needed, or no torque respects the
            limits.

        Raises:
            InputError: The logs are quasi-static.
        """
        if not isinstance(self.told, Report) or self.rig is None:
            raise InputError(f"there is no next experiment: {WHY_NOT_QUASI_STATIC}")
        # Imported here: few results need an experiment.
        from fitting.next_experiment.proposal import experiment_for_alpha, experiment_for_ties

        outcome = self.told.outcome
        if isinstance(outcome, Loop):
            proposed = experiment_for_ties(outcome, limits, progress=progress)
        else:
            proposed = experiment_for_alpha(outcome, self.rig.experiments[outcome.hold], limits, progress=progress)
        return replace(self, told=Report.of_rig(outcome, self.rig, next_experiment=proposed, sought=True))

    def to_dict(self) -> dict[str, Any]:
        """The content of `report.json`."""
        return self.report

    def __str__(self) -> str:
        return self.told.text

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.report['name']}: {self.report['summary']})"

    def _repr_html_(self) -> str:
        name, sentence = (html.escape(self.report[key], quote=False) for key in ("name", "summary"))
        return f"<p><b>{name}</b>: {sentence}</p>{self.parameters._repr_html_()}"


@dataclass(frozen=True, eq=False, repr=False)
class FitResult(Result):
    """A fit of the base model."""


@dataclass(frozen=True, eq=False, repr=False)
class LoopResult(Result):
    """A closed loop: the accepted effects, and the model with them."""

    @property
    def decision(self) -> str:
        """ "effect_found", "model_sufficient" or "unexplained"."""
        return self.report["decision"]

    @property
    def effects(self) -> "pl.DataFrame":
        """The accepted effects: family, form, gain and p-value, largest gain first."""
        import polars as pl

        keys = ("family", "name", "gain", "p_value")
        rows = [[_of_effect(e, key) for key in keys] for e in self.report["after"]["effects"]]
        kinds = {"family": pl.String, "name": pl.String, "gain": pl.Float64, "p_value": pl.Float64}
        return pl.DataFrame(rows, schema=kinds, orient="row")

    @property
    def effect_parameters(self) -> "pl.DataFrame":
        """The parameters of all effects, as in `parameters`."""
        known: dict[str, Any] = {}
        for effect in self.report["after"]["effects"]:
            known |= effect.get("parameters") or {}
        return _estimates(known)

    @property
    def rules(self) -> "pl.DataFrame":
        """Reasons of the decision: each rule with statistic, threshold and outcome."""
        import polars as pl

        return pl.DataFrame(self.report.get("rules") or [])


def _of_effect(effect: dict[str, Any], key: str) -> Any:
    return effect.get(key, effect.get("validation_gain") if key == "gain" else None)


def _estimates(parameters: dict[str, Any]) -> "pl.DataFrame":
    import polars as pl

    rows = []
    for path, known in parameters.items():
        low, high = known["ci95"]
        own = {**known, "low": low, "high": high}
        rows.append([path, *(own.get(column) for column in _COLUMNS)])
    kinds = dict.fromkeys(("value", "std", "low", "high"), pl.Float64)
    kinds |= {"parameter": pl.String, "unit": pl.String, "identifiable": pl.Boolean, "flag": pl.String}
    return pl.DataFrame(rows, schema={name: kinds[name] for name in ("parameter", *_COLUMNS)}, orient="row")
