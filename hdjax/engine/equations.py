"""A model's equations as one graph of scalars, with their derivatives."""

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hdjax.dynamics import Inputs, Model
from hdjax.effects import ActuatorEffect, Conditions, Rubbing
from hdjax.engine.array_rules import Nodes
from hdjax.engine.derivatives import Tangent, derivatives
from hdjax.engine.graph import PARAMETER, VARYING, Graph, Node
from hdjax.engine.translate import traced, translated
from hdjax.rubbing import over_step

LOAD, TEMPERATURE = "load torque", "temperature"


@dataclasses.dataclass(frozen=True)
class Part:
    """Some of the equations.

    Attributes:
        values: of each row.
        slopes: their nonzero derivatives, by direction: `("parameter", i)`, `("state", i)`, `("held", i)`.
    """

    values: tuple[Node, ...]
    slopes: tuple[Tangent, ...]

    def rows_along(self, kind: str) -> list[int]:
        """The rows that have a derivative in a direction of this kind."""
        return [i for i, t in enumerate(self.slopes) if any(d[0] == kind for d in t)]


@dataclasses.dataclass(frozen=True)
class Equations:
    """Equations of a model for a simulation with sensitivities.

    Attributes:
        graph: of all nodes here.
        paths: the parameters of the derivatives.
        acting: those of them that change only the logged torque.
        constants: number of further numbers in the model.
        states: their number.
        signals: inputs other than the torque: `LOAD`, `TEMPERATURE`.
        rates: of the states.
        held: values computed once per step.
        outputs: of the sensors; their signals are those just before the sample.
        prior: deviation of hidden initial states from their expected values, in units of their prior.
    """

    graph: Graph
    paths: tuple[str, ...]
    acting: tuple[int, ...]
    constants: int
    states: int
    signals: tuple[str, ...]
    rates: Part
    held: Part
    outputs: Part
    prior: Part


class DryStep:
    """Dry friction over a step: values computed at the step's start, as a list of numbers, and their use."""

    def __init__(self):
        self._names: list[str] = []

    def before(
        self, model: Model, state: list[Array], torque: Array, load: Array, conditions: Conditions, step: Array
    ) -> list[Array]:
        """The numbers; arguments as of [`hdjax.rubbing.over_step`][]."""
        found = over_step(model, state, torque, load, conditions, step) or {}
        self._names[:] = sorted(found)
        return [part for name in self._names for part in (found[name].sign, found[name].reach)]

    def within(self, conditions: Conditions, held: Array) -> Conditions:
        """The conditions within the step, from the values of `before`."""
        if not self._names:
            return conditions
        rubbing = {n: Rubbing(held[2 * i], held[2 * i + 1]) for i, n in enumerate(self._names)}
        return dataclasses.replace(conditions, rubbing=rubbing)


def numbers_of(model: Any) -> list[Any]:
    """All arrays of a model, or of a tree with one."""
    return jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))


def split_model(model: Model, paths: Sequence[str]) -> tuple[list[Array], list[Array], Callable[..., Model]]:
    """A model as numbers: the parameters at the paths, all arrays, and the inverse function."""
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)

    def joined(free: Sequence[Array], others: Sequence[Array]) -> Model:
        whole = eqx.combine(jax.tree.unflatten(tree, others), rest)
        return whole.replace(dict(zip(paths, free, strict=True))) if paths else whole

    return model.values(paths), leaves, joined


def structure(model: Any, paths: Sequence[str], signals: Sequence[str]) -> Hashable:
    """Key of models, or of trees with one, that share machine code."""
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    fixed, fixed_tree = jax.tree.flatten(rest)
    whole = tuple((np.asarray(a).shape, np.asarray(a).tobytes()) if eqx.is_array(a) else a for a in fixed)
    return tree, fixed_tree, whole, tuple(a.shape for a in leaves), tuple(paths), tuple(signals)


