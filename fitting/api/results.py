"""Results of the verbs: tables, a summary, pictures, a report on disk."""

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
from fitting.report.parameters import PARTS
from fitting.report.plots import Plot
from fitting.stored_model import StoredModel

if TYPE_CHECKING:
    # Few fits are asked for a table.
    import polars as pl

_COLUMNS = ("value", "std", "low", "high", "unit", "identifiable", "flag")


class Told(Protocol):
    """What is told of an outcome: a [`fitting.report.Report`][], or that of quasi-static logs."""

    @property
    def content(self) -> dict[str, Any]:
        """What `report.json` holds."""
        ...

    @property
    def pictures(self) -> Sequence[Plot]:
        """Of the page, in its order."""
        ...

    @property
    def text(self) -> str:
        """For a terminal."""
        ...

    def write(self, folder: str | PathLike[str]) -> Any:
        """Write the files of the report into a folder."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What a verb found.

    Attributes:
        told: What is told of the outcome.
        rig: The logs as they were fitted; None for quasi-static ones.
    """

    told: Told
    rig: Rig | None = None

    @property
    def report(self) -> dict[str, Any]:
        """What `report.json` holds."""
        return self.told.content

    @property
    def model(self) -> StoredModel | None:
        """The identified model; None for quasi-static logs, which show no motion."""
        return self.told.outcome.stored if isinstance(self.told, Report) else None

    @property
    def parameters(self) -> "pl.DataFrame":
        """The drive's parameters in the final model: value, standard error, 95 % interval, unit, flag."""
        final = self.report["after"]["parameters"] or self.report["before"]["parameters"]
        return _estimates(final)

    @property
    def rmse(self) -> dict[str, float]:
        """Rms error of the final model on each part of the data, in the unit of the dynamic error."""
        final = self.report["after"] if self.report["after"]["parameters"] else self.report["before"]
        return {part: final["rmse"][part] for part in PARTS if final["rmse"].get(part) is not None}

    @property
    def plots(self) -> tuple[str, ...]:
        """Names of the pictures that [`plot`][] draws."""
        return tuple(plot.key for plot in self.told.pictures)

    def summary(self) -> str:
        """What was found, in a page of text."""
        return self.told.text

    def plot(self, name: str = "prediction", axes: Any = None) -> Any:
        """Draw one of the pictures of the report on axes of matplotlib.

        Args:
            name: One of `plots`, or how it begins.
            axes: To draw on, one for each pair of axes that the picture has; made where not given.

        Returns:
            The axes, or an array of them.

        Raises:
            ValueError: There is no such picture.
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
        """Look for the motor torque of an experiment that would tell more: explanations that are tied apart, or after a
        fit alpha.

        Args:
            limits: Any of `torque` [N m], `speed` [rad/s], `travel` [rad], `twist` [rad] and `duration` [s]; what the
                logs have reached where not given.
            progress: Told what is being done.

        Returns:
            The same with the experiment in its report; without one where nothing is open, or no torque keeps the
            limits.

        Raises:
            InputError: The logs are quasi-static.
        """
        if not isinstance(self.told, Report) or self.rig is None:
            raise InputError(f"there is no next experiment to look for: {WHY_NOT_QUASI_STATIC}")
        # Loaded here: few are asked for an experiment.
        from fitting.next_experiment.proposal import experiment_for_alpha, experiment_for_ties

        outcome = self.told.outcome
        if isinstance(outcome, Loop):
            proposed = experiment_for_ties(outcome, limits, progress=progress)
        else:
            proposed = experiment_for_alpha(outcome, self.rig.experiments[outcome.hold], limits, progress=progress)
        return replace(self, told=Report.of_rig(outcome, self.rig, next_experiment=proposed))

    def to_dict(self) -> dict[str, Any]:
        """What `report.json` holds."""
        return self.report

    def __str__(self) -> str:
        return self.told.text

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.report['name']}: {self.report['summary']})"

    def _repr_html_(self) -> str:
        sentence = self.report["summary"].replace("&", "&amp;").replace("<", "&lt;")
        return f"<p><b>{self.report['name']}</b>: {sentence}</p>{self.parameters._repr_html_()}"


@dataclass(frozen=True, eq=False, repr=False)
class FitResult(Result):
    """A fit of the base model."""


@dataclass(frozen=True, eq=False, repr=False)
class LoopResult(Result):
    """A closed loop: what was missing, and the model with it."""

    @property
    def decision(self) -> str:
        """ "effect_found", "model_sufficient" or "unexplained"."""
        return self.report["decision"]

    @property
    def effects(self) -> "pl.DataFrame":
        """The effects that were found: family, form, gain and p-value, largest gain first."""
        import polars as pl

        keys = ("family", "name", "gain", "p_value")
        rows = [[_of_effect(e, key) for key in keys] for e in self.report["after"]["effects"]]
        kinds = {"family": pl.String, "name": pl.String, "gain": pl.Float64, "p_value": pl.Float64}
        return pl.DataFrame(rows, schema=kinds, orient="row")

    @property
    def effect_parameters(self) -> "pl.DataFrame":
        """The parameters of all effects, as `parameters` has them."""
        known: dict[str, Any] = {}
        for effect in self.report["after"]["effects"]:
            known |= effect.get("parameters") or {}
        return _estimates(known)

    @property
    def rules(self) -> "pl.DataFrame":
        """Why this decision: each rule with its statistic, its threshold and its outcome."""
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
