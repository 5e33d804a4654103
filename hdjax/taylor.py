"""Taylor series in time."""

from collections.abc import Callable, Sequence

import jax
from jaxtyping import Array


def taylor(derivatives: Sequence[Array], time: Array) -> Array:
    """A function of time by its Taylor polynomial.

    Args:
        derivatives: its value, and its derivatives from the first one on, now.
        time: from now [s].
    """
    found = derivatives[-1]
    for order in reversed(range(len(derivatives) - 1)):
        found = derivatives[order] + time / (order + 1) * found
    return found


def time_derivative(function: Callable[..., Array]) -> Callable[..., Array]:
    """The derivative by time of a function of a quantity and of its first derivatives; it takes one of these more."""
    return lambda *moving: jax.jvp(function, moving[:-1], moving[1:])[1]
