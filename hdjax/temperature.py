"""Temperature dependence of mesh stiffness and damping."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.parameters import Scalar, as_scalar, parameter
from hdjax.where import where

_Drive = TypeVar("_Drive", Drive, ReducedDrive)

SOURCE = "EFFECTS.md, row `temperature`"


class TemperatureLaw(eqx.Module):
    """Mesh stiffness and damping at a temperature T, from a drive known at the reference T_0.

        K(T) = K (1 + k_T (T - T_0))        B_sp(T) = B_sp exp(-kappa (T - T_0))

    A reduced drive follows: `omega_0` goes with the root of the stiffness, `mu` with the damping; alpha and the
    inertias stay. A warmer drive is usually softer (`k_T` below zero, 1e-4 to 1e-3 per kelvin in size) and, as its
    lubricant thins, less damped (`kappa` above zero).

    References:
        Viscous friction that falls exponentially with temperature: Wolf and Iskandar, on joints with harmonic drives.
        The linear stiffness and its range are assumed; verify them on the drive.
    """

    k_T: Scalar = parameter(0.0, unit="1/K", doc="relative stiffness change per kelvin", source=SOURCE, role="strength")
    kappa: Scalar = parameter(0.0, unit="1/K", doc="decay of the damping per kelvin", source=SOURCE, role="strength")
    T_0: Scalar = parameter(293.15, unit="K", doc="temperature at which the drive is known", bounds=(0.0, 1e4))

    def stiffness_factor(self, temperature: ArrayLike) -> Scalar:
        """`K(T) / K`.

        Args:
            temperature: T [K].

        Raises:
            ValueError: where the law leaves no stiffness. Inside a transformation, which knows no values,
                equinox raises its runtime error with the same words.
        """
        factor = 1.0 + self.k_T * (as_scalar(temperature) - self.T_0)
        if isinstance(factor, Tracer):
            return eqx.error_if(factor, factor <= 0.0, "`k_T` must leave a positive stiffness at every temperature")
        if factor <= 0.0:
            raise ValueError(
                f"`k_T` must leave a positive stiffness at {temperature} K, but is {self.k_T} 1/K: K would be "
                f"{factor} times its value at {self.T_0} K"
            )
        return factor

    def damping_factor(self, temperature: ArrayLike) -> Scalar:
        """`B_sp(T) / B_sp` at the temperature T [K]."""
        return jnp.exp(-self.kappa * (as_scalar(temperature) - self.T_0))

    def at(self, drive: _Drive, temperature: ArrayLike) -> _Drive:
        """The drive at another temperature.

        Args:
            drive: the drive at `T_0`.
            temperature: T [K].

        Returns:
            A drive of the same kind.

        Raises:
            ValueError: see [`TemperatureLaw.stiffness_factor`][].
        """
        stiffness, damping = self.stiffness_factor(temperature), self.damping_factor(temperature)
        if isinstance(drive, Drive):
            return eqx.tree_at(lambda d: (d.K, d.B_sp), drive, (drive.K * stiffness, drive.B_sp * damping))
        warm = (drive.omega_0 * jnp.sqrt(stiffness), drive.mu * damping)
        return eqx.tree_at(lambda d: (d.omega_0, d.mu), drive, warm)

    def referred_to(self, temperature: ArrayLike) -> "TemperatureLaw":
        """The same law for a drive that is known at another temperature [K]; it leads back, too."""
        return TemperatureLaw(k_T=self.k_T / self.stiffness_factor(temperature), kappa=self.kappa, T_0=temperature)


class ResonanceDrift(eqx.Module):
    """The primary resonance over temperature.

    Attributes:
        temperature: T [K].
        omega_0: natural frequency [rad/s].
        mu: damping of the dynamic error [1/s].
        peak: amplitude at resonance, `A/(mu omega_0)` [rad, or a reduced drive's x].
    """

    temperature: Float[Array, " n"]
    omega_0: Float[Array, " n"]
    mu: Float[Array, " n"]
    peak: Float[Array, " n"]


def resonance_drift(
    drive: _Drive, law: TemperatureLaw, temperatures: Float[ArrayLike, " n"], *, forcing: ArrayLike
) -> ResonanceDrift:
    """Change of a drive's resonance with temperature.

    Args:
        drive: the drive at the law's reference temperature.
        law: of stiffness and damping.
        temperatures: T [K].
        forcing: amplitude A of the harmonic forcing of the dynamic error [rad/s^2], see [`Drive.error_forcing`][].

    Returns:
        Frequency, damping and peak at each temperature. An undamped drive has an infinite peak.

    Raises:
        ValueError: where the law leaves no stiffness at one of the temperatures.
    """
    temperatures = jnp.asarray(temperatures, dtype=float)
    if not isinstance(temperatures, Tracer):
        for temperature in (temperatures.min(), temperatures.max()):  # the law is linear: checking its ends suffices
            law.stiffness_factor(temperature)

    def resonance(temperature):
        warm = law.at(drive, temperature)
        return warm.omega_0, warm.mu

    omega_0, mu = jax.vmap(resonance)(temperatures)
    damped = mu > 0.0
    peak = where(damped, as_scalar(forcing) / (where(damped, mu, 1.0) * omega_0), jnp.inf)
    return ResonanceDrift(temperatures, omega_0, mu, peak)
