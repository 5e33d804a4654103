"""Least-squares fit of parameters, initial states and noise covariance to segments of logs."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from fitting.errors import DataError
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import FreeParameters
from fitting.estimation.late_readings import aligned, is_aligned
from fitting.estimation.problem import Segmentation, initial_states, on_all_devices, pose
from fitting.estimation.residual import RUNAWAY, Engine, Problem, Unknowns
from fitting.estimation.scales import of_twist, scales
from fitting.estimation.separate_states import Damping
from fitting.estimation.solve import FIRST_DAMPING, NEARBY_DAMPING, Solution, evaluate, solve
from fitting.estimation.weighing import Shown, weighed
from hdjax import Model

REWEIGHTINGS = 3
"""Passes of "fit, then reweigh the outputs by the residual's covariance"; it converges after two or three."""

# An output that the model can't follow may take longer to be down-weighted.
_MOST_REWEIGHTINGS = 12
# Simulations longer than this many segments start from the states of shorter ones.
_LONGEST_RETRY = 16
# A segment with this many times the median sum of squares may have ended in a wrong minimum.
_OUTLIER = 6.0
# Most moves of a late encoder's readings: the law's error in a long delay is less after each.
_MOST_MOVES = 4
# Iterations in each of the growing windows of samples.
_WINDOW_STEPS = 12


Label = TypeVar("Label", bound=Hashable)


class Start(eqx.Module):
    """Start of a fit, beside the values of its model.

    Attributes:
        covariance: initial covariance of the outputs' errors; the model's where not given.
        states: initial states of the segments; from their first samples where not given.
    """

    covariance: Float[Array | np.ndarray, "outputs outputs"] | None = None
    states: Float[Array | np.ndarray, "segments states"] | None = None


@dataclass(frozen=True)
class Strategy:
    """Settings of a fit's iteration.

    Attributes:
        max_steps: iterations of each pass at most; no pass begins after twice as many in total.
        least_progress: least relative decrease of the sum of squares over a few steps, see
            [`fitting.estimation.solve.solve`][].
        reweigh: whether to reweigh by the residual's covariance; with False the initial covariance is kept.
        hold_parameters: whether only the initial states are fitted, by the same program that fits the parameters; or
            the dotted paths of the parameters that are fixed.
        begin_anew_above: an objective above which a first pass that does not converge is repeated from the first
            samples of each segment.
        retry_states: whether segments with a large error after the first pass are repeated likewise: they may have
            ended in a wrong minimum.
        give_up_above: an objective above which no second pass follows the first.
    """

    max_steps: int = 60
    least_progress: float = 0.0
    reweigh: bool = True
    hold_parameters: bool | tuple[str, ...] = False
    begin_anew_above: float = -np.inf
    retry_states: bool = True
    give_up_above: float = np.inf

    def solve(self, problem: Problem, begin: Unknowns, damping: Damping) -> Solution:
        """One pass: least squares with fixed weights, by [`fitting.estimation.solve.solve`][]."""
        return solve(problem, begin, self.max_steps, damping, least_progress=self.least_progress)


class Fit(eqx.Module):
    """A fitted model and its residual.

    Attributes:
        model: with the fitted values.
        problem: the least-squares problem (its model holds the starting values).
        unknowns: the solution.
        error: measured minus simulated outputs on each segment.
        covariance: of the output error, estimated from it.
        objective: half the log-determinant of that covariance; a decrease of 0.01 means 1 % less error.
        stretches: the data.
        horizon: samples until a simulation starts anew.
        converged: whether the iteration met its tolerance.
        steps: iterations spent.
        was_held: whether all parameters were fixed.
    """

    model: Model
    problem: Problem
    unknowns: Unknowns
    error: Float[Array, "segments samples outputs"]
    covariance: Float[Array, "outputs outputs"]
    objective: float = eqx.field(static=True)
    stretches: tuple[Stretch, ...]
    horizon: int = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    was_held: bool = eqx.field(static=True)

    @property
    def free(self) -> FreeParameters:
        """The free parameters."""
        return self.problem.free

    @property
    def substeps(self) -> int:
        """Solver steps in a sample interval."""
        return int(self.problem.substeps)

    @property
    def segmentation(self) -> Segmentation:
        """The segmentation of its data; fits with the same segmentation share the compiled program."""
        count, length = self.problem.segments.weight.shape
        return Segmentation(self.horizon, length, self.problem.segments.halo, self.substeps, count)

    @property
    def at_solution(self) -> Problem:
        """The problem at the fitted values."""
        return eqx.tree_at(lambda p: p.model, self.problem, self.model)

    @property
    def white_error(self) -> Float[np.ndarray, "segments samples outputs"]:
        """The whitened output error."""
        return np.asarray(self.error) @ np.asarray(self.problem.whitening).T

    @property
    def pieces(self) -> Int[np.ndarray, " stretches"]:
        """Number of segments of each stretch; padding segments come last."""
        return np.array([-(-len(s) // self.error.shape[1]) for s in self.stretches])

    def by_stretch(self, values: Shaped[np.ndarray, "segments samples *each"]) -> list[Shaped[np.ndarray, "_ *each"]]:
        """Values per sample of the segments, rearranged by stretch, without padding."""
        parts = np.split(values, np.cumsum(self.pieces))
        return [a.reshape(-1, *a.shape[2:])[: len(s)] for s, a in zip(self.stretches, parts, strict=False)]

    @property
    def held(self) -> tuple[str, ...]:
        """Dotted paths of the parameters that were fixed."""
        active = np.asarray(self.problem.active)
        return tuple(path for path, free in zip(self.free.paths, active, strict=True) if not free)

    def with_all_free(self) -> "Fit":
        """The same with fixed parameters counted as free, to compute what the data say about them."""
        return eqx.tree_at(lambda f: f.problem.active, self, jnp.asarray(np.ones(self.problem.active.shape)))

    @property
    def principal_std(self) -> float:
        """Rms residual of the principal output."""
        return float(np.sqrt(self.covariance[-1, -1]))


def fit(
    model: Model,
    stretches: Sequence[Stretch],
    paths: Sequence[str],
    segmentation: Segmentation,
    *,
    start: Start = Start(),
    strategy: Strategy = Strategy(),
    engine: Engine | None = None,
) -> Fit:
    """Fit parameters of a model to stretches of logs.

    Simulations start anew after each horizon, and their initial states are fitted together with the shared parameters.
    Long horizons are cut into joined segments that are simulated in parallel. Their gaps close as the fit converges, so
    that the result equals that of one simulation (multiple shooting). The outputs are weighted by the residual's
    covariance, which maximises the likelihood of Gaussian errors of unknown covariance. An output that the model can't
    follow is down-weighted. Readings of a late encoder are moved by the whole rows of the fitted delay.

    Args:
        model: equations and starting values.
        stretches: the data.
        paths: dotted paths of the free parameters; may be empty.
        segmentation: how the data are cut into segments.
        start: covariance and initial states to start with.
        strategy: settings of the iteration.
        engine: that evaluates the residual; where not given, machine code, or XLA where that is impossible.

    Returns:
        The fit.

    Raises:
        DataError: an output never changes in the data.
    """
    found = _fit_aligned(*aligned(model, stretches), paths, segmentation, start, strategy, engine)
    for _ in range(_MOST_MOVES):
        if is_aligned(found.model, found.stretches):
            break
        start = Start(found.covariance, found.unknowns.states)
        data = aligned(found.model, found.stretches)
        found = _fit_aligned(*data, paths, segmentation, start, strategy, engine)
    return found


def _fit_aligned(
    model: Model,
    stretches: Sequence[Stretch],
    paths: Sequence[str],
    segmentation: Segmentation,
    start: Start,
    strategy: Strategy,
    engine: Engine | None,
) -> Fit:
    """[`fit`][] of data whose readings are moved for the model's delays."""
    problem, unknowns = pose(
        model,
        stretches,
        paths,
        segmentation,
        hold_parameters=strategy.hold_parameters,
        states=start.states,
        engine=engine,
    )
    if strategy.reweigh:
        _refuse_still(problem, stretches)
    moves = float(scales(stretches, model).x) * of_twist(model)[-1]
    shown = Shown.of(problem.model, moves)
    # The scale of a single output affects only the weight of priors: of parameters, and of hidden states.
    priors = np.any(np.asarray(problem.free.precision) > 0) or unknowns.states.shape[1] > len(model.motion_states)
    scale_matters = problem.segments.measured.shape[-1] > 1 or bool(priors)
    covariance = start.covariance
    if covariance is None:
        covariance = evaluate(problem, unknowns).covariance if scale_matters else np.array([[moves**2]])
    objective, steps = np.inf, 0
    solution = None
    for turn in range(_MOST_REWEIGHTINGS if strategy.reweigh and scale_matters else 1):
        problem = weighed(problem, covariance, shown)
        solution = strategy.solve(problem, unknowns, FIRST_DAMPING if solution is None else solution.damping)
        if turn == 0 and segmentation.horizon <= _LONGEST_RETRY * problem.segments.weight.shape[1]:
            solution = _with_poor_states_retried(problem, unknowns, solution, strategy)
        unknowns, covariance = solution.unknowns, solution.left_over.covariance
        before, objective = objective, half_log_determinant(covariance)
        steps += solution.steps
        settled = not np.isfinite(objective) or abs(before - objective) < max(1e-4, 0.5 * strategy.least_progress)
        if settled or objective > strategy.give_up_above or steps >= 2 * strategy.max_steps:
            break
    assert solution is not None
    # Via the host: computations with the model alone need not run on every device.
    values = jnp.asarray(np.asarray(unknowns.parameters))
    return Fit(
        model=problem.free.unpack(model, values),
        problem=weighed(problem, covariance, shown) if strategy.reweigh else problem,
        unknowns=unknowns,
        error=jnp.asarray(solution.left_over.error),
        covariance=jnp.asarray(covariance),
        objective=objective,
        stretches=tuple(stretches),
        horizon=segmentation.horizon,
        converged=solution.success,
        steps=steps,
        was_held=not np.any(np.asarray(problem.active)),
    )


