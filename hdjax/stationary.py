"""Stationary distributions of a drive's motion under random torque."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.noise import root
from hdjax.parameters import as_scalar
from hdjax.where import where


class StationaryVariance(eqx.Module):
    """Variances of a stationary motion under noise.

    Attributes:
        x: variance of the dynamic error [rad^2].
        v: variance of its rate [rad^2/s^2].
    """

    x: Array
    v: Array


def stationary_density(
    drive: Drive | ReducedDrive, S: ArrayLike, x: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
) -> Float[Array, "*shape"]:
    """Stationary probability density of dynamic error and rate under white noise.

        p(x, v) ~ exp(-2 mu H/S)        H = v^2/2 + omega_0^2 (x^2/2 + alpha x^4/4)

    is the exact solution of the Fokker-Planck equation of `x'' + mu x' + omega_0^2 (x + alpha x^3) = w(t)`. It says
    that x and v are independent at the same time, and that v is Gaussian however nonlinear the stiffness.

    Args:
        drive: a drive without effects; either kind.
        S: intensity of the forcing of the dynamic error [rad^2/s^3], see [`WhiteNoise.error_intensity`][].
        x: dynamic error [rad].
        v: its rate [rad/s].

    Returns:
        Density [s/rad^2], normalised to one.

    Raises:
        ValueError: where no such law exists: without noise, damping or stiffness, or with a negative alpha, for
            which noise sooner or later takes the drive over the saddle, and away. Inside a transformation, which knows
            no values, the density is zero there: all has gone.

    References:
        Caughey, J. Acoust. Soc. Am. 35 (1963) 1683; Risken, The Fokker-Planck Equation, 2nd ed., section 10.2.
    """
    x, v = jnp.asarray(x, dtype=float), jnp.asarray(v, dtype=float)
    gibbs = _gibbs(drive, S, noiseless=False)
    # Far out the density is zero before its exponents overflow.
    u = jnp.clip(x / (gibbs.sigma * jnp.sqrt(gibbs.harmonic)), -1e3, 1e3)
    rate = jnp.clip(v / (gibbs.sigma * gibbs.omega_0), -1e3, 1e3)
    nodes, width = _nodes()
    norm = gibbs.sigma * jnp.sqrt(gibbs.harmonic) * width * jnp.sum(gibbs.weight(nodes))
    norm = norm * gibbs.sigma * gibbs.omega_0 * np.sqrt(2.0 * np.pi)
    return where(gibbs.exists, gibbs.weight(u) * jnp.exp(-(rate**2) / 2.0) / norm, 0.0)


def stationary_variance(drive: Drive | ReducedDrive, S: ArrayLike) -> StationaryVariance:
    """Exact stationary variances of dynamic error and rate under white noise.

    For alpha = 0 they are `S/(2 mu omega_0^2)` and `S/(2 mu)`. Differentiable with respect to drive and S.

    Args:
        drive: a drive without effects; either kind.
        S: intensity of the forcing of the dynamic error [rad^2/s^3], see [`WhiteNoise.error_intensity`][].

    Raises:
        ValueError: where there is none, see [`stationary_density`][], though without noise both are zero. Inside a
            transformation, which knows no values, both are infinite there.
    """
    gibbs = _gibbs(drive, S, noiseless=True)
    nodes, _ = _nodes()
    weights = gibbs.weight(nodes)
    variance = gibbs.sigma_2 * gibbs.harmonic * jnp.sum(nodes**2 * weights) / jnp.sum(weights)
    return StationaryVariance(
        x=where(gibbs.exists, variance, jnp.inf),
        v=where(gibbs.exists, gibbs.sigma_2 * gibbs.omega_0**2, jnp.inf),
    )


def linearised_variance(drive: Drive | ReducedDrive, S: ArrayLike) -> StationaryVariance:
    """Variances under white noise by statistical linearisation: a Gaussian motion with the mean stiffness.

    The stiffness is `omega_0^2 (1 + 3 alpha <x^2>)`. The variance of v is exact; that of x is so for small
    `alpha <x^2>` and falls short by up to 15 % where the cubic term is all.

    Args:
        drive: a drive without effects; either kind.
        S: intensity of the forcing of the dynamic error [rad^2/s^3].

    Raises:
        ValueError: see [`stationary_variance`][].

    References:
        Roberts and Spanos, Random Vibration and Statistical Linearization, Dover 2003, chapter 5.
    """
    gibbs = _gibbs(drive, S, noiseless=True)
    variance = 2.0 * gibbs.sigma_2 / (1.0 + jnp.sqrt(1.0 + 12.0 * gibbs.epsilon))
    return StationaryVariance(
        x=where(gibbs.exists, variance, jnp.inf),
        v=where(gibbs.exists, gibbs.sigma_2 * gibbs.omega_0**2, jnp.inf),
    )


def coloured_variance(drive: Drive | ReducedDrive, rms: ArrayLike, correlation_time: ArrayLike) -> StationaryVariance:
    """Stationary variances of the drive's linear part under coloured noise.

    The Lyapunov equation of (x, v, w) gives, with `t_c` the correlation time,

        <v^2> = rms^2 t_c/(mu D)   <x^2> = <v^2> (1 + mu t_c)/omega_0^2   D = 1 + mu t_c + (omega_0 t_c)^2

    For `t_c -> 0` at `S = 2 rms^2 t_c` these are the variances under white noise.

    Args:
        drive: a drive without effects; either kind. There is no closed form with a cubic term: alpha must be zero.
        rms: root mean square of the forcing of the dynamic error [rad/s^2], see [`ColouredNoise.error_rms`][].
        correlation_time: t_c [s].

    Raises:
        ValueError: for an alpha that is not zero, or without damping or stiffness. Inside a transformation, which knows
            no values, alpha is not checked, and the variances are infinite without damping or stiffness.
    """
    if not isinstance(drive.alpha, Tracer) and drive.alpha != 0.0:
        raise ValueError(f"`drive.alpha` must be zero for a closed form, but is {drive.alpha}")
    exists, mu, omega_0 = _damped(drive)
    t_c = as_scalar(correlation_time)
    v = as_scalar(rms) ** 2 * t_c / (mu * (1.0 + mu * t_c + (omega_0 * t_c) ** 2))
    x = v * (1.0 + mu * t_c) / omega_0**2
    return StationaryVariance(x=where(exists, x, jnp.inf), v=where(exists, v, jnp.inf))


class _Gibbs(eqx.Module):
    """The Gibbs law in the width `sigma sqrt(harmonic)` at which its exponent is 1/2 to 1/4, whatever alpha.

    There, `exp(-harmonic u^2/2 - (1 - harmonic) u^4/4)` runs from the Gaussian (1) to the pure quartic (0).
    """

    exists: Array
    omega_0: Array
    sigma_2: Array  # variance of x for alpha = 0
    epsilon: Array  # alpha sigma^2
    harmonic: Array

    @property
    def sigma(self) -> Array:
        return root(self.sigma_2)

    def weight(self, u: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        quartic = self.epsilon * self.harmonic**2
        return jnp.exp(-self.harmonic * u**2 / 2.0 - quartic * u**4 / 4.0)


def _nodes() -> tuple[Float[Array, " nodes"], float]:
    """Points and spacing of the trapezoidal rule, which errs by less than 1e-16 for any of the laws.

    It does so since the integrand is entire; the Gaussian, the widest of them, ends at exp(-9^2/2) = 3e-18.
    """
    return jnp.linspace(-9.0, 9.0, 145), 18.0 / 144


def _gibbs(drive: Drive | ReducedDrive, S: ArrayLike, *, noiseless: bool) -> _Gibbs:
    S = as_scalar(S)
    exists, mu, omega_0 = _damped(drive)
    for name, value, fine, range_ in (
        ("S", S, S >= 0.0 if noiseless else S > 0.0, "not be negative" if noiseless else "be above zero"),
        ("drive.alpha", drive.alpha, drive.alpha >= 0.0, "not be negative"),
    ):
        if not isinstance(fine, Tracer) and not fine:
            raise ValueError(f"`{name}` must {range_} for a stationary law, but is {value}")
        exists = exists & fine
    S = where(exists, S, 1.0)
    alpha = where(exists, drive.alpha, 0.0)
    sigma_2 = S / (2.0 * mu * omega_0**2)
    epsilon = alpha * sigma_2
    return _Gibbs(exists, omega_0, sigma_2, epsilon, harmonic=2.0 / (1.0 + jnp.sqrt(1.0 + 4.0 * epsilon)))


def _damped(drive: Drive | ReducedDrive) -> tuple[Array, Array, Array]:
    """Whether damping and stiffness are there to balance noise, and harmless values of mu and omega_0 if not."""
    for name, value in (("mu", drive.mu), ("omega_0", drive.omega_0)):
        if not isinstance(value, Tracer) and not value > 0.0:
            raise ValueError(f"`drive.{name}` must be above zero for a stationary law, but is {value}")
    exists = (drive.mu > 0.0) & (drive.omega_0 > 0.0)
    return exists, where(exists, drive.mu, 1.0), where(exists, drive.omega_0, 1.0)
