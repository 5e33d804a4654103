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

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from fitting.residual import Blocks, LinearisedResidual, Unknowns, blocks_of_columns, seeds
from hdjax.where import where

# Long simulations see their parameters together rather than one by one: damping that is small on the diagonal is large
# across it, so it must go quickly where the model predicts well.
_REGION = optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=30.0, low_constant=0.1)
# Points between which an iteration must make progress.
_LATEST = 6


class Chains(eqx.Module):
    """What closing the gaps makes of each segment's initial state: `by_parameter dp + by_first dc + closing`, where
    dc is the change of the state that its chain starts from.

    Attributes:
        by_parameter: response to the shared parameters.
        by_first: response to the chain's first state.
        closing: what closes the gaps where nothing else moves.
        index: the chain of each segment.
    """

    by_parameter: Float[Array, "segments states parameters"]
    by_first: Float[Array, "segments states states"]
    closing: Float[Array, "segments states"]
    index: Int[Array, " segments"]

    def collect(self, each: Array) -> Array:
        """Sum over the segments of each chain; there are as many places as segments."""
        return jax.ops.segment_sum(each, self.index, num_segments=each.shape[0])


def chains(found: Blocks, joined: Bool[Array, " segments"]) -> Chains:
    """Follow the linearised motion from segment to segment."""
    parameters, states = found.by_parameter.shape[2], found.by_state.shape[2]
    first = jnp.concatenate([jnp.zeros((states, parameters)), jnp.eye(states), jnp.zeros((states, 1))], axis=1)
    added = jnp.concatenate(
        [found.before_by_parameter, jnp.zeros_like(found.before_by_state), -found.gap[:, :, None]], axis=2
    )

    def follow(before, inputs):
        continues, by_state, own = inputs
        here = where(continues, by_state @ before + own, first)
        return here, here

    _, path = jax.lax.scan(follow, first, (joined, found.before_by_state, added))
    index = jnp.cumsum(where(joined, 0, 1)) - 1
    return Chains(path[..., :parameters], path[..., parameters:-1], path[..., -1], jnp.maximum(index, 0))


class ArrowSystem(eqx.Module):
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

    shared: Float[Array, "parameters parameters"]
    own: Float[Array, "segments states states"]
    coupling: Float[Array, "segments states parameters"]
    shared_gradient: Float[Array, "parameters 2"]
    own_gradient: Float[Array, "segments states 2"]
    chains: Chains
    yardstick: Float[Array, " parameters"]

    def eliminate(self, damping: Array, closing: Array) -> tuple[Array, Array, Array, Array]:
        """Solve each chain for its own first state.

        Args:
            damping: relative to the yardstick of the shared parameters and to the diagonals of the chains.
            closing: share of the gaps that the step closes.

        Returns:
            The reduced matrix and gradient of the shared parameters, and each chain's response `own^-1 coupling`
            and `own^-1 own_gradient`.
        """
        share = jnp.stack([jnp.ones_like(closing), closing])
        own = self.own + damping * _diagonal(self.own)
        right = jnp.concatenate([self.coupling, (self.own_gradient @ share)[:, :, None]], axis=2)
        solved = jax.vmap(_solve_scaled)(own, right)
        response, own_step = solved[:, :, :-1], solved[:, :, -1]
        shared = self.shared + damping * jnp.diag(where(self.yardstick > 0, self.yardstick, 1.0))
        matrix = shared - jnp.einsum("sqp,sqr->pr", self.coupling, response)
        gradient = self.shared_gradient @ share - jnp.einsum("sqp,sq->p", self.coupling, own_step)
        return matrix, gradient, response, own_step

    def step(self, damping: Array, longest: Float[Array, " parameters"] | float = jnp.inf) -> Unknowns:
        """The damped Gauss-Newton step; damping holds back the closing of the gaps as well.

        Args:
            damping: relative to the diagonals, see [`ArrowSystem.eliminate`][].
            longest: how far each shared parameter may go; where one would go farther, all else suits where it goes.
        """
        closing = 1.0 / (1.0 + damping)
        matrix, gradient, response, own_step = self.eliminate(damping, closing)
        wanted = -_solve_scaled(matrix, gradient[:, None])[:, 0]
        held = jnp.abs(wanted) > longest
        ends = where(held, jnp.sign(wanted) * longest, 0.0)
        left = where(held, 0.0, gradient + matrix @ ends)
        others = where(held[:, None] | held[None, :], 0.0, matrix)
        shared = ends - _solve_scaled(others, left[:, None])[:, 0]
        first = -own_step - jnp.einsum("sqp,p->sq", response, shared)
        path = self.chains
        states = jnp.einsum("sqp,p->sq", path.by_parameter, shared)
        states = states + jnp.einsum("sqk,sk->sq", path.by_first, first[path.index]) + closing * path.closing
        return Unknowns(shared, states)


