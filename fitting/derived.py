"""Quantities that follow from fitted ones, with standard errors propagated to first order."""

import math
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from fitting.compare import Account
from fitting.normal_law import NORMAL_95
from hdjax import Drive, Model

Quantities = Mapping[str, tuple[Array, str]]
"""Value and unit by name."""


class Derived(eqx.Module):
    """A quantity that follows from fitted ones.

    Attributes:
        value: in `unit`.
        std: standard error to first order.
        unit: SI unit.
    """

    value: float
    std: float
    unit: str = eqx.field(static=True)

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % interval."""
        half = NORMAL_95 * self.std
        return self.value - half, self.value + half


def derived(account: Account, quantities: Callable[[Model], Quantities]) -> dict[str, Derived]:
    """Quantities of a fitted model with their standard errors.

    Args:
        account: the fitted model's.
        quantities: value and unit of each, as a function of the model.
    """
    model, estimates = account.model, account.uncertainty.estimates
    known = quantities(model)
    if not known:
        return {}
    paths = list(estimates)

    def values(vector: Array) -> Array:
        moved = model.replace({p: vector[i] for i, p in enumerate(paths)})
        return jnp.stack([value for value, _ in quantities(moved).values()])

    slopes = np.asarray(jax.jacfwd(values)(jnp.asarray([e.value for e in estimates.values()], dtype=float)))
    spread = np.array([e.std for e in estimates.values()])
    with np.errstate(all="ignore"):
        scaled = slopes * spread
        variance = np.einsum("ip,pq,iq->i", scaled, np.asarray(account.uncertainty.correlation), scaled)
        errors = np.sqrt(variance)
    return {
        name: Derived(float(value), float(error), unit)
        for (name, (value, unit)), error in zip(known.items(), errors, strict=True)
    }


def drive_figures(model: Model, x_max: float) -> dict[str, tuple[Array, str]]:
    """What engineers use of a drive beside its parameters.

    Args:
        model: the drive.
        x_max: the largest twist.

    Returns:
        Natural frequency (`omega_0` in rad/s, `natural_frequency` in Hz), `mu`, damping ratio `zeta`, the nonlinear
        share of the restoring torque at full twist alpha x_max^2, and the slope of the restoring torque there. What
        is a parameter of the model itself is left out.
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
