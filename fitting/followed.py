"""The motion that a fit found, sample by sample, and how a small force anywhere along it would change it.

To first order every candidate effect is a force (or a reading) along the motion that the model has found. How the
model answers a force is the same for all of them, so that it is computed once: one matrix a sample interval carries
the deviation on, two more add what a force that runs in a straight line through the interval does.
"""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.residual import Problem, Unknowns
from hdjax import Drive, Model, PiecewisePolynomial, ReducedDrive
from hdjax.dynamics import State
from hdjax.effects import Conditions, Effect, Motion
from hdjax.lanes import jit_small_lanes
from hdjax.signals import polynomial
from hdjax.simulate import march

NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)
"""Where a sample interval, from -1 to 1, is looked into; exact for a sextic's mean and a quintic's first moment."""


class Followed(eqx.Module):
    """A simulated motion on every segment, and its linear response in every sample interval.

    Attributes:
        states: at each knot, the end of the last interval included.
        between: at the `NODES` of each interval.
        transition: what a deviation of the state at an interval's start is at its end.
        from_start: what a force (a rate of the state) that falls from one to zero through the interval adds.
        from_end: likewise of one that rises from zero to one.
        readout: derivative of the outputs by the state, at each sample.
    """

    states: Float[Array, "segments knots states"]
    between: Float[Array, "segments samples nodes states"]
    transition: Float[Array, "segments samples states states"]
    from_start: Float[Array, "segments samples states states"]
    from_end: Float[Array, "segments samples states states"]
    readout: Float[Array, "segments samples outputs states"]


class _Pushed(Model):
    """A model whose rates have a straight line through the interval added; its last state is the part of the interval
    that has passed."""

    model: Model
    width: Array
    at_start: Float[Array, " states"]
    at_end: Float[Array, " states"]
    drive: Drive | ReducedDrive
    effects: tuple[Effect, ...]
    motion_states: ClassVar[tuple[str, ...]] = ()

    def motion(self, state: State | Sequence[Array], conditions: Conditions = Conditions()) -> Motion:
        return self.model.motion(state[:-1], conditions)

    def component_rates(
        self, state: Sequence[Array], torque: Array, load_torque: Array, conditions: Conditions = Conditions()
    ) -> list[Array]:
        *own, passed = state
        found = self.model.component_rates(own, torque, load_torque, conditions)
        pushed = [
            rate + start * (1.0 - passed) + end * passed
            for rate, start, end in zip(found, self.at_start, self.at_end, strict=True)
        ]
        return [*pushed, 1.0 / self.width]

    def mobility(self, moved: str, opposed: str) -> Array | float:
        return self.model.mobility(moved, opposed)

    def outputs(self, state: State) -> Array:
        return self.model.outputs(state[:-1])


@jit_small_lanes
def follow(problem: Problem, unknowns: Unknowns) -> Followed:
    """Simulate the segments and linearise every sample interval along the way."""
    model = problem.free.unpack(problem.model, unknowns.parameters)
    segments = problem.segments
    halo = segments.halo

    def one(torque, load_torque, temperature, state):
        acting = model.actuate(torque)
        own = PiecewisePolynomial(acting.knots[halo:], acting.coefficients[halo:])
        options = {"solver": problem.solver, "substeps": problem.substeps, "unroll": problem.unroll}
        states, end = march(model, own, load_torque, state, temperature=temperature, **options)
        knots = jnp.concatenate([states, end[None]])

        def through(start, at_start, at_end, begin, width, coefficients, load, warmth):
            pushed = _Pushed(
                model=model, width=width, at_start=at_start, at_end=at_end, drive=model.drive, effects=model.effects
            )
            interval = jnp.stack([begin, begin + width])
            piece = PiecewisePolynomial(interval, coefficients[None])
            on_load, warm = (None if c is None else PiecewisePolynomial(interval, c[None]) for c in (load, warmth))
            initial = jnp.append(start, jnp.zeros_like(width))
            return march(pushed, piece, on_load, initial, temperature=warm, **options)[1][:-1]

        none = jnp.zeros_like(state)
        linear = jax.jacfwd(through, argnums=(0, 1, 2))
        load, warmth = (None if s is None else s.coefficients for s in (load_torque, temperature))
        transition, from_start, from_end = jax.vmap(linear, in_axes=(0, None, None, 0, 0, 0, 0, 0))(
            states, none, none, own.knots[:-1], jnp.diff(own.knots), own.coefficients, load, warmth
        )
        between = _between(model, knots, own, load_torque, temperature)
        return knots, between, transition, from_start, from_end, jax.vmap(jax.jacfwd(model.outputs))(states)

    found = jax.vmap(one)(segments.torque, segments.load_torque, segments.temperature, unknowns.states)
    knots, between, transition, from_start, from_end, readout = found
    return Followed(knots, between, transition, from_start, from_end, readout)


def _between(
    model: Model,
    knots: Float[Array, "knots states"],
    torque: PiecewisePolynomial,
    load_torque: PiecewisePolynomial | None,
    temperature: PiecewisePolynomial | None,
) -> Float[Array, "samples nodes states"]:
    """States inside the intervals: cubics with the right values and rates at both ends (Hermite)."""
    width = jnp.diff(torque.knots)

    def rise_at(states: Array, late: Array) -> Array:
        value = polynomial(torque.coefficients, late)
        load = jnp.zeros_like(late) if load_torque is None else polynomial(load_torque.coefficients, late)
        warmth = None if temperature is None else polynomial(temperature.coefficients, late)
        return width[:, None] * jax.vmap(model.rates)(states, value, load, Conditions(torque.knots[:-1] + late, warmth))

    r0, r1 = rise_at(knots[:-1], jnp.zeros_like(width))[:, None], rise_at(knots[1:], width)[:, None]
    y0, y1 = knots[:-1, None], knots[1:, None]
    s = jnp.asarray(0.5 * (NODES + 1.0))[None, :, None]
    rise = y1 - y0
    return y0 + s * rise + s * (1.0 - s) * ((1.0 - s) * (r0 - rise) - s * (r1 - rise))


def respond(
    followed: Followed,
    at_start: Float[Array, "segments samples states columns"],
    at_end: Float[Array, "segments samples states columns"],
) -> tuple[Float[Array, "segments samples outputs columns"], Float[Array, "segments states columns"]]:
    """What forces along the motion do to the outputs and to each segment's end, where it starts undisturbed.

    Args:
        followed: the motion.
        at_start: each force at the start of each sample interval.
        at_end: and at its end; in between it runs in a straight line.
    """

    def one(followed: Followed, at_start, at_end):
        pushed = _times(followed.from_start, at_start) + _times(followed.from_end, at_end)

        def step(deviation, inputs):
            transition, push = inputs
            return _times(transition, deviation) + push, deviation

        undisturbed = jnp.zeros(pushed.shape[1:])
        end, deviations = jax.lax.scan(step, undisturbed, (followed.transition, pushed))
        return _times(followed.readout, deviations), end

    return jax.vmap(one)(followed, at_start, at_end)


def _times(matrices: Array, columns: Array) -> Array:
    """Their product, written out: one of many tiny matrices is slow."""
    return sum((matrices[..., :, j, None] * columns[..., None, j, :] for j in range(matrices.shape[-1])), jnp.zeros(()))
