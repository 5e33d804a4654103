"""Least squares of one problem: the model's program looks at a point, another one says where to look next.

That one has nothing of the model in it, so that models with as many parameters and states share it; within the model's
own program it would be compiled again for each, and take longer than the rest of it.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, Shaped

from fitting.arrow import ArrowDescent, ArrowLevenbergMarquardt
from fitting.engines import linearise
from fitting.machine_code import Task, task
from fitting.residual import Blocks, LinearisedResidual, Problem, Unknowns, moved_residual, seen_residual
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

    error: Float[Array, "segments samples outputs"]
    covariance: Float[Array, "outputs outputs"]
    squares: Float[Array, " segments"]


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


class _Rules(eqx.Module):
    """What an iteration goes by, beside what it sees.

    Attributes:
        joined: whether a segment starts where the one before it ends.
        gap_weight: of each state, as in the problem.
        longest: how far a step may carry each parameter.
        most_steps: where the iteration ends at the latest.
        damping: of the first step.
        least_progress: see [`solve`][].
    """

    joined: Bool[Array, " segments"]
    gap_weight: Float[Array, " states"]
    longest: Float[Array, " parameters"]
    most_steps: Int[Array, ""]
    damping: Float[Array, ""]
    least_progress: Float[Array, ""]

    def solver(self) -> ArrowLevenbergMarquardt:
        descent = ArrowDescent(self.joined, self.gap_weight, self.damping, self.longest)
        return ArrowLevenbergMarquardt(descent=descent, most_steps=self.most_steps, least_progress=self.least_progress)


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
    longest = np.where(_widened(np.array(problem.free.logarithmic)), _LONGEST_LOG, np.inf)
    numbers = (jnp.asarray(np.asarray(a)) for a in (longest, max_steps, damping, least_progress))
    rules = _Rules(*on_one_device((problem.segments.joined, problem.gap_weight)), *numbers)
    unknowns = Unknowns(_widened(start.parameters), on_one_device(start.states))
    looked_at = task(problem, start, unknowns.parameters.size)
    if looked_at is None:
        return _solve_by_host(problem, start, unknowns, rules)
    return _solve_in_bursts(problem, start, unknowns, rules, looked_at)


def _solve_in_bursts(problem: Problem, start: Unknowns, unknowns: Unknowns, rules: _Rules, looked_at: Task) -> Solution:
    """The whole iteration as one program, left now and then so that it can be interrupted."""
    segments, count = problem.segments, start.parameters.shape[0]
    tangents = unknowns.parameters.size + unknowns.states.shape[1]
    guess = _SAMPLE * segments.weight.size * tangents * int(problem.substeps)
    point, left, burst = None, None, int(np.clip(_BURST / guess, 1, 1000))
    while point is None or not bool(point.done):
        begun = time.perf_counter()
        most = jnp.asarray(np.asarray(burst))
        if point is None:
            point, left = _begin_iteration(unknowns, rules, looked_at, most, problem.whitening, segments.measured)
        else:
            point, left = _iterate(point, rules, looked_at, most, problem.whitening, segments.measured)
        point.done.block_until_ready()
        each = (time.perf_counter() - begun) / burst
        burst = int(np.clip(_BURST / each, 1, 1000))
    assert left is not None
    found = Unknowns(jnp.asarray(np.asarray(point.unknowns.parameters)[:count]), point.unknowns.states)
    return Solution(found, left, bool(point.success), int(point.steps))


def _solve_by_host(problem: Problem, start: Unknowns, unknowns: Unknowns, rules: _Rules) -> Solution:
    """The iteration step by step, where each model's residual is a program of its own."""
    count = start.parameters.shape[0]
    ahead = unknowns
    rows = carried = None
    steps, done, success = 0, False, False

    def at(wide: Unknowns) -> Unknowns:
        return placed_like(Unknowns(jnp.asarray(np.asarray(wide.parameters)[:count]), wide.states), start)

    while not done:
        seen = on_one_device(linearise(problem, at(ahead), unknowns.parameters.size))
        if carried is None:
            carried = _begin(unknowns, seen, rules)
        unknowns, ahead, carried, *flags = _step(unknowns, carried, seen, rules)
        accepted, done, success = map(bool, flags)
        rows = seen.residual if accepted or rows is None else rows
        steps += 1
    assert rows is not None
    return Solution(at(unknowns), _left_over(problem, rows), success, steps)


