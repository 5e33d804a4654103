"""What several families share: a term that is locked to an angle."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.elementary import cosine_and_sine

Angle = Float[Array, "*n"]


def ripple(angle: Angle, order: float | int | Array, cosine: Array, sine: Array) -> Angle:
    """`cosine cos(order angle) + sine sin(order angle)`."""
    along, across = cosine_and_sine(order * angle)
    return cosine * along + sine * across


def ripple_slope(angle: Angle, order: float | int | Array, cosine: Array, sine: Array) -> Angle:
    """Derivative of [`ripple`][] with respect to the angle."""
    return order * ripple(angle, order, sine, -cosine)


def amplitude_and_phase(cosine: Array, sine: Array, unit: str, suffix: str = "") -> dict[str, tuple[Array, str]]:
    """`A` and `psi` of the same term as `A cos(order angle + psi)`, for `Effect.derived`."""
    return {
        f"amplitude{suffix}": (jnp.hypot(cosine, sine), unit),
        f"phase{suffix}": (jnp.arctan2(-sine, cosine), "rad"),
    }