def _refuse_still(problem: Problem, stretches: Sequence[Stretch]) -> None:
    """Refuse data in which an output never changes: its weight would be infinite."""
    seen = np.asarray(problem.segments.measured)[np.asarray(problem.segments.weight) > 0]
    for name, swing in zip(problem.model.measured, np.ptp(seen, axis=0), strict=True):
        if swing == 0.0:
            ends = [(s.experiment.time[[s.start, s.stop - 1]], s.name) for s in stretches]
            told = ", ".join(f"{name} from {begin:.4g} s to {end:.4g} s" for (begin, end), name in ends)
            raise DataError(
                f"{name.replace('motor_turn', 'motor_angle')} does not change in {told}; cut this part off, or record "
                "motion in it"
            )


def _with_poor_states_retried(problem: Problem, begin: Unknowns, found: Solution, strategy: Strategy) -> Solution:
    """Repeat the first pass from other initial states, in all or some segments, as the strategy states.

    Args:
        problem: the least-squares problem.
        begin: start of the first pass.
        found: its result.
        strategy: settings of the iteration.
    """
    reached = half_log_determinant(found.left_over.covariance)
    if reached > strategy.begin_anew_above and not (found.success or strategy.hold_parameters):
        grown = _grown(problem, begin, strategy.least_progress)
        again = strategy.solve(problem, grown, NEARBY_DAMPING)
        found = min(found, again, key=lambda s: np.sum(s.left_over.squares))
    mended = _retry_states(problem, found, strategy.least_progress) if strategy.retry_states else None
    return found if mended is None else strategy.solve(problem, mended, found.damping)