class _Point(eqx.Module):
    """Where an iteration stands.

    Attributes:
        unknowns: the best so far.
        ahead: where to look next.
        carried: arrays of the solver's state.
        rows: of the residual at the best.
        steps: how many were taken.
        done: whether the iteration has ended.
        success: whether it has succeeded.
    """

    unknowns: Unknowns
    ahead: Unknowns
    carried: list[Array]
    rows: Float[Array, "segments rows"]
    steps: Int[Array, ""]
    done: Bool[Array, ""]
    success: Bool[Array, ""]


@jit_small
def _begin_iteration(
    unknowns: Unknowns, rules: _Rules, looked_at: Task, most: Array, whitening: Array, measured: Array
) -> tuple[_Point, LeftOver]:
    """The first steps of an iteration; arguments as in [`_iterate`][]."""
    blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(looked_at.look, unknowns))
    carried, no = _arrays(_fresh(unknowns, blank[0], rules)), jnp.zeros((), bool)
    first = _Point(unknowns, unknowns, carried, blank[1], jnp.zeros((), int), no, no)
    return _run(first, rules, looked_at, most, whitening, measured)


@jit_small
def _iterate(
    point: _Point, rules: _Rules, looked_at: Task, most: Array, whitening: Array, measured: Array
) -> tuple[_Point, LeftOver]:
    """Go on from a point.

    Args:
        point: where the iteration stands.
        rules: what it goes by.
        looked_at: what is minimised.
        most: steps after which to come back, at the end of the iteration or before.
        whitening: of the outputs.
        measured: the outputs.

    Returns:
        Where the iteration has come to, and what is left over there.
    """
    return _run(point, rules, looked_at, most, whitening, measured)


def _run(
    point: _Point, rules: _Rules, looked_at: Task, most: Array, whitening: Array, measured: Array
) -> tuple[_Point, LeftOver]:
    last = point.steps + most

    def step(point: _Point) -> _Point:
        return _taken(point, *looked_at.look(point.ahead), rules)

    end = jax.lax.while_loop(lambda p: ~p.done & (p.steps < last), step, point)
    return end, _of_rows(end.rows, whitening, measured, jnp.asarray(looked_at.lanes.weight))


def _taken(point: _Point, seen: Blocks, rows: Array, rules: _Rules) -> _Point:
    best, ahead, carried, accepted, done, success = _step(point.unknowns, point.carried, seen, rules)
    kept = where(accepted | (point.steps == 0), rows, point.rows)
    return _Point(best, ahead, carried, kept, point.steps + 1, done, success)


def _widened(by_parameter: Shaped[Array | np.ndarray, "*before parameters"]) -> Shaped[Array, "*before wide"]:
    """On one device, with zeros for parameters that there are not: few numbers of them make few programs."""
    array = np.asarray(by_parameter)
    more = -array.shape[-1] % _WIDTH
    return jnp.asarray(np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, more)]))


def evaluate(problem: Problem, unknowns: Unknowns) -> LeftOver:
    """What is left over at the given unknowns, by the program of the fit."""
    return _left_over(problem, on_one_device(linearise(problem, unknowns).residual))


class _Sight(eqx.Module):
    """What is seen of a residual from one point."""

    found: Blocks
    rules: _Rules


@eqx.filter_custom_jvp
def _in_sight(unknowns: Unknowns, sight: _Sight) -> LinearisedResidual:
    return seen_residual(sight.found, sight.rules.gap_weight)


