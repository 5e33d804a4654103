"""How far a stretch of a log takes its drive: largest twist, speed and torque, ranges of angle and temperature."""

from typing import Literal

import numpy as np

from fitting.estimation.driven_load import seen_load, seen_motor, twist
from fitting.estimation.experiment import Stretch
from hdjax import Model, TwoInertiaModel

Quantity = Literal["twist", "speed", "torque"]
Condition = Literal["motor angle", "output angle", "temperature"]
Range = tuple[float, float]

# Share of a natural period over which a speed is taken: shorter, the steps of an encoder would count as speed.
_SHARE = 0.1


def reach(stretch: Stretch, model: Model) -> dict[Quantity, float]:
    """Largest size of each quantity: the twist [rad] as in [`fitting.estimation.driven_load.twist`][], the speed of the
    motor [rad/s] and its torque [N m]; of a reduced log the dynamic error, its rate and the forcing."""
    experiment, part = stretch.experiment, slice(stretch.start, stretch.stop)
    x, time = twist(stretch, model), experiment.time[part]
    angle = x if experiment.motor_angle is None else experiment.motor_angle[part]
    period = 2.0 * np.pi / float(model.drive.omega_0)
    lag = int(np.clip(_SHARE * period / experiment.time_step, 1, len(stretch) - 1))
    speed = (angle[lag:] - angle[:-lag]) / (time[lag:] - time[:-lag])
    torque = np.asarray(experiment.torque.coefficients)[part, 0]
    return {"twist": _largest(x), "speed": _largest(speed), "torque": _largest(torque)}


def ranges(stretch: Stretch, model: Model) -> dict[Condition, Range]:
    """Lowest and highest value of what an effect of the model depends on: the angle of motor and output [rad], where
    one of the two was measured, and the temperature [K]."""
    experiment, part = stretch.experiment, slice(stretch.start, stretch.stop)
    found: dict[Condition, Range] = {}
    if isinstance(model, TwoInertiaModel):
        N, matters = float(model.drive.N), frozenset().union(*(e.angles for e in model.effects))
        # The twist is negligible.
        seen = [s for s in (seen_load(experiment), seen_motor(experiment, N)) if s is not None and s.order == 0]
        if seen and "theta_l" in matters:
            found["output angle"] = _range(seen[0].values[part])
        if seen and "theta_m" in matters:
            found["motor angle"] = _range(N * seen[-1].values[part])
    if experiment.temperature is not None and any(e.needs_temperature for e in model.effects):
        found["temperature"] = _range(np.asarray(experiment.temperature.coefficients)[part, 0])
    return found


def _range(values: np.ndarray) -> Range:
    return float(np.min(values)), float(np.max(values))


def _largest(values: np.ndarray) -> float:
    return float(np.max(np.abs(values), initial=0.0))
