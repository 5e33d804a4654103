"""Free runs: the initial state from a short window, then the model alone."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.engines import linearise, simulate
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Stretch, cut
from fitting.estimation.free_parameters import FreeParameters, free_parameters
from fitting.estimation.problem import Segmentation, suggested_substeps
from fitting.estimation.residual import Problem, Unknowns
from hdjax import Model, TwoInertiaModel

WINDOW = 50
"""Samples from which the initial state is taken."""

# 99 % point of chi-squared with as many degrees of freedom as there are rates (one or two).
_REST_LIMIT = {1: 6.63, 2: 9.21}


class FreeRun(eqx.Module):
    """A model's free run along a stretch.

    Attributes:
        name: the log's name.
        time: sample stamps [s].
        predicted: dynamic error [rad].
        measured: likewise.
        motor_angle: predicted motor angle [rad], or None for a reduced model.
        weight: 1 for a sample whose measurement counts, 0 for the others; None where all count.
        measured_motor_angle: [rad], or None for a reduced model.
    """

    name: str = eqx.field(static=True)
    time: Float[np.ndarray, " n"]
    predicted: Float[np.ndarray, " n"]
    measured: Float[np.ndarray, " n"]
    motor_angle: Float[np.ndarray, " n"] | None
    weight: Float[np.ndarray, " n"] | None = None
    measured_motor_angle: Float[np.ndarray, " n"] | None = None

    @property
    def counts(self) -> Bool[np.ndarray, " n"]:
        """Which samples count."""
        return np.ones(self.time.size, dtype=bool) if self.weight is None else self.weight > 0

    @property
    def squared_error(self) -> Float[np.ndarray, " counted"]:
        """Squares of measured minus predicted [rad^2], of the samples that count."""
        return ((self.measured - self.predicted) ** 2)[self.counts]

    @property
    def rmse(self) -> float:
        """Rms of measured minus predicted [rad]."""
        return rms_error((self,))


def rms_error(runs: Sequence[FreeRun]) -> float:
    """Rms of measured minus predicted over several runs [rad]; infinite where a run left the numbers."""
    return _rms(np.concatenate([r.squared_error for r in runs]))


def motor_rms_error(runs: Sequence[FreeRun]) -> float | None:
    """Likewise of the motor's angle; None for a reduced model."""
    errors = [
        (r.measured_motor_angle - r.motor_angle)[r.counts]
        for r in runs
        if r.motor_angle is not None and r.measured_motor_angle is not None
    ]
    return _rms(np.concatenate(errors) ** 2) if errors else None


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
) -> tuple[FreeRun, ...]:
    """Simulate each stretch from its first [`WINDOW`][] samples on.

    Args:
        model: the equations with their values.
        stretches: where to run. Measured outputs beyond the window are not looked at.
        covariance: of the measurement noise of the outputs.
        halo: intervals of torque before the start, for delays.
        substeps: solver steps in a sample interval.
        like: a fit of the same model, whose compiled program then finds the initial states as well.
    """
    if substeps is None:
        substeps = suggested_substeps(model, stretches)
    starts = fitted_starts(model, stretches, covariance=covariance, halo=halo, substeps=substeps, like=like)
    states = _rest_where_at_rest(model, starts, len(stretches))
    problem = whole_simulations(model, free_parameters(model, (), {}), stretches, halo, substeps)
    outputs = np.asarray(simulate(problem, Unknowns(jnp.asarray(np.zeros(0)), states))[0])
    runs = []
    for stretch, output in zip(stretches, outputs, strict=True):
        n = len(stretch)
        part = slice(stretch.start, stretch.stop)
        measured = stretch.experiment.measured[part]
        motor = measured_motor = None
        if isinstance(model, TwoInertiaModel):
            motor, measured_motor = (y[:, 0] * float(model.drive.N) for y in (output[:n], measured))
        runs.append(
            FreeRun(
                name=stretch.name,
                time=stretch.experiment.time[part],
                predicted=output[:n, -1],
                measured=measured[:, -1],
                motor_angle=motor,
                weight=stretch.weight,
                measured_motor_angle=measured_motor,
            )
        )
    return tuple(runs)


def whole_simulations(
    model: Model, free: FreeParameters, stretches: Sequence[Stretch], halo: int, substeps: int
) -> Problem:
    """Each stretch as one simulation, with unit weights.

    Args:
        model: the equations.
        free: parameters to differentiate by.
        stretches: where to run.
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
    windows = [s.beginning(WINDOW) for s in stretches]
    paths, length, count = (), max(WINDOW, *(len(w) for w in windows)), len(stretches)
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
    """Initial states, with rates set to zero where the window can't tell them from zero.

    A short window knows a rate poorly, and the error grows with time. A log that begins at rest is common; where
    that is compatible with the window (1 % level), rest is taken.
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
        # What the window does not see at all is as good as at rest.
        towards = np.linalg.pinv(block, rcond=1e-12, hermitian=True) @ rate
        if rate @ towards < _REST_LIMIT[rates.size]:
            states[lane] -= covariance[:, rates] @ towards * float(excess[lane])
            states[lane, rates] = 0.0
    return jnp.asarray(states)
