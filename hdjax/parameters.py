"""Physical parameters: fields that carry their unit, bounds and source, and have one dotted path everywhere."""

import dataclasses
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

if TYPE_CHECKING:
    # Numbers go in and arrays come out (a converter stands between), which a type checker can't follow.
    Scalar = Any
else:
    Scalar = Float[Array, ""]
Role = Literal["base", "strength", "shape"]


@dataclasses.dataclass(frozen=True)
class ParameterInfo:
    """What is known of a parameter apart from its value.

    Attributes:
        unit: SI unit as text, for instance `"N m/rad"`.
        doc: one line that says what it is.
        source: paper, table or equation behind its law or magnitude; `"assumed"` where there is none.
        bounds: open interval of values that make physical sense.
        plausible: magnitudes that real drives show, lowest and highest; evidence for a reader, no bound of a fit.
        role: `"base"` for the drive itself, `"strength"` for a parameter whose zero removes the effect,
            `"shape"` for one that only shapes an effect that is there.
    """

    unit: str
    doc: str
    source: str
    bounds: tuple[float, float]
    plausible: tuple[float, float]
    role: Role

    def implausibly_large(self, value: float) -> bool:
        """Whether the value's magnitude is above what real drives show. (A small one only is weak.)"""
        return abs(value) > self.plausible[1]

    @property
    def positive(self) -> bool:
        """Whether only values above zero make sense."""
        return self.bounds[0] == 0.0


def as_scalar(value: Any) -> Array:
    """Turn a number into a floating-point scalar array of JAX's default precision."""
    # Arrays that are one stay as they are; from numbers by way of numpy, since JAX would compile a program for them.
    if isinstance(value, jax.Array) and value.dtype == np.dtype(jnp.result_type(float)):
        return value
    return jnp.asarray(np.asarray(value) if isinstance(value, float | int) else value, dtype=float)


def _as_scalars(values: Any) -> tuple[Array, ...]:
    return tuple(as_scalar(value) for value in values)


def parameter(
    default: float | None = None,
    *,
    unit: str,
    doc: str,
    source: str = "assumed",
    bounds: tuple[float, float] = (-math.inf, math.inf),
    plausible: tuple[float, float] = (0.0, math.inf),
    role: Role = "base",
    several: bool = False,
) -> Any:
    """Declare a field of an equinox module as a physical parameter.

    Args:
        default: value where the user gives none.
        unit: SI unit as text.
        doc: one line that says what it is.
        source: where the law or the magnitude comes from.
        bounds: open interval of sensible values; a lower bound of 0 makes the fitter work on its logarithm.
        role: see [`ParameterInfo`][].
        several: whether the field holds any number of such parameters, which are then called `field_0`, `field_1`, ...

    Returns:
        A dataclass field.
    """
    info = ParameterInfo(unit=unit, doc=doc, source=source, bounds=bounds, plausible=plausible, role=role)
    options: dict[str, Any] = {
        "converter": _as_scalars if several else as_scalar,
        "metadata": {"parameter": info, "several": several},
        "kw_only": True,
    }
    if default is not None:
        options["default"] = default
    return eqx.field(**options)


def own_parameters(module: eqx.Module) -> Iterator[tuple[str, ParameterInfo]]:
    """The parameters that a module declares itself, as (name, info)."""
    for field in dataclasses.fields(module):
        info = field.metadata.get("parameter")
        if info is None:
            continue
        if field.metadata["several"]:
            yield from ((f"{field.name}_{i}", info) for i in range(len(getattr(module, field.name))))
        else:
            yield field.name, info


def own_value(module: eqx.Module, name: str) -> Any:
    """The value of one of [`own_parameters`][]."""
    if name in {field.name for field in dataclasses.fields(module)}:
        return getattr(module, name)
    stem, _, index = name.rpartition("_")
    return getattr(module, stem)[int(index)]
