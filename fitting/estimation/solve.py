"""Least squares of one problem: steps of an optimistix solver, taken by the host.

What takes long is to look at a problem, by the model's machine code or by a program of XLA. A step of the solver is
little work, for which a program would take longer to compile than it saves.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.engines import linearise, residual_at
from fitting.estimation.levenberg_marquardt import ArrowLevenbergMarquardt
from fitting.estimation.machine_code import task
from fitting.estimation.residual import Blocks, Problem, Products, Unknowns
from fitting.estimation.separate_states import Damping, Ended, Look, solve_states
from hdjax.compilation import jit_small, on_host
from hdjax.lanes import on_one_device, placed_like

FIRST_DAMPING, NEARBY_DAMPING = 1e-3, 1e-9
"""Damping of the first step, relative to the diagonal of J^T J: from a start, and near a solution."""

# A step that would carry a positive parameter farther (a factor e) was promised by a slope that does not reach so far:
# a corner that leaps to zero shows no slope there, and never comes back.
_LONGEST_LOG = 1.0


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
        damping: with which an iteration under slightly other weights goes on.
    """

    unknowns: Unknowns
    left_over: LeftOver
    success: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    damping: Damping


def solve(
    problem: Problem, start: Unknowns, max_steps: int, damping: Damping, *, least_progress: float = 0.0
) -> Solution:
    """Iterate to the least squares.

    Args:
        problem: what is solved.
        start: where the iteration begins.
        max_steps: where it ends at the latest.
        damping: of the first step, see [`FIRST_DAMPING`][].
        least_progress: share of the sum of squares that a few steps must take off it for the iteration to go on.
    """
    look, begin = _sight_of(problem, start), on_host(start)
    separate = not (np.asarray(problem.active).any() or np.asarray(problem.segments.joined).any())
    # What runs away is no warning: it is a step that is not taken.
    with np.errstate(all="ignore"):
        if separate:
            rtol = ArrowLevenbergMarquardt.rtol
            limits = {"rtol": rtol, "least_progress": least_progress}
            ended = solve_states(look, begin, max_steps, damping, **limits)
        else:
            ended = _solve_together(problem, look, begin, max_steps, damping, least_progress)
    best = ended.unknowns
    unknowns = Unknowns(jnp.asarray(best.parameters), jnp.asarray(best.states))
    return Solution(unknowns, _left_over(problem, ended.rows), ended.success, ended.steps, ended.damping)


def _solve_together(
    problem: Problem, look: Look, best: Unknowns, max_steps: int, damping: Damping, least_progress: float
) -> Ended:
    """The iteration where segments share parameters or are joined."""
    segments = problem.segments
    solver = ArrowLevenbergMarquardt(
        joined=np.asarray(segments.joined),
        gap_weight=np.asarray(problem.gap_weight),
        damping=np.asarray(damping),
        most_steps=np.asarray(max_steps),
        rows=np.asarray(float(segments.weight.size * segments.measured.shape[2])),
        longest=np.where(problem.free.logarithmic, _LONGEST_LOG, np.inf),
        least_progress=np.asarray(least_progress),
    )
    seen, rows = look(best)
    state = solver.init(_function, best, seen, {}, None, seen, frozenset())
    found = rows
    while True:
        best, state, _ = solver.step(_function, best, seen, {}, state, frozenset())
        found = rows if state.accepted else found
        done, late = solver.ended(best, state)
        finite = np.all(np.isfinite(best.parameters)) and np.all(np.isfinite(best.states))
        if done or late or not finite:
            return Ended(best, found, bool(done and finite), int(state.count), float(solver.damping_at(state.size)))
        seen, rows = look(state.ahead)


def _sight_of(problem: Problem, start: Unknowns) -> Look:
    """How a problem is looked at: its normal equations at some unknowns, and the rows of its residual."""
    looked_at = task(problem, start)
    if looked_at is not None:
        return looked_at.look
    free = problem.free
    slope = np.asarray(free.precision * problem.active)

    def look(unknowns: Unknowns) -> tuple[Products, Array | np.ndarray]:
        products, rows = on_host(_products(on_one_device(linearise(problem, placed_like(unknowns, start)))))
        return products.beside_prior(np.asarray(free.off_prior(unknowns.parameters)), slope), rows

    return look


@jit_small
def _products(found: Blocks) -> tuple[Products, Array | np.ndarray]:
    return Products.of(found), found.residual


def _function(unknowns: Unknowns, seen: Products) -> tuple[None, Products]:
    """What the solver minimises, where it has been looked at already."""
    return None, seen


def evaluate(problem: Problem, unknowns: Unknowns) -> LeftOver:
    """What is left over at the given unknowns."""
    return _left_over(problem, residual_at(problem, unknowns)[0])


def _left_over(problem: Problem, rows: Float[Array | np.ndarray, "segments rows"]) -> LeftOver:
    """What the rows of a residual say."""
    segments, found = problem.segments, np.asarray(rows)
    measured, weight = np.asarray(segments.measured), np.asarray(segments.weight)
    white = found[:, : measured[0].size].reshape(measured.shape)
    error = white @ np.linalg.inv(np.asarray(problem.whitening)).T
    return LeftOver(error, _covariance(error, measured, weight), np.sum(found**2, axis=1))


def _covariance(error: np.ndarray, measured: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Covariance of the output error. Runaway simulations count as large, not as unknown."""
    samples = np.sum(weight)
    # Output by output: numpy is slow along an axis of two.
    spans, rows = [], []
    for own, told in zip(np.moveaxis(error, -1, 0), np.moveaxis(measured, -1, 0), strict=True):
        mean = np.sum(told * weight) / samples
        spans.append(np.sqrt(np.sum((told - mean) ** 2 * weight) / samples))
        rows.append(np.fmax(np.fmin(own, 10 * spans[-1]), -10 * spans[-1]) * weight)
    span, flat = np.array(spans), np.reshape(rows, (len(rows), -1))
    # The floor keeps an output that the model follows to the last bit from becoming infinitely certain.
    # Nor may two outputs that run away alike be one.
    covariance = flat @ flat.T / samples
    return covariance + np.diag((1e-9 * span + 1e-300) ** 2 + 1e-12 * np.diag(covariance))
