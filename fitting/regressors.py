"""What an effect of little strength would do along a motion: a force, or a change of what the encoders read."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.along import ERROR, INPUT, PART, SLOPE, Along, at_nodes, conditions_between, place_of
from fitting.experiment import Segments
from fitting.followed import NODES, WEIGHTS, Followed
from fitting.free import strength_paths
from hdjax import Drive, Model, PiecewisePolynomial
from hdjax.effects import (
    ActuatorEffect,
    Effect,
    LoadSideEffect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
    SensorEffect,
)
from hdjax.effects.learned import LearnedMotorTorque
from hdjax.parameters import own_value
from hdjax.program_cache import jit_small
from hdjax.where import where

# Steps of an effect's own states in a sample interval, along a motion that is a straight line in between.
_OWN_STEPS = 2


class Regressors(eqx.Module):
    """Derivatives by the strengths of an effect, one column for each strength of each proposal.

    Those of rates are straight lines with the mean and the first moment that the rates have in each sample interval: a
    system that is slow against it sees the same.

    Attributes:
        at_start: of the state's rates, where the line starts.
        at_end: where it ends.
        reading: of the outputs at the samples.
    """

    at_start: Float[Array | np.ndarray, "segments samples states columns"]
    at_end: Float[Array | np.ndarray, "segments samples states columns"]
    reading: Float[Array | np.ndarray, "segments samples outputs columns"]


class Memory(eqx.Module):
    """An effect's own states along a motion, for each proposal.

    Attributes:
        at_starts: where each segment starts.
        at_ends: where each stretch ends.
    """

    at_starts: Float[np.ndarray, "segments own proposals"]
    at_ends: Float[np.ndarray, "stretches own proposals"]


class _Chain(eqx.Module):
    """Where an effect's own states come from, and where they are wanted.

    Attributes:
        goes_on: whether a segment goes on where the one before it ends.
        known: whether a segment starts with states that are given; settled ones are taken where neither holds.
        given: these.
        ends: segment and knot where each stretch ends.
    """

    goes_on: Bool[Array, " segments"]
    known: Bool[Array, " segments"]
    given: Float[Array, "segments own proposals"]
    ends: Int[Array, "stretches 2"]


def regressors(
    seen: Along, proposals: Sequence[Effect], before: Memory | None = None
) -> tuple[Regressors, Memory | None]:
    """The regressors of proposals of one form along a motion, and the effect's own states there.

    Args:
        seen: the motion.
        proposals: effects of one and the same form, at zero strength.
        before: own states along stretches that these ones continue.
    """
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *proposals)
    # What an effect adds is the same whatever other effects there are: one program for all models that the loop comes
    # by.
    bare = replace(seen.model, effects=())
    segments = seen.segments
    if isinstance(stacked, SensorEffect):
        reading = _finite(np.asarray(_readings(bare, stacked, seen.at_knots)))
        nothing = np.zeros((*segments.measured.shape[:2], seen.followed.states.shape[-1], reading.shape[-1]))
        return Regressors(nothing, nothing, reading), None
    width = jnp.diff(segments.torque.knots[:, segments.halo :])
    place = place_of(stacked)
    chain = _chain(seen, len(stacked.states), len(proposals), before)
    if isinstance(stacked, LoadSideEffect) and stacked.takes_inertia():
        found, *memory = _regressors(seen.model, stacked, seen.followed, segments, seen.at_knots, chain)
        return jax.tree.map(lambda a: _finite(np.asarray(a)), found), _memory(stacked, memory)
    memory = None
    if place is not None:
        torques, *own = _torques(bare, stacked, seen.at_knots, seen.between, width, chain)
        added, memory = {place.name: torques}, _memory(stacked, own)
        if isinstance(stacked, MeshTorqueEffect) and stacked.reacts():
            added[LearnedMotorTorque.name] = _reactions(bare, stacked, seen.between)
    elif isinstance(stacked, ActuatorEffect):
        added = {INPUT: _inputs(_actuated(seen.model, segments), stacked, segments.halo)}
    else:
        assert isinstance(stacked, MeshGeometryEffect)
        added = dict(zip((ERROR, SLOPE), _geometry(stacked, seen.between), strict=True))
    columns = next(iter(added.values())).shape[-1]
    lines = [_straight_lines(seen.pushes[n], _padded(_finite(np.asarray(v)))) for n, v in added.items()]
    at_start, at_end = (np.sum([np.asarray(line[side])[..., :columns] for line in lines], axis=0) for side in (0, 1))
    return Regressors(at_start, at_end, np.zeros((*segments.measured.shape, columns))), memory


def _chain(seen: Along, own: int, proposals: int, before: Memory | None) -> _Chain:
    segments = seen.goes_on.shape[0]
    known, given = np.zeros(segments, dtype=bool), np.zeros((segments, own, proposals))
    if before is not None:
        known[seen.firsts], given[seen.firsts] = True, before.at_ends
    return _Chain(seen.goes_on, jnp.asarray(known), jnp.asarray(given), jnp.asarray(seen.ends))


def _memory(stacked: Effect, found: Sequence[Array]) -> Memory | None:
    return Memory(*(np.asarray(a) for a in found)) if stacked.states else None


def _padded(values: np.ndarray) -> Array:
    """With columns of zeros up to a power of two: few shapes, few programs."""
    columns = values.shape[-1]
    wide = 1 << (columns - 1).bit_length()
    return jnp.asarray(np.concatenate([values, np.zeros((*values.shape[:-1], wide - columns))], axis=-1))


@jit_small
def _straight_lines(
    push: Float[Array, "segments samples nodes states"], values: Float[Array, "segments samples nodes columns"]
) -> tuple[Float[Array, "segments samples states columns"], Float[Array, "segments samples states columns"]]:
    """The straight lines with the mean and the first moment of what is pushed; where they start, and where they end."""
    # Written out: a product of many tiny matrices is slow.
    mean, rise = jnp.zeros(()), jnp.zeros(())
    for k, (weight, node) in enumerate(zip(WEIGHTS, NODES, strict=True)):
        pushed = push[:, :, k, :, None] * values[:, :, k, None, :]
        mean, rise = mean + 0.5 * weight * pushed, rise + 1.5 * weight * node * pushed
    return mean - rise, mean + rise


def _finite(values: np.ndarray) -> np.ndarray:
    """An effect that runs away along the motion explains nothing."""
    lost = ~np.isfinite(values).all(axis=tuple(range(values.ndim - 1)))
    return np.where(lost, 0.0, values) if lost.any() else values


def _torque_columns(
    bare: Model,
    stacked: Effect,
    at_knots: Motion,
    between: Motion,
    width: Float[Array, "segments samples"],
    chain: _Chain,
) -> tuple[
    Float[Array, "segments samples nodes columns"],
    Float[Array, "segments own proposals"],
    Float[Array, "stretches own proposals"],
]:
    """Derivatives of the torque by each strength of each proposal, at the nodes; the effect's own states where each
    segment starts and where each stretch ends."""
    start, end = _all_own_states(stacked, at_knots, width, chain)

    def torque(effect: Effect, own: Array) -> Array:
        assert isinstance(effect, MeshTorqueEffect | MotorSideEffect | LoadSideEffect)
        at = jax.vmap(jax.vmap(jax.vmap(lambda motion, state: effect.torque(motion, bare.drive, state))))  # pyright: ignore[reportArgumentType]
        return jnp.broadcast_to(at(between, own), own.shape[:-1])

    columns = _by_strength(stacked, torque, jax.vmap(_own_between, in_axes=-1, out_axes=-1)(start, end))
    return columns, start[:, 0], _at(start, end, chain.ends)


def _at(start: Array, end: Array, places: Int[Array, "places 2"]) -> Array:
    """Own states at knots, from those at both ends of each interval."""
    knots = jnp.concatenate([start, end[:, -1:]], axis=1)
    return knots[places[:, 0], places[:, 1]]


def _reaction_columns(bare: Model, stacked: Effect, between: Motion) -> Float[Array, "segments samples nodes columns"]:
    """Derivatives of what a mesh torque puts on the motor alone, at the nodes."""

    def reaction(effect: Effect) -> Array:
        assert isinstance(effect, MeshTorqueEffect) and isinstance(bare.drive, Drive)
        return effect.reaction(between, bare.drive)

    return _by_strength(stacked, reaction)


def _by_strength(stacked: Effect, find: Callable[..., Any], *own: Array) -> Any:
    """Derivatives of what is found of an effect by each strength of each proposal, as columns.

    Args:
        stacked: the proposals.
        find: what is looked at, of an effect and its own states.
        own: each proposal's, on the last axis. At zero strength they don't depend on it.
    """

    def of(effect: Effect, *own: Array) -> Any:
        names = [path.split(".")[1] for path in strength_paths(effect)]

        # Not typed: `eqx.tree_at` fills the effect with placeholders.
        def values(effect):
            return [own_value(effect, name) for name in names]

        def changed(strengths: Array) -> Any:
            return find(eqx.tree_at(values, effect, list(strengths)), *own)

        return jax.jacfwd(changed)(jnp.stack(values(effect)))

    return jax.tree.map(_side_by_side, jax.vmap(of, in_axes=(0, *[-1 for _ in own]), out_axes=-1)(stacked, *own))


@jit_small
def _actuated(model: Model, segments: Segments) -> PiecewisePolynomial:
    """The torque as the effects that there are let it act."""
    return jax.vmap(model.actuate)(segments.torque)


def _input_columns(
    torque: PiecewisePolynomial, stacked: Effect, halo: int
) -> Float[Array, "segments samples nodes columns"]:
    """Derivatives of the torque that acts, at the nodes."""

    def acting(effect: Effect) -> Array:
        assert isinstance(effect, ActuatorEffect)
        return at_nodes(_behind(halo, jax.vmap(effect.actuate)(torque)))

    return _by_strength(stacked, acting)


def _behind(halo: int, torque: PiecewisePolynomial) -> PiecewisePolynomial:
    """The torque from each segment's own start on."""
    return PiecewisePolynomial(torque.knots[:, halo:], torque.coefficients[:, halo:])


