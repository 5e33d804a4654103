"""What an effect of little strength would do along a motion: a force, or a change of what the encoders read."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.experiment import Segments
from fitting.followed import NODES, WEIGHTS, Followed
from fitting.free import strength_paths
from hdjax import Model, PiecewisePolynomial
from hdjax.effects import (
    Conditions,
    Effect,
    LoadSideEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
)
from hdjax.effects.learned import LEARNED, LearnedTorque
from hdjax.program_cache import jit_kept
from hdjax.signals import polynomial
from hdjax.where import where

# Steps of an effect's own states in a sample interval, along a motion that is a straight line in between.
_OWN_STEPS = 2
# The nodes as parts of an interval.
_PART = 0.5 * (NODES + 1.0)[None, None, :]


class Regressors(eqx.Module):
    """Derivatives by the strengths of an effect, one column for each strength of each proposal.

    Those of rates are straight lines with the mean and the first moment that the rates have in each sample interval: a
    system that is slow against it sees the same.

    Attributes:
        at_start: of the state's rates, where the line starts.
        at_end: where it ends.
        reading: of the outputs at the samples.
    """

    at_start: Float[Array, "segments samples states columns"]
    at_end: Float[Array, "segments samples states columns"]
    reading: Float[Array, "segments samples outputs columns"]


class Along(eqx.Module):
    """A motion, as effects look at it.

    Attributes:
        model: whose motion it is.
        followed: its states.
        segments: the data that it belongs to.
        at_knots: the motion at each knot.
        between: the motion at the nodes of each interval.
        goes_on: whether a segment goes on where the one before it ends in time, joined or not.
    """

    model: Model
    followed: Followed
    segments: Segments
    at_knots: Motion
    between: Motion
    goes_on: Bool[Array, " segments"]


def along(model: Model, followed: Followed, segments: Segments) -> Along:
    """The motion of a model as effects look at it.

    Args:
        model: at the solution.
        followed: its states.
        segments: the data that it belongs to.
    """
    at_knots, between = _motions(model, followed, segments)
    return Along(model, followed, segments, at_knots, between, jnp.asarray(continues(segments)))


@jit_kept
def _motions(model: Model, followed: Followed, segments: Segments) -> tuple[Motion, Motion]:
    time = segments.torque.knots[:, segments.halo :]
    width = jnp.diff(time)
    at_knots = jax.vmap(jax.vmap(model.motion))(
        followed.states, Conditions(time, _at_knots(segments.temperature, width))
    )
    late = jnp.asarray(_PART) * width[..., None]
    warmth = segments.temperature
    warmth = None if warmth is None else polynomial(warmth.coefficients[..., None, :], late)
    conditions = Conditions(time[:, :-1, None] + late, warmth)
    return at_knots, jax.vmap(jax.vmap(jax.vmap(model.motion)))(followed.between, conditions)


def regressors(seen: Along, proposals: Sequence[Effect]) -> Regressors:
    """The regressors of proposals of one form along a motion.

    Args:
        seen: the motion.
        proposals: effects of one and the same form, at zero strength.
    """
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *proposals)
    place = place_of(stacked)
    takes_inertia = (
        isinstance(stacked, LoadSideEffect) and type(stacked).inertia_taken is not LoadSideEffect.inertia_taken
    )
    if place is None or takes_inertia:
        found = _regressors(seen.model, stacked, seen.followed, seen.segments, seen.at_knots, seen.goes_on)
        return jax.tree.map(lambda a: _finite(np.asarray(a)), found)
    # A torque is the same whatever other effects there are: one program for all models that the loop comes by.
    bare = replace(seen.model, effects=())
    width = jnp.diff(seen.segments.torque.knots[:, seen.segments.halo :])
    torque = _finite(np.asarray(_torques(bare, stacked, seen.at_knots, seen.between, width, seen.goes_on)))
    acting = np.asarray(unit_torque(seen.model, place, seen.followed.between))
    mean = 0.5 * np.einsum("k,snki,snkp->snip", WEIGHTS, acting, torque, optimize=True)
    rise = 1.5 * np.einsum("k,snki,snkp->snip", WEIGHTS * NODES, acting, torque, optimize=True)
    nothing = np.zeros((*seen.segments.measured.shape, torque.shape[-1]))
    found = Regressors(*map(jnp.asarray, (mean - rise, mean + rise, nothing)))
    return jax.tree.map(np.asarray, found)


def place_of(effect: Effect) -> type[LearnedTorque] | None:
    """The learned torque that acts where an effect does; None where that is no torque."""
    kinds = (MeshTorqueEffect, MotorSideEffect, LoadSideEffect)
    return next((form for form, kind in zip(LEARNED, kinds, strict=True) if isinstance(effect, kind)), None)


def unit_torque(model: Model, place: type[LearnedTorque], states: Float[Array, "*many states"]) -> Array:
    """What a unit of torque at a place adds to the rates of each of many states."""
    probe = place(axes=(), mixing=jnp.ones((1, 1)), c=(0.0,))
    return _unit_torque(model.with_effects(probe), probe.name, states)


@eqx.filter_jit
def _unit_torque(model: Model, name: str, states: Array) -> Array:
    zero = jnp.zeros(())

    def rates(strength: Array, state: Array) -> Array:
        return model.replace({f"{name}.c_0": strength}).rates(state, zero, zero)

    flat = states.reshape(-1, states.shape[-1])
    return jax.vmap(lambda state: jax.jacfwd(rates)(zero, state))(flat).reshape(states.shape)


def _finite(values: np.ndarray) -> np.ndarray:
    """An effect that runs away along the motion explains nothing."""
    lost = ~np.isfinite(values).all(axis=tuple(range(values.ndim - 1)))
    return np.where(lost, 0.0, values) if lost.any() else values


def continues(segments: Segments) -> Bool[np.ndarray, " segments"]:
    """Whether a segment goes on where the one before it ends in time, joined or not."""
    knots = np.asarray(segments.torque.knots)[:, segments.halo :]
    step = np.median(np.diff(knots))
    late = knots[1:, 0] - knots[:-1, -1]
    return np.append(False, np.abs(late) < 0.5 * step)


def _torque_columns(
    bare: Model,
    stacked: Effect,
    at_knots: Motion,
    between: Motion,
    width: Float[Array, "segments samples"],
    goes_on: Bool[Array, " segments"],
) -> Float[Array, "segments samples nodes columns"]:
    """Derivatives of the torque by each strength of each proposal, at the nodes."""

    def of(effect: Effect) -> Array:
        extended = bare.with_effects(effect)
        paths = strength_paths(effect)
        own = jnp.zeros((*width.shape, NODES.size, 0))
        if effect.states:
            own = _own_between(*_own_states(effect, at_knots, width, goes_on))

        def torque(strengths: Array) -> Array:
            changed = extended.replace(dict(zip(paths, strengths, strict=True))).effect(effect.name)
            assert isinstance(changed, MeshTorqueEffect | MotorSideEffect | LoadSideEffect)
            at = jax.vmap(jax.vmap(jax.vmap(lambda motion, state: changed.torque(motion, bare.drive, state))))  # pyright: ignore[reportArgumentType]
            return jnp.broadcast_to(at(between, own), own.shape[:-1])

        return jax.jacfwd(torque)(jnp.stack([extended.get(p) for p in paths]))

    found = jax.vmap(of, out_axes=-1)(stacked)
    return _side_by_side(found)


def _side_by_side(found: Array) -> Array:
    """From (..., strengths, proposals) to one axis, a proposal's strengths side by side."""
    return jnp.swapaxes(found, -1, -2).reshape(*found.shape[:-2], -1)


