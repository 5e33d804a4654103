"""The learned function, where the catalogue does not explain what is missing."""

from collections.abc import Mapping
from typing import Any

from fitting import formatting
from fitting.close_loop import Loop
from fitting.learned_curve import WORDS, LearnedCurve, learned_curve
from fitting.report.outcome import Outcome
from fitting.report.separating import plain_family
from fitting.shapes import Shape, shapes
from hdjax import ReducedModel
from hdjax.effects.learned_axes import UNITS

_WORDS = {
    "x": "twist",
    "v": "twist rate",
    "theta_m": "motor angle",
    "omega_m": "motor speed",
    "theta_l": "load angle",
    "omega_l": "load speed",
    "T_m": "motor torque",
    "time": "time",
    "temperature": "temperature",
}
_QUANTITIES = {"torque": "N m", "error": "rad"}
_TOLD = 6


def curve_of(loop: Loop) -> LearnedCurve | None:
    """The learned function of a loop with its final values; None where there is none."""
    if loop.unknown is None:
        return None
    return learned_curve(loop.unknown, loop.after.model, loop.after.uncertainty)


def unknown_dict(outcome: Outcome, units: Mapping[str, str]) -> dict[str, Any] | None:
    """The learned function: what it depends on, what it is worth, and what it looks like; None where there is none."""
    if not isinstance(outcome, Loop) or outcome.unknown is None:
        return None
    curve = curve_of(outcome)
    assert curve is not None
    finding = next(f for f in outcome.findings if f.name == outcome.unknown.chosen.form.name)
    found = shapes(curve)
    unit = unit_in_log(_QUANTITIES[curve.quantity], outcome, units)
    others = [c for c in outcome.unknown.candidates if len(c.variables) == 1][:_TOLD]
    return {
        "family": finding.family,
        "name": finding.name,
        "place": curve.place,
        "variables": list(curve.variables),
        "period": curve.period,
        "quantity": curve.quantity,
        "units": {curve.quantity: unit} | {n: unit_in_log(UNITS[n], outcome, units) for n in curve.variables},
        "says": _sentence(curve, found.closest, outcome.doubted, in_step=not any(outcome.put_back)),
        "coefficients": len(outcome.unknown.chosen.effect.c),
        "validation_gain": finding.validation_gain,
        "p_value": finding.p_value,
        "rmse": {
            "before": outcome.after.validation_rmse / max(1.0 - finding.validation_gain, 1e-12),
            "after": outcome.after.validation_rmse,
        },
        "shapes": [_shape_dict(s) for s in found.closest],
        "symbolic": None if found.symbolic is None else _shape_dict(found.symbolic),
        "doubted": list(outcome.doubted),
        "looked_at": [{"place": c.form.name, "variable": c.variables[0], "gain": c.gain} for c in others],
    }


def unit_in_log(unit: str, loop: Loop, units: Mapping[str, str]) -> str:
    """A unit of the learned function or of what it depends on; a reduced drive's come from the log."""
    if not isinstance(loop.after.model, ReducedModel):
        return unit
    return formatting.in_log_units(unit, response=units["dynamic_error"], forcing=units["forcing"])


def place_and_variables(place: str, variables: list[str], period: float | None) -> str:
    """Where a learned function acts and what it depends on, in words."""
    if period is not None:
        return f"{WORDS[place]}, which comes back {formatting.number(1.0 / period)} times a second"
    return f"{WORDS[place]}, a function of the {' and the '.join(_WORDS[v] for v in variables)}"


def _shape_dict(shape: Shape) -> dict[str, Any]:
    return {"expression": shape.expression, "r_squared": shape.explained, "families": list(shape.families)}


def _sentence(curve: LearnedCurve, closest: tuple[Shape, ...], doubted: tuple[str, ...], *, in_step: bool) -> str:
    """What was learned, and what it resembles; `in_step` with the logs as they begin."""
    where = place_and_variables(curve.place, list(curve.variables), curve.period)
    said = [f"A learned {where}, stands for what is missing."]
    if curve.period is not None:
        phase = "with the same phase at the start of every log" if in_step else "begins each log in another phase"
        said.append(f"It comes back whatever the drive does, and {phase}.")
    if closest:
        best = closest[0]
        like = " and ".join(plain_family(f) for f in best.families)
        named = f", as of {like}," if like else ""
        said.append(
            f"Of the simple forms `{best.expression}`{named} is closest: it accounts for "
            f"{formatting.percent(best.explained)} of its mean square over the data."
        )
    if doubted:
        said.append(
            f"{formatting.words(list(doubted))} explained a part, but what was learned explains more and does not "
            "look like it: the name would be wrong."
        )
    return " ".join(said)
