"""Result of a design study, for programs (JSON) and for a terminal."""

import math
from typing import Any

import numpy as np

from fitting import formatting
from fitting.files import finite
from hdjax.design import Confirmation, Optimised, Optimum, Study
from hdjax.design.robustness import exact_worst_share

SCHEMA = "hdjax-design/1"


def design_dict(study: Study, found: Optimised, proof: Confirmation) -> dict[str, Any]:
    """The result as JSON content: finite numbers and nulls only."""
    parts = (*study.terms, *study.limits)
    return finite(
        {
            "schema": SCHEMA,
            "feasible": found.best.feasible,
            "confirmed": found.best.feasible and proof.confirmed(),
            "variables": {
                v.path: {"from": float(v.low), "to": float(v.high), "spacing": v.spacing} for v in study.variables
            },
            "units": {p.label: p.measure.unit for p in parts},
            "criterion": None if study.draws is None else {"name": study.criterion, "share": study.share},
            "draws": 0 if study.draws is None else len(study.draws.values),
            "best": _end_dict(study, found.best),
            "starts": [_end_dict(study, end) for end in found.ends],
            "sweep": {
                "designs": len(proof.objective),
                "feasible": int(proof.feasible.sum()),
                "best": proof.best,
                "best_objective": proof.best_objective,
                "gain": proof.gain,
            },
            "gradient_error": proof.gradient_error,
        }
    )


def _end_dict(study: Study, end: Optimum) -> dict[str, Any]:
    return {
        "outcome": end.outcome.name,
        "values": end.values,
        "objective": end.objective,
        "measures": {
            label: {"expected": float(d.mean()), "worst": _worst(study, label, d)} for label, d in end.draws.items()
        },
        "excess": end.excess,
        "at_bound": end.at_bound,
        "bound_multipliers": end.bound_multipliers,
        "multipliers": end.multipliers,
        "gradient": end.gradient,
        "asked": end.asked,
    }


def _worst(study: Study, label: str, draws: np.ndarray) -> float:
    """The mean of a measure's worst share: its largest values, or its smallest where it has a lower bound or is
    maximised."""
    least = {limit.label: limit.least for limit in study.limits}
    made_large = {term.label: float(term.weight) < 0.0 for term in study.terms}
    if least.get(label, made_large.get(label, False)):
        return -exact_worst_share(-draws, study.share)
    return exact_worst_share(draws, study.share)


def design_text(study: Study, found: Optimised, proof: Confirmation) -> str:
    """The result as text for a terminal."""
    best, known = found.best, study.case.parameters()
    lines = ["Best design" if best.feasible else "No design meets all limits; the one with the smallest violation"]
    for path, value in best.values.items():
        unit = known[path][1].unit if path in known else "1"
        held = ""
        if path in best.at_bound:
            price = best.bound_multipliers[path]
            held = f"  at its {best.at_bound[path]} bound, worth {price:.4g} of the objective per unit"
        lines.append(f"  {path} = {_quantity(value, unit)}{held}")
    lines.append(f"Objective {best.objective:.6g}{_criterion(study)}")
    for part in (*study.terms, *study.limits):
        if part.label in best.draws:
            lines.append("  " + _measure_line(study, part, best))
    lines.append(_starts_line(found))
    lines += _verdict(best, proof)
    if study.draws is not None:
        both = sorted(set(study.draws.paths) & set(best.values))
        if both:
            lines.append(
                f"{', '.join(both)}: both uncertain and a design variable; the chosen value is used in every draw."
            )
    return "\n".join(lines)


def _criterion(study: Study) -> str:
    if study.draws is None:
        return ""
    told = "expected value" if study.criterion == "expected" else f"mean of the worst {100 * study.share:g} %"
    return f" ({told} of {len(study.draws.values)} draws)"


def _measure_line(study: Study, part: Any, best: Optimum) -> str:
    draws, unit = best.draws[part.label], part.measure.unit
    line = f"{part.label}: {_quantity(float(draws.mean()), unit)}"
    if study.draws is not None:
        line += f" expected, {_quantity(_worst(study, part.label, draws), unit)} in the worst {100 * study.share:g} %"
    if part.label in best.excess:
        side = "at least" if part.least else "at most"
        line += f"; must be {side} {_quantity(float(part.bound), unit)}"
        if part.label in best.multipliers:
            line += f", an active limit, worth {best.multipliers[part.label]:.4g} of the objective per unit"
        if best.excess[part.label] > 1e-6:
            line += f", MISSED by {100 * best.excess[part.label]:.3g} %"
    return line


def _starts_line(found: Optimised) -> str:
    best = found.best.objective
    same = sum(abs(e.objective - best) <= 1e-4 * (abs(best) or 1.0) and e.feasible for e in found.ends)
    names = [e.outcome.name for e in found.ends]
    told = ", ".join(f"{names.count(n)} {n}" for n in dict.fromkeys(names))
    return f"{len(found.ends)} starts: {told}; {same} reached this objective."


def _verdict(best: Optimum, proof: Confirmation) -> list[str]:
    if not best.feasible:
        return [f"Of {proof.objective.size} designs around it {int(proof.feasible.sum())} meet all limits."]
    agrees = f"gradients differ from difference quotients by {proof.gradient_error:.1e}, relative"
    if not math.isfinite(proof.best_objective):
        return [f"No design of the sweep around it meets all limits; {agrees}."]
    if proof.confirmed():
        return [f"Confirmed: none of {proof.objective.size} designs around it is better; {agrees}."]
    better = ", ".join(f"{p} = {v:.6g}" for p, v in proof.best.items())
    told = f"NOT confirmed: {agrees}"
    return [told + (f"; a design of the sweep is better by {proof.gain:.1e}: {better}." if proof.gain > 1e-4 else ".")]


def _quantity(value: float, unit: str) -> str:
    return f"{value:.5g}" if unit == "1" else f"{value:.5g} {formatting.pretty_unit(unit)}"