# Programs of little work for each form: compiling them well would take longer than what that saves.
_QUICKLY_MADE: Any = {"compiler_options": {"xla_backend_optimization_level": 1}}
_torques = jit_kept(_torque_columns, **_QUICKLY_MADE)


def _looked_along(
    model: Model,
    stacked: Effect,
    followed: Followed,
    segments: Segments,
    at_knots: Motion,
    goes_on: Bool[Array, " segments"],
) -> Regressors:
    states, between = followed.states, followed.between
    width = jnp.diff(segments.torque.knots[:, segments.halo :])

    def of(effect: Effect) -> Regressors:
        own = _own_states(effect, at_knots, width, goes_on) if effect.states else None
        paths = strength_paths(effect)
        extended = model.with_effects(effect)

        def looked_at(strengths: Array):
            changed = extended.replace(dict(zip(paths, strengths, strict=True)))
            return _rates_and_reading(changed, states, between, own, segments)

        rates, reading = jax.jacfwd(looked_at)(jnp.stack([extended.get(p) for p in paths]))
        mean = 0.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS), rates)
        rise = 1.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS * NODES), rates)
        return Regressors(mean - rise, mean + rise, reading)

    found = jax.vmap(of, out_axes=-1)(stacked)
    return jax.tree.map(_side_by_side, found)


