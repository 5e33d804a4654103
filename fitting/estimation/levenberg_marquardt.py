"""Levenberg-Marquardt for arrow-shaped least squares: shared parameters, and states that belong to one segment each.

The dense Jacobian of a log has thousands of columns, nearly all of them zero. Where segments are joined, closing the
gaps between them makes each initial state an affine function of the shared parameters and of the state that its
chain starts from (multiple shooting with condensing: Bock and Plitt 1984). Eliminating the chains' first states leaves
a system as small as the number of shared parameters (the Schur complement), so that a step costs little more than the
simulation behind it, and a chain of many segments no more than as many segments that start anew. optimistix does the
iteration; this file tells it how to solve for a step.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from fitting.estimation.residual import Blocks, Products, Unknowns, moved_gap
from fitting.record import Record
from hdjax.compilation import library_of, on_host

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


class Chains(Record):
    """What closing the gaps makes of each segment's initial state: `by_parameter dp + by_first dc + closing`, where
    dc is the change of the state that its chain starts from.

    Attributes:
        by_parameter: response to the shared parameters.
        by_first: response to the chain's first state.
        closing: what closes the gaps where nothing else moves.
        index: the chain of each segment.
    """

    by_parameter: Float[Array | np.ndarray, "segments states parameters"]
    by_first: Float[Array | np.ndarray, "segments states states"]
    closing: Float[Array | np.ndarray, "segments states"]
    index: Int[Array | np.ndarray, " segments"]


def chains(found: Blocks | Products, joined: Bool[Array | np.ndarray, " segments"]) -> Chains:
    """Follow the linearised motion from segment to segment."""
    library = library_of(found.gap, found.before_by_parameter, joined)
    states, parameters = found.before_by_parameter.shape[1:]
    first = np.concatenate([np.zeros((states, parameters)), np.eye(states), np.zeros((states, 1))], axis=1)
    added = library.concatenate(
        [found.before_by_parameter, library.zeros_like(found.before_by_state), -found.gap[:, :, None]], axis=2
    )
    path = (_path_inside if library is jnp else _path)(first, joined, found.before_by_state, added)
    index = library.cumsum(library.where(joined, 0, 1)) - 1
    return Chains(path[..., :parameters], path[..., parameters:-1], path[..., -1], library.maximum(index, 0))


def _path(first: np.ndarray, joined: Any, by_state: Any, added: Any) -> Any:
    """What becomes of the first state of each chain, segment by segment: `by_state @ before + added`."""
    path = np.tile(first, (len(added), 1, 1))
    for here in np.flatnonzero(joined):
        path[here] = by_state[here] @ path[here - 1] + added[here]
    return path


def _path_inside(first: np.ndarray, joined: Any, by_state: Any, added: Any) -> Any:
    """[`_path`][] inside a program of JAX."""

    def follow(before, inputs):
        continues, by_state, own = inputs
        here = jnp.where(continues, by_state @ before + own, first)
        return here, here

    return jax.lax.scan(follow, jnp.asarray(first), (joined, by_state, added))[1]


def _collected(each: Any, index: Any) -> Any:
    """Sum over the segments of each chain; there are as many places as segments."""
    if library_of(each, index) is jnp:
        return jax.ops.segment_sum(each, index, num_segments=each.shape[0])
    if index[-1] == len(each) - 1:
        return each
    total = np.zeros(each.shape)
    np.add.at(total, index, each)
    return total


class ArrowSystem(Record):
    """The normal equations of [`Blocks`][], in blocks. The gradients have two columns: of the residual as it is, and
    what closing the gaps adds to it.

    Attributes:
        shared: sum over segments of J_p^T J_p.
        own: J_c^T J_c of each chain.
        coupling: J_c^T J_p of each chain.
        shared_gradient: sum of J_p^T r.
        own_gradient: J_c^T r of each chain.
        chains: how segments' states follow from shared parameters and chains' first states.
        yardstick: what damping of the shared parameters is relative to.
    """

    shared: Float[Array | np.ndarray, "parameters parameters"]
    own: Float[Array | np.ndarray, "segments states states"]
    coupling: Float[Array | np.ndarray, "segments states parameters"]
    shared_gradient: Float[Array | np.ndarray, "parameters 2"]
    own_gradient: Float[Array | np.ndarray, "segments states 2"]
    chains: Chains
    yardstick: Float[Array | np.ndarray, " parameters"]

    def eliminate(self, damping: Any, closing: Any) -> tuple[Any, Any, Any, Any]:
        """Solve each chain for its own first state.

        Args:
            damping: relative to the yardstick of the shared parameters and to the diagonals of the chains.
            closing: share of the gaps that the step closes.

        Returns:
            The reduced matrix and gradient of the shared parameters, and each chain's response `own^-1 coupling`
            and `own^-1 own_gradient`.
        """
        library = library_of(self.own, damping, closing)
        share = library.stack([library.ones_like(closing), closing])
        own = self.own + damping * _diagonal(self.own)
        right = library.concatenate([self.coupling, (self.own_gradient @ share)[:, :, None]], axis=2)
        solved = solve_scaled(own, right)
        response, own_step = solved[:, :, :-1], solved[:, :, -1]
        shared = self.shared + damping * library.diag(library.where(self.yardstick > 0, self.yardstick, 1.0))
        rows = own_step.size, shared.shape[0]
        coupling = self.coupling.reshape(rows).T
        matrix = shared - coupling @ response.reshape(rows)
        gradient = self.shared_gradient @ share - coupling @ own_step.reshape(-1)
        return matrix, gradient, response, own_step

    def step(self, damping: Any, longest: Float[Array | np.ndarray, " parameters"] | float = jnp.inf) -> Unknowns:
        """The damped Gauss-Newton step; damping holds back the closing of the gaps as well.

        Args:
            damping: relative to the diagonals, see [`ArrowSystem.eliminate`][].
            longest: how far each shared parameter may go; where one would go farther, all else suits where it goes.
        """
        library = library_of(self.own, damping)
        closing = 1.0 / (1.0 + damping)
        matrix, gradient, response, own_step = self.eliminate(damping, closing)
        wanted = -solve_scaled(matrix, gradient[:, None])[:, 0]
        held = library.abs(wanted) > longest
        ends = library.where(held, library.sign(wanted) * longest, 0.0)
        left = library.where(held, 0.0, gradient + matrix @ ends)
        others = library.where(held[:, None] | held[None, :], 0.0, matrix)
        shared = ends - solve_scaled(others, left[:, None])[:, 0]
        first = -own_step - response @ shared
        path = self.chains
        states = path.by_parameter @ shared + closing * path.closing
        return Unknowns(shared, states + (path.by_first @ first[path.index][:, :, None])[:, :, 0])


def normal_equations(
    found: Products, joined: Bool[Array | np.ndarray, " segments"], yardstick: Any = 0.0
) -> ArrowSystem:
    """The normal equations of a linearised residual, with the gaps closed; by numpy outside programs of JAX.

    Args:
        found: of residual and Jacobian.
        joined: whether a segment starts where the one before it ends.
        yardstick: what damping of the shared parameters is relative to at least.
    """
    library = library_of(found.gap, found.before_by_parameter, joined)
    found, joined = on_host((found, joined))
    path = chains(found, joined)
    states, parameters = found.before_by_parameter.shape[1:]
    # From (parameters, first state, residual, closing) to (parameters, own state, residual), segment by segment.
    through = library.concatenate(
        [path.by_parameter, path.by_first, library.zeros_like(path.closing)[..., None], path.closing[..., None]], axis=2
    )
    segments, columns = len(through), through.shape[2]
    above = library.broadcast_to(library.eye(parameters, columns), (segments, parameters, columns))
    below = library.broadcast_to(library.eye(1, columns, parameters + states), (segments, 1, columns))
    change = library.concatenate([above, through, below], axis=1)
    total = library.swapaxes(change, 1, 2) @ found.products @ change
    mine = slice(parameters, parameters + states)
    shared = library.sum(total[:, :parameters, :parameters], axis=0)
    return ArrowSystem(
        shared=shared,
        own=_collected(total[:, mine, mine], path.index),
        coupling=_collected(total[:, mine, :parameters], path.index),
        shared_gradient=library.sum(total[:, :parameters, parameters + states :], axis=0),
        own_gradient=_collected(total[:, mine, parameters + states :], path.index),
        chains=path,
        yardstick=library.maximum(library.diagonal(shared), yardstick),
    )


def project(
    found: Blocks, joined: Bool[Array | np.ndarray, " segments"]
) -> Float[Array | np.ndarray, "segments rows parameters"]:
    """The parameters' columns without what each chain's own first state could do as well."""
    system = normal_equations(Products.of(found), joined)
    _, _, response, _ = system.eliminate(np.zeros(()), np.ones(()))
    path = system.chains
    moved = path.by_parameter - path.by_first @ response[path.index]
    return found.by_parameter + found.by_state @ moved


def _diagonal(matrix: Any) -> Any:
    """The diagonal part of each matrix; where it is zero (padding), ones."""
    library = library_of(matrix)
    d = library.diagonal(matrix, axis1=-2, axis2=-1)
    return library.where(d > 0, d, 1.0)[..., None] * np.broadcast_to(np.eye(d.shape[-1]), matrix.shape)


def solve_scaled(matrix: Any, right: Any) -> Any:
    """Solve symmetric positive systems after scaling their diagonals to one; a direction without information does not
    move. Without a solution to working precision, no numbers."""
    library = library_of(matrix, right)
    matrix, right = on_host((matrix, right))
    d = library.diagonal(matrix, axis1=-2, axis2=-1)[..., None]
    scale = library.where(d > 0, 1.0 / library.sqrt(library.where(d > 0, d, 1.0)), 0.0)
    empty = library.where(d > 0, 0.0, 1.0)
    scaled = matrix * scale * library.swapaxes(scale, -1, -2)
    scaled = scaled + (empty + 1e-13) * np.broadcast_to(np.eye(matrix.shape[-1]), matrix.shape)
    if library is jnp:
        lower = jax.lax.linalg.cholesky(scaled, symmetrize_input=False)
        half = jax.lax.linalg.triangular_solve(lower, scale * right, left_side=True, lower=True)
        return scale * jax.lax.linalg.triangular_solve(lower, half, left_side=True, lower=True, transpose_a=True)
    lower = _cholesky(scaled)
    half = np.linalg.solve(lower, scale * right)
    return scale * np.linalg.solve(np.swapaxes(lower, -1, -2), half)


def _cholesky(matrix: np.ndarray) -> np.ndarray:
    """The factors of matrices; no numbers where one is not positive."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.stack([_cholesky(m) for m in matrix]) if matrix.ndim > 2 else np.full(matrix.shape, np.nan)


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
        bolder = where(well, library.minimum(CAUTIOUS * state.bolder, LONGER), state.bolder)
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
            bolder=where(accepted & solved, bolder, CAUTIOUS),
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
