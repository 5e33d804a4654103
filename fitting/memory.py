"""The own states of effects along a motion: settled where it starts, then driven by it."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.along import PART, Along
from fitting.instants import through_instants
from hdjax.compilation import jit_small
from hdjax.effects import Effect, Motion
from hdjax.where import where

# Steps in a sample interval, along a motion that is a straight line in between.
_STEPS = 2

OwnStates = Float[np.ndarray, "segments samples own proposals"]
"""The own states of each proposal, at the start of each sample interval or at its end."""


class Memory(eqx.Module):
    """An effect's own states along a motion, for each proposal.

    Attributes:
        at_starts: where each segment starts.
        at_ends: where each stretch ends.
    """

    at_starts: Float[np.ndarray, "segments own proposals"]
    at_ends: Float[np.ndarray, "stretches own proposals"]


class _Intervals(eqx.Module):
    """Sample intervals, one after the other.

    Attributes:
        before: the motion where each starts.
        after: where it ends.
        width: of it [s].
        anew: whether it does not go on where the one before it ends.
        known: whether it then starts with states that are given; with settled ones where not.
    """

    before: Motion
    after: Motion
    width: Float[np.ndarray | Array, "*intervals"]
    anew: Bool[np.ndarray | Array, "*intervals"]
    known: Bool[np.ndarray | Array, "*intervals"]


def own_states(
    seen: Along, stacked: Effect, proposals: int, before: Memory | None = None
) -> tuple[OwnStates, OwnStates]:
    """Own states at both ends of each sample interval.

    Args:
        seen: the motion.
        stacked: proposals of one form.
        proposals: how many.
        before: own states along stretches that these ones continue.
    """
    knots = np.asarray(seen.segments.torque.knots)[:, seen.segments.halo :]
    width = np.diff(knots)
    own = (len(stacked.states), proposals)
    anew, known, given = np.zeros(width.shape, bool), np.zeros(width.shape, bool), np.zeros((*width.shape, *own))
    anew[:, 0] = ~np.asarray(seen.goes_on)
    if before is not None:
        known[seen.firsts, 0], given[seen.firsts, 0] = True, before.at_ends
    sides = (slice(None, -1), slice(1, None))
    starts, ends = (jax.tree.map(lambda a, side=side: np.asarray(a)[:, side], seen.at_knots) for side in sides)
    intervals = _Intervals(starts, ends, width, anew, known)
    drive = functools.partial(_driven, stacked)
    start, end = through_instants(drive, jnp.asarray(np.zeros(own)), width.shape, intervals, given)
    return np.asarray(start), np.asarray(end)


def memory_of(seen: Along, start: OwnStates, end: OwnStates) -> Memory:
    """What own states at both ends of each interval leave for what comes after."""
    knots = np.concatenate([start, end[:, -1:]], axis=1)
    return Memory(start[:, 0], knots[seen.ends[:, 0], seen.ends[:, 1]])


def own_between(start: OwnStates, end: OwnStates) -> Float[np.ndarray, "segments samples nodes own proposals"]:
    """Own states at the nodes of each interval, in a straight line from its start to its end."""
    part = PART[..., None, None]
    return start[:, :, None] * (1.0 - part) + end[:, :, None] * part


@jit_small
def _driven(
    stacked: Effect,
    carried: Float[Array, "own proposals"],
    intervals: _Intervals,
    given: Float[Array, "intervals own proposals"],
) -> tuple[
    Float[Array, "own proposals"],
    tuple[Float[Array, "intervals own proposals"], Float[Array, "intervals own proposals"]],
]:
    """Own states after the last of some intervals, and at both ends of each."""

    def of(effect: Effect, own: Array, given: Array):
        def rate(own: Array, interval: _Intervals, passed: float) -> Array:
            between = jax.tree.map(lambda a, b: (1.0 - passed) * a + passed * b, interval.before, interval.after)
            return jnp.stack(list(effect.state_rates(between, own)))

        def step(own: Array, inputs: tuple[_Intervals, Array]):
            interval, given = inputs
            own = where(interval.anew, where(interval.known, given, effect.initial_state(interval.before)), own)
            start, part = own, 1.0 / _STEPS
            for i in range(_STEPS):
                h = part * interval.width
                k1 = rate(own, interval, i * part)
                k2 = rate(own + 0.5 * h * k1, interval, (i + 0.5) * part)
                k3 = rate(own + 0.5 * h * k2, interval, (i + 0.5) * part)
                k4 = rate(own + h * k3, interval, (i + 1) * part)
                own = own + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            return own, (start, own)

        return jax.lax.scan(step, own, (intervals, given))

    return jax.vmap(of, in_axes=(0, -1, -1), out_axes=-1)(stacked, carried, given)
