"""Learned terms in a report, where the catalogue does not explain the discrepancy."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting import formatting
from fitting.discrepancy.closed_forms import Shape, shapes
from fitting.discrepancy.curve import PLACES, WORDS, LearnedCurve, learned_curve, period_of
from fitting.discrepancy.dynamic_laws import MemoryCandidate
from fitting.discrepancy.dynamic_stiffness import LearnedResponse, learned_response
from fitting.discrepancy.learn import Unknown
from fitting.estimation.free_parameters import effect_paths
from fitting.first_order.motion import place_of
from fitting.outcome import Loop
from fitting.report.outcome import Outcome
from fitting.report.separating import plain_family
from hdjax import ReducedModel
from hdjax.effects.learned import Learned
from hdjax.effects.learned_axes import UNITS
from hdjax.effects.learned_memory import Lagging, LaggingShaftTorque, LearnedMemory, Yielding

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
_MEMORIES = {"lags": "lags behind", "yields": "yields to"}
_TOLD = 6
# Damping ratio above which a lag does not oscillate.
_CREEPS = 0.5


def curve_of(loop: Loop) -> LearnedCurve | LearnedResponse | None:
    """The learned function of a loop with its final values, or the response of a lagging torque; None without either.
    (Hysteresis is plotted like an effect.)"""
    if loop.unknown is None:
        return None
    effect = loop.after.model.effect(loop.unknown.chosen.form.name)
    if isinstance(effect, Lagging):
        return learned_response(effect.name, loop.after.model, loop.after.uncertainty)
    if isinstance(effect, LearnedMemory):
        return None
    return learned_curve(loop.unknown, loop.after.model, loop.after.uncertainty)


def unknown_dict(outcome: Outcome, units: Mapping[str, str]) -> dict[str, Any] | None:
    """A learned term: variables, gain and resemblance; None without one."""
    if not isinstance(outcome, Loop) or outcome.unknown is None:
        return None
    finding = next(f for f in outcome.findings if f.name == outcome.unknown.chosen.form.name)
    others = [c for c in outcome.unknown.candidates if len(c.variables) == 1][:_TOLD]
    effect = outcome.after.model.effect(finding.name)
    told = _of_memory(effect, outcome) if isinstance(effect, LearnedMemory) else _of_function(outcome)
    wanted = {told["quantity"]: _QUANTITIES[told["quantity"]]} | {n: UNITS[n] for n in told["variables"]}
    return {
        "family": finding.family,
        "name": finding.name,
        **told,
        "units": {name: unit_in_log(unit, outcome, units) for name, unit in wanted.items()},
        "gain": finding.gain,
        "p_value": finding.p_value,
        "rmse": {
            "before": outcome.after.rmse["selection"] / (1.0 - finding.gain) if finding.gain < 1.0 else None,
            "after": outcome.after.rmse["selection"],
        },
        "doubted": list(outcome.doubted),
        "looked_at": [{"place": c.form.name, "variable": c.variables[0], "gain": c.gain} for c in others],
    }


def _of_function(loop: Loop) -> dict[str, Any]:
    """Content on a function of the present motion."""
    curve = curve_of(loop)
    assert isinstance(curve, LearnedCurve) and loop.unknown is not None
    effect = loop.after.model.effect(loop.unknown.chosen.form.name)
    assert isinstance(effect, Learned)
    found = shapes(curve)
    return {
        "place": curve.place,
        "variables": list(curve.variables),
        "period": curve.period,
        "memory": None,
        "quantity": curve.quantity,
        "says": _sentence(curve, found.closest, loop.doubted, in_step=not any(loop.put_back)),
        "coefficients": len(effect.c),
        "shapes": [_shape_dict(s) for s in found.closest],
        "symbolic": None if found.symbolic is None else _shape_dict(found.symbolic),
    }


def _of_memory(effect: LearnedMemory, loop: Loop) -> dict[str, Any]:
    """Content on a torque with memory."""
    place, memory = _place(effect), _memory(effect)
    where = place_and_variables(place, [effect.angle], None, memory)
    said = [f"A learned {where}, represents what is missing. It depends on the past: it has memory."]
    family = _remembers(effect, place)
    if isinstance(effect, Lagging):
        hertz = formatting.quantity(float(effect.omega) / (2 * np.pi), "Hz", digits=3)
        said.append(f"The lag has a natural frequency of {hertz} and a damping ratio of {effect.zeta:.2g}.")
    said.append(f"Of the catalogue, {plain_family(family)} resembles it.")
    said += _doubted(loop.doubted)
    return {
        "place": place,
        "variables": [effect.angle],
        "period": None,
        "memory": memory,
        "quantity": "torque",
        "says": " ".join(said),
        "coefficients": len(effect_paths(effect)),
        "shapes": [],
        "symbolic": {"expression": _formula(effect), "r_squared": 1.0, "families": [family]},
    }


def _remembers(effect: LearnedMemory, place: str) -> str:
    """The family of the catalogue that resembles a torque with memory."""
    if isinstance(effect, Lagging):
        return "creep" if place == "mesh" and effect.zeta >= _CREEPS else "extra_resonance"
    return {"mesh": "hysteresis", "motor": "motor_friction", "load": "load_friction"}[place]


def _formula(effect: LearnedMemory) -> str:
    """Formula of a torque with memory as a function of its angle."""
    u = effect.angle
    if isinstance(effect, Lagging):
        spring, damper = float(effect.omega) ** 2, 2 * float(effect.zeta) * float(effect.omega)
        beside, inertia = "", ""
        if isinstance(effect, LaggingShaftTorque):
            beside = f" {effect.drag:+.4g} {u}'"
            inertia = f", and {effect.share:.3g} of the shaft's inertia is not coupled to it"
        return (
            f"{effect.k:.4g} ({u} - y) {effect.b:+.4g} ({u}' - y'){beside} where y'' = {spring:.4g} ({u} - y) "
            f"{damper:+.4g} ({u}' - y'){inertia}"
        )
    assert isinstance(effect, Yielding)
    bow = float(effect.bow)
    return (
        f"{effect.k:.4g} z where z' = {u}' (1 {bow - 1.0:+.3g} s {-bow:+.3g} s^2) on the way out, "
        f"{u}' (1 {effect.back:+.3g} s {effect.back_bow:+.3g} s^2) on the way back, s = |z| / {effect.reach:.4g}"
    )


def unit_in_log(unit: str, loop: Loop, units: Mapping[str, str]) -> str:
    """A unit of the learned function or its variables; for a reduced drive from the log."""
    if not isinstance(loop.after.model, ReducedModel):
        return unit
    return formatting.in_log_units(unit, response=units["dynamic_error"], forcing=units["forcing"])


def learned_in_words(unknown: Unknown) -> str:
    """Place and variables of a learned term."""
    effect = unknown.trial.model.effect(unknown.chosen.form.name)
    if isinstance(effect, LearnedMemory):
        return place_and_variables(_place(effect), [effect.angle], None, _memory(effect))
    assert not isinstance(unknown.chosen, MemoryCandidate)
    assert isinstance(effect, Learned)
    return place_and_variables(PLACES[effect.name], list(unknown.chosen.variables), period_of(effect), None)


def _place(effect: LearnedMemory) -> str:
    form = place_of(effect)
    assert form is not None
    return PLACES[form.name]


def _memory(effect: LearnedMemory) -> str:
    return "lags" if isinstance(effect, Lagging) else "yields"


def place_and_variables(place: str, variables: list[str], period: float | None, memory: str | None) -> str:
    """Place and variables of a learned term, in words."""
    if memory is not None:
        return f"{WORDS[place]}, which {_MEMORIES[memory]} the {_WORDS[variables[0]]}"
    if period is not None:
        return f"{WORDS[place]}, which repeats {formatting.number(1.0 / period)} times a second"
    return f"{WORDS[place]}, a function of the {' and the '.join(_WORDS[v] for v in variables)}"


def _shape_dict(shape: Shape) -> dict[str, Any]:
    return {"expression": shape.expression, "r_squared": shape.explained, "families": list(shape.families)}


def _sentence(curve: LearnedCurve, closest: tuple[Shape, ...], doubted: tuple[str, ...], *, in_step: bool) -> str:
    """A sentence on a learned function and its resemblance; `in_step`: equal phase at the start of all logs."""
    where = place_and_variables(curve.place, list(curve.variables), curve.period, None)
    said = [f"A learned {where}, represents what is missing."]
    if curve.period is not None:
        phase = "with the same phase at the start of every log" if in_step else "begins each log in another phase"
        said.append(f"It is periodic in time, independently of the drive, and {phase}.")
    if closest:
        best = closest[0]
        like = " and ".join(plain_family(f) for f in best.families)
        named = f", as of {like}," if like else ""
        said.append(
            f"Of the simple forms `{best.expression}`{named} is closest: it explains "
            f"{formatting.percent(best.explained)} of its mean square over the data."
        )
    return " ".join([*said, *_doubted(doubted)])


def _doubted(names: tuple[str, ...]) -> list[str]:
    """A sentence on names that the learned function contradicts."""
    if not names:
        return []
    return [
        f"{formatting.words(list(names))} explained a part, but the learned function explains more and differs from "
        "it: the name would be wrong."
    ]
