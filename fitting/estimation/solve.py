"""Least squares of one problem: optimistix' loop around the model's machine code, as one program for all models.

That program depends on sizes alone. Where a model has no machine code its residual is a program of its own, and where
effects change the logged torque that is one: there the host takes the steps.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, Shaped

from fitting.estimation.engines import linearise, rows_at
from fitting.estimation.levenberg_marquardt import ArrowLevenbergMarquardt, Iteration
from fitting.estimation.machine_code import Task, task
from fitting.estimation.residual import Blocks, Problem, Products, Unknowns
from hdjax.compilation import jit_small
from hdjax.lanes import on_one_device, placed_like
from hdjax.where import where

FIRST_DAMPING, NEARBY_DAMPING = 1e-3, 1e-9
"""Damping of the first step, relative to the diagonal of J^T J: from a start, and from the solution under other
weights."""

# A step that would carry a positive parameter farther (a factor e) was promised by a slope that does not reach so far:
# a corner that leaps to zero shows no slope there, and never comes back.
_LONGEST_LOG = 1.0

# Seconds until a program is left: an interrupt waits as long.
_BURST = 0.3
# What a step takes for a sample and a sensitivity, in seconds: a first guess.
_SAMPLE = 1.5e-8

# What steps are made by is compiled for multiples of so many parameters.
_WIDTH = 4


class LeftOver(eqx.Module):
    """What the model leaves over at some point.

    Attributes:
        error: measured minus simulated.
        covariance: of the error.
        squares: each segment's sum of squares.
    """

    error: Float[np.ndarray, "segments samples outputs"]
    covariance: Float[np.ndarray, "outputs outputs"]
    squares: Float[np.ndarray, " segments"]


class Solution(eqx.Module):
    """Where the iteration has come to.

    Attributes:
        unknowns: the fitted ones.
        left_over: by the model there.
        success: whether the next step promised next to nothing.
        steps: how many were taken.
    """

    unknowns: Unknowns
    left_over: LeftOver
    success: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True)


def solve(
    problem: Problem, start: Unknowns, max_steps: int, damping: float, *, least_progress: float = 0.0
) -> Solution:
    """Iterate to the least squares.

    Args:
        problem: what is solved.
        start: where the iteration begins.
        max_steps: where it ends at the latest.
        damping: of the first step, see [`FIRST_DAMPING`][].
        least_progress: share of the sum of squares that a few steps must take off it for the iteration to go on.
    """
    segments = problem.segments
    count = start.parameters.shape[0]
    solver = ArrowLevenbergMarquardt(
        joined=on_one_device(segments.joined),
        gap_weight=on_one_device(problem.gap_weight),
        damping=np.asarray(damping),
        most_steps=np.asarray(max_steps),
        rows=np.asarray(float(segments.weight.size * segments.measured.shape[2])),
        longest=np.where(_widened(problem.free.logarithmic), _LONGEST_LOG, np.inf),
        least_progress=np.asarray(least_progress),
    )
    unknowns = Unknowns(jnp.asarray(_widened(start.parameters)), on_one_device(start.states))
    looked_at = task(problem, start, unknowns.parameters.size)
    if looked_at is not None and looked_at.acting is None:
        point = _in_bursts(problem, unknowns, solver, looked_at)
    else:
        point = _by_host(problem, start, unknowns, solver, looked_at)
    found = Unknowns(jnp.asarray(np.asarray(point.unknowns.parameters)[:count]), point.unknowns.states)
    return Solution(found, _left_over(problem, point.rows), bool(point.success), int(point.state.count))


class _Point(eqx.Module):
    """Where an iteration stands.

    Attributes:
        unknowns: the best so far.
        state: of the solver.
        rows: of the residual at the best.
        done: whether the iteration has ended.
        success: whether it has succeeded.
    """

    unknowns: Unknowns
    state: Iteration
    rows: Float[Array | np.ndarray, "segments rows"]
    done: Bool[Array | np.ndarray, ""]
    success: Bool[Array | np.ndarray, ""]


def _in_bursts(problem: Problem, unknowns: Unknowns, solver: ArrowLevenbergMarquardt, looked_at: Task) -> _Point:
    """The iteration as one program, left now and then so that it can be interrupted."""
    point = _begun(unknowns, solver, *looked_at.blank())
    tangents = unknowns.parameters.size + unknowns.states.shape[1]
    guess = _SAMPLE * problem.segments.weight.size * tangents * int(problem.substeps)
    burst = int(np.clip(_BURST / guess, 1, 1000))
    while not bool(point.done):
        begun, before = time.perf_counter(), int(point.state.count)
        point = _iterate(point, solver, looked_at, np.asarray(burst))
        jax.block_until_ready(point.done)
        each = (time.perf_counter() - begun) / (int(point.state.count) - before)
        burst = int(np.clip(_BURST / each, 1, 1000))
    return point


def _by_host(
    problem: Problem, start: Unknowns, unknowns: Unknowns, solver: ArrowLevenbergMarquardt, looked_at: Task | None
) -> _Point:
    """The iteration step by step, where what is looked at is no part of one program for all models."""
    count, free = start.parameters.shape[0], problem.free
    more = (0, unknowns.parameters.size - count)
    slope = jnp.asarray(np.pad(np.asarray(free.precision * problem.active), more))

    def seen_from(wide: Unknowns) -> tuple[Products, Array]:
        if looked_at is not None:
            return looked_at.look(wide)
        own = placed_like(Unknowns(jnp.asarray(np.asarray(wide.parameters)[:count]), wide.states), start)
        products, rows = _products(on_one_device(linearise(problem, own, unknowns.parameters.size)))
        off = free.off_prior(np.asarray(own.parameters))
        return products.beside_prior(jnp.asarray(np.pad(off, more)), slope), rows

    seen = seen_from(unknowns)
    point = _begun(unknowns, solver, *seen)
    while True:
        point = _next_by_host(point, *seen, solver)
        if bool(point.done):
            return point
        seen = seen_from(point.state.ahead)


@jit_small
def _products(found: Blocks) -> tuple[Products, Array]:
    return Products.of(found), found.residual


def _begun(unknowns: Unknowns, solver: ArrowLevenbergMarquardt, seen: Any, rows: Any) -> _Point:
    """The point that an iteration starts from; of what is seen, shapes suffice."""
    state = solver.init(_function, unknowns, seen, {}, None, seen, frozenset())
    no = np.zeros((), bool)
    return _Point(unknowns, state, np.zeros(rows.shape), no, no)


@jit_small
def _iterate(
    point: _Point, solver: ArrowLevenbergMarquardt, looked_at: Task, most: Int[Array | np.ndarray, ""]
) -> _Point:
    """Go on from a point.

    Args:
        point: where the iteration stands.
        solver: what takes the steps.
        looked_at: what is minimised.
        most: steps after which to come back, at the end of the iteration or before.

    Returns:
        Where the iteration has come to.
    """
    last = point.state.count + most

    def step(point: _Point) -> _Point:
        return _next(point, *looked_at.look(point.state.ahead), solver)

    return jax.lax.while_loop(lambda p: ~p.done & (p.state.count < last), step, point)


def _next(point: _Point, seen: Products, rows: Array, solver: ArrowLevenbergMarquardt) -> _Point:
    """One step of the solver, as optimistix' own loop takes it.

    Args:
        point: where the iteration stands.
        seen: at the point that was to be looked at next.
        rows: of the residual there.
        solver: what takes the step.
    """
    best, state, _ = solver.step(_function, point.unknowns, seen, {}, point.state, frozenset())
    done, result = solver.terminate(_function, best, seen, {}, state, frozenset())
    finite = jnp.all(jnp.isfinite(best.parameters)) & jnp.all(jnp.isfinite(best.states))
    good = (result == optx.RESULTS.successful) & finite
    return _Point(best, state, where(state.accepted, rows, point.rows), done | ~good, done & good)


_next_by_host = jit_small(_next)


def _function(unknowns: Unknowns, seen: Products) -> tuple[None, Products]:
    """What the solver minimises, where it has been looked at already."""
    return None, seen


def _widened(by_parameter: Shaped[Array | np.ndarray, " parameters"] | tuple[bool, ...]) -> np.ndarray:
    """With zeros for parameters that there are not: few numbers of them make few programs."""
    array = np.asarray(by_parameter)
    return np.pad(array, (0, -array.size % _WIDTH))


def evaluate(problem: Problem, unknowns: Unknowns) -> LeftOver:
    """What is left over at the given unknowns."""
    return _left_over(problem, rows_at(problem, unknowns))


def _left_over(problem: Problem, rows: Float[Array | np.ndarray, "segments rows"]) -> LeftOver:
    """What the rows of a residual say."""
    segments, found = problem.segments, np.asarray(rows)
    measured, weight = np.asarray(segments.measured), np.asarray(segments.weight)[:, :, None]
    white = found[:, : measured[0].size].reshape(measured.shape)
    error = white @ np.linalg.inv(np.asarray(problem.whitening)).T
    return LeftOver(error, _covariance(error, measured, weight), np.sum(found**2, axis=1))


def _covariance(error: np.ndarray, measured: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Covariance of the output error. Runaway simulations count as large, not as unknown."""
    samples = np.sum(weight)
    mean = np.sum(measured * weight, axis=(0, 1)) / samples
    span = np.sqrt(np.sum((measured - mean) ** 2 * weight, axis=(0, 1)) / samples)
    rows = (np.clip(np.nan_to_num(error, nan=np.inf), -10 * span, 10 * span) * weight).reshape(-1, span.size)
    # The floor keeps an output that the model follows to the last bit from becoming infinitely certain.
    # Nor may two outputs that run away alike be one.
    covariance = rows.T @ rows / samples
    return covariance + np.diag((1e-9 * span + 1e-300) ** 2 + 1e-12 * np.diag(covariance))
