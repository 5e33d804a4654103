"""Physical parameters: fields with unit, bounds and source, and one dotted path everywhere."""

import dataclasses
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

if TYPE_CHECKING:
    # A converter turns numbers into arrays, which a type checker can't follow.
    Scalar = Any
else:
    Scalar = Float[Array, ""]
Role = Literal["base", "strength", "shape"]


@dataclasses.dataclass(frozen=True)
class ParameterInfo:
    """Metadata of a parameter.

    Attributes:
        unit: SI unit as text, for instance `"N m/rad"`.
        doc: its meaning in one line.
        source: paper, table or equation behind its law or magnitude; `"assumed"` where there is none.
        bounds: open interval of physical values.
        plausible: range of magnitudes of real drives, for information; not a bound of a fit.
        role: `"base"` for the drive itself, `"strength"` for a parameter whose zero removes the effect, `"shape"` for
            other parameters of an effect.
    """

    unit: str
    doc: str
    source: str
    bounds: tuple[float, float]
    plausible: tuple[float, float]
    role: Role

    def implausibly_large(self, value: float) -> bool:
        """Whether the value's magnitude exceeds that of real drives. (A small value is a weak effect.)"""
        return abs(value) > self.plausible[1]

    @property
    def positive(self) -> bool:
        """Whether only positive values are physical."""
        return self.bounds[0] >= 0.0


def as_scalar(value: Any) -> Array:
    """Turn a number into a floating-point scalar array of JAX's default precision."""
    # Suitable arrays are unchanged; numbers are converted by numpy, since JAX would compile a program.
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
        default: default value.
        unit: SI unit as text.
        doc: its meaning in one line.
        source: of the law or the magnitude.
        bounds: open interval of physical values; with a lower bound of 0 the logarithm is fitted.
        role: see [`ParameterInfo`][].
        several: whether the field has any number of such parameters, named `field_0`, `field_1`, ... ...

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


def refuse_unphysical(module: eqx.Module) -> None:
    """Refuse parameters that no drive has; tracers of JAX have no value yet, and pass.

    Args:
        module: with numbers for parameters.

    Raises:
        ValueError: A parameter is not above its lower bound, or no finite number.
    """
    for name, info in own_parameters(module):
        value, low = own_value(module, name), info.bounds[0]
        if not isinstance(value, Tracer) and not np.all((np.asarray(value) > low) & np.isfinite(value)):
            range_ = "a finite number" if math.isinf(low) else f"above {low:g} {info.unit}"
            raise ValueError(f"`{name}` must be {range_}, but is {value}")
