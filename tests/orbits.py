"""Periodic motions against scipy's integration: error of a Fourier series, and Floquet multipliers."""

from collections.abc import Callable
from math import cos

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from hdjax import ReducedDrive, ReducedModel
from hdjax.fourier import FourierSeries

Rates = Callable[[float, np.ndarray], tuple]


def duffing(mu: float, alpha: float, omega_0: float = 1.0) -> ReducedModel:
    """The model of `x'' + mu x' + omega_0^2 (x + alpha x^3) = F(t)`."""
    return ReducedModel(ReducedDrive(mu=mu, omega_0=omega_0, alpha=alpha))


def duffing_rates(mu: float, alpha: float, level: float, omega: float, omega_0: float = 1.0) -> Rates:
    """Rates of the same equation under `level cos(omega t)`, in floats for scipy."""

    def rates(t, y):
        return y[1], level * cos(omega * t) - mu * y[1] - omega_0**2 * y[0] * (1 + alpha * y[0] * y[0])

    return rates


def duffing_slope(mu: float, alpha: float, omega_0: float = 1.0) -> Callable[[np.ndarray], np.ndarray]:
    """Derivative of the rates of [`duffing_rates`][] by the state."""
    return lambda y: np.array([[0.0, 1.0], [-(omega_0**2) * (1 + 3 * alpha * y[0] ** 2), -mu]])


def columns(x: np.ndarray, v: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The states of a reduced drive."""
    return np.stack([x, v], axis=1)


def period_error(rates: Rates, motion: FourierSeries, state: Callable = columns) -> float:
    """Largest relative distance of a series from scipy's integration over one period from the same initial state.

    `state` turns (coordinates, their rates, times) into what `rates` integrates. It integrates quarter by quarter,
    since the interpolation of an integrator is less accurate than its steps.
    """
    t = np.linspace(0.0, 2 * np.pi / float(motion.omega), 5)
    rows = state(np.asarray(motion(jnp.asarray(t))), np.asarray(motion.derivative()(jnp.asarray(t))), t)
    size = np.abs(rows).max(axis=0)
    y, worst = rows[0], 0.0
    for k in range(4):
        y = solve_ivp(rates, (t[k], t[k + 1]), y, method="DOP853", rtol=1e-12, atol=1e-14 * size).y[:, -1]
        worst = max(worst, (np.abs(y - rows[k + 1]) / size).max())
    return worst


def multipliers(rates: Rates, slope: Callable[[np.ndarray], np.ndarray], motion: FourierSeries) -> np.ndarray:
    """Floquet multipliers from the variational equations along a motion of a reduced drive.

    `slope` is the derivative of the rates by the state.
    """

    def varied(t, y):
        return np.concatenate([rates(t, y[:2]), (slope(y[:2]) @ y[2:].reshape(2, 2)).ravel()])

    zero = jnp.zeros(())
    start = [float(motion(zero)), float(motion.derivative()(zero)), 1.0, 0.0, 0.0, 1.0]
    end = solve_ivp(varied, (0.0, 2 * np.pi / float(motion.omega)), start, method="DOP853", rtol=1e-12, atol=1e-13)
    return np.linalg.eigvals(end.y[2:, -1].reshape(2, 2))