def normal_equations(found: Blocks, joined: Bool[Array, " segments"]) -> ArrowSystem:
    """The normal equations of a linearised residual, with the gaps closed."""
    p, s, r = found.by_parameter, found.by_state, found.residual
    path = chains(found, joined)
    parameters, states = p.shape[2], s.shape[2]
    columns = jnp.concatenate([p, s, r[:, :, None]], axis=2)
    products = jnp.einsum("sri,srj->sij", columns, columns)
    # From (parameters, first state, residual, closing) to (parameters, own state, residual), segment by segment.
    through = jnp.concatenate(
        [path.by_parameter, path.by_first, jnp.zeros_like(path.closing)[..., None], path.closing[..., None]], axis=2
    )
    above = jnp.broadcast_to(jnp.eye(parameters, through.shape[2]), (through.shape[0], parameters, through.shape[2]))
    below = jnp.broadcast_to(jnp.eye(1, through.shape[2], parameters + states), (through.shape[0], 1, through.shape[2]))
    change = jnp.concatenate([above, through, below], axis=1)
    total = jnp.einsum("sia,sij,sjb->sab", change, products, change)
    mine = slice(parameters, parameters + states)
    shared = jnp.sum(total[:, :parameters, :parameters], axis=0)
    return ArrowSystem(
        shared=shared,
        own=path.collect(total[:, mine, mine]),
        coupling=path.collect(total[:, mine, :parameters]),
        shared_gradient=jnp.sum(total[:, :parameters, parameters + states :], axis=0),
        own_gradient=path.collect(total[:, mine, parameters + states :]),
        chains=path,
        yardstick=jnp.diagonal(shared),
    )


def project(found: Blocks, joined: Bool[Array, " segments"]) -> Float[Array, "segments rows parameters"]:
    """The parameters' columns without what each chain's own first state could do as well."""
    system = normal_equations(found, joined)
    _, _, response, _ = system.eliminate(jnp.zeros(()), jnp.ones(()))
    path = system.chains
    moved = path.by_parameter - jnp.einsum("sqk,skp->sqp", path.by_first, response[path.index])
    return found.by_parameter + jnp.einsum("srq,sqp->srp", found.by_state, moved)


def _diagonal(matrix: Array) -> Array:
    """The diagonal part of each matrix; where it is zero (padding), ones."""
    d = jnp.diagonal(matrix, axis1=-2, axis2=-1)
    return where(d > 0, d, 1.0)[..., None] * jnp.broadcast_to(jnp.eye(d.shape[-1]), matrix.shape)


def _solve_scaled(matrix: Array, right: Array) -> Array:
    """Solve a symmetric system after scaling its diagonal to one; a direction without information does not move."""
    d = jnp.diagonal(matrix)
    scale = where(d > 0, 1.0 / jnp.sqrt(where(d > 0, d, 1.0)), 0.0)
    empty = where(d > 0, 0.0, 1.0)
    scaled = matrix * scale[:, None] * scale[None, :] + jnp.diag(empty + 1e-13)
    return scale[:, None] * jnp.linalg.solve(scaled, scale[:, None] * right)


def blocks_seen(
    f_info: Any,
    unknowns: Unknowns,
    gap_weight: Float[Array, " states"],
    joined: Bool[Array, " segments"],
) -> Blocks:
    """The blocks behind what optimistix knows of [`fitting.residual.residual_with_blocks`][] at the unknowns, its
    `FunctionInfo.ResidualJac`."""
    moved: LinearisedResidual = jax.vmap(f_info.jac.mv, out_axes=-1)(seeds(unknowns))
    value, weight = f_info.residual, gap_weight[None]
    return blocks_of_columns(value.rows, value.gap / weight, moved.rows, moved.gap / weight[:, :, None], joined)


