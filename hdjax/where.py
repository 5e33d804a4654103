"""A choice between two arrays, typed for checkers."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike


def where(condition: ArrayLike, x: ArrayLike, y: ArrayLike) -> Array:
    """`jax.numpy.where` of three arguments. That of one argument gives a tuple, and where a type is unknown a checker
    takes the one for the other."""
    return jnp.asarray(jnp.where(condition, x, y))
