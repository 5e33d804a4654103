"""Hidden states of effects, driven by a given motion."""

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdjax.effects import Effect, Motion
from hdjax.engine.array_rules import UntranslatableError
from hdjax.engine.equations import Equations, Part
from hdjax.engine.graph import Graph, Node
from hdjax.engine.kernel import Lanes, march_arrays, threads
from hdjax.engine.pointwise import likeness
from hdjax.engine.translate import traced, translated

# Steps in a sample interval, along a motion that is linear in between.
_STEPS = 2


class _Classical(dfx.AbstractERK):
    """The Runge-Kutta method of fourth order."""

    tableau: ClassVar[dfx.ButcherTableau] = dfx.ButcherTableau(
        c=np.array([0.5, 0.5, 1.0]),
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
        b_error=np.zeros(4),
    )
    interpolation_cls: ClassVar[Callable[..., Any]] = dfx.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: Any) -> int:
        return 4


@dataclasses.dataclass(frozen=True)
class _Driven:
    """Machine code of an effect's hidden states.

    Attributes:
        address: of the march. Its states are those of the effect, followed by the effect's numbers as constant states,
            so that each lane has its own numbers.
        numbers: which numbers of the effect are included.
        signals: which parts of the motion are inputs.
    """

    address: int
    numbers: tuple[int, ...]
    signals: tuple[int, ...]


_DRIVEN: dict[Hashable, _Driven | None] = {}


def own_states_along(
    effect: Effect,
    before: Motion,
    after: Motion,
    width: Float[np.ndarray, "chains intervals"],
    start: Float[np.ndarray, "chains proposals own"],
    *,
    by_machine_code: bool,
) -> Float[np.ndarray, "chains knots proposals own"]:
    """Hidden states of proposals of an effect at each knot of motions that are linear in each interval.

    Args:
        effect: the proposals, along the first axis of each array.
        before: the motions at the start of each interval, by chain and interval.
        after: the motions at its end.
        width: of the intervals [s].
        start: the states at the first knot.
        by_machine_code: whether machine code is available.
    """
    key = likeness(effect, 1), likeness(before, 2), by_machine_code
    if key not in _DRIVEN:
        try:
            _DRIVEN[key] = _translated(effect, before) if by_machine_code else None
        except UntranslatableError:
            _DRIVEN[key] = None
    made = _DRIVEN[key]
    if made is None:
        return np.asarray(_by_jax(*jax.tree.map(jnp.asarray, (effect, before, after, width, start))))
    from hdjax.engine.rows import LOST

    chains, intervals = width.shape
    proposals, own = start.shape[1:]
    lanes = chains * proposals
    arrays = jax.tree.leaves(eqx.filter(effect, eqx.is_inexact_array))
    numbers = np.concatenate([np.reshape(a, (proposals, -1)) for a in arrays], axis=1)[:, list(made.numbers)]
    states = np.concatenate([start, np.broadcast_to(numbers, (chains, *numbers.shape))], axis=2).reshape(lanes, -1)
    ends = [[np.asarray(a) for a in jax.tree.leaves(motion)] for motion in (before, after)]
    lines = [np.stack([ends[0][i], (ends[1][i] - ends[0][i]) / width], axis=-1) for i in made.signals]
    found = march_arrays(
        np.array(made.address),
        Lanes(
            free=np.zeros(0),
            slopes=np.zeros(0),
            constants=np.zeros(0),
            states=states,
            knots=np.repeat(np.pad(np.cumsum(width, axis=1), ((0, 0), (1, 0))), proposals, axis=0),
            measured=np.zeros((lanes, intervals, own)),
            weight=np.ones((lanes, intervals)),
            joined=np.zeros(lanes),
            whitening=-np.eye(own),
            settings=np.array([_STEPS, 1, threads()]),
            signals=tuple(np.repeat(line, proposals, axis=0) for line in lines),
        ),
        0,
        "values",
    )
    rows = found.rows.reshape(lanes, intervals, own)
    states = np.concatenate([rows, np.asarray(found.end)[:, None, :own]], axis=1)
    states = np.where(np.abs(states) < LOST, states, np.nan)
    return np.swapaxes(states.reshape(chains, proposals, intervals + 1, own), 1, 2)


