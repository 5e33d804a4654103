"""Free runs: simulations from an initial state that is fitted to a short window."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.engines import simulate
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Moved, Stretch
from fitting.estimation.free_parameters import FreeParameters, as_they_are
from fitting.estimation.initial_states import initial_states
from fitting.estimation.late_readings import aligned, moved_readings, moved_to
from fitting.estimation.problem import suggested_substeps
from fitting.estimation.reach import Condition, Quantity, Range, ranges, reach
from fitting.estimation.residual import Problem, Unknowns
from fitting.estimation.segments import cut
from hdjax import Model, TwoInertiaModel

Pair = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]
"""Predicted and measured values of an output."""


class FreeRun(eqx.Module):
    """A model's free run along a stretch.

    Attributes:
        name: the log's name.
        time: sample stamps [s].
        predicted: principal output, the dynamic error [rad] where that was measured.
        measured: the same output, measured.
        beside: the other outputs, predicted and measured, by their names in the log.
        weight: 1 for a valid sample, 0 for the others; None where all are valid.
        output: name of the principal output.
        zero: of the log's dynamic error: what was subtracted from it, and the free run's estimate of the rest.
        reach: largest twist, speed and torque of the stretch, as in [`fitting.estimation.reach`][].
        ranges: range of each angle and of the temperature that matters to the model, likewise.
    """

    name: str = eqx.field(static=True)
    time: Float[np.ndarray, " n"]
    predicted: Float[np.ndarray, " n"]
    measured: Float[np.ndarray, " n"]
    beside: dict[str, Pair] | None = None
    weight: Float[np.ndarray, " n"] | None = None
    output: str = eqx.field(static=True, default="dynamic_error")
    zero: float = eqx.field(static=True, default=0.0)
    reach: dict[Quantity, float] = eqx.field(default_factory=dict)
    ranges: dict[Condition, Range] = eqx.field(default_factory=dict)

    @property
    def outputs(self) -> dict[str, Pair]:
        """All outputs, predicted and measured, the principal one first."""
        return {self.output: (self.predicted, self.measured)} | (self.beside or {})

    @property
    def motor_angle(self) -> Float[np.ndarray, " n"] | None:
        """Predicted motor angle [rad]; None where it is no output."""
        found = self.outputs.get("motor_angle")
        return None if found is None else found[0]

    @property
    def counts(self) -> Bool[np.ndarray, " n"]:
        """Which samples are valid."""
        return np.ones(self.time.size, dtype=bool) if self.weight is None else self.weight > 0

    @property
    def squared_error(self) -> Float[np.ndarray, " counted"]:
        """Squared residuals of the principal output at valid samples."""
        return ((self.measured - self.predicted) ** 2)[self.counts]

    @property
    def rmse(self) -> float:
        """Rms residual of the principal output."""
        return rms_error((self,))


def rms_error(runs: Sequence[FreeRun], output: str | None = None) -> float:
    """Rms residual over several runs; infinite where a run diverged.

    Args:
        runs: the runs.
        output: by its name; the principal one where not given.
    """
    if output is None:
        return _rms(np.concatenate([r.squared_error for r in runs]))
    pairs = [(run.outputs[output], run.counts) for run in runs]
    return _rms(np.concatenate([((measured - predicted) ** 2)[counts] for (predicted, measured), counts in pairs]))


def _rms(square: Float[np.ndarray, " counted"]) -> float:
    return float(np.sqrt(np.mean(square))) if np.isfinite(square).all() else np.inf


def free_run(
    model: Model,
    stretches: Sequence[Stretch],
    *,
    covariance: Float[Array, "outputs outputs"],
    halo: int = 0,
    substeps: int | None = None,
    like: Fit | None = None,
    judged: Sequence[Stretch] | None = None,
) -> tuple[FreeRun, ...]:
    """Simulate each stretch after its initial state is fitted to its first samples, see
    [`fitting.estimation.initial_states.window`][].

    Args:
        model: the equations with their values.
        stretches: to simulate. Measured outputs beyond the window are not used.
        covariance: of the measurement noise of the outputs.
        halo: intervals of torque before the start, for delays.
        substeps: solver steps in a sample interval.
        like: a fit of the same model, whose compiled program is reused.
        judged: the same stretches with the outputs that the runs are compared with; those to simulate if None.
    """
    if substeps is None:
        substeps = suggested_substeps(model, stretches)
    logged = [replace(s, experiment=moved_to(s.experiment, Moved())) for s in judged or stretches]
    model, stretches = aligned(model, stretches)
    setting = {"covariance": covariance, "halo": halo, "substeps": substeps}
    states, zeros = initial_states(model, stretches, **setting, like=like)
    free, values = as_they_are(model, () if like is None else like.free.paths)
    problem = whole_simulations(model, free, stretches, halo, substeps)
    outputs = np.asarray(simulate(problem, Unknowns(values, states))[0])
    runs = []
    back = Moved(*(-by for by in stretches[0].experiment.moved))
    for stretch, output, zero in zip(logged, outputs, zeros, strict=True):
        part = slice(stretch.start, stretch.stop)
        time, measured = stretch.experiment.time[part], stretch.experiment.measured[part]
        simulated = moved_readings(time, output[: len(stretch)], model.measured, back)
        pairs = {
            told: (factor * simulated[:, k], factor * measured[:, k])
            for k, (told, factor) in enumerate(zip(*as_logged(model), strict=True))
        }
        principal = list(pairs)[-1]
        predicted, seen = pairs.pop(principal)
        predicted = predicted + zero
        zeroed = replace(stretch, experiment=stretch.experiment.less(float(zero)))
        runs.append(
            FreeRun(
                name=stretch.name,
                time=time,
                predicted=predicted,
                measured=seen,
                beside=pairs,
                weight=stretch.weight * np.prod([_within(time, time + by) for by in back], axis=0),
                output=principal,
                zero=zeroed.experiment.zero,
                reach=reach(zeroed, model),
                ranges=ranges(zeroed, model),
            )
        )
    return tuple(runs)


def _within(time: Float[np.ndarray, " n"], at: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Which times are within those of a stretch."""
    return (time[0] <= at) & (at <= time[-1])


def as_logged(model: Model) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Name of each model output in the log, and the conversion to the log's unit."""
    names = tuple("motor_angle" if name == "motor_turn" else name for name in model.measured)
    N = float(model.drive.N) if isinstance(model, TwoInertiaModel) else 1.0
    return names, tuple(N if name == "motor_turn" else 1.0 for name in model.measured)


def whole_simulations(
    model: Model, free: FreeParameters, stretches: Sequence[Stretch], halo: int, substeps: int
) -> Problem:
    """Each stretch as one simulation, with unit weights.

    Args:
        model: the equations.
        free: parameters of the sensitivities.
        stretches: to simulate.
        halo: intervals of torque before the start.
        substeps: solver steps in a sample interval.
    """
    segments = cut(stretches, max(len(s) for s in stretches), halo=halo, count=len(stretches))
    whitening = jnp.asarray(np.eye(segments.measured.shape[-1]))
    active, gap_weight = (jnp.asarray(np.ones(len(names))) for names in (free.paths, model.state_names))
    return Problem(model, free, segments, whitening, active, gap_weight, substeps=substeps)