def _grown(problem: Problem, unknowns: Unknowns, least_progress: float) -> Unknowns:
    """Fit a growing window of each segment's first samples, up to the whole segment.

    Over half a natural period a simulation depends so smoothly on parameters and state that the fit converges from far
    away. Each window's solution is a good start for the next one. Later samples are masked, so that the compiled
    program stays the same.
    """
    weight = problem.segments.weight
    length = weight.shape[1]
    apart = zeros_like(problem.segments.joined)
    for samples in _growing(problem, length):
        masked = jnp.asarray(np.asarray(weight) * (np.arange(length) < samples)[None, :])
        part = eqx.tree_at(lambda p: (p.segments.weight, p.segments.joined), problem, (masked, apart))
        part, unknowns = on_all_devices(part, unknowns)
        unknowns = solve(part, unknowns, _WINDOW_STEPS, FIRST_DAMPING, least_progress=least_progress).unknowns
    return unknowns


def _retry_states(problem: Problem, found: Solution, least_progress: float) -> Unknowns | None:
    """Refit each segment's initial state over growing windows and keep the better one; None where none is better.

    A nonsmooth model gives a segment several minima; a poor initial state ends in a wrong one, and a few such
    segments would dominate the sum of squares.
    """
    parameters, old = found.unknowns.parameters, found.left_over.squares
    suspect = old > _OUTLIER * np.median(old[np.asarray(problem.segments.weight).any(axis=1)])
    if not suspect.any():
        return None
    held = eqx.tree_at(lambda p: p.active, problem, zeros_like(problem.active))
    model = problem.free.unpack(problem.model, parameters)
    fresh = _grown(held, Unknowns(parameters, initial_states(model, problem.segments)), least_progress)
    new = evaluate(problem, fresh).squares
    better = (new < 0.99 * old) & suspect
    if not better.any():
        return None
    return Unknowns(parameters, jnp.asarray(np.where(better[:, None], fresh.states, found.unknowns.states)))