class ArrowDescent(optx.AbstractDescent):
    """Damped Gauss-Newton steps by elimination of the segments' states; damping is relative to diag(J^T J), for the
    shared parameters to the largest that it has been.

    Attributes:
        joined: whether a segment starts where the one before it ends.
        gap_weight: of each state, as in the problem.
        damping: at the start.
        longest: how far a step may carry each shared parameter.
    """

    joined: Bool[Array, " segments"]
    gap_weight: Float[Array, " states"]
    damping: Float[Array, ""]
    longest: Float[Array, " parameters"] | float = jnp.inf

    def init(self, y: Unknowns, f_info_struct) -> ArrowSystem:
        parameters = y.parameters.shape[0]
        segments, states = y.states.shape
        zeros = jnp.zeros((segments, states, states))
        return ArrowSystem(
            shared=jnp.eye(parameters),
            own=zeros,
            coupling=zeros[:, :, :1] * jnp.zeros(parameters)[None, None, :],
            shared_gradient=jnp.zeros((parameters, 2)),
            own_gradient=jnp.zeros((segments, states, 2)),
            chains=Chains(
                by_parameter=zeros[:, :, :1] * jnp.zeros(parameters)[None, None, :],
                by_first=zeros,
                closing=zeros[:, :, 0],
                index=jnp.zeros(segments, dtype=int),
            ),
            yardstick=jnp.zeros(parameters),
        )

    def query(self, y: Unknowns, f_info, state: ArrowSystem) -> ArrowSystem:
        system = normal_equations(blocks_seen(f_info, y, self.gap_weight, self.joined), self.joined)
        # A parameter that has run to where it hardly shows must not be set free there: its damping is relative to the
        # most that it has ever shown (Moré 1978).
        return eqx.tree_at(lambda s: s.yardstick, system, jnp.maximum(system.yardstick, state.yardstick))

    def step(self, step_size: Array, state: ArrowSystem) -> tuple[Unknowns, optx.RESULTS]:
        damping = self.damping / jnp.maximum(step_size, 1e-30)
        return state.step(damping, self.longest), optx.RESULTS.successful


class Progress(eqx.Module):
    """How far an iteration has come.

    Attributes:
        region: state of the trust region.
        costs: half the sums of squares at the latest points, newest first; infinite where there were none.
    """

    region: Any
    costs: Float[Array, " latest"]


class GapTrustRegion(optx.AbstractSearch):
    """optimistix' trust region, but two kinds of step are taken in any case: one that hardly changes the sum of
    squares, and one that closes most of the gaps for a little more residual. No finite weight of the gaps repays what
    closing the last of them costs.
    """

    region: optx.ClassicalTrustRegion = _REGION
    slack: float = 1e-4
    closed: float = 0.25
    dearest: float = 1.5

    def init(self, y, f_info_struct):
        return Progress(self.region.init(y, f_info_struct), jnp.full(_LATEST, jnp.inf))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        old = state.region
        size, accept, result, new = self.region.step(first_step, y, y_eval, f_info, f_eval_info, old)
        before = f_info.as_min()
        slight = jnp.abs(f_eval_info.as_min() - before) < self.slack * before
        rows, gap = (jnp.sum(part**2) for part in (f_info.residual.rows, f_info.residual.gap))
        new_rows, new_gap = (jnp.sum(part**2) for part in (f_eval_info.residual.rows, f_eval_info.residual.gap))
        closing = (new_gap < self.closed * gap) & (new_rows < self.dearest * rows)
        anyway = ~accept & (slight | closing)
        new = jax.tree.map(lambda before, after: where(anyway, before, after), old, new)
        accept = accept | anyway
        costs = jnp.concatenate([f_eval_info.as_min()[None], state.costs[:-1]])
        return where(anyway, old.step_size, size), accept, result, Progress(new, where(accept, costs, state.costs))


class ArrowLevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix' Levenberg-Marquardt with [`ArrowDescent`][] for its linear algebra.

    It ends where a step promises next to nothing: less than `rtol` of what one more degree of freedom explains of
    noise. (The change of the unknowns says little: they come in many units, and some of them are hardly seen.) Corners
    of a nonsmooth model make steps promise what they do not keep: the iteration ends as well where the latest of them
    together have taken off less than a share of the sum of squares, where one is given. How many steps it may take, and
    that share, are data, so that one compiled program serves hasty fits and patient ones.
    """

    descent: ArrowDescent
    most_steps: Int[Array, ""]
    least_progress: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)
    rtol: float = 1e-3
    atol: float = 0.0
    norm: Callable[[Any], Array] = optx.max_norm
    search: GapTrustRegion = GapTrustRegion()
    verbose: Callable[..., None] = eqx.field(static=True, default=lambda **_: None)

    def terminate(self, fn, y, args, options, state, tags):
        """Whether to stop: by the decrease that the next step promises."""
        step = jax.tree.map(jnp.subtract, state.y_eval, y)
        promised = self.search.region.predict_reduction(step, state.f_info)
        residual = state.f_info.residual
        cost = 0.5 * (jnp.sum(residual.rows**2) + jnp.sum(residual.gap**2))
        small = jnp.abs(promised) < self.rtol * cost / residual.rows.size
        done = small & ~state.first_step
        costs, least = state.search_state.costs, self.least_progress
        # To close gaps may cost more than it takes off: without a least progress none is asked for.
        stalled = (least > 0) & (costs[-1] - costs[0] < least * costs[0])
        done = done | stalled
        late = ~done & (state.num_steps >= self.most_steps)
        return done | late, optx.RESULTS.where(late, optx.RESULTS.nonlinear_max_steps_reached, state.result)