_regressors = jit_kept(_looked_along, **_QUICKLY_MADE)


def _rates_and_reading(
    model: Model,
    states: Float[Array, "segments knots states"],
    between: Float[Array, "segments samples nodes states"],
    own: tuple[Array, Array] | None,
    segments: Segments,
) -> tuple[Array, Array]:
    """Rates of the given states, at the nodes of each interval, and the outputs at the samples."""
    kept, samples = states.shape[-1], states[:, :-1]
    if own is not None:
        between = jnp.concatenate([between, _own_between(*own)], axis=-1)
        samples = jnp.concatenate([samples, own[0]], axis=-1)
    halo = segments.halo
    acting = jax.vmap(model.actuate)(segments.torque)
    acting = PiecewisePolynomial(acting.knots[:, halo:], acting.coefficients[:, halo:])
    late = jnp.asarray(_PART) * jnp.diff(acting.knots)[..., None]
    torque = polynomial(acting.coefficients[..., None, :], late)
    load, warmth = (
        None if signal is None else polynomial(signal.coefficients[..., None, :], late)
        for signal in (segments.load_torque, segments.temperature)
    )
    load = jnp.zeros_like(late) if load is None else load
    conditions = Conditions(acting.knots[:, :-1, None] + late, warmth)
    rates = jax.vmap(jax.vmap(jax.vmap(model.rates)))(between, torque, load, conditions)
    return rates[..., :kept], jax.vmap(jax.vmap(model.outputs))(samples)


def _own_between(start: Array, end: Array) -> Array:
    """An effect's own states at the nodes, in a straight line between both ends of an interval."""
    part = jnp.asarray(_PART)[..., None]
    return start[:, :, None] * (1.0 - part) + end[:, :, None] * part


def _own_states(
    effect: Effect, motion: Motion, width: Float[Array, "segments samples"], goes_on: Bool[Array, " segments"]
) -> tuple[Array, Array]:
    """An effect's own states at both ends of each interval: settled at each log's start, then driven by the motion."""

    def rate(own: Array, before: Motion, after: Motion, passed: float) -> Array:
        between = jax.tree.map(lambda a, b: (1.0 - passed) * a + passed * b, before, after)
        return jnp.stack(list(effect.state_rates(between, own)))

    def interval(own: Array, inputs):
        before, after, h = inputs
        start, part = own, 1.0 / _OWN_STEPS
        for i in range(_OWN_STEPS):
            k1 = rate(own, before, after, i * part)
            k2 = rate(own + 0.5 * part * h * k1, before, after, (i + 0.5) * part)
            k3 = rate(own + 0.5 * part * h * k2, before, after, (i + 0.5) * part)
            k4 = rate(own + part * h * k3, before, after, (i + 1) * part)
            own = own + part * h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return own, (start, own)

    def segment(own: Array, inputs):
        motion, width, goes_on = inputs
        settled = effect.initial_state(jax.tree.map(lambda a: a[0], motion))
        own = where(goes_on, own, settled)
        before, after = (jax.tree.map(lambda a, s=s: a[s], motion) for s in (slice(None, -1), slice(1, None)))
        return jax.lax.scan(interval, own, (before, after, width))

    return jax.lax.scan(segment, jnp.zeros_like(effect.initial_state()), (motion, width, goes_on))[1]


def _at_knots(signal: PiecewisePolynomial | None, width: Float[Array, "segments samples"]) -> Array | None:
    """A signal's values at the samples and at the end of the last interval."""
    if signal is None:
        return None
    last = polynomial(signal.coefficients[:, -1], width[:, -1])
    return jnp.concatenate([signal.coefficients[:, :, 0], last[:, None]], axis=1)
