"""An independent simulator of the drive: Runge-Kutta in plain Python, no code of the package."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

SUBSTEPS = 4
"""Runge-Kutta steps a sample: at 2 kHz and 60 Hz the phase error stays below 1e-8 a step."""

Signal = Callable[[np.ndarray], np.ndarray]


def _no_torque(x: float, v: float) -> float:
    return 0.0


def _constant(t: float) -> float:
    return 1.0


@dataclass(frozen=True)
class Plant:
    """A drive and what it hides.

    Attributes:
        ratio: N.
        motor_inertia: J_m [kg m^2].
        load_inertia: J_l [kg m^2].
        stiffness: K [N m/rad].
        cubic: alpha [rad^-2].
        damping: B_sp [N m s/rad].
        kinematic: cosine and sine [rad] of a kinematic error of two cycles per motor revolution.
        mesh: further torque of the mesh [N m] as a function of twist and its rate.
        stiffening: factor on K as a function of time.
    """

    ratio: float = 50.0
    motor_inertia: float = 5.26e-4
    load_inertia: float = 5.0e-2
    stiffness: float = 7160.0
    cubic: float = 4000.0
    damping: float = 0.3
    kinematic: tuple[float, float] = (0.0, 0.0)
    mesh: Callable[[float, float], float] = _no_torque
    stiffening: Callable[[float], float] = _constant


def simulate(plant: Plant, dt: float, motor: np.ndarray, load: np.ndarray | None = None) -> np.ndarray:
    """Angles of motor and load at the samples, from rest.

    Args:
        plant: the drive.
        dt: sampling interval [s].
        motor: motor torque at the nodes of each interval, from `held` or `smooth`, shape (samples, nodes).
        load: likewise the torque on the load; none where None.

    Returns:
        theta_m and theta_l [rad], shape (samples, 2).
    """
    N, J_m, J_l = plant.ratio, plant.motor_inertia, plant.load_inertia
    c, s = plant.kinematic

    def rates(t: float, y: tuple[float, ...], T_m: float, T_l: float) -> tuple[float, ...]:
        theta_m, theta_l, omega_m, omega_l = y
        cosine, sine = math.cos(2.0 * theta_m), math.sin(2.0 * theta_m)
        slope = 1.0 / N + 2.0 * (s * cosine - c * sine)
        x = theta_m / N + c * cosine + s * sine - theta_l
        v = slope * omega_m - omega_l
        tau = plant.stiffness * plant.stiffening(t) * (x + plant.cubic * x**3) + plant.damping * v + plant.mesh(x, v)
        return omega_m, omega_l, (T_m - slope * tau) / J_m, (tau + T_l) / J_l

    pulled = np.zeros_like(motor) if load is None else load
    h = dt / SUBSTEPS
    # The mean of e at the start is no twist: the spring is relaxed.
    y = (0.0, c, 0.0, 0.0)
    found = np.empty((len(motor), 2))
    for k, (T, L) in enumerate(zip(motor.tolist(), pulled.tolist(), strict=True)):
        found[k] = y[0], y[1]
        for i in range(SUBSTEPS):
            y = _step(rates, k * dt + i * h, y, h, T[2 * i : 2 * i + 3], L[2 * i : 2 * i + 3])
    return found


def _step(rates: Callable, t: float, y: tuple, h: float, T: list[float], L: list[float]) -> tuple:
    """One step of the classical Runge-Kutta method, with the torques at its start, middle and end."""

    def moved(slope: tuple, by: float) -> tuple:
        return tuple(a + by * b for a, b in zip(y, slope, strict=True))

    first = rates(t, y, T[0], L[0])
    second = rates(t + 0.5 * h, moved(first, 0.5 * h), T[1], L[1])
    third = rates(t + 0.5 * h, moved(second, 0.5 * h), T[1], L[1])
    fourth = rates(t + h, moved(third, h), T[2], L[2])
    total = (a + 2.0 * (b + c) + d for a, b, c, d in zip(first, second, third, fourth, strict=True))
    return moved(tuple(total), h / 6.0)


def held(values: np.ndarray, hold: str = "zero-order") -> np.ndarray:
    """A sampled signal at the nodes of each interval.

    Args:
        values: at the samples.
        hold: `zero-order`, `linear` or `cubic`.
    """
    inside = np.arange(2 * SUBSTEPS + 1) / (2 * SUBSTEPS)
    if hold == "zero-order":
        return np.repeat(values[:, None], inside.size, axis=1)
    index = np.arange(len(values))
    at = index[:, None] + inside
    if hold == "linear":
        return np.interp(at, index, values)
    return CubicSpline(index, values)(np.minimum(at, index[-1]))


def smooth(signal: Signal, count: int, dt: float) -> np.ndarray:
    """A known signal at the nodes of each interval."""
    inside = np.arange(2 * SUBSTEPS + 1) / (2 * SUBSTEPS)
    return signal(dt * (np.arange(count)[:, None] + inside))


def multisine(rms: float, duration: float, seed: int, *, low: float = 2.0, high: float = 120.0) -> Signal:
    """A sum of sines of random phase and equal size, plus a slow swing that turns the motor.

    Args:
        rms: of the sum [N m]; the swing has 0.15 N m.
        duration: period of the sum [s].
        seed: of the phases.
        low: lowest frequency [Hz].
        high: highest frequency [Hz].
    """
    cycles = np.arange(math.ceil(low * duration), math.floor(high * duration) + 1)
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, cycles.size)
    size = rms * math.sqrt(2.0 / cycles.size)

    def signal(t: np.ndarray) -> np.ndarray:
        turns = t / duration
        total = 0.15 * np.sin(4.0 * np.pi * turns)
        for count, phase in zip(cycles, phases, strict=True):
            total = total + size * np.cos(2.0 * np.pi * count * turns + phase)
        return total

    return signal
