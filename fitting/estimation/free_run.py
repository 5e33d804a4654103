"""Free runs: simulations from an initial state that is fitted to a short window."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.engines import linearise, simulate
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Moved, Stretch
from fitting.estimation.free_parameters import FreeParameters, as_they_are
from fitting.estimation.late_readings import aligned, moved_readings, moved_to
from fitting.estimation.problem import Segmentation, suggested_substeps
from fitting.estimation.reach import Condition, Quantity, Range, ranges, reach
from fitting.estimation.residual import Problem, Unknowns
from fitting.estimation.segments import cut
from hdjax import Model, TwoInertiaModel

WINDOW = 50
"""Samples of the initial-state window."""

# Window where no sensor observes the twist: periods of the antiresonance, and largest share of a stretch, both assumed.
_PERIODS, _MOST = 1.0, 0.25

# 99 % point of chi-squared with as many degrees of freedom as there are rates (one or two).
_REST_LIMIT = {1: 6.63, 2: 9.21}


Pair = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]
"""Predicted and measured values of an output."""


def window(model: Model, stretches: Sequence[Stretch]) -> int:
    """Samples of the initial-state window: [`WINDOW`][], or more where no sensor observes the twist."""
    if not isinstance(model, TwoInertiaModel) or "dynamic_error" in model.measured:
        return WINDOW
    period = 2 * np.pi * np.sqrt(float(model.drive.J_l / model.drive.K)) / stretches[0].experiment.time_step
    return int(np.clip(_PERIODS * period, WINDOW, max(WINDOW, _MOST * min(len(s) for s in stretches))))


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
    """Simulate each stretch from its first [`WINDOW`][] samples on.

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
    starts = fitted_starts(model, stretches, covariance=covariance, halo=halo, substeps=substeps, like=like)
    states = _rest_where_at_rest(model, starts, len(stretches))
    free, values = as_they_are(model, () if like is None else like.free.paths)
    problem = whole_simulations(model, free, stretches, halo, substeps)
    outputs = np.asarray(simulate(problem, Unknowns(values, states))[0])
    runs = []
    back = Moved(*(-by for by in stretches[0].experiment.moved))
    for stretch, output in zip(logged, outputs, strict=True):
        part = slice(stretch.start, stretch.stop)
        time, measured = stretch.experiment.time[part], stretch.experiment.measured[part]
        simulated = moved_readings(time, output[: len(stretch)], model.measured, back)
        pairs = {
            told: (factor * simulated[:, k], factor * measured[:, k])
            for k, (told, factor) in enumerate(zip(*as_logged(model), strict=True))
        }
        principal = list(pairs)[-1]
        predicted, seen = pairs.pop(principal)
        runs.append(
            FreeRun(
                name=stretch.name,
                time=time,
                predicted=predicted,
                measured=seen,
                beside=pairs,
                weight=stretch.weight * np.prod([_within(time, time + by) for by in back], axis=0),
                output=principal,
                reach=reach(stretch, model),
                ranges=ranges(stretch, model),
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


def fitted_starts(
    model: Model,
    stretches: Sequence[Stretch],
    *,
    covariance: Float[Array, "outputs outputs"],
    halo: int,
    substeps: int,
    like: Fit | None = None,
) -> Fit:
    """Initial states fitted to the first samples of each stretch; arguments as in [`free_run`][]."""
    samples = window(model, stretches)
    windows = [s.beginning(samples) for s in stretches]
    paths, length, count = (), max(samples, *(len(w) for w in windows)), len(stretches)
    if like is not None and _holds(like, count, length):
        paths, (count, length) = like.free.paths, like.problem.segments.weight.shape
    return fit(
        model,
        windows,
        paths,
        Segmentation(length, length, halo, substeps, count),
        start=Start(covariance),
        strategy=Strategy(reweigh=False, hold_parameters=True),
    )


def _holds(like: Fit, count: int, window: int) -> bool:
    segments, samples = like.problem.segments.weight.shape
    return segments >= count and samples >= window


def _rest_where_at_rest(model: Model, starts: Fit, lanes: int) -> Array:
    """Initial states, with rates set to zero where they are not significantly nonzero in the window.

    A short window determines a rate poorly, and the error grows with time. Logs often begin at rest; where the window
    agrees with rest (1 % level), rest is assumed.
    """
    found = linearise(starts.problem, starts.unknowns)
    slopes = np.asarray(found.by_state)
    information = np.einsum("srp,srq->spq", slopes, slopes)
    rows = np.maximum(np.asarray(starts.problem.segments.weight).sum(1) * starts.covariance.shape[0], 1.0)
    excess = np.maximum(np.sum(np.asarray(found.residual) ** 2, axis=1) / rows, 1.0)
    rates = np.array([i for i, n in enumerate(model.motion_states) if n in ("omega_m", "omega_l", "v")])
    states = np.array(starts.unknowns.states)[:lanes]
    for lane in range(lanes):
        matrix = information[lane]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        scaled = matrix * scale[:, None] * scale[None, :]
        covariance = np.linalg.pinv(scaled, hermitian=True) * scale[:, None] * scale[None, :]
        block = covariance[np.ix_(rates, rates)] * float(excess[lane])
        rate = states[lane, rates]
        # A rate that the window does not determine at all is set to zero.
        towards = np.linalg.pinv(block, rcond=1e-12, hermitian=True) @ rate
        if rate @ towards < _REST_LIMIT[rates.size]:
            states[lane] -= covariance[:, rates] @ towards * float(excess[lane])
            states[lane, rates] = 0.0
    return jnp.asarray(states)
