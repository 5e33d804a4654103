"""Implementation of `hdjax simulate`."""

from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from fitting.commands.options import ForcingOptions
from fitting.commands.spinner import spinning
from fitting.commands.table import write_table
from fitting.errors import InputError
from fitting.stored_model import read_model
from hdjax import PRESETS, Chirp, Harmonic, TwoInertiaModel, random_phase_multisine, sampled, simulate
from hdjax.dynamics import reading_both_angles


def write_simulation(
    out: Path, torque: ForcingOptions, *, model: Path | None, preset: str, noise: float, seed: int
) -> None:
    """Simulate a drive and write its log.

    Args:
        out: CSV file.
        torque: of the motor, with zero-order hold.
        model: model.json of a report, or None for a preset.
        preset: name of a drive.
        noise: rms of each angle [rad at the output].
        seed: of phases and noise.

    Raises:
        InputError: unknown preset, bad model, or a band without a line.
    """
    if preset not in PRESETS:
        raise InputError(f"--preset must be one of {', '.join(PRESETS)}, but is {preset}")
    system = TwoInertiaModel(PRESETS[preset]()) if model is None else read_model(model).model
    system = reading_both_angles(system)
    warm = [e.name for e in system.effects if e.needs_temperature]
    if warm:
        raise InputError(f"{model}: {warm[0]} needs a temperature, which a simulation of a torque lacks")
    time = np.arange(max(2, round(torque.duration * torque.rate))) / torque.rate
    applied = np.asarray(jax.vmap(_function(torque, seed))(time))
    with spinning("simulating"):
        motion = jax.block_until_ready(
            simulate(system, sampled(time, applied, hold="zero-order"), time, rtol=1e-9, atol=1e-12)
        )
    random = np.random.default_rng(seed)
    if isinstance(system, TwoInertiaModel):
        outputs = np.asarray(motion.outputs)
        motor = outputs[:, 0] + noise * random.normal(size=time.size)
        load = outputs[:, 0] - outputs[:, 1] + noise * random.normal(size=time.size)
        columns = {"motor_angle": motor * float(system.drive.N), "load_angle": load, "motor_torque": applied}
    else:
        x = np.asarray(motion.dynamic_error) + noise * random.normal(size=time.size)
        columns = {"dynamic_error": x, "forcing": applied}
    write_table(out, {"time": time} | columns)
    print(f"Log: {out}")


def _function(torque: ForcingOptions, seed: int) -> Callable:
    first, last = 2 * np.pi * torque.frequency, 2 * np.pi * torque.frequency_end
    if torque.forcing == "harmonic":
        return Harmonic(torque.amplitude, first)
    if torque.forcing == "chirp":
        return Chirp(torque.amplitude, first, last, torque.duration)
    try:
        return random_phase_multisine(
            rms=torque.amplitude, omega_min=first, omega_max=last, period=torque.duration, key=jax.random.key(seed)
        )
    except ValueError as error:
        raise InputError(f"--frequency, --frequency-end and --duration do not go together: {error}") from error
