"""Orders of magnitude of what was measured."""

from collections.abc import Sequence

import numpy as np

from fitting.estimation.experiment import Stretch
from hdjax import Model, TwoInertiaModel
from hdjax.effects import Scales


def largest_torque(stretches: Sequence[Stretch]) -> float:
    """The largest motor torque of the logs [N m], in size."""
    return max(float(np.max(np.abs(np.asarray(s.experiment.torque.coefficients)[:, 0]))) for s in stretches)


def scales(stretches: Sequence[Stretch], model: Model | None = None) -> Scales:
    """Orders of magnitude of the measured motion.

    Args:
        stretches: the data.
        model: supplies the natural frequency and the reduction ratio where it is given.
    """
    x = np.concatenate([s.experiment.measured[s.start : s.stop, -1] for s in stretches])
    x = x - np.median(x)
    step = stretches[0].experiment.time_step

    def rate(values: np.ndarray) -> float:
        """Rms slope over a few samples, so that encoder noise does not pass for speed."""
        span = 8
        return float(np.sqrt(np.mean(((values[span:] - values[:-span]) / (span * step)) ** 2)))

    angles = [s.experiment.motor_angle[s.start : s.stop] for s in stretches if s.experiment.motor_angle is not None]
    motor = float(np.sqrt(np.mean([rate(a) ** 2 for a in angles]))) if angles else 1.0
    output = [rate(s.experiment.measured[s.start : s.stop, 0]) for s in stretches]
    temperature, change = _temperature(stretches)
    return Scales(
        x=float(np.std(x)),
        x_max=float(np.max(np.abs(x))),
        v=rate(x),
        omega_m=motor,
        omega_l=float(np.sqrt(np.mean(np.square(output)))),
        time_step=step,
        duration=max(float(np.ptp(s.experiment.time)) for s in stretches),
        reduction_ratio=float(model.drive.N) if isinstance(model, TwoInertiaModel) else 1.0,
        omega_0=None if model is None else float(model.drive.omega_0),
        temperature=temperature,
        temperature_change=change,
    )


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
