"""The only least squares: parameters, initial states and noise covariance from segments of logs."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from fitting.arrow import ArrowLevenbergMarquardt
from fitting.experiment import Segments, Stretch, cut, scales
from fitting.free import FreeParameters, free_parameters
from fitting.residual import (
    Problem,
    Unknowns,
    output_error,
    residual,
    residual_with_blocks,
)
from hdjax import Drive, Model, TwoInertiaModel

# Passes of "fit, then weigh the outputs by what was left over"; the covariance settles after two or three.
_REWEIGHTINGS = 3
# Longer segments are fitted from states that shorter ones have found already.
_LONGEST_RETRY = 2048
# A segment with this many times the median sum of squares may have ended in a wrong minimum.
_OUTLIER = 6.0
_RETRY_STEPS = 12
# A Runge-Kutta step of Tsit5 turns the fastest oscillation by at most this angle [rad]: error about 1e-5 of x.
_STEP_ANGLE = 0.3


class Fit(eqx.Module):
    """A fitted model and what it leaves over.

    Attributes:
        model: with the fitted values.
        problem: what was solved (its model holds the starting values).
        unknowns: the solution.
        error: measured minus simulated outputs on each segment.
        covariance: of the output error, from the error itself.
        objective: half the log-determinant of that covariance; a decrease of 0.01 is 1 % less error.
        stretches: the data.
        converged: whether the iteration met its tolerance.
        steps: iterations spent.
    """

    model: Model
    problem: Problem
    unknowns: Unknowns
    error: Float[Array, "segments samples outputs"]
    covariance: Float[Array, "outputs outputs"]
    objective: float = eqx.field(static=True)
    stretches: tuple[Stretch, ...]
    converged: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    @property
    def free(self) -> FreeParameters:
        """What was free."""
        return self.problem.free

    @property
    def dynamic_error_std(self) -> float:
        """Rms of what is left of the dynamic error [rad]."""
        return float(np.sqrt(self.covariance[-1, -1]))


def fit(
    model: Model,
    stretches: Sequence[Stretch],
    paths: Sequence[str],
    *,
    horizon: int,
    halo: int = 0,
    substeps: int | None = None,
    max_steps: int = 60,
    covariance: Float[Array, "outputs outputs"] | None = None,
    reweigh: bool = True,
    hold_parameters: bool = False,
    count: int | None = None,
    give_up_above: float = np.inf,
) -> Fit:
    """Fit parameters of a model to stretches of logs.

    The stretches are cut into segments of `horizon` samples. Each segment's initial state is fitted with the shared
    parameters. The outputs are weighed by the covariance of what is left over, which maximises the likelihood
    of Gaussian errors of unknown covariance: an output that the model cannot follow loses its say.

    Args:
        model: equations and starting values.
        stretches: the data.
        paths: dotted paths of what is free; may be empty.
        horizon: samples in a segment. Short ones converge from far away, long ones use the data fully.
        halo: intervals of torque before each segment, for delays.
        substeps: solver steps in a sample interval; from the natural frequency where not given.
        max_steps: iterations of each pass at most.
        covariance: of the outputs' errors to start the weighing with.
        reweigh: whether to weigh by what is left over; with False the given covariance is kept.
        hold_parameters: fit the initial states only, by the same program that fits the parameters.
        count: number of segments, see [`fitting.experiment.cut`][].
        give_up_above: an objective that the fit must reach in its first pass to be worth another.

    Returns:
        The fit.
    """
    segments = cut(stretches, horizon, halo=halo, count=count)
    if substeps is None:
        substeps = suggested_substeps(model, stretches)
    free = free_parameters(model, paths, typical_scales(model, stretches))
    states = initial_states(model, segments)
    unknowns = Unknowns(free.pack(model), states)
    active = jnp.full(len(paths), 0.0 if hold_parameters else 1.0)
    outputs = segments.measured.shape[-1]
    problem = Problem(model, free, segments, jnp.eye(outputs), active, substeps=substeps)
    if covariance is None:
        covariance = _covariance(_error(problem, unknowns), segments)
    objective, converged, steps = np.inf, False, 0
    error = None
    for turn in range(_REWEIGHTINGS if reweigh else 1):
        problem = eqx.tree_at(lambda p: p.whitening, problem, whitening(covariance))
        unknowns, error, success, taken = _solve(problem, unknowns, max_steps)
        if turn == 0 and horizon <= _LONGEST_RETRY:
            unknowns, changed = _retry_states(problem, unknowns)
            if changed:
                unknowns, error, success, taken = _solve(problem, unknowns, max_steps)
        covariance = _covariance(error, segments)
        before, objective = objective, _half_log_determinant(covariance)
        converged, steps = bool(success), steps + int(taken)
        if not np.isfinite(objective) or abs(before - objective) < 1e-4 or objective > give_up_above:
            break
    assert error is not None
    return Fit(
        model=free.unpack(model, unknowns.parameters),
        problem=problem,
        unknowns=unknowns,
        error=error,
        covariance=covariance,
        objective=objective,
        stretches=tuple(stretches),
        converged=converged,
        steps=steps,
    )


@eqx.filter_jit
def _solve(problem: Problem, start: Unknowns, max_steps: int):
    solution = optx.least_squares(
        residual_with_blocks,
        ArrowLevenbergMarquardt(rtol=1e-4, atol=1e-4),
        start,
        args=problem,
        max_steps=max_steps,
        throw=False,
    )
    error = output_error(problem, solution.value)
    success = solution.result == optx.RESULTS.successful
    return solution.value, error, success, jnp.asarray(solution.stats["num_steps"])


def _retry_states(problem: Problem, unknowns: Unknowns) -> tuple[Unknowns, bool]:
    """Fit each segment's initial state anew, from its first samples to all of them, and keep the better one.

    A nonsmooth model gives a segment several minima; a poor initial state ends in a wrong one, and a few such
    segments would dominate the sum of squares. Masking the later samples lets the same compiled program do it.
    """
    weight = problem.segments.weight
    held = eqx.tree_at(lambda p: p.active, problem, jnp.zeros_like(problem.active))
    model = problem.free.unpack(problem.model, unknowns.parameters)
    fresh = Unknowns(unknowns.parameters, initial_states(model, problem.segments))
    old = _squares(problem, unknowns)
    squares = np.asarray(old)[np.asarray(weight).any(axis=1)]
    if squares.max() < _OUTLIER * np.median(squares):
        return unknowns, False
    length = weight.shape[1]
    for samples in (max(length // 8, min(length, 16)), length // 2, length):
        masked = weight * (jnp.arange(length) < samples).astype(weight.dtype)[None, :]
        part = eqx.tree_at(lambda p: p.segments.weight, held, masked)
        fresh, _, _, _ = _solve(part, fresh, _RETRY_STEPS)
    better = np.asarray(_squares(problem, fresh) < 0.99 * old)
    states = jnp.where(better[:, None], fresh.states, unknowns.states)
    return Unknowns(unknowns.parameters, states), bool(np.any(better))


@eqx.filter_jit
def _squares(problem: Problem, unknowns: Unknowns) -> Array:
    return jnp.sum(residual(problem, unknowns) ** 2, axis=1)


@eqx.filter_jit
def _error(problem: Problem, unknowns: Unknowns):
    return output_error(problem, unknowns)


@jax.jit
def whitening(covariance: Float[Array, "outputs outputs"]) -> Float[Array, "outputs outputs"]:
    """W with `W covariance W^T = 1`."""
    return jnp.linalg.inv(jnp.linalg.cholesky(covariance))


def _covariance(error: Array, segments: Segments) -> Array:
    """Covariance of the output error. Runaway simulations count as large, not as unknown."""
    measured = np.asarray(segments.measured)
    weight = np.asarray(segments.weight)
    span = np.std(measured[weight > 0], axis=0)
    bounded = np.clip(np.nan_to_num(np.asarray(error), nan=np.inf), -10 * span, 10 * span)
    rows = bounded[weight > 0]
    # The floor keeps an output that the model follows to the last bit from becoming infinitely certain.
    floor = np.diag((1e-9 * span + 1e-300) ** 2)
    return jnp.asarray(rows.T @ rows / rows.shape[0] + floor)


def _half_log_determinant(covariance: Array) -> float:
    sign, value = np.linalg.slogdet(np.asarray(covariance))
    return float(0.5 * value) if sign > 0 else np.inf


def initial_states(model: Model, segments: Segments) -> Float[Array, "segments states"]:
    """Each segment's first state from a local polynomial through its first samples; hidden states at rest."""
    count = min(9, segments.measured.shape[1])
    measured = np.asarray(segments.measured[:, :count])
    halo = segments.halo
    t = np.asarray(segments.torque.knots[:, halo : halo + count])
    t = t - t[:, :1]
    scaled = t / t[:, -1:]
    basis = scaled[:, :, None] ** np.arange(4)[None, None, :]
    coefficients = np.linalg.pinv(basis) @ measured
    value, rate = coefficients[:, 0], coefficients[:, 1] / t[:, -1:]
    if isinstance(model, TwoInertiaModel):
        N = float(model.drive.N)
        columns = [N * value[:, 0], value[:, 0] - value[:, 1]]
        columns += [N * rate[:, 0], rate[:, 0] - rate[:, 1]]
    else:
        columns = [value[:, 0], rate[:, 0]]
    motion = np.stack(columns, axis=1)
    hidden = np.asarray(model.rest())[len(model.motion_states) :]
    return jnp.asarray(np.hstack([motion, np.tile(hidden, (motion.shape[0], 1))]))


