"""A drive under a forcing from rest, as one graph of scalars; each lane has its own numbers."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hdjax.dynamics import Model
from hdjax.effects import Conditions
from hdjax.elementary import cosine_and_sine
from hdjax.engine.array_rules import Nodes
from hdjax.engine.equations import DryStep, numbered_leaves
from hdjax.engine.graph import PARAMETER, VARYING, Graph, Node
from hdjax.engine.translate import traced, translated
from hdjax.forcing import Harmonic


class Drawn(NamedTuple):
    """A point of a sweep.

    Attributes:
        model: the equations.
        forcing: motor torque, or a reduced drive's forcing, as a function of time.
        length: of the simulation [s].
    """

    model: Model
    forcing: Callable[[Array], Array]
    length: Array


Seen = tuple[Array, Array, Array]
"""Measured dynamic error [rad], its rate and its acceleration."""


@dataclasses.dataclass(frozen=True)
class Forced:
    """A drive under a forcing.

    Attributes:
        graph: of all nodes here.
        length: of the simulation [s].
        start: the state at t = 0.
        wave: amplitude, frequency, phase and mean of a harmonic forcing; empty for any other.
        circle: cosine and sine of the leaf `("angle",)`.
        torque: the forcing at `("time",)`.
        held: dry friction over a step, from the state, time and `("torque",)` at its start.
        rates: of the states.
        seen: measured dynamic error, its rate and its acceleration.
        largest: largest |x| within a step, from `seen` at its ends, `("before", i)` and `("after", i)`.
    """

    graph: Graph
    length: Node
    start: tuple[Node, ...]
    wave: tuple[Node, ...]
    circle: tuple[Node, ...]
    torque: Node
    held: tuple[Node, ...]
    rates: tuple[Node, ...]
    seen: tuple[Node, ...]
    largest: Node


def forced(
    drawn: Callable[[Sequence[Array]], Drawn],
    shapes: Sequence[tuple[int, ...]],
    seen: Callable[[Model, Array, Array, Array], Seen],
    largest: Callable[[Seen, Seen, Array], Array],
) -> Forced:
    """Translate a drive under a forcing.

    Args:
        drawn: a point, from arrays of its numbers.
        shapes: of these arrays.
        seen: function of a model, its state, the torque and the time.
        largest: function of `seen` at both ends of a step, and its width.

    Raises:
        UntranslatableError: the model or the forcing uses an unsupported function.
    """
    graph, half = Graph(), np.float64(0.5)
    numbers: list[Nodes] = []
    for shape in shapes:
        numbers.append(numbered_leaves(graph, "number", shape, PARAMETER, sum(n.size for n in numbers)))

    def translate(function: Callable[..., Any], *extra: Any) -> tuple[Node, ...]:
        nodes = [np.asarray(n, dtype=object) for n in extra]
        examples = [np.full(n.shape, half)[()] for n in (*numbers, *nodes)]
        program = traced(
            lambda *given: jax.tree.leaves(function(drawn(given[: len(shapes)]), *given[len(shapes) :])), *examples
        )
        return tuple(node for array in translated(graph, program, [*numbers, *nodes]) for node in np.ravel(array))

    moving = ("torque", "time", "step", "angle")
    torque, time, step, angle = (np.array(graph.leaf((name,)), dtype=object) for name in moving)
    start = translate(lambda point: point.model.rest())
    state = numbered_leaves(graph, "state", (len(start),), VARYING)
    dry, none = DryStep(), jnp.asarray(np.zeros(()))

    def before(point: Drawn, state: Array, torque: Array, time: Array, step: Array) -> list[Array]:
        return dry.before(point.model, list(state), torque, none, Conditions(time=time), step)

    def rates(point: Drawn, state: Array, torque: Array, time: Array, held: Array) -> list[Array]:
        around = dry.within(Conditions(time=time), held)
        return point.model.component_rates(list(state), torque, none, around)

    def wave(point: Drawn) -> list[Array]:
        f = point.forcing
        return [f.amplitude, f.omega, f.phase, f.offset] if isinstance(f, Harmonic) else []

    held = translate(before, state, torque, time, step)
    ends = [numbered_leaves(graph, name, (3,), VARYING) for name in ("before", "after")]
    return Forced(
        graph=graph,
        length=translate(lambda point: point.length)[0],
        start=start,
        wave=translate(wave),
        circle=translate(lambda point, angle: cosine_and_sine(angle), angle),
        torque=translate(lambda point, time: point.forcing(time), time)[0],
        held=held,
        rates=translate(rates, state, torque, time, numbered_leaves(graph, "held", (len(held),), VARYING)),
        seen=translate(lambda point, *moving: seen(point.model, *moving), state, torque, time),
        largest=translate(lambda point, a, b, step: largest(tuple(a), tuple(b), step), *ends, step)[0],
    )
