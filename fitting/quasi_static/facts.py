"""Common content of all quasi-static reports: the drive, its logs and their health, versions, figures."""

import dataclasses
import math
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from fitting import formatting
from fitting.files import finite
from fitting.quasi_static.intervals import Known
from fitting.quasi_static.preparation import QuasiStaticData

SCHEMA = "hdjax-report/1"
_LIBRARIES = ("hdjax", "numpy", "scipy")
ARCMIN = math.degrees(1.0) * 60.0
"""Minutes of arc in a radian."""

FEW_STRETCHES = 10
"""Number of independent stretches below which intervals are unreliable."""

ABOUT_SCALE = (
    "If the joint torque was not measured but computed, from gravity or a current, its scale error affects every "
    "stiffness in proportion."
)


def framed(data: QuasiStaticData, content: Mapping[str, Any]) -> dict[str, Any]:
    """Content with the common first and last entries of a report; finite numbers and nulls only."""
    heading = {
        "schema": SCHEMA,
        "version": version("hdjax"),
        "name": data.drive_file.name,
        "kind": "quasi-static",
        "decision": "fit_only",
        "summary": "",
        "units": {"dynamic_error": "rad", "joint_torque": "N m"},
    }
    health = [{"log": name} | dataclasses.asdict(one) for name, found in data.findings.items() for one in found]
    versions = {"python": platform.python_version()} | {library: version(library) for library in _LIBRARIES}
    return finite(heading | dict(content) | {"health": health, "versions": versions})


def log_dicts(data: QuasiStaticData, rows: Sequence[int], reversals: Sequence[int]) -> list[dict[str, Any]]:
    """The logs that were fitted; each of their rows is held out once.

    Args:
        data: The logs.
        rows: In a block, by log.
        reversals: Of the torque, by log.
    """
    return [
        {
            "name": log.name,
            "samples": len(log),
            "held_out": len(log),
            "seconds": float(log.time[-1] - log.time[0]),
            "rows_per_block": size,
            "reversals": count,
            "motion": motion,
        }
        for log, motion, size, count in zip(data.logs, data.motion, rows, reversals, strict=True)
    ]


def account(
    known: Mapping[str, Known], training: np.ndarray, selection: np.ndarray, test: np.ndarray | None = None
) -> dict[str, Any]:
    """A fitted equation: figures, and rms errors by part of the data.

    The model is selected by cross-validation over folds of whole stretches.

    Args:
        known: Figures, by name.
        training: Misfit of the fitted data [rad], (n,).
        selection: Misfit of the held-out folds; schema 1 called them validation.
        test: Misfit of test data, (m,); None where there are none.
    """
    return no_account() | {"parameters": estimates(known), "rmse": rmse_dict(training, selection, test)}


def no_account() -> dict[str, Any]:
    """The same where nothing was fitted."""
    return {"effects": [], "parameters": {}, "derived": {}, "rmse": rmse_dict(None, None)}


def rmse_dict(
    training: np.ndarray | None, selection: np.ndarray | None, test: np.ndarray | None = None
) -> dict[str, float | None]:
    """Rms errors by part of the data; arguments as in [`account`][]."""
    parts = {"training": training, "selection": selection, "test": test, "validation": selection}
    return {name: None if one is None else float(np.sqrt(np.mean(one**2))) for name, one in parts.items()}


def estimates(known: Mapping[str, Known]) -> dict[str, Any]:
    """Figures, by name."""
    return {name: dataclasses.asdict(one) | {"ci95": list(one.ci95 or (None, None))} for name, one in known.items()}


def not_identifiable(names: list[str]) -> str:
    """The beginning of a sentence about figures that are not identifiable."""
    return f"{formatting.words(names)} {'is' if len(names) == 1 else 'are'} not identifiable from these logs"


def those_that_hold(notes: Sequence[tuple[Any, str]]) -> list[str]:
    """The sentences whose condition is true."""
    return [sentence for holds, sentence in notes if holds]


def few_stretches(count: int) -> tuple[bool, str]:
    """A warning where the logs hold few independent stretches."""
    return count < FEW_STRETCHES, (
        f"The residual is so correlated that the logs hold only {count} independent stretches: the "
        "intervals are wide and unreliable. Record more torque cycles."
    )


def beyond_fitted(torque: np.ndarray, fitted: np.ndarray, error: float) -> tuple[bool, str]:
    """What is said where test data lie at torques beyond those that were fitted.

    Args:
        torque: Of the test data [N m], (m,).
        fitted: Of the fitted data [N m], (n,).
        error: Of a torque [N m], rms; noisy torques scatter about the ends of the range.
    """
    margin = 2.0 * error
    beyond = (torque < np.min(fitted) - margin) | (torque > np.max(fitted) + margin)
    share = float(np.mean(beyond)) if len(beyond) else 0.0
    return share > 0.0, (
        f"{formatting.percent(share)} of the test data lie at torques beyond those that were fitted: there the "
        "equation extrapolates."
    )
