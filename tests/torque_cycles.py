"""Simulated torque-twist logs with known parameters: a nonlinear spring beside sliders or Bouc and Wen's law."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from fitting.logs.log import Log

K1, K2, K3, T1, T2 = 3e4, 4.5e4, 6e4, 15.0, 50.0
FRICTION = 4.0
Law = Callable[[np.ndarray], np.ndarray]


def line(x: np.ndarray) -> np.ndarray:
    return K1 * x


def cubic(x: np.ndarray) -> np.ndarray:
    return K1 * (x + 2e5 * x**3)


def three_slopes(x: np.ndarray) -> np.ndarray:
    """Torque of the vendors' three-slope curve."""
    knees = [0.0, T1 / K1, T1 / K1 + (T2 - T1) / K2, 1.0]
    torques = [0.0, T1, T2, T2 + K3 * (1.0 - knees[2])]
    return np.sign(x) * np.interp(np.abs(x), knees, torques)


def sliders(x: np.ndarray, *, most: float = FRICTION, stiffness: float = 3e5) -> np.ndarray:
    """Jenkins element: a spring in series with a slider."""
    borne, path = 0.0, []
    for step in np.diff(x, prepend=x[0]).tolist():
        borne = min(most, max(-most, borne + stiffness * step))
        path.append(borne)
    return np.array(path)


def bouc_wen(x: np.ndarray) -> np.ndarray:
    """Bouc and Wen's law with exponent 1: z' = (1 - |z| (1 + sgn(z x'))/2) x'/d, torque FRICTION z."""
    z, path = 0.0, []
    for step in np.diff(x, prepend=x[0]).tolist():
        for part in [step / 10] * 10:
            z += part / 3e-5 * (1.0 - abs(z) * 0.5 * (1.0 + np.sign(z * part)))
        path.append(FRICTION * z)
    return np.array(path)


def no_friction(x: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def cycles(
    spring: Law = three_slopes,
    friction: Law = sliders,
    *,
    count: float = 2.0,
    rows: int = 1000,
    largest: float = 2.2e-3,
    twist_noise: float = 4e-6,
    torque_noise: float = 0.3,
    colour: float = 0.0,
    bias: float = 0.0,
    drift: float = 0.0,
    seed: int = 0,
) -> Log:
    """A log of slow cycles of the twist.

    Args:
        spring: Torque from twist.
        friction: Torque from twist, with hysteresis.
        count: Number of cycles.
        rows: Number of rows, 10 ms apart.
        largest: Amplitude of the twist [rad].
        twist_noise: [rad].
        torque_noise: [N m].
        colour: Correlation of neighbouring noises of the twist.
        bias: Of the torque sensor [N m].
        drift: Of the twist [rad/s].
        seed: Of the noise.
    """
    random = np.random.default_rng(seed)
    time = 0.01 * np.arange(rows)
    x = largest * 2 / np.pi * np.arcsin(np.sin(2 * np.pi * count * np.arange(rows) / rows))
    noises = lfilter([np.sqrt(1 - colour**2)], [1.0, -colour], random.normal(size=rows + 200))[200:]
    torque = spring(x) + friction(x) + bias + torque_noise * random.normal(size=rows)
    return quasi_static_log(time, 0.4 + x + drift * time + twist_noise * noises, torque)


def quasi_static_log(time: np.ndarray, twist: np.ndarray, torque: np.ndarray) -> Log:
    """A quasi-static log as `read_log` returns it."""
    return Log(
        name="log",
        path=Path("log.csv"),
        kind="quasi-static",
        time=time,
        motor_angle=None,
        load_angle=None,
        motor_torque=None,
        load_torque=None,
        temperature=None,
        dynamic_error=twist,
        forcing=None,
        units={"dynamic_error": "rad"},
        joint_torque=torque,
    )
