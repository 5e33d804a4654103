"""Bristles that follow a motion and slip: the hidden states of Dahl, LuGre and Maxwell slip.

A bristle forgets the past within a path of its yield length: at a speed v it relaxes at the rate |v| / length, which no
explicit step of fixed size can follow where the length is short. So the rate is bounded by 1 / settling: steps up to
2.8 times that long stay stable. A bristle that yields within a much shorter path is then Coulomb friction that reverses
within `settling`. A larger stiffness is not identifiable and has no effect.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from hdjax.where import where

SETTLING = "shortest time in which a bristle may slip through: a quarter of a sampling interval"
SETTLING_SHARE = 0.25
"""Of a sampling interval. With a whole one, Dahl hysteresis that yields within an interval got a second form beside it,
and K was 4 standard errors off; with a quarter it is one form, and 1.3 (`benchmarks/undeclared`, seed 684, pair-10)."""


def bristle_rate(rate: Array, z: Array, limit: Array, settling: Array) -> Array:
    """`z' = rate - |rate| z / limit`, no faster than `settling` allows.

    Args:
        rate: of the motion that the bristle follows [rad/s].
        z: deflection [rad].
        limit: where it saturates [rad].
        settling: shortest time constant [s].
    """
    # No quotients: each would be one more division for every direction of a derivative.
    by_limit = 1.0 / limit
    # Of a size below `limit / settling`; of the eighth order, so that slower motions are hardly slowed down.
    eighth = jnp.square(jnp.square(jnp.square(rate * (settling * by_limit))))
    rate = rate * jax.lax.rsqrt(jnp.sqrt(jnp.sqrt(1.0 + eighth)))
    return rate - jnp.abs(rate) * z * by_limit


def slip_rate(rate: Array, z: Array, limit: Array, settling: Array) -> Array:
    """An element that sticks and slips: `z' = rate` within the limit; what lies beyond it goes within `settling`.

    The spring's deflection is z cut at the limit: while the motion goes on, z runs ahead of it by no more than the
    path of one `settling`, from where it comes back as the motion slows down (a plastic element with a little
    viscosity, after Perzyna 1966). The corner stays sharp, and steps of up to two settling times resolve it. Arguments
    as in [`bristle_rate`][].
    """
    return rate - (z - kept_within(z, limit)) * (1.0 / settling)


def kept_within(z: Array, limit: Array) -> Array:
    """z, cut at the limit on both sides.

    Args:
        z: any number.
        limit: positive.
    """
    # A choice: what `clip` has for derivatives counts how many of its arguments are equal, with a division each.
    return where(z > limit, limit, where(z < -limit, -limit, z))
