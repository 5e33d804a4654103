"""Terms locked to an angle, which several families share."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.elementary import cosine_and_sine, cosines_and_sines

Angle = Float[Array, "*n"]
Term = tuple[float | int | Array, Array, Array]
"""Order, and the amplitudes of its cosine and its sine."""


def ripple(angle: Angle, order: float | int | Array, cosine: Array, sine: Array) -> Angle:
    """`cosine cos(order angle) + sine sin(order angle)`."""
    return ripples(angle, [(order, cosine, sine)])


def ripple_slope(angle: Angle, order: float | int | Array, cosine: Array, sine: Array) -> Angle:
    """Derivative of [`ripple`][] with respect to the angle."""
    return ripple_slopes(angle, [(order, cosine, sine)])


def ripples(angle: Angle, terms: Sequence[Term]) -> Angle:
    """Sum of [`ripple`][] over several orders."""
    first, *others = (a * c + b * s for (_, a, b), (c, s) in zip(terms, _turned(angle, terms), strict=True))
    return sum(others, start=first)


def ripple_slopes(angle: Angle, terms: Sequence[Term]) -> Angle:
    """Derivative of [`ripples`][] with respect to the angle."""
    return ripples(angle, [(n, n * b, -n * a) for n, a, b in terms])


def _turned(angle: Angle, terms: Sequence[Term]) -> Sequence[tuple[Angle, Angle]]:
    """Cosine and sine of each order's angle."""
    orders = [n for n, _, _ in terms if isinstance(n, int)]
    if len(orders) == len(terms):
        return cosines_and_sines(angle, tuple(orders))
    return [cosine_and_sine(n * angle) for n, _, _ in terms]


def amplitude_and_phase(cosine: Array, sine: Array, unit: str, suffix: str = "") -> dict[str, tuple[Array, str]]:
    """`A` and `psi` of the same term as `A cos(order angle + psi)`, for `Effect.derived`."""
    return {
        f"amplitude{suffix}": (jnp.hypot(cosine, sine), unit),
        f"phase{suffix}": (jnp.arctan2(-sine, cosine), "rad"),
    }


def amplitudes_and_phases(terms: Sequence[Term], unit: str) -> dict[str, tuple[Array, str]]:
    """[`amplitude_and_phase`][] of several orders."""
    return {k: v for n, a, b in terms for k, v in amplitude_and_phase(a, b, unit, f"_{n}").items()}