def _translated(effect: Effect, motion: Motion) -> _Driven:
    # Modules that need llvmlite are imported only if it is installed.
    from hdjax.engine.machine import compiled
    from hdjax.engine.march import MARCH, March

    arrays, rest = eqx.partition(effect, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    moving, motion_tree = jax.tree.flatten(motion)
    own = len(effect.states)
    half = np.float64(0.5)

    def rates(numbers: list[Array], moving: list[Array], states: list[Array]) -> list[Array]:
        whole = eqx.combine(tree.unflatten(numbers), rest)
        return list(whole.state_rates(motion_tree.unflatten(moving), jnp.stack(states)))

    blank = [np.full(np.shape(leaf)[1:], half)[()] for leaf in leaves]
    program = traced(rates, blank, [half] * len(moving), [half] * own)

    def translate(names: Callable[[str, int], Hashable]) -> tuple[Graph, list[Node]]:
        graph, used, nodes = Graph(), 0, []
        for leaf in blank:
            place = np.empty(leaf.shape, dtype=object)
            for index in np.ndindex(leaf.shape):
                place[index] = graph.leaf(names("number", used))
                used += 1
            nodes.append(place)
        nodes += [np.array(graph.leaf(names("signal", i)), dtype=object) for i in range(len(moving))]
        nodes += [np.array(graph.leaf(("state", i)), dtype=object) for i in range(own)]
        return graph, [node.item() for node in translated(graph, program, nodes)]

    # Unused parts cost nothing.
    graph, found = translate(lambda kind, i: (kind, i))
    needed = sorted(graph.nodes[n][1] for n in graph.needed(found) if graph.nodes[n][0] == "leaf")
    numbers, signals = (tuple(i for kind, i in needed if kind == name) for name in ("number", "signal"))
    signals = signals or (0,)
    places = {("number", i): ("state", own + k) for k, i in enumerate(numbers)}
    places |= {("signal", i): ("signal", k) for k, i in enumerate(signals)}
    graph, found = translate(lambda kind, i: places.get((kind, i), ("unused", kind, i)))

    def part(*nodes: Node) -> Part:
        return Part(nodes, tuple({} for _ in nodes))

    equations = Equations(
        graph=graph,
        paths=(),
        acting=(),
        constants=0,
        states=own + len(numbers),
        signals=tuple(str(i) for i in signals[1:]),
        rates=part(*found, *(graph.constant(0.0) for _ in numbers)),
        held=part(),
        outputs=part(*(graph.leaf(("state", i)) for i in range(own))),
        prior=part(),
    )
    (address,) = compiled(March(equations, _Classical(), "values").module, MARCH)
    return _Driven(address, numbers, signals)


@eqx.filter_jit
def _by_jax(effect: Effect, before: Motion, after: Motion, width: Array, start: Array) -> Array:
    """The same by a JAX program, for functions that the graph does not support."""

    def lane(effect: Effect, before: Motion, after: Motion, width: Array, start: Array) -> Array:
        def interval(own: Array, inputs: tuple[Motion, Motion, Array]) -> tuple[Array, Array]:
            before, after, width = inputs

            def rate(own: Array, passed: float) -> Array:
                between = jax.tree.map(lambda a, b: (1.0 - passed) * a + passed * b, before, after)
                return jnp.stack(list(effect.state_rates(between, own)))

            h = width / _STEPS
            for i in range(_STEPS):
                k1 = rate(own, i / _STEPS)
                k2 = rate(own + 0.5 * h * k1, (i + 0.5) / _STEPS)
                k3 = rate(own + 0.5 * h * k2, (i + 0.5) / _STEPS)
                k4 = rate(own + h * k3, (i + 1) / _STEPS)
                own = own + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            return own, own

        _, after_each = jax.lax.scan(interval, start, (before, after, width))
        return jnp.concatenate([start[None], after_each])

    proposals = jax.vmap(lane, in_axes=(0, None, None, None, 0), out_axes=1)
    return jax.vmap(proposals, in_axes=(None, 0, 0, 0, 0))(effect, before, after, width, start)
