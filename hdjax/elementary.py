"""Elementary functions in plain arithmetic, which XLA vectorises on a processor.

XLA's own functions call a library lane by lane, which would dominate the time of a simulation.
"""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.where import where

Values = Float[Array, "*n"]

# A quarter turn in three parts (Cody and Waite 1980): the first two have few enough digits for up to 1e6 of them to be
# exact, the three together have more digits than a number.
_QUARTER_TURN = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
# Taylor's coefficients: on a sixteenth of a turn the first one left out is below the last digit.
_SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(7))
_COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(8))


@jax.custom_jvp
def cosine_and_sine(angle: Values) -> tuple[Values, Values]:
    """Cosine and sine [1], to the last digit up to a million quarter turns.

    Args:
        angle: in radians.
    """
    return _by_arithmetic(angle)


# Traced once for all callers.
@jax.jit
def _by_arithmetic(angle: Values) -> tuple[Values, Values]:
    turns = jnp.round(angle * (2.0 / math.pi))
    rest = angle
    for part in _QUARTER_TURN:
        rest = rest - turns * part
    half = 0.5 * rest
    tangent = half * _polynomial(_SINE, half * half) / _polynomial(_COSINE, half * half)
    # Of the rest, times `1 + tangent^2`. The division comes last: XLA keeps a quotient, and would compute a product
    # again for each direction of a derivative.
    cosine, sine, whole = 1.0 - tangent * tangent, 2.0 * tangent, 1.0 + tangent * tangent
    quarter = turns - 4.0 * jnp.floor(0.25 * turns)
    crossed = (quarter == 1.0) | (quarter == 3.0)
    along, across = where(crossed, sine, cosine), where(crossed, cosine, sine)
    return (
        where((quarter == 1.0) | (quarter == 2.0), -along, along) / whole,
        where(quarter >= 2.0, -across, across) / whole,
    )


@cosine_and_sine.defjvp
def _cosine_and_sine_jvp(primals, tangents):
    (angle,), (turned,) = primals, tangents
    cosine, sine = cosine_and_sine(angle)
    return (cosine, sine), (-sine * turned, cosine * turned)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def cosines_and_sines(angle: Values, orders: tuple[int, ...]) -> tuple[tuple[Values, Values], ...]:
    """Cosine and sine [1] of whole multiples of an angle, by rotation.

    Args:
        angle: in radians.
        orders: the multiples, from 1 on.
    """
    found = {1: cosine_and_sine(angle)}

    def of(order: int) -> tuple[Values, Values]:
        if order not in found:
            (c, s), (by_c, by_s) = of(order // 2), of(order - order // 2)
            found[order] = c * by_c - s * by_s, s * by_c + c * by_s
        return found[order]

    return tuple(of(order) for order in orders)


@cosines_and_sines.defjvp
def _cosines_and_sines_jvp(orders, primals, tangents):
    (angle,), (turned,) = primals, tangents
    found = cosines_and_sines(angle, orders)
    return found, tuple((-n * s * turned, n * c * turned) for n, (c, s) in zip(orders, found, strict=True))


def exponential(exponent: Values) -> Values:
    """`exp`, to the last digit of 1 where it is smaller."""
    return jnp.expm1(exponent) + 1.0


def power(base: Values, exponent: Values) -> Values:
    """`base ** exponent` of a positive base, to the last digit of 1 where it is smaller."""
    return exponential(exponent * jnp.log(base))


def _polynomial(coefficients: tuple[float, ...], x: Values) -> Values:
    """The polynomial with coefficients by rising power."""
    total = jnp.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total
