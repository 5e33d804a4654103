"""A fitted motion as effects look at it, and what a unit of each thing that they can add does there."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.experiment import Segments, Stretch
from fitting.followed import NODES, Followed
from fitting.instants import at_instants
from hdjax import Model, PiecewisePolynomial, TwoInertiaModel
from hdjax.compilation import jit_small
from hdjax.effects import (
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
from hdjax.parameters import Scalar, parameter
from hdjax.signals import polynomial

PART = 0.5 * (NODES + 1.0)[None, None, :]
"""The nodes as parts of an interval, behind segments and samples."""

INPUT, ERROR, SLOPE = "input", "error", "slope"
"""What effects add beside a torque at one of the places of [`hdjax.effects.learned`][]."""


class Along(eqx.Module):
    """A motion, as effects look at it.

    Attributes:
        model: whose motion it is.
        followed: its states.
        segments: the data that it belongs to.
        at_knots: the motion at each knot.
        between: the motion at the nodes of each interval.
        pushes: what a unit of each thing that effects add does there to the state's rates, see [`unit_pushes`][].
        goes_on: whether a segment goes on where the one before it ends in time, joined or not.
        firsts: the first segment of each stretch.
        ends: segment and knot where each stretch ends.
    """

    model: Model
    followed: Followed
    segments: Segments
    at_knots: Motion
    between: Motion
    pushes: dict[str, Float[Array, "segments samples nodes states"]]
    goes_on: Bool[Array, " segments"]
    firsts: Int[np.ndarray, " stretches"]
    ends: Int[np.ndarray, "stretches 2"]


def along(model: Model, followed: Followed, segments: Segments, stretches: Sequence[Stretch]) -> Along:
    """The motion of a model as effects look at it.

    Args:
        model: at the solution.
        followed: its states.
        segments: the data that it belongs to.
        stretches: what was cut into them.
    """
    length, samples = segments.weight.shape[1], np.array([len(s) for s in stretches])
    pieces = -(-samples // length)
    firsts = np.cumsum(pieces) - pieces
    ends = np.stack([firsts + pieces - 1, samples - (pieces - 1) * length], axis=1)
    conditions = conditions_between(segments)
    at_knots = motions(model, followed.states, conditions_at_knots(segments))
    between = motions(model, followed.between, conditions)
    pushes = unit_pushes(model, followed.between, conditions)
    goes_on = jnp.asarray(continues(segments))
    return Along(model, followed, segments, at_knots, between, pushes, goes_on, firsts, ends)


@jit_small
def conditions_at_knots(segments: Segments) -> Conditions:
    """Time and temperature at each knot, the end of the last interval included."""
    time = segments.torque.knots[:, segments.halo :]
    warmth = None if segments.temperature is None else _at_knots(segments.temperature.coefficients, jnp.diff(time))
    return Conditions(time, warmth)


@jit_small
def acting_at_knots(model: Model, segments: Segments) -> Float[Array, "segments knots"]:
    """The torque that acts on a drive, or the forcing, at each knot; where it jumps the middle, so that a straight line
    from knot to knot is not late."""
    acting = jax.vmap(model.actuate)(segments.torque)
    width = jnp.diff(acting.knots[:, segments.halo :])
    return _at_knots(acting.coefficients[:, segments.halo :], width)


def at_nodes(signal: PiecewisePolynomial) -> Float[Array, "segments samples nodes"]:
    """A signal's values at the nodes of each interval."""
    return polynomial(signal.coefficients[..., None, :], _late(signal.knots))


def _late(knots: Float[Array, "segments knots"]) -> Float[Array, "segments samples nodes"]:
    """How late in its interval each node comes."""
    return jnp.asarray(PART) * jnp.diff(knots)[..., None]


@jit_small
def conditions_between(segments: Segments) -> Conditions:
    """Time and temperature at the nodes of each interval."""
    time = segments.torque.knots[:, segments.halo :]
    warmth = None if segments.temperature is None else at_nodes(segments.temperature)
    return Conditions(time[:, :-1, None] + _late(time), warmth)


