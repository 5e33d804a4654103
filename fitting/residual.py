"""Measured minus simulated on every segment, and its derivatives: the one program that all fits run."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fitting.experiment import Segments
from fitting.free import FreeParameters
from hdjax import Model
from hdjax.simulate import march

# Where a simulation has left the numbers, the residual is this many standard deviations: a rejected step.
_LOST = 1e8


class Problem(eqx.Module):
    """Everything that the residual depends on except what is fitted.

    Attributes:
        model: supplies the parameters that are not free.
        free: what is free.
        segments: the data.
        whitening: `whitening @ e` has unit covariance for an output error e.
        active: 1 for a parameter that may move, 0 for one that is held; one program fits and evaluates.
        solver: explicit Runge-Kutta solver of diffrax.
        substeps: its steps in each sample interval.
    """

    model: Model
    free: FreeParameters
    segments: Segments
    whitening: Float[Array, "outputs outputs"]
    active: Float[Array, " parameters"]
    solver: dfx.AbstractERK = dfx.Tsit5()
    substeps: int = eqx.field(static=True, default=1)


class Unknowns(eqx.Module):
    """What is fitted: the free parameters, and the initial state of each segment."""

    parameters: Float[Array, " parameters"]
    states: Float[Array, "segments states"]


class Blocks(eqx.Module):
    """Residual and its Jacobian, which is arrow-shaped: a segment's rows depend on the shared parameters and on its
    own initial state only."""

    residual: Float[Array, "segments rows"]
    by_parameter: Float[Array, "segments rows parameters"]
    by_state: Float[Array, "segments rows states"]


def simulate_segments(problem: Problem, unknowns: Unknowns) -> Float[Array, "segments samples outputs"]:
    """The outputs that the model gives on each segment."""
    model = problem.free.unpack(problem.model, unknowns.parameters)
    segments = problem.segments

    def one(torque, load_torque, state):
        acting = model.actuate(torque)
        halo = segments.halo
        own = eqx.tree_at(
            lambda t: (t.knots, t.coefficients),
            acting,
            (acting.knots[halo:], acting.coefficients[halo:]),
        )
        states = march(model, own, load_torque, state, solver=problem.solver, substeps=problem.substeps)
        return jax.vmap(model.outputs)(states)

    return jax.vmap(one)(segments.torque, segments.load_torque, unknowns.states)


def output_error(problem: Problem, unknowns: Unknowns) -> Float[Array, "segments samples outputs"]:
    """Measured minus simulated outputs, zero on padding."""
    error = problem.segments.measured - simulate_segments(problem, unknowns)
    return error * problem.segments.weight[:, :, None]


def residual(problem: Problem, unknowns: Unknowns) -> Float[Array, "segments rows"]:
    """Whitened output error of each segment by row, then its hidden initial states in units of their prior."""
    error = output_error(problem, unknowns)
    white = jnp.einsum("ij,snj->sni", problem.whitening, error)
    rows = white.reshape(white.shape[0], -1)
    rows = jnp.where(jnp.isfinite(rows), rows, _LOST)
    prior = _state_prior(problem, unknowns)
    return jnp.concatenate([rows, prior], axis=1)


def _state_prior(problem: Problem, unknowns: Unknowns) -> Float[Array, "segments hidden"]:
    """Hidden states start unseen: without a prior they could take any value where the data say nothing."""
    model = problem.free.unpack(problem.model, unknowns.parameters)
    motion = len(model.motion_states)
    scale = [e.state_scale() for e in model.effects if e.states]
    hidden = unknowns.states[:, motion:]
    if not scale:
        return hidden
    return hidden / jax.lax.stop_gradient(jnp.concatenate(scale))[None, :]


def blocks(problem: Problem, unknowns: Unknowns) -> Blocks:
    """Residual and Jacobian from one simulation whose lanes are segments x sensitivities (forward mode)."""
    parameters = unknowns.parameters.shape[0]
    segments, states = unknowns.states.shape
    seeds = jnp.eye(parameters + states)

    def along(seed):
        tangent = Unknowns(seed[:parameters], jnp.broadcast_to(seed[None, parameters:], (segments, states)))
        return jax.jvp(lambda u: residual(problem, u), (unknowns,), (tangent,))

    value, columns = jax.vmap(along, out_axes=(None, -1))(seeds)
    columns = jnp.where(jnp.isfinite(columns), columns, 0.0)
    return Blocks(value, columns[..., :parameters] * problem.active[None, None, :], columns[..., parameters:])


@eqx.filter_custom_jvp
def residual_with_blocks(unknowns: Unknowns, problem: Problem) -> Float[Array, "segments rows"]:
    """[`residual`][], whose derivative is a product with [`blocks`][] rather than a second simulation."""
    return residual(problem, unknowns)


@residual_with_blocks.def_jvp
def _residual_jvp(primals, tangents):
    unknowns, problem = primals
    tangent, _ = tangents
    found = blocks(problem, unknowns)
    change = jnp.zeros_like(found.residual)
    if tangent.parameters is not None:
        change = change + jnp.einsum("srp,p->sr", found.by_parameter, tangent.parameters)
    if tangent.states is not None:
        change = change + jnp.einsum("srq,sq->sr", found.by_state, tangent.states)
    return found.residual, change
