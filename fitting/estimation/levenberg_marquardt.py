"""Levenberg-Marquardt for arrow-shaped least squares ([`fitting.estimation.arrow_system`][]).

optimistix does the iteration; this file tells it how to solve for a step, which steps to take, and where to end.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from fitting.estimation.arrow_system import normal_equations
from fitting.estimation.residual import Products, Unknowns, moved_gap
from fitting.record import Record
from hdjax.compilation import library_of

KEPT, WELL = 0.01, 0.75
"""Shares of what a step promises: one that keeps less is not taken (so in optimistix' `ClassicalTrustRegion`), one that
keeps more is followed by a bolder one."""
LONGER, SHORTER, CAUTIOUS = 30.0, 0.1, 3.0
"""Factors of a step's size then. Damping that is small on the diagonal may be large across it, so it must go quickly
where the model predicts well; after a step that was not taken, by 3, then by 9 and 27. Otherwise two of three steps at
corners of a nonsmooth model would not be taken."""
SLIGHT = 1e-4
"""Relative change of the sum of squares that is none."""
LEAST_DAMPING = 1e-12
"""With less damping than this, relative to the diagonal, rounding decides whether the normal equations are definite."""
LATEST = 6
"""Points between which an iteration must make progress."""
# Share of the gaps that a step leaves which closes them, and of the residual that it may leave.
_CLOSED, _DEAREST = 0.25, 1.5


def bolder_after(taken: Any, well: Any, bolder: Any) -> Any:
    """Factor of a step's size after the next step that the model predicts well.

    Args:
        taken: whether the latest step was taken.
        well: whether the model predicted it well.
        bolder: the factor until then.
    """
    library = library_of(taken, well, bolder)
    grown = library.where(well, library.minimum(CAUTIOUS * bolder, LONGER), bolder)
    return library.where(taken, grown, CAUTIOUS)


class Iteration(Record):
    """What [`ArrowLevenbergMarquardt`][] carries from step to step.

    Attributes:
        ahead: where to look next.
        found: the normal equations at the best point.
        costs: half the sums of squares at the latest best points, newest first; infinite where there were none.
        rows: sum of squares of the residual at the best point.
        gap: of the weighted gaps.
        promised: by how much the next step is to lower half the sum of squares, negative.
        expected: sum of squares of the residual after the next step, to first order.
        size: inverse of the damping in units of the first one.
        bolder: factor of the size after the next step that keeps what it promises.
        yardstick: the largest diagonal of J^T J so far, of the shared parameters.
        count: how many steps were taken.
        accepted: whether the point that was seen last is the best.
    """

    ahead: Unknowns
    found: Products
    costs: Float[Array | np.ndarray, " latest"]
    rows: Float[Array | np.ndarray | np.float64, ""]
    gap: Float[Array | np.ndarray | np.float64, ""]
    promised: Float[Array | np.ndarray | np.float64, ""]
    expected: Float[Array | np.ndarray | np.float64, ""]
    size: Float[Array | np.ndarray | np.float64, ""]
    bolder: Float[Array | np.ndarray | np.float64, ""]
    yardstick: Float[Array | np.ndarray, " parameters"]
    count: Int[Array | np.ndarray | np.int64, ""]
    accepted: Bool[Array | np.ndarray | np.bool_, ""]


class ArrowLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt of optimistix for arrow-shaped problems: damped Gauss-Newton steps by elimination of the
    segments' states. All that it uses of its function are the [`Products`][fitting.estimation.residual.Products] that
    this returns as a second result.

    A step is taken where it lowers the sum of squares by a share of what it promised. Two more kinds are taken in any
    case: one that hardly changes it, and one that closes most of the gaps for little more residual than there is, or
    than a linear model would leave. Where a model can't follow the log, pieces fit far better than the whole, and no
    finite weight of the gaps repays closing them.

    It ends where a step promises next to nothing: less than `rtol` of what one more degree of freedom explains of
    noise. (The change of the unknowns says little: they come in many units, and some are hardly seen.) Corners of a
    nonsmooth model make steps promise what they do not keep: it ends as well where the latest of them together have
    taken off less than a share of the sum of squares, where one is given.

    Attributes:
        joined: whether a segment starts where the one before it ends.
        gap_weight: of each state, as in the problem.
        damping: of the first step, relative to the diagonal of J^T J; for the shared parameters to the largest that it
            has been.
        most_steps: where the iteration ends at the latest.
        rows: how many rows the residual has.
        longest: how far a step may carry each shared parameter.
        least_progress: share of the sum of squares that a few steps must take off it.
    """

    joined: Bool[Array | np.ndarray, " segments"]
    gap_weight: Float[Array | np.ndarray, " states"]
    damping: Float[Array | np.ndarray, ""]
    most_steps: Int[Array | np.ndarray, ""]
    rows: Float[Array | np.ndarray, ""]
    longest: Float[Array | np.ndarray, " parameters"] | float = jnp.inf
    least_progress: Float[Array | np.ndarray, ""] | float = 0.0
    rtol: float = 1e-3
    atol: float = 0.0
    norm: Callable[[Any], Array] = optx.max_norm

    __getattribute__ = object.__getattribute__  # as of a `Record`

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Iteration:
        # By numpy: outside programs of JAX nothing is compiled for it.
        zero = np.zeros(())
        return Iteration(
            ahead=y,
            found=jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), aux_struct),
            costs=np.full(LATEST, np.inf),
            rows=zero,
            gap=zero,
            promised=np.array(-np.inf),
            expected=zero,
            size=np.ones(()),
            bolder=np.array(LONGER),
            yardstick=np.zeros(y.parameters.shape),
            count=np.zeros((), int),
            accepted=np.zeros((), bool),
        )

    def step(self, fn, y, args, options, state: Iteration, tags) -> tuple[Unknowns, Iteration, Products]:
        _, seen = fn(state.ahead, args)
        library = library_of(state.count, seen.gap)
        where = library.where
        rows, gap = seen.square, library.sum((seen.gap * self.gap_weight[None]) ** 2)
        cost, before, first = 0.5 * (rows + gap), state.costs[0], state.count == 0
        kept = first | (cost - before <= KEPT * state.promised)
        well = ~first & (cost - before < WELL * state.promised)
        slight = library.abs(cost - before) < SLIGHT * before
        closing = (gap < _CLOSED * state.gap) & (rows < _DEAREST * library.maximum(state.rows, state.expected))
        accepted = kept | slight | closing
        size = state.size * where(kept, where(well, state.bolder, 1.0), where(accepted, 1.0, SHORTER))
        costs = library.concatenate([cost[None], state.costs[:-1]])
        new, old = (state.ahead, seen, costs, rows, gap), (y, state.found, state.costs, state.rows, state.gap)
        best, found, costs, rows, gap = jax.tree.map(lambda a, b: where(accepted, a, b), new, old)

        # A parameter that has run to where it hardly shows must not be set free there: its damping is relative to the
        # most that it has ever shown (Moré 1978).
        system = normal_equations(found, self.joined, state.yardstick)
        step = system.step(self.damping_at(size), self.longest)
        promised, expected = self._promised(found, step)
        # Where the system has no solution to working precision, another step from here is more damped.
        solved = library.isfinite(promised)
        after = Iteration(
            ahead=jax.tree.map(lambda a, b: where(solved, a + b, a), best, step),
            found=found,
            costs=costs,
            rows=rows,
            gap=gap,
            promised=where(solved, promised, -jnp.inf),
            expected=where(solved, expected, 0.0),
            size=where(solved, size, SHORTER * size),
            bolder=bolder_after(accepted & solved, well, state.bolder),
            yardstick=system.yardstick,
            count=state.count + 1,
            accepted=accepted,
        )
        return best, after, found

    def damping_at(self, size: Any) -> Any:
        """Damping of a step of this size."""
        return library_of(size).maximum(self.damping / size, LEAST_DAMPING)

    def _promised(self, found: Products, step: Unknowns) -> tuple[Any, Any]:
        """By how much half the sum of squares changes along a step, to second order; and the residual's after it."""
        library = library_of(found.gap, step.states)
        segments = step.states.shape[0]
        own = library.broadcast_to(step.parameters, (segments, step.parameters.size))
        column = library.concatenate([own, step.states, library.zeros((segments, 1))], axis=1)
        changed = (found.products @ column[:, :, None])[:, :, 0]
        gap, moved = (g * self.gap_weight[None] for g in (found.gap, moved_gap(found, self.joined, step)))
        rows = library.sum(changed[:, -1]) + 0.5 * library.sum(column * changed)
        return rows + library.sum(moved * (gap + 0.5 * moved)), found.square + 2.0 * rows

    def ended(self, y: Unknowns, state: Iteration) -> tuple[Any, Any]:
        """Whether the next step promises next to nothing; and whether to stop all the same."""
        library = library_of(state.count, y.states)
        newest, oldest = state.costs[0], state.costs[-1]
        small = library.abs(state.promised) < self.rtol * newest / self.rows
        # Rounding may leave nothing of a step that still promises something.
        still = [library.all(a == b) for a, b in zip(jax.tree.leaves(state.ahead), jax.tree.leaves(y), strict=True)]
        small = small | (library.isfinite(state.promised) & still[0] & still[1])
        # To close gaps may cost more than it takes off: without a least progress none is asked for.
        stalled = (self.least_progress > 0) & (oldest < (1.0 + self.least_progress) * newest)
        done = (state.count > 0) & (small | stalled)
        return done, ~done & (state.count >= self.most_steps)

    def terminate(self, fn, y, args, options, state: Iteration, tags):
        """Whether to stop: by the decrease that the next step promises."""
        done, late = self.ended(y, state)
        successful, most = optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
        return done | late, optx.RESULTS.where(late, most, successful)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}
