"""What an effect of little strength would do along a motion: a force, or a change of what the encoders read."""

from collections.abc import Sequence
from dataclasses import replace

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
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
)
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


def regressors(model: Model, proposals: Sequence[Effect], followed: Followed, segments: Segments) -> Regressors:
    """The regressors of proposals of one form along a motion.

    Args:
        model: whose motion it is.
        proposals: effects of one and the same form, at zero strength.
        followed: the motion.
        segments: the data that it belongs to.
    """
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *proposals)
    if isinstance(stacked, MeshTorqueEffect | MotorSideEffect | LoadSideEffect):
        # A torque is the same whatever other torques there are: one program for all models that the loop comes by.
        model = replace(model, effects=tuple(e for e in model.effects if isinstance(e, MeshGeometryEffect)))
    found = _regressors(model, stacked, followed, segments, jnp.asarray(continues(segments)))
    return jax.tree.map(lambda a: _finite(np.asarray(a)), found)


def _finite(values: np.ndarray) -> np.ndarray:
    """An effect that runs away along the motion explains nothing."""
    lost = ~np.isfinite(values).all(axis=(0, 1, 2))
    return np.where(lost, 0.0, values) if lost.any() else values


def continues(segments: Segments) -> Bool[np.ndarray, " segments"]:
    """Whether a segment goes on where the one before it ends in time, joined or not."""
    knots = np.asarray(segments.torque.knots)[:, segments.halo :]
    step = np.median(np.diff(knots))
    late = knots[1:, 0] - knots[:-1, -1]
    return np.append(False, np.abs(late) < 0.5 * step)


def _looked_along(
    model: Model, stacked: Effect, followed: Followed, segments: Segments, goes_on: Bool[Array, " segments"]
) -> Regressors:
    kept = len(model.state_names)
    others = followed.states.shape[-1] - kept
    states, between = followed.states[..., :kept], followed.between[..., :kept]

    def of(effect: Effect) -> Regressors:
        own = _own_states(model, effect, states, segments, goes_on) if effect.states else None
        paths = strength_paths(effect)
        extended = model.with_effects(effect)

        def looked_at(strengths: Array):
            changed = extended.replace(dict(zip(paths, strengths, strict=True)))
            return _rates_and_reading(changed, states, between, own, segments)

        rates, reading = jax.jacfwd(looked_at)(jnp.stack([extended.get(p) for p in paths]))
        # Rates of states that the model was looked at without do not depend on the effect.
        rates = jnp.pad(rates, ((0, 0), (0, 0), (0, 0), (0, others), (0, 0)))
        mean = 0.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS), rates)
        rise = 1.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS * NODES), rates)
        return Regressors(mean - rise, mean + rise, reading)

    found = jax.vmap(of, out_axes=-1)(stacked)
    # From (..., strengths, proposals) to one axis, a proposal's strengths side by side.
    return jax.tree.map(lambda a: jnp.swapaxes(a, -1, -2).reshape(*a.shape[:-2], -1), found)


# A program of little work for each form: compiling it well would take longer than what that saves.
_regressors = jit_kept(_looked_along, compiler_options={"xla_backend_optimization_level": 1})


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
        start, end = own
        part = jnp.asarray(_PART)[..., None]
        start_to_end = start[:, :, None] * (1.0 - part) + end[:, :, None] * part
        between = jnp.concatenate([between, start_to_end], axis=-1)
        samples = jnp.concatenate([samples, start], axis=-1)
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


def _own_states(
    model: Model,
    effect: Effect,
    states: Float[Array, "segments knots states"],
    segments: Segments,
    goes_on: Bool[Array, " segments"],
) -> tuple[Array, Array]:
    """An effect's own states at both ends of each interval: settled at each log's start, then driven by the motion."""
    time = segments.torque.knots[:, segments.halo :]
    width = jnp.diff(time)
    motion = jax.vmap(jax.vmap(model.motion))(states, Conditions(time, _at_knots(segments.temperature, width)))

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
