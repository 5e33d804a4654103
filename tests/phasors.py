"""Complex amplitudes of steady motions, and their computation by harmonic balance in numpy."""

import numpy as np

from hdjax.drive import ReducedDrive
from hdjax.fourier import FourierSeries


def balanced(drive: ReducedDrive, omega: float, forces: dict[int, complex], start: np.ndarray) -> np.ndarray:
    """Phasors of the harmonics 1, 2, ... of omega: harmonic balance of the odd ones by Newton's method in numpy."""
    mu, w0, alpha = (float(v) for v in (drive.mu, drive.omega_0, drive.alpha))
    k = np.arange(1, start.size + 1, 2)
    angles = np.outer(k, 2 * np.pi * np.arange(256) / 256)
    waves = np.vstack([np.cos(angles), -np.sin(angles)])
    stiff, damping = np.diag(w0**2 - (k * omega) ** 2), np.diag(mu * k * omega)
    linear = np.block([[stiff, -damping], [damping, stiff]])
    push = np.array([forces.get(int(i), 0.0) for i in k])
    push, u = (np.concatenate([X.real, X.imag]) for X in (push, start[::2]))
    for _ in range(12):
        x = u @ waves
        residual = linear @ u + 2 / 256 * waves @ (w0**2 * alpha * x**3) - push
        step = np.linalg.solve(linear + 2 / 256 * (waves * (3 * w0**2 * alpha * x**2)) @ waves.T, residual)
        u = u - step
    assert np.linalg.norm(step) < 1e-11 * np.linalg.norm(u)
    X = np.zeros(start.size, complex)
    X[::2] = u[: k.size] + 1j * u[k.size :]
    return X


def phasors(series: FourierSeries, harmonics: int = 15) -> np.ndarray:
    """Phasors of the harmonics 1, 2, ... of a series, zero where it has none."""
    X = np.zeros(harmonics, complex)
    X[: series.harmonics] = np.asarray(series.cosine) - 1j * np.asarray(series.sine)
    return X
