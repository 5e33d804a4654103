"""Orders of magnitude of the measured signals."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fitting.estimation.driven_load import Seen, seen_load, seen_motor, twist
from fitting.estimation.experiment import Stretch
from hdjax import Drive, Model, TwoInertiaModel
from hdjax.dynamics import BOTH_ANGLES
from hdjax.effects import Scales


def largest_torque(stretches: Sequence[Stretch]) -> float:
    """Largest magnitude of the logs' motor torque [N m]."""
    return max(float(np.max(np.abs(np.asarray(s.experiment.torque.coefficients)[:, 0]))) for s in stretches)


def of_twist(model: Model) -> Float[np.ndarray, " outputs"]:
    """Amplitude of each output per radian of twist, at the natural frequency."""
    drive = model.drive
    if not isinstance(drive, Drive) or model.measured == BOTH_ANGLES:
        return np.ones(len(model.measured))
    N, omega = float(drive.N), float(drive.omega_0)
    other = {"motor_angle": N, "motor_velocity": N * omega, "load_velocity": omega, "joint_torque": float(drive.K)}
    return np.array([other.get(name, 1.0) for name in model.measured])


def scales(stretches: Sequence[Stretch], model: Model | None = None) -> Scales:
    """Orders of magnitude of the motion.

    Args:
        stretches: the data.
        model: supplies the natural frequency and the reduction ratio, and the twist where that was not measured.
    """
    twists = [twist(s, model) for s in stretches]
    x = np.concatenate(twists)
    x = x - np.median(x)
    steps = [s.experiment.time_step for s in stretches]
    angles = [
        (s.experiment.motor_angle[s.start : s.stop], step)
        for s, step in zip(stretches, steps, strict=True)
        if s.experiment.motor_angle is not None
    ]
    temperature, change = _temperature(stretches)
    return Scales(
        x=float(np.std(x)),
        x_max=float(np.max(np.abs(x))),
        v=_rms([_rate(*pair) for pair in zip(twists, steps, strict=True)]),
        omega_m=_rms([_rate(*pair) for pair in angles]) if angles else 1.0,
        omega_l=_rms([_speed(s, model, step) for s, step in zip(stretches, steps, strict=True)]),
        time_step=steps[0],
        duration=max(float(np.ptp(s.experiment.time)) for s in stretches),
        reduction_ratio=float(model.drive.N) if isinstance(model, TwoInertiaModel) else 1.0,
        omega_0=None if model is None else float(model.drive.omega_0),
        temperature=temperature,
        temperature_change=change,
    )


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _rate(values: np.ndarray, step: float) -> float:
    """Rms slope over a few samples, so that encoder noise does not dominate."""
    span = 8
    return float(np.sqrt(np.mean(((values[span:] - values[:-span]) / (span * step)) ** 2)))


def _speed(stretch: Stretch, model: Model | None, step: float) -> float:
    """Rms rate of the first output, or of the measured side where the first output is not an angle of the output side
    [rad/s]."""
    experiment, part = stretch.experiment, slice(stretch.start, stretch.stop)
    seen = Seen(experiment.measured[:, 0], 0)
    if isinstance(model, TwoInertiaModel) and experiment.output("motor_turn") is None:
        seen = seen_motor(experiment, float(model.drive.N)) or seen_load(experiment) or seen
    values = seen.values[part]
    return float(np.sqrt(np.mean(values**2))) if seen.order else _rate(values, step)


def _temperature(stretches: Sequence[Stretch]) -> tuple[float | None, float]:
    """Mean temperature of the first log and the rms distance from it [K], where all logs have one."""
    found = []
    for stretch in stretches:
        signal = stretch.experiment.temperature
        if signal is None:
            return None, 0.0
        found.append(np.asarray(signal.coefficients)[stretch.start : stretch.stop, 0])
    mean = float(np.mean(found[0]))
    return mean, float(np.sqrt(np.mean((np.concatenate(found) - mean) ** 2)))
