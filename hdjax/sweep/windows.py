"""Results of a lane: its motion at the ends of equal windows, and the largest twist in each."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.where import where

_NEWTON_STEPS = 2


class Windows(eqx.Module):
    """A motion by windows.

    Attributes:
        x: twist at each window's end [rad].
        v: its rate there [rad/s].
        peak: largest |x| in each window [rad]; zero where it was not computed.
    """

    x: Float[Array, "*lanes windows"]
    v: Float[Array, "*lanes windows"]
    peak: Float[Array, "*lanes windows"]


def largest_between(
    start: tuple[Array, Array, Array], end: tuple[Array, Array, Array], h: Array
) -> Float[Array, "*lanes"]:
    """Largest |x| of the quintic through twist, rate and acceleration at both ends of a step.

    Where the rate changes sign within the step, the turning point is where the cubic through the rates and
    accelerations is zero.

    Args:
        start: x, x' and x'' at the start.
        end: likewise at the end.
        h: width of the step [s].
    """
    (x0, v0, a0), (x1, v1, a1) = start, end
    turns = v0 * v1 < 0.0
    difference = where(turns, v0 - v1, 1.0)
    s = where(turns, v0 / difference, 0.0)
    d0, d1 = h * a0, h * a1
    c2, c3 = 3.0 * (v1 - v0) - 2.0 * d0 - d1, 2.0 * (v0 - v1) + d0 + d1
    for _ in range(_NEWTON_STEPS):
        slope = d0 + s * (2.0 * c2 + s * 3.0 * c3)
        value = v0 + s * (d0 + s * (c2 + s * c3))
        s = jnp.clip(s - value / where(slope == 0.0, 1.0, slope), 0.0, 1.0)
    jump = x1 - x0
    p0, p1, q0, q1 = h * v0, h * v1, 0.5 * h * h * a0, 0.5 * h * h * a1
    c3 = 10.0 * jump - 6.0 * p0 - 4.0 * p1 - 3.0 * q0 + q1
    c4 = -15.0 * jump + 8.0 * p0 + 7.0 * p1 + 3.0 * q0 - 2.0 * q1
    c5 = 6.0 * jump - 3.0 * (p0 + p1) - q0 + q1
    top = x0 + s * (p0 + s * (q0 + s * (c3 + s * (c4 + s * c5))))
    return jnp.maximum(jnp.maximum(jnp.abs(x0), jnp.abs(x1)), where(turns, jnp.abs(top), 0.0))
