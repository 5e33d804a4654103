"""Measures of a design: differentiable functions of a case."""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from hdjax.design.case import Case
from hdjax.parameters import Scalar, as_scalar


def number(default: float | None = None) -> Any:
    """Declare a numeric field of a measure. It is data: another value needs no compilation."""
    if default is None:
        return eqx.field(converter=as_scalar)
    return eqx.field(converter=as_scalar, default=default)


class Measure(eqx.Module):
    """A pure, differentiable function of a [`Case`][]; its fields are its settings.

    If it does not exist (for example without a steady motion), it is NaN, and a search avoids the design.
    """

    name: eqx.AbstractClassVar[str]
    unit: eqx.AbstractClassVar[str]
    says: eqx.AbstractClassVar[str]

    @abc.abstractmethod
    def __call__(self, case: Case) -> Float[Array, ""]:
        """The value, in `unit`."""

    def refuse(self, case: Case) -> None:  # noqa: B027 (most measures take any case)
        """Refuse a case that can't be measured.

        Raises:
            ValueError: states the reason.
        """


class SpeedRange(Measure):
    """A measure over forcing frequencies, or motor speeds, from `slow` to `fast`."""

    slow: eqx.AbstractVar[Scalar]
    fast: eqx.AbstractVar[Scalar]

    def refuse(self, case: Case) -> None:
        if not 0.0 < self.slow < self.fast:
            raise ValueError(
                f"`{self.name}` must have 0 < slow < fast, but runs from {self.slow:g} to {self.fast:g} rad/s"
            )
