"""Free parameters of a fit, by dotted path, scaled to order one."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from fitting.record import Record
from hdjax import Drive, Model
from hdjax.drive import Prior
from hdjax.effects import Effect
from hdjax.effects.learned import FAMILY
from hdjax.parameters import own_parameters

# Bounds of a parameter that the data drive towards zero or infinity, far beyond where it has any influence.
LARGEST_LOG = 100.0


ModelT = TypeVar("ModelT", bound=Model)

MESH = ("K", "alpha", "B_sp")
"""Fitted parameters of the mesh."""


class FreeParameters(Record):
    """The parameters that a fit changes, as a vector of order one.

    A positive parameter is represented by its logarithm, any other in units of `scale`.

    Attributes:
        paths: dotted paths.
        logarithmic: which are represented by their logarithm.
        scale: unit of each of the others.
        centre: prior mean of each entry of the vector.
        precision: inverse of the prior's standard deviation; zero without a prior.
    """

    paths: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    scale: Float[Array, " parameters"]
    centre: Float[Array, " parameters"]
    precision: Float[Array, " parameters"]

    def off_prior(self, vector: Float[Array | np.ndarray, " parameters"]) -> Float[Array | np.ndarray, " parameters"]:
        """Deviation of each entry of a vector from its prior mean, in standard deviations."""
        return self.precision * (vector - self.centre)

    def pack(self, model: Model) -> Float[Array, " parameters"]:
        """The vector of the model's values."""
        return self._each(model, lambda library, v, positive, s: library.log(v) if positive else v / s)

    def _each(self, model: Model, entry: Callable[..., Any]) -> Float[Array, " parameters"]:
        """The array library, then for each parameter its value, whether it is logarithmic, and its unit."""
        values = model.values(self.paths)
        library, (*values, scale) = _library(*values, self.scale)
        with np.errstate(all="ignore"):
            entries = [entry(library, *own) for own in zip(values, self.logarithmic, scale, strict=True)]
        return jnp.asarray(library.stack(entries) if entries else np.zeros(0))

    def unpack(self, model: Model, vector: Float[Array | np.ndarray, " parameters"]) -> Model:
        """The model with the values of the vector."""
        if not self.paths:
            return model
        return model.replace(dict(zip(self.paths, self.values(vector), strict=True)))

    def values(self, vector: Float[Array | np.ndarray, " parameters"]) -> list[Any]:
        """The physical values of the vector."""
        library, (entries, scale) = _library(vector, self.scale)
        return [
            library.exp(library.clip(v, -LARGEST_LOG, LARGEST_LOG)) if positive else v * s
            for positive, v, s in zip(self.logarithmic, entries, scale, strict=True)
        ]

    def slopes(self, model: Model) -> Float[Array, " parameters"]:
        """Derivative of each physical value with respect to its entry of the vector."""
        return self._each(model, lambda library, v, positive, s: v if positive else s)


def _library(*arrays: Any) -> tuple[Any, Sequence[Any]]:
    """The array library and its arrays: JAX under tracing; numpy outside, where JAX would compile each operation."""
    if any(isinstance(array, Tracer) for array in arrays):
        return jnp, arrays
    return np, [np.asarray(array) for array in arrays]


def free_parameters(model: Model, paths: Sequence[str], scale: dict[str, float]) -> FreeParameters:
    """Free the parameters at `paths`.

    Args:
        model: supplies the current values.
        paths: dotted paths.
        scale: a typical magnitude for those that may be zero; the larger of it and the current value is the unit.

    Raises:
        ValueError: unknown path, or a positive parameter whose current value is not positive.
    """
    known = model.parameters()
    for path in paths:
        if path not in known:
            raise ValueError(f"`{path}` must be one of {sorted(known)}")
    logarithmic = tuple(known[p][1].positive for p in paths)
    values = [float(known[p][0]) for p in paths]
    for path, value, positive in zip(paths, values, logarithmic, strict=True):
        if positive and not value > 0:
            raise ValueError(f"`{path}` must be positive, but is {value}")
    units = [
        max(abs(v), scale.get(p, 0.0)) or 1.0 if math.isfinite(v) else 1.0 for p, v in zip(paths, values, strict=True)
    ]
    priors = {p.path: p for p in model.drive.priors} if isinstance(model.drive, Drive) else {}
    known_before = [priors.get(p, Prior(p, 1.0, math.inf)) for p in paths]
    centres, precisions = zip(*map(_of_prior, known_before, logarithmic, units), strict=True) if paths else ((), ())
    numbers = units, centres, precisions
    return FreeParameters(tuple(paths), logarithmic, *(jnp.asarray(np.array(n, dtype=float)) for n in numbers))


def _of_prior(prior: Prior, positive: bool, unit: float) -> tuple[float, float]:
    """Mean and precision of an entry of the vector."""
    return (math.log(prior.value), 1.0 / prior.tolerance) if positive else (prior.value / unit, unit / prior.tolerance)


def as_they_are(model: Model, paths: Sequence[str]) -> tuple[FreeParameters, Float[Array, " parameters"]]:
    """The parameters at `paths` neither scaled nor by their logarithm, and their values, equal to the last bit."""
    none = jnp.asarray(np.zeros(len(paths)))
    values = jnp.asarray(np.array([float(v) for v in model.values(paths)], dtype=float))
    return FreeParameters(tuple(paths), (False,) * len(paths), none + 1.0, none, none), values


def with_priors(model: ModelT, priors: tuple[Prior, ...]) -> ModelT:
    """The model of a drive with other priors."""
    assert isinstance(model.drive, Drive)
    return replace(model, drive=replace(model.drive, priors=priors))


def named(model: Model, paths: Sequence[str]) -> Bool[np.ndarray, " parameters"]:
    """Which parameters have a meaning of their own: coefficients of learned terms have none."""
    learned = {e.name for e in model.effects if e.family == FAMILY}
    return np.array([path.partition(".")[0] not in learned for path in paths], dtype=bool)


def base_paths(model: Model) -> tuple[str, ...]:
    """Fitted parameters of a drive without effects."""
    if isinstance(model.drive, Drive):
        return (*MESH, *(prior.path for prior in model.drive.priors if prior.path not in MESH))
    return ("mu", "omega_0", "alpha", "gain")


def effect_paths(effect: Effect) -> tuple[str, ...]:
    """Fitted parameters of an effect: strengths and shapes."""
    return tuple(f"{effect.name}.{n}" for n, i in own_parameters(effect) if i.role != "base")


def fitted_paths(model: Model) -> tuple[str, ...]:
    """Fitted parameters of a drive with its effects."""
    return sum((effect_paths(effect) for effect in model.effects), base_paths(model))


def strength_paths(effect: Effect) -> tuple[str, ...]:
    """Parameters of an effect that remove it when they are zero."""
    return tuple(f"{effect.name}.{n}" for n, i in own_parameters(effect) if i.role == "strength")
