"""What an effect of little strength would do along a motion: a force, or a change of what the encoders read."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.experiment import Segments
from fitting.followed import NODES, WEIGHTS, Followed
from fitting.free import strength_paths
from hdjax import Model, PiecewisePolynomial
from hdjax.effects import Effect, Motion
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
    return _regressors(model, stacked, followed, segments, jnp.asarray(continues(segments)))


def continues(segments: Segments) -> Bool[np.ndarray, " segments"]:
    """Whether a segment goes on where the one before it ends in time, joined or not."""
    knots = np.asarray(segments.torque.knots)[:, segments.halo :]
    step = np.median(np.diff(knots))
    late = knots[1:, 0] - knots[:-1, -1]
    return np.append(False, np.abs(late) < 0.5 * step)


@eqx.filter_jit
def _regressors(
    model: Model, stacked: Effect, followed: Followed, segments: Segments, goes_on: Bool[Array, " segments"]
) -> Regressors:
    def of(effect: Effect) -> Regressors:
        own = _own_states(model, effect, followed.states, segments, goes_on) if effect.states else None
        paths = strength_paths(effect)
        extended = model.with_effects(effect)

        def looked_at(strengths: Array):
            changed = extended.replace(dict(zip(paths, strengths, strict=True)))
            return _rates_and_reading(changed, followed, own, segments)

        rates, reading = jax.jacfwd(looked_at)(jnp.stack([extended.get(p) for p in paths]))
        mean = 0.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS), rates)
        rise = 1.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS * NODES), rates)
        return Regressors(mean - rise, mean + rise, reading)

    found = jax.vmap(of, out_axes=-1)(stacked)
    # From (..., strengths, proposals) to one axis, a proposal's strengths side by side.
    return jax.tree.map(lambda a: _finite(jnp.swapaxes(a, -1, -2).reshape(*a.shape[:-2], -1)), found)


def _finite(values: Array) -> Array:
    """An effect that runs away along the motion explains nothing."""
    lost = jnp.any(~jnp.isfinite(values), axis=(0, 1, 2), keepdims=True)
    return where(lost, jnp.zeros_like(values), values)


def _rates_and_reading(
    model: Model, followed: Followed, own: tuple[Array, Array] | None, segments: Segments
) -> tuple[Array, Array]:
    """Rates of the states that are followed, at the nodes of each interval, and the outputs at the samples."""
    between, samples = followed.between, followed.states[:, :-1]
    if own is not None:
        start, end = own
        start_to_end = start[:, :, None] * (1.0 - _PART[..., None]) + end[:, :, None] * _PART[..., None]
        between = jnp.concatenate([between, start_to_end], axis=-1)
        samples = jnp.concatenate([samples, start], axis=-1)
    halo = segments.halo
    acting = jax.vmap(model.actuate)(segments.torque)
    torque = _at_nodes(PiecewisePolynomial(acting.knots[:, halo:], acting.coefficients[:, halo:]))
    load = segments.load_torque
    on_load = jnp.zeros_like(torque) if load is None else _at_nodes(load)
    rates = jax.vmap(jax.vmap(jax.vmap(model.rates)))(between, torque, on_load)
    return rates[..., : followed.states.shape[-1]], jax.vmap(jax.vmap(model.outputs))(samples)


def _at_nodes(signal: PiecewisePolynomial) -> Float[Array, "segments samples nodes"]:
    width = jnp.diff(signal.knots)[..., None]
    return polynomial(signal.coefficients[..., None, :], jnp.asarray(_PART) * width)


def _own_states(
    model: Model,
    effect: Effect,
    states: Float[Array, "segments knots states"],
    segments: Segments,
    goes_on: Bool[Array, " segments"],
) -> tuple[Array, Array]:
    """An effect's own states at both ends of each interval, driven by the motion from rest at each log's start."""
    motion = jax.vmap(jax.vmap(model.motion))(states)
    rest = effect.initial_state()
    width = jnp.diff(segments.torque.knots[:, segments.halo :])

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
        own = where(goes_on, own, rest)
        before, after = (jax.tree.map(lambda a, s=s: a[s], motion) for s in (slice(None, -1), slice(1, None)))
        return jax.lax.scan(interval, own, (before, after, width))

    return jax.lax.scan(segment, rest, (motion, width, goes_on))[1]
