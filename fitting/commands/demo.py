"""The demo: logs of a simulated drive with an effect that is not declared."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from hdjax import Drive, TwoInertiaModel, random_phase_multisine, sampled, simulate
from hdjax.effects.kinematic import KinematicError

NOISE = 1e-6
"""Rms noise of the demo's dynamic error [rad]."""

_RATE = 2000.0
_DRIVE_FILE = """\
# The demo's drive, as stated by its maker. Not stated: a kinematic error of two cycles per motor revolution.
[drive]
name = "demo"
reduction_ratio = 50
motor_inertia = 5.26e-4        # kg m^2
load_inertia = 5.0e-2          # kg m^2

[signals]
torque_hold = "zero-order"
"""


def hidden_truth() -> TwoInertiaModel:
    """The drive behind the demo's logs."""
    drive = Drive(N=50.0, J_m=5.26e-4, J_l=5.0e-2, K=7160.0, alpha=4000.0, B_sp=0.3)
    return TwoInertiaModel(drive, (KinematicError(cos_2=1.2e-4, sin_2=-0.9e-4),))


def write_demo_logs(folder: Path, *, seconds: float = 5.0, seed: int = 0) -> tuple[list[Path], Path]:
    """Simulate the demo's drive and write its logs and drive file.

    Args:
        folder: for the files; it must exist.
        seconds: length of each log.
        seed: of torque and noise.

    Returns:
        Paths of the logs, and of the drive file.
    """
    model = hidden_truth()
    time = np.arange(round(seconds * _RATE)) / _RATE
    logs = []
    for number, rms in enumerate((0.25, 0.4)):
        key = jax.random.key(seed + number)
        multisine = random_phase_multisine(
            rms=rms, omega_min=2 * np.pi * 2.0, omega_max=2 * np.pi * 120.0, period=seconds, key=key
        )
        # A slow oscillation turns the motor through many revolutions; fast lines excite the resonance.
        swing = 0.15 * np.sin(2 * np.pi * time / seconds * 2)
        torque = np.asarray(jax.vmap(multisine)(jnp.asarray(time))) + swing
        motion = simulate(model, sampled(time, torque, hold="zero-order"), time, rtol=1e-9, atol=1e-12)
        theta_m, theta_l = np.asarray(motion.states[:, 0]), np.asarray(motion.states[:, 1])
        random = np.random.default_rng(seed + 100 + number)
        theta_m = theta_m + random.normal(0.0, 10 * NOISE, time.size)
        theta_l = theta_l + random.normal(0.0, np.sqrt(1 - 0.2**2) * NOISE, time.size)
        path = folder / f"log_{number + 1}.csv"
        np.savetxt(
            path,
            np.stack([time, theta_m, theta_l, torque], axis=1),
            delimiter=",",
            header="time,motor_angle,load_angle,motor_torque",
            comments="",
            fmt="%.10g",
        )
        logs.append(path)
    drive_path = folder / "drive.toml"
    drive_path.write_text(_DRIVE_FILE, encoding="utf-8")
    return logs, drive_path