def motions(model: Model, states: Float[Array, "*many states"], conditions: Conditions) -> Motion:
    """The motion that each of many states means."""
    return at_instants(functools.partial(_motions, model), states.shape[:-1], states, conditions)


@jit_small
def _motions(model: Model, states: Float[Array, "instants states"], conditions: Conditions) -> Motion:
    return jax.vmap(model.motion)(states, conditions)


class _UnitGeometry(MeshGeometryEffect):
    """An error of the mesh and a slope of it, each by itself."""

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
    model: Model, states: Float[Array, "*many states"], conditions: Conditions
) -> dict[str, Float[Array, "*many states"]]:
    """What a unit of each thing that effects can add does to the rates of each of many states: a torque at each place
    of [`hdjax.effects.learned`][], by the name of the learned torque there; the torque that comes in; an error of the
    mesh, and its slope."""
    return at_instants(functools.partial(_unit_pushes, model), states.shape[:-1], states, conditions)


@jit_small
def _unit_pushes(
    model: Model, states: Float[Array, "instants states"], conditions: Conditions
) -> dict[str, Float[Array, "instants states"]]:
    whole = isinstance(model, TwoInertiaModel)
    forms = [f for f in LEARNED_TORQUES if whole or not f.needs_motor]
    names = [f.name for f in forms] + ([ERROR, SLOPE] if whole else [])

    def rates(strengths: Array, torque: Array, state: Array, conditions: Conditions) -> Array:
        # Added afresh, not set by name: the model may have something learned already.
        torques = [f(axes=(), mixing=jnp.ones((1, 1)), c=(s,)) for f, s in zip(forms, strengths, strict=False)]
        geometry = [_UnitGeometry(e=strengths[-2], e_slope=strengths[-1])] if whole else []
        probed = model.with_effects(*torques, *geometry)
        return probed.rates(state, torque, jnp.zeros_like(torque), conditions)

    find = jax.vmap(jax.jacfwd(rates, argnums=(0, 1)), in_axes=(None, None, 0, 0))
    by_strength, by_input = find(jnp.zeros(len(names)), jnp.zeros(()), states, conditions)
    return {name: by_strength[..., i] for i, name in enumerate(names)} | {INPUT: by_input}


def unit_reading(model: Model, form: type[LearnedReading]) -> Float[Array, " outputs"]:
    """What a unit of error of what an encoder reads does to the outputs."""
    bare, at_rest = replace(model, effects=()), jnp.zeros(len(model.motion_states))
    probed = bare.with_effects(form(axes=(), mixing=jnp.ones((1, 1)), c=(jnp.ones(()),)))
    return probed.outputs(at_rest) - bare.outputs(at_rest)


def place_of(effect: Effect | type[Effect]) -> type[LearnedTorque] | None:
    """The learned torque that acts where an effect, or a form, does; None where that is no torque."""
    own = effect if isinstance(effect, type) else type(effect)
    kinds = (MeshTorqueEffect, MotorSideEffect, LoadSideEffect)
    return next((form for form, kind in zip(LEARNED_TORQUES, kinds, strict=True) if issubclass(own, kind)), None)


def continues(segments: Segments) -> Bool[np.ndarray, " segments"]:
    """Whether a segment goes on where the one before it ends in time, joined or not."""
    knots = np.asarray(segments.torque.knots)[:, segments.halo :]
    step = np.median(np.diff(knots))
    late = knots[1:, 0] - knots[:-1, -1]
    return np.append(False, np.abs(late) < 0.5 * step)


def _at_knots(
    coefficients: Float[Array, "segments samples order"], width: Float[Array, "segments samples"]
) -> Float[Array, "segments knots"]:
    """A signal's values at the samples and at the end of the last interval; where it jumps the middle."""
    after, before = coefficients[:, :, 0], polynomial(coefficients, width)
    return jnp.concatenate([after[:, :1], 0.5 * (before[:, :-1] + after[:, 1:]), before[:, -1:]], axis=1)
