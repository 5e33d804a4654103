"""What an effect of little strength would do along a motion: a force, or a change of what the encoders read."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.along import ERROR, INPUT, SLOPE, Along, at_nodes, conditions_between, place_of
from fitting.experiment import Segments
from fitting.followed import NODES, WEIGHTS, Followed
from fitting.free import strength_paths
from fitting.instants import at_instants
from fitting.memory import Memory, memory_of, own_between, own_states
from hdjax import Drive, Model, PiecewisePolynomial
from hdjax.compilation import jit_small
from hdjax.effects import (
    ActuatorEffect,
    Effect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    SensorEffect,
    ShaftEffect,
)
from hdjax.effects.learned import LearnedMotorTorque
from hdjax.parameters import own_value

# What a sensor effect adds.
_READING = "reading"


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


def regressors(
    seen: Along, proposals: Sequence[Effect], before: Memory | None = None
) -> tuple[Regressors, Memory | None]:
    """The regressors of proposals of one form along a motion, and the effect's own states there.

    Args:
        seen: the motion.
        proposals: effects of one and the same form, at zero strength.
        before: own states along stretches that these ones continue.
    """
    stacked, count = _stacked(proposals), len(proposals)
    segments = seen.segments
    shape = segments.measured.shape
    start = end = np.zeros((*shape[:2], 0, count))
    memory = None
    if stacked.states:
        start, end = own_states(seen, stacked, count, before)
        memory = memory_of(seen, start, end)
    own = own_between(start, end)
    if _takes_inertia(stacked):
        found = _regressors(seen.model, stacked, seen.followed, segments, *(jnp.asarray(a) for a in (start, own)))
        return jax.tree.map(lambda a: _finite(np.asarray(a)), found), memory
    if isinstance(stacked, ActuatorEffect):
        added = {INPUT: _inputs(_actuated(seen.model, segments), stacked, segments.halo)}
    else:
        motion = seen.between
        if isinstance(stacked, SensorEffect):
            motion, own = jax.tree.map(lambda a: np.asarray(a)[:, :-1], seen.at_knots), start
        find = functools.partial(_columns, replace(seen.model, effects=()), stacked)
        added = at_instants(find, own.shape[:-2], motion, own)
    added = {name: _finite(np.asarray(values)) for name, values in added.items()}
    columns = next(iter(added.values())).shape[-1]
    nothing = np.zeros((*shape[:2], seen.followed.states.shape[-1], columns))
    if _READING in added:
        return Regressors(nothing, nothing, added[_READING]), None
    at_start, at_end = nothing, nothing
    for name, values in added.items():
        starts, ends = at_instants(_straight_lines, shape[:2], seen.pushes[name], _padded(values))
        at_start, at_end = at_start + np.asarray(starts)[..., :columns], at_end + np.asarray(ends)[..., :columns]
    return Regressors(at_start, at_end, np.zeros((*shape, columns))), memory


def _stacked(proposals: Sequence[Effect]) -> Effect:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *proposals)


def _takes_inertia(effect: Effect) -> bool:
    return isinstance(effect, ShaftEffect) and effect.takes_inertia()


def _padded(values: np.ndarray) -> Array:
    """With columns of zeros up to a power of two: few shapes, few programs."""
    columns = values.shape[-1]
    wide = 1 << (columns - 1).bit_length()
    return jnp.asarray(np.concatenate([values, np.zeros((*values.shape[:-1], wide - columns))], axis=-1))


@jit_small
def _straight_lines(
    push: Float[Array, "samples nodes states"], values: Float[Array, "samples nodes columns"]
) -> tuple[Float[Array, "samples states columns"], Float[Array, "samples states columns"]]:
    """The straight lines with the mean and the first moment of what is pushed; where they start, and where they end."""
    # Written out: a product of many tiny matrices is slow.
    mean, rise = jnp.zeros(()), jnp.zeros(())
    for k, (weight, node) in enumerate(zip(WEIGHTS, NODES, strict=True)):
        pushed = push[:, k, :, None] * values[:, k, None, :]
        mean, rise = mean + 0.5 * weight * pushed, rise + 1.5 * weight * node * pushed
    return mean - rise, mean + rise


def _finite(values: np.ndarray) -> np.ndarray:
    """An effect that runs away along the motion explains nothing."""
    lost = ~np.isfinite(values).all(axis=tuple(range(values.ndim - 1)))
    return np.where(lost, 0.0, values) if lost.any() else values


@jit_small
def _columns(
    bare: Model, stacked: Effect, motion: Motion, own: Float[Array, "instants own proposals"]
) -> dict[str, Float[Array, "instants *what columns"]]:
    """Derivatives, by each strength of each proposal, of what an effect adds at each instant, by what that is.

    Args:
        bare: the model without effects: what one adds is the same whatever others there are, and so one program serves
            all models that the loop comes by.
        stacked: the proposals.
        motion: at each instant.
        own: the effect's own states.
    """

    def added(effect: Effect, own: Array) -> dict[str, Array]:
        if isinstance(effect, SensorEffect):
            assert motion.theta_m is not None and motion.theta_l is not None
            still = jnp.zeros_like(motion.x)
            states = jnp.stack([motion.theta_m, motion.theta_l, still, still], axis=-1)
            return {_READING: jax.vmap(bare.with_effects(effect).outputs)(states)}
        if isinstance(effect, MeshGeometryEffect):
            assert motion.theta_m is not None
            return {ERROR: effect.error(motion.theta_m), SLOPE: effect.slope(motion.theta_m)}
        place = place_of(effect)
        assert place is not None and isinstance(effect, MeshTorqueEffect | ShaftEffect)
        at = jax.vmap(lambda motion, state: effect.torque(motion, bare.drive, state))  # pyright: ignore[reportArgumentType]
        torques = {place.name: jnp.broadcast_to(at(motion, own), motion.x.shape)}
        if isinstance(effect, MeshTorqueEffect) and effect.reacts() and isinstance(bare.drive, Drive):
            torques[LearnedMotorTorque.name] = effect.reaction(motion, bare.drive)
        return torques

    return _by_strength(stacked, added, own)


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


@jit_small
def _inputs(torque: PiecewisePolynomial, stacked: Effect, halo: int) -> Float[Array, "segments samples nodes columns"]:
    """Derivatives of the torque that acts, at the nodes."""

    def acting(effect: Effect) -> Array:
        assert isinstance(effect, ActuatorEffect)
        return at_nodes(_behind(halo, jax.vmap(effect.actuate)(torque)))

    return _by_strength(stacked, acting)


def _behind(halo: int, torque: PiecewisePolynomial) -> PiecewisePolynomial:
    """The torque from each segment's own start on."""
    return PiecewisePolynomial(torque.knots[:, halo:], torque.coefficients[:, halo:])


