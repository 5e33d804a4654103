"""An oscillator under white noise whose linear motion has unit variance."""

import numpy as np

from hdjax import ReducedDrive

MU, OMEGA_0, GAIN = 12.0, 50.0, 2.0
S = 2 * MU * OMEGA_0**2  # the linear drive's x has unit variance


def oscillator(alpha: float = 0.0, mu: float = MU) -> ReducedDrive:
    return ReducedDrive(mu=mu, omega_0=OMEGA_0, alpha=alpha, gain=GAIN)


def pair(variance) -> np.ndarray:
    return np.array([variance.x, variance.v])
