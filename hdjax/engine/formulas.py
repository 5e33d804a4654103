"""Functions of scalars, composed of operations of the graph."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from hdjax.where import where


@jax.custom_jvp
def power(base, exponent):
    """A power; NaN for a negative base, unless the exponent is whole."""
    at_zero = where(exponent > 0.0, 0.0, where(exponent == 0.0, 1.0, math.inf))
    size = where(base == 0.0, 1.0, jnp.abs(base))
    value = jnp.exp(exponent * jnp.log(size))
    odd = exponent - 2.0 * jnp.floor(0.5 * exponent) == 1.0
    of_negative = where(exponent == jnp.floor(exponent), where(odd, -value, value), math.nan)
    return where(base > 0.0, value, where(base == 0.0, at_zero, of_negative))


@power.defjvp
def _power_jvp(primals, tangents):
    (base, exponent), (moved, bent) = primals, tangents
    value = power(base, exponent)
    # The derivative of a zeroth power is zero, and so is that of a zero base.
    by_base = where(exponent == 0.0, 0.0, exponent * power(base, exponent - 1.0))
    by_exponent = jnp.log(where(base == 0.0, 1.0, jnp.abs(base))) * value
    return value, by_base * moved + by_exponent * bent


def with_slope(function: Callable[[Any], Any], slope: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
    """A function whose derivative is a formula of its argument and value, more accurate than that of its parts."""
    found = jax.custom_jvp(function)

    def rule(primals, tangents):
        value = found(*primals)
        return value, slope(primals[0], value) * tangents[0]

    found.defjvp(rule)
    return found


# Beyond it one is negligible beside the square of a number.
_HUGE = 1e100


def log1p(x):
    """ln(1 + x)."""
    # Kahan: corrects the rounding of 1 + x.
    u = 1.0 + x
    huge = u > _HUGE
    small = where((u == 1.0) | huge, 1.0, u - 1.0)
    return where(u == 1.0, x, jnp.log(u) * where(huge, 1.0, where(u == 1.0, 1.0, x) / small))


def asinh(x):
    """Inverse of `sinh`."""
    size = jnp.abs(x)
    huge = size > _HUGE
    a = where(huge, 1.0, size)
    near = log1p(a + a * a / (1.0 + jnp.sqrt(1.0 + a * a)))
    return jnp.sign(x) * where(huge, jnp.log(where(huge, size, 1.0)) + math.log(2.0), near)


def acosh(x):
    """Inverse of `cosh`."""
    huge = x > _HUGE
    a = where(huge, 2.0, x) - 1.0
    near = log1p(a + jnp.sqrt(a * (a + 2.0)))
    return where(huge, jnp.log(where(huge, x, 1.0)) + math.log(2.0), near)


def sinh(x):
    """Hyperbolic sine."""
    return 0.5 * (jnp.expm1(x) - jnp.expm1(-x))


def cosh(x):
    """Hyperbolic cosine."""
    return 0.5 * (jnp.exp(x) + jnp.exp(-x))


def arctangent(x):
    """Inverse of the tangent: by two halvings of the angle, then a series on tangents below tan(pi / 16)."""
    a = jnp.abs(x)
    large = a > 1.0
    t = where(large, 1.0 / where(large, a, 1.0), a)
    for _ in range(2):
        t = t / (1.0 + jnp.sqrt(1.0 + t * t))
    total = jnp.zeros_like(t)
    for k in range(13, -1, -1):
        total = total * (t * t) + (-1.0) ** k / (2 * k + 1)
    angle = 4.0 * t * total
    return jnp.sign(x) * where(large, math.pi / 2 - angle, angle)


@jax.custom_jvp
def arctangent2(y, x):
    """Angle of the point (x, y)."""
    swapped = jnp.abs(y) > jnp.abs(x)
    over, under = where(swapped, x, y), where(swapped, y, x)
    t = arctangent(over / where(under == 0.0, 1.0, under))
    right = where(swapped, where(y >= 0.0, math.pi / 2, -math.pi / 2) - t, t)
    turned = where(y >= 0.0, math.pi, -math.pi)
    return where(swapped | (x >= 0.0), right, right + turned)


@arctangent2.defjvp
def _arctangent2_jvp(primals, tangents):
    (y, x), (dy, dx) = primals, tangents
    square = x * x + y * y
    return arctangent2(y, x), dy * (x / square) - dx * (y / square)