def zeros_like(array: Array) -> Array:
    """Zeros of an array's shape, without compiling a program."""
    return jax.device_put(np.zeros(array.shape, array.dtype), array.sharding if array.committed else None)


def _growing(problem: Problem, length: int) -> list[int]:
    """Window lengths from half a natural period, within which few wrong states diverge, to the whole segment."""
    knots = np.asarray(problem.segments.torque.knots)
    half = np.pi / float(problem.model.drive.omega_0) / float(np.median(np.diff(knots)))
    first = min(length, max(4, round(half)))
    return [first * 4**k for k in range(10) if first * 4**k < length] + [length]


def half_log_determinant(covariance: Array | np.ndarray) -> float:
    """The objective of errors with this covariance; infinite where it is not positive definite."""
    with np.errstate(all="ignore"):
        sign, value = np.linalg.slogdet(np.asarray(covariance))
    return float(0.5 * value) if sign > 0 and np.isfinite(value) else np.inf


def segments_by(found: Fit, label: Callable[[Stretch], Label]) -> dict[Label, Bool[np.ndarray, " segments"]]:
    """The segments of a fit whose stretches share a label, such as their log, in the order of first stretches."""
    ends, place = np.cumsum(found.pieces), np.arange(len(found.error))
    by_label: dict[Label, Bool[np.ndarray, " segments"]] = {}
    for stretch, end, count in zip(found.stretches, ends, found.pieces, strict=True):
        own, key = (end - count <= place) & (place < end), label(stretch)
        by_label[key] = own | by_label[key] if key in by_label else own
    return by_label


def log_of(stretch: Stretch) -> str:
    """Name of the log that a stretch between gaps belongs to."""
    return stretch.experiment.log


def followed_error(found: Fit) -> Float[np.ndarray, "segments samples outputs"]:
    """The whitened output error; zero in the segments in which the simulation diverges."""
    return np.where(lost(found)[:, None, None], 0.0, found.white_error)


def lost(found: Fit) -> Bool[np.ndarray, " segments"]:
    """The segments in which the simulation diverges."""
    return np.logical_not(np.all(np.abs(found.white_error) < RUNAWAY, axis=(1, 2)))


def mostly_lost(found: Fit) -> bool:
    """Whether the simulation diverges in more than half of the segments, so that the fit means nothing."""
    return bool(np.mean(lost(found)) > 0.5)
