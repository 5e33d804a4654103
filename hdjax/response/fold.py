"""Folds of a branch of steady motions, where the response jumps, and their dependence on a parameter."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from hdjax.parameters import as_scalar
from hdjax.response.continuation import Branch, continued
from hdjax.response.harmonic_balance import BalancedMotion
from hdjax.where import where

_SOLVED = 1e-8
_TOLERANCE = 1e-11


class Folds(eqx.Module):
    """Folds of a branch, where two motions meet and the response jumps.

    Attributes:
        value: the branch's parameter at each fold.
        unknowns: the system's unknowns there.
        null_vector: the direction in which the motion can change at a constant parameter.
        exists: which entries are folds.
    """

    value: Float[Array, " folds"]
    unknowns: Float[Array, "folds unknowns"]
    null_vector: Float[Array, "folds unknowns"]
    exists: Bool[Array, " folds"]


@eqx.filter_jit
def folds(branch: Branch, *, at_most: int = 4) -> Folds:
    """Locate the folds of a branch; their values have gradients with respect to everything in `branch.system`.

    Args:
        branch: from [`hdjax.response.frequency_response`][] or [`hdjax.response.follow`][].
        at_most: folds to look for, the first along the branch.
    """
    slope = branch.tangents[:, -1]
    turns = (slope[1:] * slope[:-1] <= 0.0) & branch.valid[1:] & branch.valid[:-1]
    (index,) = jnp.nonzero(turns, size=at_most, fill_value=0)
    exists = jnp.arange(at_most) < jnp.sum(turns)
    n = branch.unknowns.shape[1]

    def locate(i: Array) -> tuple[Array, Array]:
        # At a fold, the direction of the branch is the null vector.
        guess = jnp.concatenate([branch.unknowns[i], branch.value[i, None] / branch.scale, branch.tangents[i, :-1]])

        def residual(y: Array, given: tuple[BalancedMotion, Array]) -> Array:
            return _fold_residual(eqx.tree_at(lambda b: b.system, branch, given[0]), y, given[1])

        solver = optx.Newton(_TOLERANCE, _TOLERANCE)
        given = (branch.system, branch.omega[i])
        y = optx.root_find(residual, solver, lax.stop_gradient(guess), given, max_steps=30, throw=False).value
        left = jnp.max(jnp.abs(residual(y, given)))
        return y, jnp.isfinite(left) & (left < _SOLVED)

    y, converged = jax.vmap(locate)(index)
    y = where((exists & converged)[:, None], y, 0.0)
    return Folds(y[:, n] * branch.scale, y[:, :n], y[:, n + 1 :], exists & converged)


def _fold_residual(branch: Branch, y: Array, omega: Array) -> Array:
    """Zero where (unknowns, scaled parameter, null vector) are a fold (Seydel 2010, chapter 5)."""
    n = branch.unknowns.shape[1]
    u, p, v = y[:n], y[n], y[n + 1 :]
    left, along = jax.jvp(lambda u: branch.residual(u, p, omega), (u,), (v,))
    return jnp.concatenate([left, along, jnp.sum(v * v, keepdims=True) - 1.0])


class FoldTrack(eqx.Module):
    """A fold in the plane of two parameters: the edge of the region where several motions coexist.

    Attributes:
        second: the second parameter.
        value: the branch's own parameter at the fold.
        valid: which entries are folds.
    """

    second: Float[Array, " steps"]
    value: Float[Array, " steps"]
    valid: Bool[Array, " steps"]


def follow_fold(
    branch: Branch, fold: int, parameter: str, start: ArrayLike, end: ArrayLike, *, steps: int = 200
) -> FoldTrack:
    """Track a fold of a branch in a second parameter, through cusps.

    Args:
        branch: whose fold to track.
        fold: its index in `folds(branch)`.
        parameter: the second parameter, named as in [`hdjax.response.follow`][].
        start: its value in the branch.
        end: where to stop.
        steps: of the continuation, at most.
    """
    return _follow_fold(branch, fold, parameter, as_scalar(start), as_scalar(end), steps)


@eqx.filter_jit
def _follow_fold(branch, fold, parameter, start, end, steps) -> FoldTrack:
    found = folds(branch)
    second = jnp.maximum(jnp.abs(start), jnp.abs(end))

    def residual(y: Array, q: Array) -> Array:
        moved = eqx.tree_at(lambda b: b.system, branch, branch.system.with_parameter(parameter, q * second))
        return _fold_residual(moved, y, branch.omega[0])

    y_0 = jnp.concatenate([found.unknowns[fold], found.value[fold, None] / branch.scale, found.null_vector[fold]])
    track = continued(residual, y_0, start / second, end / second, steps)
    valid = (jnp.arange(steps + 1) < track.n_valid) & found.exists[fold]
    return FoldTrack(track.params * second, track.states[:, branch.unknowns.shape[1]] * branch.scale, valid)
