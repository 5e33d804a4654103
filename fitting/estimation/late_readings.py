"""Whole rows of an encoder's delay: the load's readings are moved by them, so that the effect's law spans the rest.

The law is a series in the delay. A delay that is a large part of a natural period needs more terms than it has.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from fitting.estimation.experiment import Experiment, Stretch
from hdjax import Model
from hdjax.dynamics import BOTH_ANGLES
from hdjax.effects import Effect
from hdjax.effects.sensing import EncoderDelay
from hdjax.parameters import as_scalar, own_parameters

# Rows beyond which the law's part of a delay is too long; above a half, so that a delay of half a row settles.
_LONGEST = 0.6


def aligned(model: Model, stretches: Sequence[Stretch]) -> tuple[Model, tuple[Stretch, ...]]:
    """The model and its data with the load's readings moved by the whole rows nearest to the model's delays.

    Args:
        model: supplies the delays.
        stretches: the data, as logged or moved.
    """
    step = stretches[0].experiment.time_step
    effects = tuple(_moved(e, _whole_rows(e, step)) if isinstance(e, EncoderDelay) else e for e in model.effects)
    by = float(sum(e.side * float(e.moved) for e in effects if isinstance(e, EncoderDelay)))
    if all(s.experiment.load_moved == by for s in stretches):
        return replace(model, effects=effects), tuple(stretches)
    done = {id(s.experiment): with_load_moved(s.experiment, by) for s in stretches}
    return replace(model, effects=effects), tuple(replace(s, experiment=done[id(s.experiment)]) for s in stretches)


def is_aligned(model: Model, stretches: Sequence[Stretch]) -> bool:
    """Whether the model's laws span less than a row of its delays."""
    step = stretches[0].experiment.time_step
    late = [e for e in model.effects if isinstance(e, EncoderDelay)]
    return all(abs(float(e.delay - e.moved)) <= _LONGEST * step or float(e.moved) == _whole_rows(e, step) for e in late)


def unaligned(model: Model) -> Model:
    """The model for readings as they are logged."""
    return replace(model, effects=tuple(_moved(e, 0.0) if isinstance(e, EncoderDelay) else e for e in model.effects))


def _whole_rows(effect: EncoderDelay, step: float) -> float:
    """The whole rows nearest to the delay, within its bounds [s]."""
    longest = dict(own_parameters(effect))["delay"].bounds[1]
    return round(min(float(effect.delay), longest) / step) * step


def _moved(effect: EncoderDelay, by: float) -> Effect:
    return replace(effect, moved=as_scalar(by))


def with_load_moved(experiment: Experiment, by: float) -> Experiment:
    """The experiment with readings of the load's sensors from a later time; samples without a valid one are invalid.

    Args:
        experiment: as logged or moved.
        by: time from the stamp of a row to that of the reading [s].
    """
    time, further = experiment.time, by - experiment.load_moved
    if further == 0.0:
        return experiment
    names = experiment.outputs or BOTH_ANGLES
    measured = moved_readings(time, experiment.measured, names, further)
    weight = np.ones(time.size) if experiment.weight is None else experiment.weight
    row = np.interp(time + further, time, np.arange(time.size), left=-1.0, right=-1.0).round().astype(int)
    weight = np.where(row < 0, 0.0, weight * weight[row])
    return replace(experiment, measured=measured, weight=weight, load_moved=by)


def moved_readings(
    time: Float[np.ndarray, " n"], outputs: Float[np.ndarray, "n outputs"], names: Sequence[str], by: float
) -> Float[np.ndarray, "n outputs"]:
    """Outputs with the load's from a later time. At equal sample intervals, whole rows are moved; others are
    interpolated. Those beyond the ends are held."""
    if by == 0.0:
        return outputs
    # Imported here: few logs need it.
    from scipy.interpolate import CubicSpline

    at = np.clip(time + by, time[0], time[-1])

    def later(values: np.ndarray) -> np.ndarray:
        return CubicSpline(time, values)(at) if np.isfinite(values).all() else values

    columns = dict(zip(names, outputs.T, strict=True))
    if "dynamic_error" in columns:
        turn = columns["motor_turn"]
        if np.isfinite(outputs).all():
            columns["dynamic_error"] = turn - later(turn - columns["dynamic_error"])
    return np.stack([later(v) if name in ("load_angle", "load_velocity") else v for name, v in columns.items()], axis=1)