def _side_by_side(found: Array) -> Array:
    """From (..., strengths, proposals) to one axis, a proposal's strengths side by side."""
    return jnp.swapaxes(found, -1, -2).reshape(*found.shape[:-2], -1)


@jit_small
def _regressors(
    model: Model,
    stacked: Effect,
    followed: Followed,
    segments: Segments,
    at_start: Float[Array, "segments samples own proposals"],
    between: Float[Array, "segments samples nodes own proposals"],
) -> Regressors:
    """Of effects that take inertia: what the others do changes with it.

    Args:
        model: with its effects.
        stacked: the proposals.
        followed: the motion.
        segments: the data.
        at_start: the proposals' own states where each sample interval starts.
        between: and at its nodes.
    """
    torque = at_nodes(_behind(segments.halo, jax.vmap(model.actuate)(segments.torque)))
    load = jnp.zeros_like(torque) if segments.load_torque is None else at_nodes(segments.load_torque)
    conditions = conditions_between(segments)

    def looked_at(effect: Effect, at_start: Array, between: Array) -> tuple[Array, Array]:
        whole = model.with_effects(effect)
        states = jnp.concatenate([followed.between, between], axis=-1)
        samples = jnp.concatenate([followed.states[:, :-1], at_start], axis=-1)
        rates = jax.vmap(jax.vmap(jax.vmap(whole.rates)))(states, torque, load, conditions)
        return rates[..., : followed.states.shape[-1]], jax.vmap(jax.vmap(whole.outputs))(samples)

    rates, reading = _by_strength(stacked, looked_at, at_start, between)
    mean = 0.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS), rates)
    rise = 1.5 * jnp.einsum("k,snkip->snip", jnp.asarray(WEIGHTS * NODES), rates)
    return Regressors(mean - rise, mean + rise, reading)
