"""Whole rows of a sensor's delay: the late readings are moved by them, so that the effect's law spans the rest.

The law is a series in the delay. A delay that is a large part of a natural period needs more terms than it has. The
series of the joint torque contains the motor torque just before the reading, so that this sensor is read late, never
ahead.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from fitting.estimation.experiment import Experiment, Moved, Stretch
from hdjax import Model
from hdjax.dynamics import JOINT_TORQUE
from hdjax.effects import Effect
from hdjax.effects.sensing import SensorDelay
from hdjax.parameters import as_scalar, own_parameters

# Rows by which a law's part of a delay may leave its row, so that a delay between two of them settles. Assumed: the
# series is as accurate there.
_MARGIN = 0.1


def aligned(model: Model, stretches: Sequence[Stretch]) -> tuple[Model, tuple[Stretch, ...]]:
    """The model and its data with late readings moved by the whole rows nearest to the model's delays.

    Args:
        model: supplies the delays.
        stretches: the data, as logged or moved.
    """
    step = stretches[0].experiment.time_step
    effects = tuple(_moved(e, _whole_rows(e, model, step)) if isinstance(e, SensorDelay) else e for e in model.effects)
    late = [(e, float(e.moved)) for e in effects if isinstance(e, SensorDelay)]
    by = Moved(sum(e.of_load * t for e, t in late), sum(e.of_torque * t for e, t in late))
    if all(s.experiment.moved == by for s in stretches):
        return replace(model, effects=effects), tuple(stretches)
    done = {id(s.experiment): moved_to(s.experiment, by) for s in stretches}
    return replace(model, effects=effects), tuple(replace(s, experiment=done[id(s.experiment)]) for s in stretches)


def is_aligned(model: Model, stretches: Sequence[Stretch]) -> bool:
    """Whether the model's laws span less than a row of its delays."""
    step = stretches[0].experiment.time_step
    for effect in model.effects:
        if isinstance(effect, SensorDelay) and float(effect.moved) != _whole_rows(effect, model, step):
            beyond = float(effect.delay - effect.moved) / step - _least_part(effect, model)
            if not -_MARGIN <= beyond <= 1.0 + _MARGIN:
                return False
    return True


def unaligned(model: Model) -> Model:
    """The model for readings as they are logged."""
    return replace(model, effects=tuple(_moved(e, 0.0) if isinstance(e, SensorDelay) else e for e in model.effects))


def _whole_rows(effect: SensorDelay, model: Model, step: float) -> float:
    """The whole rows of the delay, within its bounds [s]."""
    longest = dict(own_parameters(effect))["delay"].bounds[1]
    return float(np.floor(min(float(effect.delay), longest) / step - _least_part(effect, model))) * step


def _least_part(effect: SensorDelay, model: Model) -> float:
    """The least part of a delay that is left to the law, which spans a row from there on [rows]."""
    if JOINT_TORQUE not in model.measured or not effect.of_torque:
        return -0.5
    return 0.0 if effect.of_torque > 0 else -1.0


def _moved(effect: SensorDelay, by: float) -> Effect:
    return replace(effect, moved=as_scalar(by))


def moved_to(experiment: Experiment, by: Moved) -> Experiment:
    """The experiment with readings from later times; samples without a valid one are invalid.

    Args:
        experiment: as logged or moved.
        by: times from the stamp of a row to those of the readings.
    """
    time, further = experiment.time, Moved(*(new - old for new, old in zip(by, experiment.moved, strict=True)))
    if further == Moved():
        return experiment
    names = experiment.names
    measured = moved_readings(time, experiment.measured, names, further)
    weight = np.ones(time.size) if experiment.weight is None else experiment.weight
    for late in set(_times(names, further).values()):
        row = np.interp(time + late, time, np.arange(time.size), left=-1.0, right=-1.0).round().astype(int)
        weight = np.where(row < 0, 0.0, weight * weight[row])
    return replace(experiment, measured=measured, weight=weight, moved=by)


def _times(names: Sequence[str], by: Moved) -> dict[str, float]:
    """Times by which each of the outputs is moved, where it is."""
    load = dict.fromkeys(("load_angle", "load_velocity", "dynamic_error"), by.load)
    times = load | {JOINT_TORQUE: by.joint_torque}
    return {name: times[name] for name in names if times.get(name)}


def moved_readings(
    time: Float[np.ndarray, " n"], outputs: Float[np.ndarray, "n outputs"], names: Sequence[str], by: Moved
) -> Float[np.ndarray, "n outputs"]:
    """Outputs with late ones from a later time. At equal sample intervals, whole rows are moved; others are
    interpolated. Those beyond the ends are held."""
    times = _times(names, by)
    # A dynamic error needs the motor's turn as well.
    needed = [names.index(n) for n in ("motor_turn", *times) if n in names]
    if not times or not np.isfinite(outputs[:, needed]).all():
        return outputs
    # Imported here: few logs need it.
    from scipy.interpolate import CubicSpline

    found = outputs.copy()
    for name, late in times.items():
        k = names.index(name)
        turn = outputs[:, names.index("motor_turn")] if name == "dynamic_error" else 0.0
        read = CubicSpline(time, outputs[:, k] - turn)(np.clip(time + late, time[0], time[-1]))
        found[:, k] = turn + read
    return found
