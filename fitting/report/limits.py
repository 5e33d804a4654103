"""What the data can't tell, a sentence each."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fitting import formatting
from fitting.normal_law import NORMAL_95
from fitting.report.outcome import Outcome
from fitting.report.separating import plain_family

# Beyond it two parameters are told as one combination.
_CORRELATED = 0.9
_MOST_CORRELATIONS = 8
_DAMPING = ("B_sp", "mu")


def parameter_note(path: str, estimate: Mapping[str, Any], x_max: float, x_unit: str) -> str | None:
    """What must be said beside a parameter of the drive; None where its number speaks for itself.

    Args:
        path: the parameter's.
        estimate: its entry of the report.
        x_max: the largest measured twist.
        x_unit: the twist's unit.
    """
    if estimate["at_bound"]:
        return f"{path} ran into a limit of the fit: the logs don't hold it back, and its standard error means nothing."
    if not estimate["identifiable"]:
        return _unidentifiable(path, estimate, x_max, x_unit)
    value = estimate["value"]
    if path in _DAMPING and value is not None and value < 0:
        return f"{path} is negative: such a drive would feed energy; look for a delay or a wrong hold of the torque."
    return None


def limits(report: Mapping[str, Any]) -> list[str]:
    """What these data can't tell, a sentence each."""
    final = report["after"] if report["after"]["parameters"] else report["before"]
    notes = [e["note"] for e in final["parameters"].values() if e["note"]]
    for effect in report["after"]["effects"]:
        notes += _unidentifiable_parts(effect)
    for other in report["alternatives"]:
        if not other["separable"]:
            notes.append(
                f"A tie: {other['name']} ({plain_family(other['family'])}) explains the held-out data about as well "
                f"as {other['instead_of']}. {other['separating_experiment']}"
            )
    return notes + _correlated(final["correlations"])


def _unidentifiable(path: str, estimate: Mapping[str, Any], largest: float, x_unit: str) -> str:
    value, std, unit = estimate["value"], estimate["std"], estimate["unit"]
    if value is None or std is None:
        return f"{path} is not identifiable from these logs."
    limit = formatting.quantity(NORMAL_95 * std, unit, digits=2)
    if path == "alpha":
        return (
            f"alpha is not identifiable from these logs: the largest measured twist, "
            f"{formatting.quantity(largest, x_unit)}, gives alpha x² = {formatting.number(value * largest**2, 2)}. "
            f"alpha could be told from zero only above {limit}, where alpha x² is "
            f"{formatting.number(NORMAL_95 * std * largest**2, 2)}."
        )
    low, high = estimate["ci95"]
    if low is not None and low > 0:
        factor = math.sqrt(high / low) if high is not None else math.inf
        known = f"only to within a factor of {formatting.number(factor, 2)}" if factor < 1e3 else "not at all"
        return f"{path} is not identifiable from these logs: they determine it {known}."
    return f"{path} is not identifiable from these logs: it could be told from zero only above {limit}."


def _unidentifiable_parts(effect: Mapping[str, Any]) -> list[str]:
    """One sentence about all fitted parameters of an effect that the data do not determine."""
    vague = {
        path.split(".")[1]: e
        for path, e in effect["parameters"].items()
        if not e["identifiable"] and not e.get("derived")
    }
    if not vague:
        return []
    limits = [
        f"{symbol} (±{formatting.quantity(NORMAL_95 * e['std'], e['unit'], digits=2)})" if e["std"] else symbol
        for symbol, e in vague.items()
    ]
    verb = "is" if len(limits) == 1 else "are"
    return [
        f"Of {effect['name']}, {formatting.words(limits)} {verb} not identifiable from these logs; "
        "in brackets how far from the value the truth may be."
    ]


def _correlated(correlations: Sequence[Mapping[str, Any]]) -> list[str]:
    strong = [c for c in correlations if abs(c["value"] or 0.0) > _CORRELATED]
    notes = [
        f"{c['between'][0]} and {c['between'][1]} are correlated by {formatting.number(c['value'], 3)}: the data "
        "determine a combination of the two better than each."
        for c in strong[:_MOST_CORRELATIONS]
    ]
    if len(strong) > _MOST_CORRELATIONS:
        notes.append(f"{len(strong) - _MOST_CORRELATIONS} more pairs are correlated above {_CORRELATED}.")
    return notes


def largest_twist(outcome: Outcome) -> float:
    """The largest dynamic error on training data."""
    return max(float(np.max(np.abs(run.measured))) for run in outcome.before.training)
