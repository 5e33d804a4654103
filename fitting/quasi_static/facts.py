"""What every report of quasi-static logs says alike: the drive, its logs and their health, versions, figures."""

import dataclasses
import math
import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from fitting.quasi_static.intervals import Known
from fitting.quasi_static.preparation import QuasiStaticData

SCHEMA = "hdjax-report/1"
_LIBRARIES = ("hdjax", "numpy", "scipy")
ARCMIN = math.degrees(1.0) * 60.0
"""Minutes of arc in a radian."""

FEW_STRETCHES = 10
"""Independent stretches below which intervals rest on little."""

ABOUT_SCALE = (
    "If the joint torque was not measured but computed, from gravity or a current, its errors of scale go into every "
    "stiffness in proportion."
)


def rmse_dict(training: float | None, selection: float | None) -> dict[str, float | None]:
    """Rms errors by part of the data. Folds of whole stretches select the model; there are no test data yet.

    Args:
        training: On what was fitted [rad].
        selection: On the folds that were left out [rad]; schema 1 called them validation.
    """
    return {"training": training, "selection": selection, "test": None, "validation": selection}


def heading(data: QuasiStaticData) -> dict[str, Any]:
    """What a report begins with."""
    return {
        "schema": SCHEMA,
        "version": version("hdjax"),
        "name": data.drive_file.name,
        "kind": "quasi-static",
        "decision": "fit_only",
        "summary": "",
        "units": {"dynamic_error": "rad", "joint_torque": "N m"},
    }


def ending(data: QuasiStaticData) -> dict[str, Any]:
    """What a report ends with."""
    return {
        "health": [
            {"log": name} | dataclasses.asdict(finding) for name, found in data.findings.items() for finding in found
        ],
        "versions": {"python": platform.python_version()} | {library: version(library) for library in _LIBRARIES},
    }


def log_dict(data: QuasiStaticData, i: int, rows: int, reversals: int) -> dict[str, Any]:
    """One log; each of its rows is held out once."""
    log = data.logs[i]
    return {
        "name": log.name,
        "samples": len(log),
        "held_out": len(log),
        "seconds": float(log.time[-1] - log.time[0]),
        "rows_per_block": rows,
        "reversals": reversals,
        "motion": data.motion[i],
    }


def estimate(known: Known) -> dict[str, Any]:
    """A figure."""
    return dataclasses.asdict(known) | {"ci95": list(known.ci95 or (None, None))}


def estimates(known: Mapping[str, Known]) -> dict[str, Any]:
    """Figures, by name."""
    return {name: estimate(one) for name, one in known.items()}


def few_stretches(count: int) -> list[str]:
    """What is said where the logs hold few independent stretches."""
    if count >= FEW_STRETCHES:
        return []
    return [
        f"What the curve leaves over is so correlated that the logs hold only {count} independent stretches: the "
        "intervals are wide, and rest on little. Record more torque cycles."
    ]
