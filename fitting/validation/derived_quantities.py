"""Quantities derived from fitted ones, with standard errors propagated to first order."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import stdtrit

from fitting.uncertainty.standard_errors import Uncertainty
from hdjax import Drive, Model
from hdjax.engine.pointwise import at_instants, slopes_at_instants

Quantities = Mapping[str, tuple[Array, str]]
"""Value and unit by name."""


class Derived(eqx.Module):
    """A quantity derived from fitted ones.

    Attributes:
        value: in `unit`.
        std: standard error to first order.
        unit: SI unit.
        degrees_of_freedom: of Student's t behind the interval.
    """

    value: float
    std: float
    unit: str = eqx.field(static=True)
    degrees_of_freedom: float

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % interval."""
        half = float(stdtrit(self.degrees_of_freedom, 0.975)) * self.std
        return self.value - half, self.value + half


def derived(
    model: Model, known: Uncertainty, quantities: Callable[..., Quantities], *given: float | str
) -> dict[str, Derived]:
    """Quantities of a fitted model with their standard errors.

    Args:
        model: the fitted one.
        known: of its parameters.
        quantities: function of the model and `given` that returns value and unit of each.
        given: further arguments of that function.
    """
    estimates = known.estimates
    numbers = tuple(jnp.asarray(np.asarray(g)) if isinstance(g, float) else g for g in given)
    values = np.array([e.value for e in estimates.values()])
    told, slopes = _values_and_slopes(model, tuple(estimates), values, quantities, numbers)
    if not told:
        return {}
    spread = np.array([e.std for e in estimates.values()])
    with np.errstate(all="ignore"):
        scaled = slopes * spread
        variance = np.einsum("ip,pq,iq->i", scaled, np.asarray(known.correlation), scaled)
        errors = np.sqrt(variance)
    freedom = _degrees_of_freedom(scaled, np.array([e.degrees_of_freedom for e in estimates.values()]))
    return {
        name: Derived(float(value), float(error), unit, float(own))
        for (name, value, unit), error, own in zip(told, errors, freedom, strict=True)
    }


def _values_and_slopes(
    model: Model,
    paths: tuple[str, ...],
    values: np.ndarray,
    quantities: Callable[..., Quantities],
    given: tuple[Any, ...],
) -> tuple[list[tuple[str, float, str]], np.ndarray]:
    """Name, value and unit of each quantity, and derivatives of the values by the parameters at `paths`."""
    units: dict[str, str] = {}

    def look_up(model: Model) -> None:
        units.update({name: unit for name, (_, unit) in quantities(model, *given).items()})

    jax.eval_shape(look_up, model)
    posed = (values, 0), ((model, paths, quantities, given), 0)
    found, slopes = at_instants(_values, *posed), slopes_at_instants(_values, *posed)
    return [(name, float(value), unit) for value, (name, unit) in zip(found, units.items(), strict=True)], slopes


def _values(vector: Array, posed: tuple[Model, tuple[str, ...], Callable[..., Quantities], tuple[Any, ...]]) -> Array:
    model, paths, quantities, given = posed
    moved = model.replace({p: vector[i] for i, p in enumerate(paths)})
    values = [value for value, _ in quantities(moved, *given).values()]
    return jnp.stack(values) if values else jnp.zeros(0)


def _degrees_of_freedom(
    scaled: Float[np.ndarray, "quantities parameters"], own: Float[np.ndarray, " parameters"]
) -> Float[np.ndarray, " quantities"]:
    """Degrees of freedom of each quantity's variance, from the parameters' own and what they contribute to the error.

    The harmonic mean, weighted by the parameters' shares of the sum of squared contributions. Exact for one parameter
    or equal degrees, and below Satterthwaite's for independent errors.
    """
    with np.errstate(all="ignore"):
        shares = scaled**2 / np.sum(scaled**2, axis=1, keepdims=True)
        freedom = 1.0 / (shares @ (1.0 / own))
    # A quantity that depends on no fitted parameter is certain.
    return np.where(np.isnan(freedom), np.inf, freedom)


def effect_figures(model: Model, name: str) -> Quantities:
    """Derived quantities of an effect.

    Args:
        model: with the effect.
        name: of the effect.
    """
    return model.effect(name).derived(model.drive)


def drive_figures(model: Model, x_max: float | Array) -> dict[str, tuple[Array, str]]:
    """Derived quantities of a drive.

    Args:
        model: the drive.
        x_max: the largest twist.

    Returns:
        Natural frequency (`omega_0` in rad/s, `natural_frequency` in Hz), `mu`, damping ratio `zeta`, the nonlinear
        share of the restoring torque at full twist alpha x_max^2, and the slope of the restoring torque there.
        Parameters of the model itself are omitted.
    """
    drive = model.drive
    full = drive.alpha * x_max**2
    figures = {
        "omega_0": (drive.omega_0, "rad/s"),
        "natural_frequency": (drive.omega_0 / (2 * math.pi), "Hz"),
        "mu": (drive.mu, "1/s"),
        "zeta": (drive.mu / (2 * drive.omega_0), "1"),
        "nonlinear_share": (full, "1"),
        "stiffness_at_full_twist": (
            drive.stiffness * (1 + 3 * full),
            "N m/rad" if isinstance(drive, Drive) else "1/s^2",
        ),
    }
    return {name: figure for name, figure in figures.items() if name not in model.parameters()}