@_in_sight.def_jvp
def _in_sight_jvp(primals, tangents):
    _, sight = primals
    tangent, _ = tangents
    rules = sight.rules
    moved = moved_residual(sight.found, rules.gap_weight, rules.joined, tangent)
    return seen_residual(sight.found, rules.gap_weight), moved


def _function(unknowns: Unknowns, sight: _Sight) -> tuple[LinearisedResidual, None]:
    return _in_sight(unknowns, sight), None


@jit_small
def _begin(start: Unknowns, seen: Blocks, rules: _Rules) -> list[Array]:
    """What the first step carries on."""
    return _arrays(_fresh(start, seen, rules))


@jit_small
def _step(
    unknowns: Unknowns, carried: list[Array], seen: Blocks, rules: _Rules
) -> tuple[Unknowns, Unknowns, list[Array], Bool[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """One step of optimistix' solver, as its own loop takes it.

    Args:
        unknowns: the best so far.
        carried: see [`_begin`][].
        seen: at the point that was to be looked at next.
        rules: what the iteration goes by.

    Returns:
        The best now, where to look next, and what is carried on; whether the point that was seen is the best, whether
        the iteration ends, and whether it has succeeded.
    """
    solver, sight, tags = rules.solver(), _Sight(seen, rules), frozenset()
    # What of the solver's state is no array is the same every time.
    arrays, rest = eqx.partition(_fresh(unknowns, seen, rules), eqx.is_array)
    state = eqx.combine(jax.tree.unflatten(jax.tree.structure(arrays), carried), rest)
    best, state, _ = solver.step(_function, unknowns, sight, {}, state, tags)
    done, result = solver.terminate(_function, best, sight, {}, state, tags)
    finite = jnp.all(jnp.isfinite(best.parameters)) & jnp.all(jnp.isfinite(best.states))
    good = (result == optx.RESULTS.successful) & finite
    accepted = state.num_steps_since_acceptance == 0
    return best, state.y_eval, _arrays(state), accepted, done | ~good, done & good


def _fresh(unknowns: Unknowns, seen: Blocks, rules: _Rules):
    """The state that optimistix' solver begins with."""
    sight = _Sight(seen, rules)
    shapes, aux = eqx.filter_eval_shape(_function, unknowns, sight)
    return rules.solver().init(_function, unknowns, sight, {}, shapes, aux, frozenset())


def _arrays(state) -> list[Array]:
    """Those of a solver's state, of types that every step brings back."""
    return [jax.lax.convert_element_type(a, a.dtype) for a in jax.tree.leaves(eqx.filter(state, eqx.is_array))]


def _left_over(problem: Problem, rows: Float[Array, "segments rows"]) -> LeftOver:
    segments = problem.segments
    return _of_rows(rows, *on_one_device((problem.whitening, segments.measured, segments.weight)))


@jit_small
def _of_rows(rows: Array, whitening: Array, measured: Array, weight: Array) -> LeftOver:
    """What the rows of a residual say."""
    white = rows[:, : measured[0].size].reshape(measured.shape)
    error = jnp.einsum("ij,snj->sni", jnp.linalg.inv(whitening), white)
    return LeftOver(error, _covariance(error, measured, weight[:, :, None]), jnp.sum(rows**2, axis=1))


def _covariance(error: Array, measured: Array, weight: Array) -> Array:
    """Covariance of the output error. Runaway simulations count as large, not as unknown."""
    samples = jnp.sum(weight)
    mean = jnp.sum(measured * weight, axis=(0, 1), keepdims=True) / samples
    variance = jnp.sum((measured - mean) ** 2 * weight, axis=(0, 1), keepdims=True) / samples
    span = jnp.sqrt(variance)
    rows = jnp.clip(jnp.nan_to_num(error, nan=jnp.inf), -10 * span, 10 * span) * weight
    # The floor keeps an output that the model follows to the last bit from becoming infinitely certain.
    return jnp.einsum("sni,snj->ij", rows, rows) / samples + jnp.diag((1e-9 * span[0, 0] + 1e-300) ** 2)
