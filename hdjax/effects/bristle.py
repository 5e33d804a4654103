"""Bristles that follow a motion and slip: the states behind Dahl, LuGre and Maxwell slip.

A bristle forgets the past within a path of its yield length: at a speed v it relaxes at the rate |v| / length, which no
explicit step of fixed size can follow where the length is short. So the rate is bounded by 1 / settling: the longest
step that is integrated safely is about three times that time. A bristle that yields within the path of one step then
is Coulomb friction that turns its sign within `settling`, which is all that such a step can tell.
"""

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.where import where

SETTLING = "shortest time in which a bristle may slip through: 0.4 sampling intervals"

_SHARPNESS = 8
"""Power of a slipping spring's corner: at |z| = 0.9 of the yield, half of the motion is slip."""


def bristle_rate(rate: Array, z: Array, limit: Array, settling: Array) -> Array:
    """`z' = rate - |rate| z / limit`, no faster than `settling` allows.

    Args:
        rate: of the motion that the bristle follows [rad/s].
        z: deflection [rad].
        limit: where it saturates [rad].
        settling: shortest time constant [s].
    """
    return (limit * rate - jnp.abs(rate) * z) / (limit + jnp.abs(rate) * settling)


def slip_rate(rate: Array, z: Array, limit: Array, settling: Array) -> Array:
    """An elastoplastic element: `z' = rate` until |z| reaches the limit, then zero until the motion turns back.

    The slip sets in as `|z / limit|^8`, which has derivatives; arguments as in [`bristle_rate`][].
    """
    share = z / limit
    outwards = rate * share > 0.0
    # The squares keep the power differentiable at zero.
    slip = where(outwards, (share * share) ** (_SHARPNESS // 2), 0.0)
    return rate * (1.0 - slip) / (1.0 + _SHARPNESS * slip * jnp.abs(rate) * settling / limit)
