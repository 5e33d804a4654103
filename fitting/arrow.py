"""Levenberg-Marquardt for arrow-shaped least squares: shared parameters, and states that belong to one segment each.

The dense Jacobian of a log has thousands of columns, nearly all of them zero. Eliminating each segment's state first
leaves a system as small as the number of shared parameters (the Schur complement), so that a step costs little more
than the simulation behind it. optimistix does the iteration; this file tells it how to solve for a step.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from fitting.residual import Blocks, Unknowns

# optimistix starts with damping 1; relative to the diagonal of J^T J a thousandth of it suits a good start.
_INITIAL_DAMPING = 1e-3


class ArrowSystem(eqx.Module):
    """The normal equations of [`Blocks`][], in blocks.

    Attributes:
        shared: sum over segments of J_p^T J_p.
        own: J_s^T J_s of each segment.
        coupling: J_s^T J_p of each segment.
        shared_gradient: sum of J_p^T r.
        own_gradient: J_s^T r of each segment.
    """

    shared: Float[Array, "parameters parameters"]
    own: Float[Array, "segments states states"]
    coupling: Float[Array, "segments states parameters"]
    shared_gradient: Float[Array, " parameters"]
    own_gradient: Float[Array, "segments states"]

    def eliminate(self, damping: Array) -> tuple[Array, Array, Array, Array]:
        """Solve each segment for its own state.

        Returns:
            The reduced matrix and gradient of the shared parameters, and each segment's response `own^-1 coupling`
            and `own^-1 own_gradient`.
        """
        own = self.own + damping * _diagonal(self.own)
        right = jnp.concatenate([self.coupling, self.own_gradient[:, :, None]], axis=2)
        solved = jax.vmap(_solve_scaled)(own, right)
        response, own_step = solved[:, :, :-1], solved[:, :, -1]
        shared = self.shared + damping * _diagonal(self.shared)
        matrix = shared - jnp.einsum("sqp,sqr->pr", self.coupling, response)
        gradient = self.shared_gradient - jnp.einsum("sqp,sq->p", self.coupling, own_step)
        return matrix, gradient, response, own_step

    def step(self, damping: Array) -> Unknowns:
        """The damped Gauss-Newton step."""
        matrix, gradient, response, own_step = self.eliminate(damping)
        shared = _solve_scaled(matrix, gradient[:, None])[:, 0]
        own = own_step - jnp.einsum("sqp,p->sq", response, shared)
        return Unknowns(-shared, -own)


def normal_equations(blocks: Blocks) -> ArrowSystem:
    """The normal equations of a linearised residual."""
    p, s, r = blocks.by_parameter, blocks.by_state, blocks.residual
    return ArrowSystem(
        shared=jnp.einsum("srp,srq->pq", p, p),
        own=jnp.einsum("srp,srq->spq", s, s),
        coupling=jnp.einsum("srq,srp->sqp", s, p),
        shared_gradient=jnp.einsum("srp,sr->p", p, r),
        own_gradient=jnp.einsum("srq,sr->sq", s, r),
    )


def _diagonal(matrix: Array) -> Array:
    """The diagonal part of each matrix; where it is zero (padding), ones."""
    d = jnp.diagonal(matrix, axis1=-2, axis2=-1)
    return jnp.where(d > 0, d, 1.0)[..., None] * jnp.broadcast_to(jnp.eye(d.shape[-1]), matrix.shape)


def _solve_scaled(matrix: Array, right: Array) -> Array:
    """Solve a symmetric system after scaling its diagonal to one; a direction without information does not move."""
    d = jnp.diagonal(matrix)
    scale = jnp.where(d > 0, 1.0 / jnp.sqrt(jnp.where(d > 0, d, 1.0)), 0.0)
    empty = jnp.where(d > 0, 0.0, 1.0)
    scaled = matrix * scale[:, None] * scale[None, :] + jnp.diag(empty + 1e-13)
    return scale[:, None] * jnp.linalg.solve(scaled, scale[:, None] * right)


class ArrowDescent(optx.AbstractDescent):
    """Damped Gauss-Newton steps by elimination of the segments' states; damping is relative to diag(J^T J)."""

    def init(self, y: Unknowns, f_info_struct) -> ArrowSystem:
        parameters = y.parameters.shape[0]
        segments, states = y.states.shape
        return ArrowSystem(
            shared=jnp.eye(parameters),
            own=jnp.broadcast_to(jnp.eye(states)[None], (segments, states, states)),
            coupling=jnp.zeros((segments, states, parameters)),
            shared_gradient=jnp.zeros(parameters),
            own_gradient=jnp.zeros((segments, states)),
        )

    def query(self, y: Unknowns, f_info, state: ArrowSystem) -> ArrowSystem:
        parameters = y.parameters.shape[0]
        segments, states = y.states.shape

        def column(seed):
            own = jnp.broadcast_to(seed[None, parameters:], (segments, states))
            return f_info.jac.mv(Unknowns(seed[:parameters], own))

        # One seed moves the same state of every segment: no row depends on two of them.
        columns = jax.vmap(column, out_axes=-1)(jnp.eye(parameters + states))
        return normal_equations(Blocks(f_info.residual, columns[..., :parameters], columns[..., parameters:]))

    def step(self, step_size: Array, state: ArrowSystem) -> tuple[Unknowns, optx.RESULTS]:
        damping = _INITIAL_DAMPING / jnp.maximum(step_size, 1e-30)
        return state.step(damping), optx.RESULTS.successful


class ArrowLevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix' Levenberg-Marquardt with [`ArrowDescent`][] for its linear algebra."""

    rtol: float
    atol: float
    norm: Callable[[Any], Array] = optx.rms_norm
    descent: ArrowDescent = ArrowDescent()
    search: optx.ClassicalTrustRegion = optx.ClassicalTrustRegion()
    verbose: Callable[..., None] = eqx.field(static=True, default=lambda **_: None)
