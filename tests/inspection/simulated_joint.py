"""Simulation of a linear drive with all its signals."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete


@dataclass(frozen=True)
class Motion:
    """Signals of a simulated drive in SI units, of shape (n,) each."""

    time: np.ndarray
    motor_angle: np.ndarray
    load_angle: np.ndarray
    motor_velocity: np.ndarray
    load_velocity: np.ndarray
    motor_torque: np.ndarray
    joint_torque: np.ndarray


def simulated(
    *,
    N: float = 100.0,
    J_m: float = 3e-4,
    J_l: float = 1.2,
    K: float = 2e4,
    B_sp: float = 12.0,
    rate: float = 1000.0,
    count: int = 6000,
    seed: int = 0,
    noise: float = 1e-6,
) -> Motion:
    """Simulate a linear drive with little viscous friction under a slow and a fast torque, held between samples.

    Args:
        N, J_m, J_l, K, B_sp: of the drive.
        rate: samples per second.
        count: samples.
        seed: of torque and noise.
        noise: rms of each angle, as seen at the output [rad].
    """
    random = np.random.default_rng(seed)
    time = np.arange(count) / rate
    resonance = np.sqrt(K * (1 / J_l + 1 / (N**2 * J_m))) / (2 * np.pi)
    lines = np.fft.rfftfreq(count, 1 / rate)
    spectrum = np.exp(2j * np.pi * random.uniform(size=lines.size)) * ((lines > 0.5) & (lines < 1.5 * resonance))
    quick = np.fft.irfft(spectrum, count)
    largest = 1e-3 * K / N
    torque = largest * (0.3 * quick / np.std(quick) + np.sin(2 * np.pi * 0.7 * time + random.uniform(0, 6)))
    friction_m, friction_l = 0.5 * J_m, 0.5 * J_l
    # States: motor angle, load angle, and their rates.
    system = np.array(
        [
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            [-K / N**2 / J_m, K / N / J_m, -(B_sp / N**2 + friction_m) / J_m, B_sp / N / J_m],
            [K / N / J_l, -K / J_l, B_sp / N / J_l, -(B_sp + friction_l) / J_l],
        ]
    )
    drive = np.array([[0.0], [0.0], [1 / J_m], [0.0]])
    step, kick = cont2discrete((system, drive, np.eye(4), np.zeros((4, 1))), 1 / rate)[:2]
    states = np.zeros((count, 4))
    for k in range(count - 1):
        states[k + 1] = step @ states[k] + kick[:, 0] * torque[k]
    m, f, vm, vf = states.T
    tau = K * (m / N - f) + B_sp * (vm / N - vf)
    errors = random.normal(size=(2, count)) * noise
    speeds = 1.0 + 1e-3 * random.normal(size=(2, count))
    return Motion(time, m + N * errors[0], f + errors[1], vm * speeds[0], vf * speeds[1], torque, tau)
