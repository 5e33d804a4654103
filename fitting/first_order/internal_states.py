"""Hidden states of effects along a motion: in steady state at its start, then driven by it."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from fitting.first_order.motion import PART, Along
from hdjax.effects import Effect, Motion
from hdjax.engine import unusable
from hdjax.engine.driven import own_states_along
from hdjax.engine.pointwise import at_instants

OwnStates = Float[np.ndarray, "segments knots proposals own"]
"""Hidden states of each proposal at each knot."""


class Memory(eqx.Module):
    """An effect's hidden states at starts and ends, for each proposal.

    Attributes:
        at_starts: at each segment's start.
        at_ends: at each stretch's end.
    """

    at_starts: Float[np.ndarray, "segments own proposals"]
    at_ends: Float[np.ndarray, "stretches own proposals"]


def own_states(seen: Along, stacked: Effect, proposals: int, before: Memory | None = None) -> OwnStates:
    """Hidden states at each knot.

    Args:
        seen: the motion.
        stacked: proposals of one form, along the first axis of each array.
        proposals: their number.
        before: hidden states along the preceding stretches.
    """
    width = seen.segments.width
    segments, samples = width.shape
    motion = jax.tree.map(np.asarray, seen.at_knots)
    # A segment that is not joined does not start at the final state of the preceding one.
    before_each, after_each = (
        jax.tree.map(lambda a, side=side: a[:, side], motion) for side in (slice(-1), slice(1, None))
    )
    first = jax.tree.map(lambda a: a[:, 0], motion)
    each = jax.tree.map(lambda a: a[:, None], stacked)
    # A copy: what JAX computed is read-only.
    given = np.array(np.swapaxes(at_instants(_settled, (each, 2), (first, 1)), 0, 1))
    if before is not None:
        given[seen.firsts] = np.swapaxes(before.at_ends, 1, 2)
    found = np.empty((segments, samples + 1, *given.shape[1:]))
    starts = np.flatnonzero(~np.asarray(seen.segments.goes_on))
    lengths = np.diff(np.append(starts, segments))
    for length in np.unique(lengths):
        # Joined segments form one chain.
        own = starts[lengths == length][:, None] + np.arange(length)

        def joined(intervals: np.ndarray, own: np.ndarray = own) -> np.ndarray:
            return intervals[own].reshape(len(own), -1)

        states = own_states_along(
            stacked,
            jax.tree.map(joined, before_each),
            jax.tree.map(joined, after_each),
            joined(width),
            given[own[:, 0]],
            by_machine_code=unusable() is None,
        )
        for i in range(length):
            found[own[:, i]] = states[:, i * samples : (i + 1) * samples + 1]
    return found


def _settled(effect: Effect, motion: Motion) -> Array:
    return effect.initial_state(motion)


def memory_of(seen: Along, states: OwnStates) -> Memory:
    """Hidden states at starts and ends."""
    ends = states[seen.ends[:, 0], seen.ends[:, 1]]
    return Memory(np.swapaxes(states[:, 0], 1, 2), np.swapaxes(ends, 1, 2))


def own_between(states: OwnStates) -> Float[np.ndarray, "proposals segments samples nodes own"]:
    """Hidden states at the nodes of each interval, by linear interpolation."""
    by_proposal = np.moveaxis(states, 2, 0)[..., None, :]
    part = PART[:, None]
    return by_proposal[:, :, :-1] * (1.0 - part) + by_proposal[:, :, 1:] * part
