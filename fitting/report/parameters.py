"""Fitted and derived quantities in a report."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting.outcome import Finding
from fitting.report.limits import NOT_TOLD_FROM_ZERO, in_words_of_log, parameter_note
from fitting.report.outcome import Outcome
from fitting.uncertainty.identifiability import unit_in_log
from fitting.uncertainty.standard_errors import Estimate, Uncertainty
from fitting.validation.account import Account
from fitting.validation.derived_quantities import Derived, derived, drive_figures, effect_figures
from hdjax import Drive, Model, ReducedModel

_TOLD_CORRELATION = 0.1


PARTS = ("training", "selection", "test")
"""Parts of the data: training, selection and test data."""

_NO_PARTS: dict[str, float | None] = dict.fromkeys(PARTS)


def parts_of(report: Mapping[str, Any]) -> tuple[str, ...]:
    """The parts of the data in a report."""
    return tuple(part for part in PARTS if any(log[part] for log in report["logs"]))


def account_dict(
    account: Account, units: Mapping[str, str], x_max: float, *, start: Model | None = None
) -> dict[str, Any]:
    """A fitted model: parameters, derived quantities and errors.

    Args:
        account: of the model.
        units: of `dynamic_error` and, in a reduced log, of `forcing`.
        x_max: the largest measured twist.
        start: the starting model, if known.
    """
    figures, by_output = derived(account.model, account.uncertainty, drive_figures, x_max), account.rmse_of_outputs
    base = [path for path in account.uncertainty.estimates if "." not in path]
    return {
        "effects": [],
        "parameters": {path: _estimate_dict(path, account, units, start) for path in base},
        "derived": {name: _derived_dict(name, q) for name, q in figures.items()},
        "correlations": _correlations(account.uncertainty),
        "rmse": _NO_PARTS | account.rmse,
        "rmse_motor_angle": _NO_PARTS | by_output.get("motor_angle", {}),
        "rmse_of_outputs": {output: _NO_PARTS | parts for output, parts in by_output.items()},
    }


def no_account() -> dict[str, Any]:
    """The same where no second model was fitted."""
    empty = {"effects": [], "parameters": {}, "derived": {}, "correlations": []}
    return empty | {"rmse": dict(_NO_PARTS), "rmse_motor_angle": dict(_NO_PARTS), "rmse_of_outputs": {}}


def _estimate_dict(path: str, account: Account, units: Mapping[str, str], start: Model | None = None) -> dict[str, Any]:
    estimate = account.uncertainty.estimates[path]
    info = account.model.parameters()[path][1]
    known = None if isinstance(account.model, ReducedModel) else info
    note = parameter_note(estimate, account.identifiability, known)
    return {
        "value": estimate.value,
        "std": estimate.std,
        "ci95": list(estimate.ci95),
        "interval": estimate.interval,
        "unit": _unit_in_log(estimate.unit, path, account.model, units),
        "identifiable": estimate.identifiable,
        "flag": _flag(path, estimate, path in account.identifiability.bounds),
        "std_classical": estimate.std_classical,
        "description": info.doc,
        "percent": _percent(estimate.value, estimate.std),
        "start": None if start is None else float(start.get(path)),
        "at_bound": path in account.identifiability.bounds,
        "prior": _prior_dict(path, account.model),
        "note": None if note is None else in_words_of_log(note, units),
    }


def _prior_dict(path: str, model: Model) -> dict[str, float | None] | None:
    """The prior of a fitted parameter, its relative standard deviation None for "fit"; None without a prior."""
    known = model.drive.priors if isinstance(model.drive, Drive) else ()
    found = next((prior for prior in known if prior.path == path), None)
    if found is None:
        return None
    free = math.isinf(found.tolerance)
    return {"value": None if free else found.value, "tolerance": None if free else found.tolerance}


def _flag(path: str, estimate: Estimate, at_bound: bool) -> str | None:
    """A flag beside a parameter in two or three words; None where none is needed."""
    if at_bound:
        return "at bound"
    if estimate.identifiable:
        return None
    low, high = estimate.ci95
    # A strength may be accurately determined and still be insignificant.
    return NOT_TOLD_FROM_ZERO if "." in path and low <= 0.0 <= high else "not identifiable"


def _percent(value: float, std: float) -> float:
    return 100.0 * std / abs(value) if value else math.inf


def _correlations(uncertainty: Uncertainty) -> list[dict[str, Any]]:
    """Pairs of correlated parameters, strongest first."""
    names, matrix = list(uncertainty.estimates), np.asarray(uncertainty.correlation)
    pairs = [(float(matrix[i, j]), names[j], names[i]) for i in range(len(names)) for j in range(i)]
    told = sorted((p for p in pairs if abs(p[0]) > _TOLD_CORRELATION), key=lambda p: -abs(p[0]))
    return [{"between": [one, other], "value": value} for value, one, other in told]


def _unit_in_log(unit: str, path: str, model: Model, units: Mapping[str, str]) -> str:
    return unit_in_log(path, unit, model, response=units["dynamic_error"], forcing=units["forcing"])


def effect_dict(finding: Finding, outcome: Outcome, units: Mapping[str, str]) -> dict[str, Any]:
    """An accepted effect with its fitted and derived quantities."""
    entry: dict[str, Any] = {
        "family": finding.family,
        "name": finding.name,
        "parameters": {},
        "gain": finding.gain,
        "p_value": finding.p_value,
    }
    if finding.effect is None:
        return entry | {"equation": f"Between samples the torque follows a {outcome.hold} hold."}
    account = outcome.after
    prefix = f"{finding.name}."
    entry["equation"] = (type(finding.effect).__doc__ or finding.name).splitlines()[0]
    entry["parameters"] = {
        path: _estimate_dict(path, account, units) for path in account.uncertainty.estimates if path.startswith(prefix)
    }
    for name, quantity in derived(account.model, account.uncertainty, effect_figures, finding.name).items():
        unit = _unit_in_log(quantity.unit, prefix + name, account.model, units)
        entry["parameters"][prefix + name] = _derived_dict(name, quantity) | {"unit": unit}
    return entry


def _derived_dict(name: str, quantity: Derived) -> dict[str, Any]:
    low, high = quantity.ci95
    # An angle may be zero; it is identifiable if determined to a quarter turn.
    is_phase = name.startswith("ph")
    known = high - low < math.pi if is_phase else not low <= 0.0 <= high
    doubt = "not identifiable" if is_phase else NOT_TOLD_FROM_ZERO
    return {
        "value": quantity.value,
        "std": quantity.std,
        "ci95": [low, high],
        "unit": quantity.unit,
        "identifiable": bool(known),
        "flag": None if known else doubt,
        "percent": _percent(quantity.value, quantity.std),
        "derived": True,
        "description": name.replace("_", " "),
    }
