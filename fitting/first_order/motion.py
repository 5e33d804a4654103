"""Inputs of effects along a fitted motion, and the influence of a unit of each quantity that effects add."""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fitting.estimation.experiment import Stretch
from fitting.estimation.linear_response import NODES, WEIGHTS, Followed, acting, inputs_at, polynomial
from fitting.estimation.machine_code import actuated
from fitting.estimation.segments import Segments
from hdjax import Model, TwoInertiaModel
from hdjax.dynamics import JOINT_TORQUE, Inputs
from hdjax.effects import (
    ActuatorEffect,
    Conditions,
    Effect,
    LoadSideEffect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
    Scales,
)
from hdjax.effects.learned import LEARNED_TORQUES, LearnedReading, LearnedTorque
from hdjax.engine.pointwise import at_instants, slopes_at_instants
from hdjax.parameters import Scalar, parameter

PART = 0.5 * (NODES + 1.0)
"""The nodes as fractions of an interval."""

INPUT, ERROR, SLOPE = "input", "error", "slope"
"""Quantities that effects add, other than torques at the places of [`hdjax.effects.learned`][]."""


class Along(eqx.Module):
    """Inputs of effects along a motion.

    Attributes:
        model: whose motion it is.
        followed: its states.
        segments: the data that it belongs to.
        at_knots: the motion at each knot.
        between: the motion at the nodes of each interval.
        carried: change of the state at the interval's end by a unit of each quantity that effects add, see
            [`unit_pushes`][].
        firsts: first segment of each stretch.
        ends: segment and knot where each stretch ends.
    """

    model: Model
    followed: Followed
    segments: Segments
    at_knots: Motion
    between: Motion
    carried: dict[str, Float[np.ndarray, "segments samples states nodes"]]
    firsts: Int[np.ndarray, " stretches"]
    ends: Int[np.ndarray, "stretches 2"]


