"""Bristles that follow a motion and slip: the states behind Dahl, LuGre and Maxwell slip.

A bristle forgets the past within a path of its yield length: at a speed v it relaxes at the rate |v| / length, which no
explicit step of fixed size can follow where the length is short. So the rate is bounded by 1 / settling, with a
sampling interval for `settling`: steps up to three times that long stay stable, and those of a fit are accurate. A
bristle that yields within the path of one interval then is Coulomb friction that turns its sign within `settling`,
which is all that such a log can tell; a stiffness beyond it is not identifiable and makes no difference.
"""

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.where import where

SETTLING = "shortest time in which a bristle may slip through: a sampling interval"

_SHARPNESS = 4
"""Power of a slipping spring's corner: at |z| = 0.84 of the limit, half of the motion is slip."""


def bristle_rate(rate: Array, z: Array, limit: Array, settling: Array) -> Array:
    """`z' = rate - |rate| z / limit`, no faster than `settling` allows.

    Args:
        rate: of the motion that the bristle follows [rad/s].
        z: deflection [rad].
        limit: where it saturates [rad].
        settling: shortest time constant [s].
    """
    rate = _followed(rate, limit, settling)
    return rate - jnp.abs(rate) * z / limit


def slip_rate(rate: Array, z: Array, limit: Array, settling: Array) -> Array:
    """An elastoplastic element: `z' = rate` until |z| reaches the limit, then zero until the motion turns back.

    The slip sets in as `|z / limit|^4`, which has derivatives; arguments as in [`bristle_rate`][].
    """
    rate = _followed(rate, limit / _SHARPNESS, settling)
    share = z / limit
    slip = where(rate * share > 0.0, share**_SHARPNESS, 0.0)
    return rate * (1.0 - slip)


def _followed(rate: Array, length: Array, settling: Array) -> Array:
    """The rate, with a size below `length / settling`."""
    return rate / jnp.sqrt(1.0 + (rate * settling / length) ** 2)
