"""Fitted and derived quantities as a report lists them."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting import formatting
from fitting.close_loop import Finding
from fitting.compare import Account
from fitting.derived import Derived, derived, drive_figures
from fitting.report.outcome import Outcome
from fitting.uncertainty import Estimate, Uncertainty
from hdjax import Model, ReducedModel
from hdjax.effects import ActuatorEffect

_NEAR, _VANISHED = 0.01, 1e-6
_TOLD_CORRELATION = 0.1


def account_dict(
    account: Account, units: Mapping[str, str], x_max: float, *, start: Model | None = None
) -> dict[str, Any]:
    """A fitted model: parameters, what follows from them, and errors.

    Args:
        account: the model's.
        units: of `dynamic_error` and, in a reduced log, of `forcing`.
        x_max: the largest measured twist.
        start: the model that the fit started from, where that is known.
    """
    estimates, model = account.uncertainty.estimates, account.model
    figures = derived(account, lambda m: drive_figures(m, x_max))
    return {
        "effects": [],
        "parameters": {p: _estimate_dict(e, model, units, start) for p, e in estimates.items() if "." not in p},
        "derived": {name: _derived_dict(name, q) for name, q in figures.items()},
        "correlations": _correlations(account.uncertainty),
        "rmse": {"training": account.training_rmse, "validation": account.validation_rmse},
    }


def no_account() -> dict[str, Any]:
    """Likewise where no second model was fitted."""
    empty = {"effects": [], "parameters": {}, "derived": {}, "correlations": []}
    return empty | {"rmse": {"training": None, "validation": None}}


def _estimate_dict(
    estimate: Estimate, model: Model, units: Mapping[str, str], start: Model | None = None
) -> dict[str, Any]:
    info = model.parameters()[estimate.path][1]
    first = None if start is None else float(start.get(estimate.path))
    return {
        "value": estimate.value,
        "std": estimate.std,
        "ci95": list(estimate.ci95),
        "unit": _unit_in_log(estimate.unit, estimate.path, model, units),
        "identifiable": estimate.identifiable,
        "std_classical": estimate.std_classical,
        "description": info.doc,
        "percent": _percent(estimate.value, estimate.std),
        "start": first,
        "at_bound": at_bound(estimate.value, info.bounds, first),
        "note": None,
    }


def at_bound(value: float, bounds: tuple[float, float], start: float | None) -> bool:
    """Whether a fit ran into a limit: within 1 % of a bound, or of the start by a factor of a million towards zero."""
    low, high = bounds
    small = low == 0.0 and start is not None and value < _VANISHED * start
    near = any(math.isfinite(b) and b != 0.0 and abs(value - b) <= _NEAR * abs(b) for b in bounds)
    return bool(small or near or not low <= value <= high)


def _percent(value: float, std: float) -> float:
    return 100.0 * std / abs(value) if value else math.inf


def _correlations(uncertainty: Uncertainty) -> list[dict[str, Any]]:
    """Pairs of parameters whose errors go together, strongest first."""
    names, matrix = list(uncertainty.estimates), np.asarray(uncertainty.correlation)
    pairs = [(float(matrix[i, j]), names[j], names[i]) for i in range(len(names)) for j in range(i)]
    told = sorted((p for p in pairs if abs(p[0]) > _TOLD_CORRELATION), key=lambda p: -abs(p[0]))
    return [{"between": [one, other], "value": value} for value, one, other in told]


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
        "percent": _percent(quantity.value, quantity.std),
        "derived": True,
        "description": name.replace("_", " "),
    }