def equations(model: Model, paths: Sequence[str], signals: Sequence[str]) -> Equations:
    """Translate a model.

    Args:
        model: its values don't matter, except for integers and truth values.
        paths: dotted paths of the parameters of the derivatives.
        signals: inputs other than the torque.

    Raises:
        UntranslatableError: the model uses an unsupported function.
    """
    free, others, joined = split_model(model, paths)
    graph = Graph(tables=("constant",))
    count = len(model.state_names)
    numbers = {
        "parameter": numbered_leaves(graph, "parameter", (len(free),), PARAMETER),
        "state": numbered_leaves(graph, "state", (count,), VARYING),
    }
    constants, used = [], 0
    for leaf in others:
        constants.append(numbered_leaves(graph, "constant", leaf.shape, PARAMETER, used))
        used += leaf.size
    surroundings = [np.array(graph.leaf(name), dtype=object) for name in (("signal", 0), ("time",), ("step",))] + [
        np.array(graph.leaf(("signal", 1 + i)), dtype=object) for i in range(len(signals))
    ]
    half = np.float64(0.5)

    def around(torque: Array, time: Array, found: Sequence[Array]) -> tuple[Array, Array, Conditions]:
        beside = dict(zip(signals, found, strict=True))
        load = beside.get(LOAD, jnp.zeros_like(torque))
        return torque, load, Conditions(time=time, temperature=beside.get(TEMPERATURE))

    def translate(function: Callable[..., Any], *extra: Nodes) -> list[Nodes]:
        examples = [np.zeros(n.shape) + half for n in extra]
        program = traced(
            lambda free, others, state, around, *extra: function(joined(free, others), state, around, *extra),
            list(free),
            others,
            [half] * count,
            [half] * len(surroundings),
            *examples,
        )
        arguments = [
            *(np.array(n, dtype=object) for n in numbers["parameter"]),
            *constants,
            *(np.array(n, dtype=object) for n in numbers["state"]),
            *surroundings,
            *extra,
        ]
        return translated(graph, program, arguments)

    dry = DryStep()

    def before_step(model: Model, state: list[Array], surrounding: list[Array]) -> list[Array]:
        torque, time, step, *beside = surrounding
        return dry.before(model, state, *around(torque, time, beside), step)

    held = translate(before_step)
    frozen = numbered_leaves(graph, "held", (len(held),), VARYING)

    def rates(model: Model, state: list[Array], surrounding: list[Array], held: Array) -> list[Array]:
        torque, time, step, *beside = surrounding
        torque, load, conditions = around(torque, time, beside)
        return model.component_rates(state, torque, load, dry.within(conditions, held))

    def read(model: Model, state: list[Array], surrounding: list[Array]) -> Array:
        torque, time, _, *beside = surrounding
        return model.outputs(jnp.stack(state), Inputs(*around(torque, time, beside)))

    moved = translate(rates, frozen)
    outputs = translate(read)[0]
    hidden = translate(_prior)[0] if count > len(model.motion_states) else np.empty(0, dtype=object)

    one = graph.constant(1.0)
    acting = _acting(model, paths)
    seeds: dict[Node, Tangent] = {}
    for kind, nodes in (*numbers.items(), ("held", frozen)):
        seeds |= {node: {(kind, i): one} for i, node in enumerate(nodes)}
    torque = graph.leaf(("signal", 0))
    seeds[torque] = {("parameter", p): graph.leaf(("signal", 1 + len(signals) + i)) for i, p in enumerate(acting)}

    def part(nodes: Sequence[Any]) -> Part:
        flat: tuple[Any, ...] = tuple(n[()] if isinstance(n, np.ndarray) else n for n in nodes)
        found = derivatives(graph, flat, seeds)
        return Part(flat, tuple(found[n] for n in flat))

    return Equations(
        graph=graph,
        paths=tuple(paths),
        acting=acting,
        constants=used,
        states=count,
        signals=tuple(signals),
        rates=part(moved),
        held=part(held),
        outputs=part(list(outputs)),
        prior=part(list(hidden)),
    )


def numbered_leaves(graph: Graph, name: str, shape: tuple[int, ...], level: int, first: int = 0) -> Nodes:
    """Leaves under numbered names, from `first` on, in the shape of an array."""
    found = np.empty(shape, dtype=object)
    for i, index in enumerate(np.ndindex(shape), first):
        found[index] = graph.leaf((name, i), level)
    return found


def _acting(model: Model, paths: Sequence[str]) -> tuple[int, ...]:
    names = {e.name for e in model.effects if isinstance(e, ActuatorEffect)}
    return tuple(i for i, path in enumerate(paths) if path.partition(".")[0] in names)


def _prior(model: Model, state: list[Array], surrounding: list[Array]) -> Array:
    motion = len(model.motion_states)
    whole = jnp.stack(state)
    scale = jax.lax.stop_gradient(jnp.concatenate([e.state_scale() for e in model.effects if e.states]))
    return (whole[motion:] - model.settled(whole[:motion])[motion:]) / scale