def typical_scales(model: Model, stretches: Sequence[Stretch]) -> dict[str, float]:
    """Units for parameters that may be zero: what makes each term visible at the measured twist."""
    motion = scales(stretches)
    drive = model.drive
    stiffness = float(drive.stiffness)
    damping = stiffness * motion.x / motion.v if motion.v > 0 else 1.0
    typical = {"alpha": 0.1 / motion.x_max**2} if motion.x_max > 0 else {}
    typical |= {"B_sp": 0.01 * damping} if isinstance(drive, Drive) else {"mu": 0.01 * damping}
    return typical


def natural_frequency(model: Model, stretches: Sequence[Stretch]) -> float:
    """The fastest oscillation of the dynamic error on the data [rad/s], hardening at full twist included."""
    drive = model.drive
    stiffening = max(0.0, 3.0 * float(drive.alpha) * scales(stretches).x_max ** 2)
    return float(drive.omega_0) * float(np.sqrt(1.0 + stiffening))


def suggested_substeps(model: Model, stretches: Sequence[Stretch]) -> int:
    """Solver steps in a sample interval that resolve the fastest oscillation."""
    angle = natural_frequency(model, stretches) * stretches[0].experiment.time_step
    return int(np.clip(np.ceil(angle / _STEP_ANGLE), 1, 16))


