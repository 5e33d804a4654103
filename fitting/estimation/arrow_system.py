"""Normal equations of arrow-shaped least squares: shared parameters, and states that belong to one segment each.

The dense Jacobian of a log has thousands of columns, nearly all of them zero. Where segments are joined, closing the
gaps between them makes each initial state an affine function of the shared parameters and of the state that its
chain starts from (multiple shooting with condensing: Bock and Plitt 1984). Eliminating the chains' first states leaves
a system as small as the number of shared parameters (the Schur complement), so that a step costs little more than the
simulation behind it, and a chain of many segments no more than as many segments that start anew.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.estimation.residual import Blocks, Products, Unknowns
from fitting.record import Record
from hdjax.compilation import library_of, on_host


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