def _geometry_columns(stacked: Effect, between: Motion) -> tuple[Array, Array]:
    """Derivatives of the mesh's error and of its slope, at the nodes."""

    def geometry(effect: Effect) -> tuple[Array, Array]:
        assert isinstance(effect, MeshGeometryEffect) and between.theta_m is not None
        return effect.error(between.theta_m), effect.slope(between.theta_m)

    return _by_strength(stacked, geometry)


def _reading_columns(
    bare: Model, stacked: Effect, at_knots: Motion
) -> Float[Array, "segments samples outputs columns"]:
    """Derivatives of the outputs at the samples."""
    theta_m, theta_l = at_knots.theta_m, at_knots.theta_l
    assert theta_m is not None and theta_l is not None
    still = jnp.zeros_like(theta_m)
    states = jnp.stack([theta_m, theta_l, still, still], axis=-1)[:, :-1]
    return _by_strength(stacked, lambda effect: jax.vmap(jax.vmap(bare.with_effects(effect).outputs))(states))


def _side_by_side(found: Array) -> Array:
    """From (..., strengths, proposals) to one axis, a proposal's strengths side by side."""
    return jnp.swapaxes(found, -1, -2).reshape(*found.shape[:-2], -1)


_torques = jit_small(_torque_columns)
_reactions = jit_small(_reaction_columns)
_inputs = jit_small(_input_columns)
_geometry = jit_small(_geometry_columns)
_readings = jit_small(_reading_columns)