def short_horizon(model: Model, stretches: Sequence[Stretch], *, periods: float = 6.0) -> int:
    """Samples in a segment of about `periods` natural periods, as a power of two (few shapes, few programs)."""
    period = 2 * np.pi / natural_frequency(model, stretches) / stretches[0].experiment.time_step
    return int(2 ** np.clip(np.round(np.log2(periods * period)), 5, 11))


def measurement_noise(
    model: Model, stretches: Sequence[Stretch], *, halo: int = 0, substeps: int | None = None
) -> Float[Array, "outputs outputs"]:
    """Covariance of the outputs' measurement noise: what stays when each short piece of the log may start anew.

    Within half a period an initial state explains any smooth motion, missing physics included, so that little but
    noise is left. Corrected for the initial states that were fitted.
    """
    half_period = np.pi / natural_frequency(model, stretches) / stretches[0].experiment.time_step
    length = int(np.clip(np.round(half_period), 6, 24))
    found = fit(model, stretches, (), horizon=length, halo=halo, substeps=substeps)
    rows = length * found.covariance.shape[0]
    return found.covariance * (rows / (rows - len(model.motion_states)))


def needed_substeps(found: Fit, *, tolerance: float = 0.05, most: int = 8) -> int:
    """Solver steps in a sample interval that keep the step error below a fraction of the residual.

    Args:
        found: a fit; its own solution is simulated again with twice the steps, until that makes no difference.
        tolerance: largest rms difference in units of the residual's standard deviation.
        most: where to stop.
    """
    problem = eqx.tree_at(lambda p: p.model, found.problem, found.model)
    substeps = problem.substeps
    error = _error(problem, found.unknowns)
    while substeps < most:
        finer = dataclasses.replace(problem, substeps=2 * substeps)
        better = _error(finer, found.unknowns)
        white = np.asarray(better - error) @ np.asarray(problem.whitening).T
        mean_square = (white**2).sum(axis=(0, 1)) / float(problem.segments.count)
        if np.sqrt(mean_square.max()) < tolerance:
            break
        substeps, error = 2 * substeps, better
    return substeps
