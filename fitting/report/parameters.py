"""Fitted and derived quantities as a report lists them."""

import math
from collections.abc import Mapping
from typing import Any

from fitting import formatting
from fitting.close_loop import Finding
from fitting.compare import Account
from fitting.derived import Derived, derived, drive_figures
from fitting.report.outcome import Outcome
from fitting.uncertainty import Estimate
from hdjax import Model, ReducedModel
from hdjax.effects import ActuatorEffect


def account_dict(account: Account, units: Mapping[str, str], x_max: float) -> dict[str, Any]:
    """A fitted model: parameters, what follows from them, and errors.

    Args:
        account: the model's.
        units: of `dynamic_error` and, in a reduced log, of `forcing`.
        x_max: the largest measured twist.
    """
    figures = derived(account, lambda m: drive_figures(m, x_max))
    drive_paths = [p for p in account.uncertainty.estimates if "." not in p]
    return {
        "effects": [],
        "parameters": {p: _estimate_dict(account.uncertainty.estimates[p], account.model, units) for p in drive_paths},
        "derived": {name: _derived_dict(name, q) for name, q in figures.items()},
        "rmse": {"training": account.training_rmse, "validation": account.validation_rmse},
    }


def no_account() -> dict[str, Any]:
    return {"effects": [], "parameters": {}, "derived": {}, "rmse": {"training": None, "validation": None}}


def _estimate_dict(estimate: Estimate, model: Model, units: Mapping[str, str]) -> dict[str, Any]:
    return {
        "value": estimate.value,
        "std": estimate.std,
        "ci95": list(estimate.ci95),
        "unit": _unit_in_log(estimate.unit, estimate.path, model, units),
        "identifiable": estimate.identifiable,
        "std_classical": estimate.std_classical,
        "description": model.parameters()[estimate.path][1].doc,
    }


def _unit_in_log(unit: str, path: str, model: Model, units: Mapping[str, str]) -> str:
    """The unit of what stands at a path; a reduced drive's come from the log."""
    if not isinstance(model, ReducedModel):
        return unit
    place: formatting.Place = "drive"
    if "." in path:
        effect = model.effect(path.split(".")[0])
        place = "actuator" if isinstance(effect, ActuatorEffect) else "mesh"
    return formatting.in_log_units(unit, response=units["dynamic_error"], forcing=units["forcing"], place=place)


def effect_dict(finding: Finding, outcome: Outcome, units: Mapping[str, str]) -> dict[str, Any]:
    """An accepted effect with its fitted and derived quantities."""
    entry: dict[str, Any] = {
        "family": finding.family,
        "name": finding.name,
        "parameters": {},
        "validation_gain": finding.validation_gain,
        "p_value": finding.p_value,
    }
    if finding.effect is None:
        return entry | {"equation": f"Between samples the torque follows a {outcome.hold} hold."}
    account = outcome.after
    prefix = f"{finding.name}."
    entry["equation"] = (type(finding.effect).__doc__ or finding.name).splitlines()[0]
    entry["parameters"] = {
        path: _estimate_dict(estimate, account.model, units)
        for path, estimate in account.uncertainty.estimates.items()
        if path.startswith(prefix)
    }
    for name, quantity in derived(account, lambda m: m.effect(finding.name).derived(m.drive)).items():
        unit = _unit_in_log(quantity.unit, prefix + name, account.model, units)
        entry["parameters"][prefix + name] = _derived_dict(name, quantity) | {"unit": unit}
    return entry


def _derived_dict(name: str, quantity: Derived) -> dict[str, Any]:
    low, high = quantity.ci95
    # An angle may well be zero; it is known when it is known to a quarter turn.
    known = high - low < math.pi if name.startswith("ph") else not low <= 0.0 <= high
    return {
        "value": quantity.value,
        "std": quantity.std,
        "ci95": [low, high],
        "unit": quantity.unit,
        "identifiable": bool(known),
        "derived": True,
        "description": name.replace("_", " "),
    }
