"""Design variables, each between two bounds."""

from collections.abc import Sequence
from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdjax.parameters import Scalar, as_scalar

Spacing = Literal["linear", "log"]
SPACINGS: tuple[Spacing, ...] = get_args(Spacing)


class Variable(eqx.Module):
    """A design variable.

    Attributes:
        path: of the parameter that it sets, such as `"B_sp"`, `"kinematic_error.cos_2"` or `"forcing.omega"`; any name
            that the study's maker supports.
        low: lower bound.
        high: upper bound.
        spacing: scale of the search, which does not affect the optimum.
    """

    path: str = eqx.field(static=True)
    low: Scalar = eqx.field(converter=as_scalar)
    high: Scalar = eqx.field(converter=as_scalar)
    spacing: Spacing = eqx.field(static=True, default="linear")

    def __check_init__(self):
        low, high = float(self.low), float(self.high)
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise ValueError(f"`{self.path}` must have a range that rises, but it runs from {low:g} to {high:g}")
        if self.spacing not in SPACINGS:
            raise ValueError(f"`{self.path}` must have a spacing of {SPACINGS}, but has {self.spacing!r}")
        if self.spacing == "log" and low <= 0.0:
            raise ValueError(f"`{self.path}` must start above zero for a log spacing, but starts at {low:g}")

    def value(self, share: Array | np.ndarray) -> Array:
        """The value at a share of the range, 0 at `low` and 1 at `high`."""
        if self.spacing == "log":
            return self.low * jnp.exp(share * jnp.log(self.high / self.low))
        return self.low + share * (self.high - self.low)

    def share(self, value: float) -> Array:
        """The share of the range at which a value lies."""
        if self.spacing == "log":
            return jnp.log(value / self.low) / jnp.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def rate(self, share: Array) -> Array:
        """Derivative of the value by the share."""
        return self.value(share) * jnp.log(self.high / self.low) if self.spacing == "log" else self.high - self.low


def values(variables: Sequence[Variable], shares: Float[Array, " variables"]) -> dict[str, Array]:
    """Values by path at shares of the ranges."""
    return {v.path: v.value(shares[i]) for i, v in enumerate(variables)}
