"""Outputs of a log in a report: names, units, noise."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting.estimation.free_run import as_logged
from fitting.stored_model import StoredModel
from hdjax.dynamics import OUTPUTS


def noise_of_outputs(stored: StoredModel) -> dict[str, float]:
    """Rms measurement noise of each output in its log's unit, that of the principal one last."""
    names, factors = as_logged(stored.model)
    std = np.sqrt(np.diag(np.asarray(stored.noise)))
    return {name: float(factor * own) for name, factor, own in zip(names, factors, std, strict=True)}


def units_of_outputs(stored: StoredModel) -> dict[str, str]:
    """SI unit of each output."""
    return {name: OUTPUTS[name] for name in as_logged(stored.model)[0]}


def principal(report: Mapping[str, Any]) -> tuple[str, str, float]:
    """The output by which the model is judged: in words, its unit, and its measurement noise."""
    output = report["output"]
    return in_words(output), report["units"][output], report["noise"][output]


def in_words(output: str) -> str:
    """An output's name in words."""
    return output.replace("_", " ")


def outputs(report: Mapping[str, Any]) -> list[str]:
    """All outputs, the principal one first."""
    return [report["output"], *others(report)]


def others(report: Mapping[str, Any]) -> list[str]:
    """The outputs beside the principal one."""
    return [name for name in report["before"]["rmse_of_outputs"] if name != report["output"]]


def final_account(report: Mapping[str, Any]) -> Mapping[str, Any]:
    """The account of the final model: that after the loop, if there is one."""
    return report["after"] if report["after"]["parameters"] else report["before"]