def along(model: Model, followed: Followed, segments: Segments, stretches: Sequence[Stretch]) -> Along:
    """Inputs of effects along a model's motion.

    Args:
        model: at the solution.
        followed: its states.
        segments: the data that it belongs to.
        stretches: that were cut into them.
    """
    length, samples = segments.weight.shape[1], np.array([len(s) for s in stretches])
    pieces = -(-samples // length)
    firsts = np.cumsum(pieces) - pieces
    ends = np.stack([firsts + pieces - 1, samples - (pieces - 1) * length], axis=1)
    conditions = inputs_at(model, segments, PART * segments.width[..., None]).conditions
    at_knots = motions(model, followed.states, conditions_at_knots(segments))
    between = motions(model, followed.between, conditions)
    lands = {n: carried(followed, push) for n, push in unit_pushes(model, followed.between, conditions).items()}
    return Along(model, followed, segments, at_knots, between, lands, firsts, ends)


def conditions_at_knots(segments: Segments) -> Conditions:
    """Time and temperature at each knot, the end of the last interval included."""
    time = segments.knots
    warmth = segments.temperature
    found = None if warmth is None else jnp.asarray(_at_knots(np.asarray(warmth.coefficients), np.diff(time)))
    return Conditions(jnp.asarray(time), found)


def acting_at_knots(model: Model, segments: Segments) -> Float[np.ndarray, "segments knots"]:
    """The torque after actuator effects, or the forcing, at each knot; at jumps the mean, so that linear interpolation
    is not delayed."""
    return _at_knots(acting(model, segments)[:, segments.halo :], segments.width)


def acting_slopes_at_knots(
    model: Model, paths: Sequence[str], segments: Segments
) -> Float[np.ndarray, "segments knots parameters"]:
    """Its derivatives by the parameters at some paths."""
    effects = tuple(e for e in model.effects if isinstance(e, ActuatorEffect))
    names = {e.name for e in effects}
    segment_count, samples = segments.weight.shape
    found = np.zeros((segment_count, samples + 1, len(paths)))
    own = [i for i, path in enumerate(paths) if path.partition(".")[0] in names]
    if own:
        values = jnp.asarray(np.array([float(model.get(paths[i])) for i in own]))
        _, slopes = actuated(effects, tuple(paths[i] for i in own), values, segments.torque)
        for i, slope in zip(own, slopes, strict=True):
            found[..., i] = _at_knots(np.asarray(slope)[:, segments.halo :], segments.width)
    return found


def motions(model: Model, states: Float[Array | np.ndarray, "*many states"], conditions: Conditions) -> Motion:
    """The motion of each of many states."""
    return at_instants(_motion, (model, 0), (states, states.ndim - 1), (conditions, states.ndim - 1))


def _motion(model: Model, state: Array, conditions: Conditions) -> Motion:
    return model.motion(state, conditions)


class _UnitGeometry(MeshGeometryEffect):
    """An error of the mesh and its slope as independent quantities."""

    family: ClassVar[str] = "kinematic_error"
    name: ClassVar[str] = "unit_geometry"

    e: Scalar = parameter(0.0, unit="rad", doc="the error", role="strength")
    e_slope: Scalar = parameter(0.0, unit="1", doc="its slope", role="strength")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return ()

    def error(self, theta_m: Array) -> Array:
        return self.e

    def slope(self, theta_m: Array) -> Array:
        return self.e_slope


def unit_pushes(
    model: Model, states: Float[Array | np.ndarray, "*many states"], conditions: Conditions
) -> dict[str, Float[np.ndarray, "*many states"]]:
    """Change of the state's rates, at each of many states, by a unit of each quantity that effects add. These are a
    torque at each place of [`hdjax.effects.learned`][], by the name of the learned torque there, the incoming torque,
    an error of the mesh, and its slope."""
    names, axes = _names(model), states.ndim - 1
    found = slopes_at_instants(_rates, (np.zeros(len(names)), 0), (model, 0), (states, axes), (conditions, axes))
    return {name: found[..., i] for i, name in enumerate(names)}


def unit_readings(
    model: Model, states: Float[Array | np.ndarray, "segments samples states"], segments: Segments
) -> dict[str, Float[np.ndarray, "segments samples outputs"]]:
    """Change of the outputs at the samples by the same units; empty without a sensor of the joint torque, which
    measures a torque in the mesh directly."""
    if JOINT_TORQUE not in model.measured:
        return {}
    inputs = inputs_at(model, segments, np.zeros_like(segments.width))
    names = _names(model)
    found = slopes_at_instants(_outputs, (np.zeros(len(names)), 0), (model, 0), (states, 2), (inputs, 2))
    return {name: found[..., i] for i, name in enumerate(names)}


def _names(model: Model) -> list[str]:
    """Names of the quantities in the order of [`_probed`][]'s strengths."""
    return [f.name for f in _torques(model)] + [ERROR, SLOPE] * isinstance(model, TwoInertiaModel) + [INPUT]


def _torques(model: Model) -> list[type[LearnedTorque]]:
    return [f for f in LEARNED_TORQUES if isinstance(model, TwoInertiaModel) or not f.needs_motor]


def _rates(strengths: Array, model: Model, state: Array, conditions: Conditions) -> Array:
    """The state's rates with each quantity at its strength; the last one is the torque."""
    return _probed(strengths, model).rates(state, strengths[-1], jnp.zeros_like(strengths[-1]), conditions)


def _outputs(strengths: Array, model: Model, state: Array, inputs: Inputs) -> Array:
    """The outputs with each quantity at its strength."""
    return _probed(strengths, model).outputs(state, replace(inputs, torque=inputs.torque + strengths[-1]))


def _probed(strengths: Array, model: Model) -> Model:
    """The model with the quantities other than the torque at their strengths."""
    # Added, not set by name: the model may have a learned term already.
    forms = zip(_torques(model), strengths, strict=False)
    torques = [form(axes=(), mixing=jnp.ones((1, 1)), c=(strength,)) for form, strength in forms]
    whole = isinstance(model, TwoInertiaModel)
    geometry = [_UnitGeometry(e=strengths[-3], e_slope=strengths[-2])] if whole else []
    return model.with_effects(*torques, *geometry)


def carried(
    followed: Followed, push: Float[np.ndarray, "segments samples nodes states"]
) -> Float[np.ndarray, "segments samples states nodes"]:
    """Change of the state at each interval's end by forces at its nodes."""
    pushed = np.swapaxes(push, -1, -2)
    first, second = (ends @ (pushed * by) for ends, by in _carriers(followed))
    return first + second


def _carriers(followed: Followed) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Change of the state at an interval's end by the two ends of a linear force, and the weight of each node in them.

    The line has the same mean and first moment as the force at the nodes, which is equivalent for dynamics slower than
    the interval.
    """
    mean, rise = 0.5 * WEIGHTS, 1.5 * WEIGHTS * NODES
    return (followed.from_start, mean - rise), (followed.from_end, mean + rise)


def unit_reading(model: Model, form: type[LearnedReading]) -> Float[np.ndarray, " outputs"]:
    """Change of the outputs by a unit of encoder error."""
    bare, at_rest = replace(model, effects=()), jnp.zeros(len(model.motion_states))
    probed = bare.with_effects(form(axes=(), mixing=jnp.ones((1, 1)), c=(jnp.ones(()),)))
    return np.asarray(probed.outputs(at_rest) - bare.outputs(at_rest))


def place_of(effect: Effect | type[Effect]) -> type[LearnedTorque] | None:
    """The learned torque at the place of an effect or form; None where that adds no torque."""
    own = effect if isinstance(effect, type) else type(effect)
    kinds = (MeshTorqueEffect, MotorSideEffect, LoadSideEffect)
    return next((form for form, kind in zip(LEARNED_TORQUES, kinds, strict=True) if issubclass(own, kind)), None)


def _at_knots(
    coefficients: Float[np.ndarray, "segments samples powers"], width: Float[np.ndarray, "segments samples"]
) -> Float[np.ndarray, "segments knots"]:
    """A signal's values at the samples and at the end of the last interval; at jumps the mean."""
    after, before = coefficients[:, :, 0], polynomial(coefficients, width)
    return np.concatenate([after[:, :1], 0.5 * (before[:, :-1] + after[:, 1:]), before[:, -1:]], axis=1)
