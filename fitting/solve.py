"""One program a model: it iterates to the least squares, and looks at any point on the way."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from fitting.arrow import ArrowDescent, ArrowLevenbergMarquardt, blocks_seen
from fitting.experiment import Segments
from fitting.residual import Blocks, Problem, Unknowns, residual_with_blocks
from hdjax.lanes import jit_lanes
from hdjax.where import where

FIRST_DAMPING, NEARBY_DAMPING = 1e-3, 1e-9
"""Damping of the first step, relative to the diagonal of J^T J: from a start, and from the solution under other
weights."""

# A step that would carry a positive parameter farther (a factor e) was promised by a slope that does not reach so far:
# a corner that leaps to zero shows no slope there, and never comes back.
_LONGEST_LOG = 1.0


class Solution(eqx.Module):
    """Where the iteration has come to.

    Attributes:
        unknowns: the fitted ones.
        error: measured minus simulated.
        covariance: of the error.
        squares: each segment's sum of squares.
        blocks: residual and Jacobian.
        success: whether the next step promised next to nothing.
        steps: how many were taken.
    """

    unknowns: Unknowns
    error: Float[Array, "segments samples outputs"]
    covariance: Float[Array, "outputs outputs"]
    squares: Float[Array, " segments"]
    blocks: Blocks
    success: Bool[Array, ""]
    steps: Int[Array, ""]


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
    return _solve(problem, start, *_numbers(max_steps, damping, least_progress))


def prepare(problem: Problem, start: Unknowns) -> Callable[[], object]:
    """Have the program for such a problem made beside what else is done; what is returned calls it off."""
    return _solve.prepare(problem, start, *_numbers(1, FIRST_DAMPING, 0.0))


def _numbers(max_steps: int, damping: float, least_progress: float) -> list[Array]:
    return [jnp.asarray(np.asarray(a)) for a in (max_steps, damping, least_progress)]


def evaluate(problem: Problem, unknowns: Unknowns) -> Solution:
    """What there is at the given unknowns, by the program of the fit: its first step looks where it starts."""
    return solve(problem, unknowns, 1, FIRST_DAMPING)


def linearise(problem: Problem, unknowns: Unknowns) -> Blocks:
    """[`fitting.residual.blocks`][] at the given unknowns, by the program of the fit."""
    return evaluate(problem, unknowns).blocks


@jit_lanes
def _solve(problem: Problem, start: Unknowns, max_steps: Array, damping: Array, least_progress: Array) -> Solution:
    joined = problem.segments.joined
    longest = jnp.asarray(np.where(problem.free.logarithmic, _LONGEST_LOG, np.inf))
    descent = ArrowDescent(joined, problem.gap_weight, damping, longest)
    solution = optx.least_squares(
        residual_with_blocks,
        ArrowLevenbergMarquardt(descent=descent, most_steps=max_steps, least_progress=least_progress),
        start,
        args=problem,
        max_steps=None,
        throw=False,
    )
    success = solution.result == optx.RESULTS.successful
    seen = blocks_seen(solution.state.f_info, solution.value, problem.gap_weight, joined)
    # An iteration that is given up before its first step, as from a start that is no number, has seen nothing.
    steps = solution.stats["num_steps"]
    rows = where(steps > 0, seen.residual, jnp.inf)
    error, squares = _error_of_rows(problem, rows), jnp.sum(rows**2, axis=1)
    covariance = _covariance(error, problem.segments)
    return Solution(solution.value, error, covariance, squares, seen, success, steps)


def _error_of_rows(problem: Problem, rows: Array) -> Array:
    """The output error behind the rows of a residual."""
    shape = problem.segments.measured.shape
    white = rows[:, : shape[1] * shape[2]].reshape(shape)
    return jnp.einsum("ij,snj->sni", jnp.linalg.inv(problem.whitening), white)


def _covariance(error: Array, segments: Segments) -> Array:
    """Covariance of the output error. Runaway simulations count as large, not as unknown."""
    weight = segments.weight[:, :, None]
    samples = jnp.sum(weight)
    mean = jnp.sum(segments.measured * weight, axis=(0, 1), keepdims=True) / samples
    variance = jnp.sum((segments.measured - mean) ** 2 * weight, axis=(0, 1), keepdims=True) / samples
    span = jnp.sqrt(variance)
    rows = jnp.clip(jnp.nan_to_num(error, nan=jnp.inf), -10 * span, 10 * span) * weight
    # The floor keeps an output that the model follows to the last bit from becoming infinitely certain.
    return jnp.einsum("sni,snj->ij", rows, rows) / samples + jnp.diag((1e-9 * span[0, 0] + 1e-300) ** 2)
