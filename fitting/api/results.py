"""Results of the verbs: tables, a summary, pictures, a report on disk."""

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import polars as pl

from fitting.api.drawing import draw
from fitting.report.parameters import PARTS
from fitting.report.plots import Plot
from fitting.stored_model import StoredModel

_COLUMNS = ("value", "std", "low", "high", "unit", "identifiable", "flag")


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What a verb found.

    Attributes:
        report: What `report.json` holds.
        text: A compact summary.
        pictures: Of the page, in its order.
        model: The identified model; None for quasi-static logs, which show no motion.
        write: Writes the report into a folder.
    """

    report: dict[str, Any]
    text: str
    pictures: tuple[Plot, ...]
    model: StoredModel | None
    write: Callable[[Path], Any]

    @property
    def parameters(self) -> pl.DataFrame:
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
        return tuple(plot.key for plot in self.pictures)

    def summary(self) -> str:
        """What was found, in a page of text."""
        return self.text

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
        found = next((plot for plot in self.pictures if plot.key.startswith(name)), None)
        if found is None:
            raise ValueError(f"there is no plot '{name}'; choose one of {', '.join(self.plots)}")
        return draw(found, axes)

    def save(self, folder: str | PathLike[str]) -> Path:
        """Write the report (`report.html`, `report.json`, and `model.json` where there is a model) into a folder."""
        self.write(Path(folder))
        return Path(folder)

    def to_dict(self) -> dict[str, Any]:
        """What `report.json` holds."""
        return self.report

    def __str__(self) -> str:
        return self.text

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
    def effects(self) -> pl.DataFrame:
        """The effects that were found: family, form, gain and p-value, largest gain first."""
        keys = ("family", "name", "gain", "p_value")
        rows = [[_of_effect(e, key) for key in keys] for e in self.report["after"]["effects"]]
        kinds = {"family": pl.String, "name": pl.String, "gain": pl.Float64, "p_value": pl.Float64}
        return pl.DataFrame(rows, schema=kinds, orient="row")

    @property
    def effect_parameters(self) -> pl.DataFrame:
        """The parameters of all effects, as `parameters` has them."""
        known: dict[str, Any] = {}
        for effect in self.report["after"]["effects"]:
            known |= effect.get("parameters") or {}
        return _estimates(known)

    @property
    def rules(self) -> pl.DataFrame:
        """Why this decision: each rule with its statistic, its threshold and its outcome."""
        return pl.DataFrame(self.report.get("rules") or [])


def _of_effect(effect: dict[str, Any], key: str) -> Any:
    return effect.get(key, effect.get("validation_gain") if key == "gain" else None)


def _estimates(parameters: dict[str, Any]) -> pl.DataFrame:
    rows = []
    for path, known in parameters.items():
        low, high = known["ci95"]
        own = {**known, "low": low, "high": high}
        rows.append([path, *(own.get(column) for column in _COLUMNS)])
    kinds = dict.fromkeys(("value", "std", "low", "high"), pl.Float64)
    kinds |= {"parameter": pl.String, "unit": pl.String, "identifiable": pl.Boolean, "flag": pl.String}
    return pl.DataFrame(rows, schema={name: kinds[name] for name in ("parameter", *_COLUMNS)}, orient="row")
