"""One steady motion of `x'' + mu x' + omega_0^2 (x + alpha x^3) = A cos(omega t)` by two independent methods: harmonic
balance in numpy, and Newton's method on scipy's time integration. Nothing is compiled.

[`hdjax.response.harmonic_balance`][] and [`hdjax.response.shooting`][] do this for any model, with lanes and gradients.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from hdjax.fourier import FourierSeries
from hdjax.response.harmonic_balance import waves

_EXACT = 1e-13
_SOLVED = 1e-9
_STEPS = 64
_SHOTS = 30
_RTOL = 1e-12
_ATOL = 1e-15
"""Tolerance, relative to the motion's size."""


class ForcedCubic(NamedTuple):
    """Parameters of the equation, and number of forcing periods after which its motion repeats."""

    mu: float
    omega_0: float
    alpha: float
    A: float
    omega: float
    periods: int = 1


class Closed(NamedTuple):
    """A motion by time integration.

    Attributes:
        motion: over the periods after which it repeats.
        converged: whether it is periodic.
        stable: whether its Floquet multipliers lie inside the unit circle.
    """

    motion: FourierSeries
    converged: bool
    stable: bool


def balanced(given: ForcedCubic, guess: FourierSeries, harmonics: int) -> tuple[FourierSeries, bool]:
    """The motion near a guess by harmonic balance, and whether there is one.

    Args:
        given: the equation.
        guess: with the motion's own fundamental.
        harmonics: of the fundamental.
    """
    samples = 2 ** math.ceil(math.log2(4 * harmonics + 1))
    basis, _, projection, orders = waves(harmonics, samples)
    projection = projection[:, : orders.size]
    speeds = orders * given.omega / (given.periods * given.omega_0)
    straight = np.diag(1.0 - speeds**2)
    damper = given.mu / given.omega_0 * speeds[1 : harmonics + 1]
    k = np.arange(1, harmonics + 1)
    straight[k, harmonics + k], straight[harmonics + k, k] = damper, -damper
    push = np.zeros(orders.size)
    push[given.periods] = given.A / given.omega_0**2
    kept = np.zeros(orders.size)
    kept[0], both = guess.mean, min(harmonics, guess.harmonics)
    kept[1 : both + 1], kept[harmonics + 1 :][:both] = guess.cosine[:both], guess.sine[:both]

    def left_over(kept: np.ndarray) -> np.ndarray:
        return straight @ kept + given.alpha * (kept @ basis) ** 3 @ projection - push

    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            slope = straight + (projection.T * (3.0 * given.alpha * (kept @ basis) ** 2)) @ basis.T
            try:
                change = np.linalg.solve(slope, left_over(kept))
            except np.linalg.LinAlgError:
                break
            kept = kept - change
            if not np.max(np.abs(change)) > _EXACT * np.max(np.abs(kept)):
                break
        solved = bool(np.max(np.abs(left_over(kept))) < _SOLVED * np.max(np.abs(kept)))
    mean, cosine, sine = np.split(kept if solved else np.zeros(orders.size), [1, harmonics + 1])
    omega = given.omega / given.periods
    return FourierSeries(omega, *(jnp.asarray(c) for c in (mean[0], cosine, sine))), solved


def closed(given: ForcedCubic, near: FourierSeries, harmonics: int) -> Closed:
    """The motion near another by time integration: Newton's method on the state after its periods.

    Args:
        given: the equation.
        near: with the motion's own fundamental.
        harmonics: of the fundamental.
    """
    mu, omega_0, alpha, A, omega, periods = given
    length = 2.0 * math.pi * periods
    z = np.asarray(near.cosine) - 1j * np.asarray(near.sine)
    size = float(np.sum(np.abs(z))) + abs(float(near.mean)) or 1.0
    # In units of the motion's size and the forcing's frequency.
    damper, spring, bend, push = mu / omega, (omega_0 / omega) ** 2, alpha * size**2, A / (size * omega**2)

    def rates(t: float, y: np.ndarray) -> tuple[float, ...]:
        x, v, *varied = y.tolist()
        slope = -spring * (1.0 + 3.0 * bend * x * x)
        found = v, push * math.cos(t) - damper * v - spring * x * (1.0 + bend * x * x)
        if not varied:
            return found
        a, b, c, d = varied
        return *found, c, d, slope * a - damper * c, slope * b - damper * d

    def march(state: np.ndarray, instants: np.ndarray | None = None) -> np.ndarray | None:
        options: dict[str, Any] = {"method": "DOP853", "rtol": _RTOL, "atol": _ATOL, "t_eval": instants}
        found = solve_ivp(rates, (0.0, length), state, **options)
        return found.y if found.success and np.all(np.isfinite(found.y)) else None

    orders = np.arange(1, z.size + 1) / periods
    state = np.array([float(near.mean) + np.sum(np.real(z)), -np.sum(orders * np.imag(z))]) / size
    matrix, converged = np.full((2, 2), np.inf), False
    with np.errstate(all="ignore"):
        for _ in range(_SHOTS):
            found = march(np.concatenate([state, [1.0, 0.0, 0.0, 1.0]]))
            if found is None:
                break
            matrix = found[2:, -1].reshape(2, 2)
            missed = found[:2, -1] - state
            change = np.linalg.lstsq(matrix - np.eye(2), -missed, rcond=None)[0]
            state = state + change
            if np.max(np.abs(change)) < _SOLVED * np.max(np.abs(state)):
                converged = True
                break
        samples = max(64, 4 * harmonics)
        found = march(state, np.arange(samples) / samples * length) if converged else None
    # Liouville: the multipliers' product is known.
    shrunk = math.exp(-damper * length)
    stable = mu > 0.0 and bool(abs(np.trace(matrix)) < 1.0 + shrunk)
    if found is None:
        return Closed(near, False, stable)
    spectrum = 2.0 * size / samples * np.fft.rfft(found[0])[: harmonics + 1]
    parts = 0.5 * np.real(spectrum[0]), np.real(spectrum[1:]), -np.imag(spectrum[1:])
    return Closed(FourierSeries(omega / periods, *(jnp.asarray(p) for p in parts)), True, stable)
