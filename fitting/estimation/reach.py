"""How far a stretch of a log takes its drive: the largest twist, speed and torque."""

from typing import Literal

import numpy as np

from fitting.estimation.driven_load import twist
from fitting.estimation.experiment import Stretch
from hdjax import Model

Quantity = Literal["twist", "speed", "torque"]

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


def _largest(values: np.ndarray) -> float:
    return float(np.max(np.abs(values), initial=0.0))
