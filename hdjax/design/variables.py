"""What a design may choose, each between two bounds."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

Spacing = Literal["linear", "log"]
SPACINGS: tuple[Spacing, ...] = get_args(Spacing)


@dataclasses.dataclass(frozen=True)
class Variable:
    """One number that a design may choose.

    Attributes:
        path: of the parameter that it sets, such as `"B_sp"`, `"kinematic_error.cos_2"` or `"forcing.omega"`; any name
            that the study's maker knows.
        low: lower bound.
        high: upper bound.
        spacing: the scale on which it is searched, which is a matter of the search and not of the answer.
    """

    path: str
    low: float
    high: float
    spacing: Spacing = "linear"

    def __post_init__(self):
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"`{self.path}` must have a range that rises, but it runs from {self.low} to {self.high}")
        if self.spacing not in SPACINGS:
            raise ValueError(f"`{self.path}` must have a spacing of {SPACINGS}, but has {self.spacing!r}")
        if self.spacing == "log" and self.low <= 0.0:
            raise ValueError(f"`{self.path}` must start above zero for a log spacing, but starts at {self.low}")

    def value(self, share: Array) -> Array:
        """The value at a share of the range, 0 at `low` and 1 at `high`."""
        if self.spacing == "log":
            return self.low * jnp.exp(share * math.log(self.high / self.low))
        return self.low + share * (self.high - self.low)

    def share(self, value: float) -> float:
        """The share of the range at which a value lies."""
        if self.spacing == "log":
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


def values(variables: Sequence[Variable], shares: Float[Array, " variables"]) -> dict[str, Array]:
    """Values by path at shares of the ranges."""
    return {v.path: v.value(shares[i]) for i, v in enumerate(variables)}
