"""The fitted motion and its linear response to small forces in each sample interval.

To first order every candidate effect is a force (or a sensor error) along the fitted motion. The response to a force is
the same for all candidates and computed once. One transition matrix per sample interval propagates the deviation, and
two input matrices add a force that is linear in the interval.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.polynomial import polyval

from fitting.estimation.machine_code import actuated
from fitting.estimation.residual import Problem, Unknowns
from fitting.estimation.segments import Segments
from hdjax import Model, PiecewisePolynomial
from hdjax.dynamics import Inputs
from hdjax.effects import ActuatorEffect, Conditions
from hdjax.engine import unusable
from hdjax.engine.equations import LOAD, TEMPERATURE
from hdjax.engine.pointwise import at_instants, slopes_at_instants
from hdjax.engine.response import Pushed, Response, response
from hdjax.lanes import jit_small_lanes
from hdjax.simulate import march

NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)
"""Quadrature nodes in a sample interval, from -1 to 1; exact for a sextic's mean and a quintic's first moment."""


class Followed(eqx.Module):
    """A simulated motion on every segment, and its linear response in every sample interval.

    Attributes:
        states: at each knot, the end of the last interval included.
        between: at the `NODES` of each interval.
        transition: derivative of the state at an interval's end by that at its start.
        from_start: response at the end to a force (a rate of the state) that falls from one to zero through the
            interval.
        from_end: response to one that rises from zero to one.
        readout: derivative of the outputs by the state, at each sample.
    """

    states: Float[np.ndarray, "segments knots states"]
    between: Float[np.ndarray, "segments samples nodes states"]
    transition: Float[np.ndarray, "segments samples states states"]
    from_start: Float[np.ndarray, "segments samples states states"]
    from_end: Float[np.ndarray, "segments samples states states"]
    readout: Float[np.ndarray, "segments samples outputs states"]


def follow(problem: Problem, unknowns: Unknowns) -> Followed:
    """Simulate the segments and linearise every sample interval."""
    model = problem.free.unpack(problem.model, unknowns.parameters)
    if problem.kernel is None:
        found = _response_by_xla(problem, unknowns)
    else:
        found = _response(model, problem, np.asarray(unknowns.states))
    states, transition, from_start, from_end = (np.asarray(a) for a in vars(found).values())
    between, samples = _between(model, states, problem.segments), np.zeros_like(problem.segments.width)
    read = readout(model, states[:, :-1], inputs_at(model, problem.segments, samples))
    return Followed(states, between, transition, from_start, from_end, read)


def _response(model: Model, problem: Problem, states: Float[np.ndarray, "segments states"]) -> Response:
    segments = problem.segments
    beside = {LOAD: segments.load_torque, TEMPERATURE: segments.temperature}
    found = {name: np.asarray(signal.coefficients) for name, signal in beside.items() if signal is not None}
    own = segments.knots, acting(model, segments)[:, segments.halo :], found
    return response(model, states, *own, int(problem.substeps), problem.solver)


def readout(
    model: Model, states: Float[Array | np.ndarray, "*many states"], inputs: Inputs | None = None
) -> Float[np.ndarray, "*many outputs states"]:
    """Derivatives of the outputs by the state, at each of many states and inputs."""
    many = states.ndim - 1
    return slopes_at_instants(_outputs, (states, many), (model, 0), (inputs, many))


def _outputs(state: Array, model: Model, inputs: Inputs | None) -> Array:
    return model.outputs(state, inputs)


@jit_small_lanes
def _response_by_xla(problem: Problem, unknowns: Unknowns) -> Response:
    model = problem.free.unpack(problem.model, unknowns.parameters)
    segments = problem.segments
    options = {"solver": problem.solver, "substeps": problem.substeps}

    def one(torque, load_torque, temperature, state):
        acting = model.actuate(torque)
        own = PiecewisePolynomial(acting.knots[segments.halo :], acting.coefficients[segments.halo :])
        states, end = march(model, own, load_torque, state, temperature=temperature, **options)

        def through(start, steady, rising, pieces):
            pushed = Pushed.of(model, tuple(steady), tuple(rising))
            torque, load, warmth = pieces
            initial = jnp.append(start, 0.0)
            return march(pushed, torque, load, initial, temperature=warmth, **options)[1][:-1]

        none, begin, width = jnp.zeros_like(state), own.knots[:-1], jnp.diff(own.knots)
        intervals = jnp.stack([begin, begin + width], axis=1)
        pieces = tuple(
            None if s is None else PiecewisePolynomial(intervals, s.coefficients[:, None])
            for s in (own, load_torque, temperature)
        )
        linear = jax.jacfwd(through, argnums=(0, 1, 2))
        transition, steady, rising = jax.vmap(linear, in_axes=(0, None, None, 0))(states, none, none, pieces)
        return Response.of(jnp.concatenate([states, end[None]]), transition, steady, rising, width)

    return jax.vmap(one)(segments.torque, segments.load_torque, segments.temperature, unknowns.states)


def acting(model: Model, segments: Segments) -> Float[np.ndarray, "segments intervals powers"]:
    """Coefficients of the torque after actuator effects, or of the forcing; those before each segment come first."""
    effects = tuple(e for e in model.effects if isinstance(e, ActuatorEffect))
    if not effects:
        return np.asarray(segments.torque.coefficients)
    return np.asarray(actuated(effects, (), jnp.asarray(np.zeros(0)), segments.torque)[0])


def polynomial(coefficients: Float[np.ndarray, "*many powers"], late: np.ndarray) -> np.ndarray:
    """Values of polynomials at given times in their intervals."""
    return polyval(late, np.moveaxis(coefficients, -1, 0), tensor=False)


def inputs_at(model: Model, segments: Segments, late: Float[np.ndarray, "segments samples *nodes"]) -> Inputs:
    """Inputs at given times in each sample interval."""
    nodes = (slice(None), slice(None), *[None] * (late.ndim - 2))

    def at(coefficients: Array | np.ndarray) -> np.ndarray:
        return polynomial(np.asarray(coefficients)[(*nodes, slice(None))], late)

    load, warmth = segments.load_torque, segments.temperature
    time = segments.knots[:, :-1][nodes] + late
    conditions = Conditions(jnp.asarray(time), None if warmth is None else jnp.asarray(at(warmth.coefficients)))
    on_load = np.zeros(late.shape) if load is None else at(load.coefficients)
    torque = jnp.asarray(at(acting(model, segments)[:, segments.halo :]))
    return Inputs(torque, jnp.asarray(on_load), conditions)


def state_rates(model: Model, state: Array, inputs: Inputs) -> Array:
    """Rates of the state under inputs at an instant."""
    return model.rates(state, inputs.torque, inputs.load_torque, inputs.conditions)


def _between(
    model: Model, knots: Float[np.ndarray, "segments knots states"], segments: Segments
) -> Float[np.ndarray, "segments samples nodes states"]:
    """States inside the intervals: cubics with the right values and rates at both ends (Hermite)."""
    width = segments.width
    y0, y1 = knots[:, :-1], knots[:, 1:]

    def rise_at(states: np.ndarray, late: np.ndarray) -> np.ndarray:
        return width[..., None] * at_instants(
            state_rates, (model, 0), (states, 2), (inputs_at(model, segments, late), 2)
        )

    r0, r1 = (r[:, :, None] for r in (rise_at(y0, np.zeros_like(width)), rise_at(y1, width)))
    y0, y1 = y0[:, :, None], y1[:, :, None]
    s = 0.5 * (NODES[:, None] + 1.0)
    rise = y1 - y0
    return y0 + s * rise + s * (1.0 - s) * ((1.0 - s) * (r0 - rise) - s * (r1 - rise))


class Forces(eqx.Module):
    """Forces along a motion: in each sample interval a sum of parts.

    Attributes:
        lands: response of the state at the interval's end to a unit of each part.
        sizes: coefficient of each part in each force.
    """

    lands: Float[np.ndarray, "segments samples states parts"]
    sizes: Float[np.ndarray, "segments samples parts columns"]


def respond(
    followed: Followed,
    forces: Forces,
    start: Float[np.ndarray, "#segments states columns"] | float = 0.0,
    readout: Float[np.ndarray, "segments samples outputs states"] | None = None,
) -> tuple[Float[np.ndarray, "segments samples outputs columns"], Float[np.ndarray, "segments states columns"]]:
    """Response of the outputs and of each segment's final state to forces along the motion.

    Args:
        followed: the motion.
        forces: along it.
        start: deviation of each segment's initial state.
        readout: derivative of the wanted signals by the state; that of the outputs where not given.
    """
    segments, samples, states, _ = forces.lands.shape
    deviation = np.broadcast_to(start, (segments, states, forces.sizes.shape[-1]))
    readout = followed.readout if readout is None else readout
    if unusable() is None:
        from hdjax.engine.linear import linear_response

        return linear_response(followed.transition, readout, forces.lands, forces.sizes, deviation)
    outputs = np.empty((segments, samples, readout.shape[2], forces.sizes.shape[-1]))
    for i in range(samples):
        outputs[:, i] = readout[:, i] @ deviation
        deviation = followed.transition[:, i] @ deviation + forces.lands[:, i] @ forces.sizes[:, i]
    return outputs, deviation