def _looked_along(
    model: Model, stacked: Effect, followed: Followed, segments: Segments, at_knots: Motion, chain: _Chain
) -> tuple[Regressors, Float[Array, "segments own proposals"], Float[Array, "stretches own proposals"]]:
    width = jnp.diff(segments.torque.knots[:, segments.halo :])
    start, end = _all_own_states(stacked, at_knots, width, chain)

    def looked_at(effect: Effect, start: Array, end: Array) -> tuple[Array, Array]:
        return _rates_and_reading(model.with_effects(effect), followed, start, end, segments)

    rates, reading = _by_strength(stacked, looked_at, start, end)
    mean = 0.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS), rates)
    rise = 1.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS * NODES), rates)
    return Regressors(mean - rise, mean + rise, reading), start[:, 0], _at(start, end, chain.ends)


_regressors = jit_small(_looked_along)


def _rates_and_reading(
    model: Model,
    followed: Followed,
    own_start: Float[Array, "segments samples own"],
    own_end: Float[Array, "segments samples own"],
    segments: Segments,
) -> tuple[Array, Array]:
    """Rates of the motion's states at the nodes of each interval, and the outputs at the samples, with an effect's own
    states beside them."""
    kept = followed.states.shape[-1]
    between = jnp.concatenate([followed.between, _own_between(own_start, own_end)], axis=-1)
    samples = jnp.concatenate([followed.states[:, :-1], own_start], axis=-1)
    torque = at_nodes(_behind(segments.halo, jax.vmap(model.actuate)(segments.torque)))
    load = jnp.zeros_like(torque) if segments.load_torque is None else at_nodes(segments.load_torque)
    conditions = conditions_between(segments)
    rates = jax.vmap(jax.vmap(jax.vmap(model.rates)))(between, torque, load, conditions)
    return rates[..., :kept], jax.vmap(jax.vmap(model.outputs))(samples)


def _own_between(start: Array, end: Array) -> Array:
    """An effect's own states at the nodes, in a straight line between both ends of an interval."""
    part = jnp.asarray(PART)[..., None]
    return start[:, :, None] * (1.0 - part) + end[:, :, None] * part


def _all_own_states(
    stacked: Effect, motion: Motion, width: Float[Array, "segments samples"], chain: _Chain
) -> tuple[Float[Array, "segments samples own proposals"], Float[Array, "segments samples own proposals"]]:
    """Each proposal's own states at both ends of each interval."""
    if not stacked.states:
        nothing = jnp.zeros((*width.shape, *chain.given.shape[1:]))
        return nothing, nothing
    find = jax.vmap(lambda effect, given: _own_states(effect, motion, width, chain, given), (0, -1), -1)
    return find(stacked, chain.given)


def _own_states(
    effect: Effect,
    motion: Motion,
    width: Float[Array, "segments samples"],
    chain: _Chain,
    given: Float[Array, "segments own"],
) -> tuple[Array, Array]:
    """An effect's own states at both ends of each interval: given or settled where a stretch starts, then driven by the
    motion."""

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
        motion, width, goes_on, known, given = inputs
        settled = effect.initial_state(jax.tree.map(lambda a: a[0], motion))
        own = where(goes_on, own, where(known, given, settled))
        before, after = (jax.tree.map(lambda a, s=s: a[s], motion) for s in (slice(None, -1), slice(1, None)))
        return jax.lax.scan(interval, own, (before, after, width))

    inputs = (motion, width, chain.goes_on, chain.known, given)
    return jax.lax.scan(segment, jnp.zeros_like(effect.initial_state()), inputs)[1]
