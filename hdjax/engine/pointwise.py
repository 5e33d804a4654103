"""Evaluation of a function at many instants by numpy: nothing is compiled, and a function is translated once for all
models of the same structure."""

import dataclasses
import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hdjax.engine.array_rules import UntranslatableError
from hdjax.engine.derivatives import Tangent, derivatives
from hdjax.engine.graph import PARAMETER, VARYING, Graph, Node
from hdjax.engine.translate import traced, translated

# Numbers per node and pass, so that operands stay in the cache.
_AT_A_TIME = 1 << 14

Instants = tuple[Any, int]
"""A tree of arrays, and the number of each array's first axes that are instants. These broadcast."""


@dataclasses.dataclass(frozen=True)
class _Formula:
    """A function as a graph.

    Attributes:
        graph: of its nodes.
        results: structure of the returned tree.
        shapes: of these arrays.
        values: their entries, concatenated.
        slopes: derivatives of each entry by the entries of the first argument.
        steady: nodes that values or slopes depend on and that are the same at all instants, in order.
        moving: the others of them, likewise.
        past: after which of these which others are no longer needed.
    """

    graph: Graph
    results: Any
    shapes: tuple[tuple[int, ...], ...]
    values: tuple[Node, ...]
    slopes: tuple[Tangent, ...]
    steady: tuple[Node, ...]
    moving: tuple[Node, ...]
    past: dict[Node, list[Node]]


_FORMULAS: dict[Hashable, _Formula | None] = {}


def at_instants(function: Callable[..., Any], *arguments: Instants) -> Any:
    """Values of a function at many instants.

    Args:
        function: of its arguments at one instant; the same object each time.
        arguments: of the function.

    Returns:
        The returned tree; the axes of the instants come first.
    """
    return _at_instants(function, arguments, slopes=False)


def slopes_at_instants(function: Callable[..., Any], *arguments: Instants) -> Any:
    """Derivatives of a function at many instants by its first argument, an array of one axis. These axes come last;
    otherwise as in [`at_instants`][]."""
    return _at_instants(function, arguments, slopes=True)


def _at_instants(function: Callable[..., Any], arguments: Sequence[Instants], *, slopes: bool) -> Any:
    parts = [eqx.partition(tree, eqx.is_inexact_array) for tree, _ in arguments]
    leaves, trees = zip(*(jax.tree.flatten(arrays) for arrays, _ in parts), strict=True)
    given = [[(np.asarray(a), axes) for a in those] for those, (_, axes) in zip(leaves, arguments, strict=True)]
    flat = [pair for those in given for pair in those]

    def joined(*leaves: Any) -> Any:
        rest = iter(leaves)
        whole = (tree.unflatten([next(rest) for _ in range(tree.num_leaves)]) for tree in trees)
        return function(*(eqx.combine(w, fixed) for w, (_, fixed) in zip(whole, parts, strict=True)))

    key = function, slopes, *(likeness(tree, axes) for tree, axes in arguments)
    if key not in _FORMULAS:
        try:
            _FORMULAS[key] = _formula(joined, flat, len(given[0]) if slopes else 0)
        except UntranslatableError:
            _FORMULAS[key] = None
    formula = _FORMULAS[key]
    if formula is None:
        return _by_jax(function, arguments, slopes=slopes)
    return _evaluated(formula, flat, flat[0][0].shape[-1] if slopes else None)


def likeness(tree: Any, axes: int) -> Hashable:
    """Key of trees for which functions have the same graph.

    Args:
        tree: its numbers don't matter, except for integers and truth values.
        axes: number of each array's first axes that are instants.
    """
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    fixed, fixed_structure = jax.tree.flatten(rest)
    whole = tuple((a.shape, np.asarray(a).tobytes()) if hasattr(a, "tobytes") else a for a in fixed)
    return structure, fixed_structure, whole, tuple(a.shape[axes:] for a in leaves), axes > 0


def _formula(joined: Callable[..., Any], leaves: Sequence[tuple[np.ndarray, int]], moved: int) -> _Formula:
    graph, used, nodes = Graph(), 0, []
    for array, axes in leaves:
        shape = array.shape[axes:]
        own = np.empty(shape, dtype=object)
        for index in np.ndindex(shape):
            own[index] = graph.leaf(used, VARYING if axes else PARAMETER)
            used += 1
        nodes.append(own)
    results: list[Any] = []

    def flattened(*leaves: Any) -> list[Any]:
        found, tree = jax.tree.flatten(joined(*leaves))
        results[:] = [tree]
        return found

    program = traced(flattened, *(np.full(n.shape, 0.5)[()] for n in nodes))
    found = translated(graph, program, nodes)
    values = [node for array in found for node in array.reshape(-1)]
    seeds = {node: {i: graph.constant(1.0)} for own in nodes[:moved] for i, node in enumerate(own.reshape(-1))}
    tangents = derivatives(graph, values, seeds) if moved else dict.fromkeys(values, {})
    shapes = tuple(array.shape for array in found)
    slopes = tuple(tangents[v] for v in values)
    needed = graph.needed([n for t in slopes for n in t.values()] if moved else values)
    steady, moving = (tuple(n for n in needed if (graph.level[n] == VARYING) == moves) for moves in (False, True))
    wanted = [n for t in slopes for n in t.values()] if moved else values
    return _Formula(graph, results[0], shapes, tuple(values), slopes, steady, moving, _past(graph, moving, wanted))


def _past(graph: Graph, nodes: Sequence[Node], kept: Sequence[Node]) -> dict[Node, list[Node]]:
    """By node, those of its arguments at instants that no later one of the nodes needs."""
    seen, found = {*kept}, {}
    for node in reversed(nodes):
        found[node] = [a for a in {*graph.arguments(node)} if a not in seen and graph.level[a] == VARYING]
        seen.update(found[node])
    return found


def _evaluated(formula: _Formula, leaves: Sequence[tuple[np.ndarray, int]], directions: int | None) -> Any:
    lead = np.broadcast_shapes(*(a.shape[:axes] for a, axes in leaves))
    entries = [(a[(..., *index)], axes) for a, axes in leaves for index in np.ndindex(a.shape[axes:])]
    if directions is None:
        nodes = dict(enumerate(formula.values))
    else:
        tangents = enumerate(formula.slopes)
        nodes = {row * directions + i: node for row, tangent in tangents for i, node in tangent.items()}
    # A single instant is an axis of one.
    some = lead or (1,)
    found = np.zeros((len(formula.values) * (1 if directions is None else directions), *some))
    same: dict[Node, Any] = {}
    formula.graph.add_values(same, formula.steady, {i: a for i, (a, axes) in enumerate(entries) if not axes})
    for piece in _pieces(some):
        # An axis of one broadcasts.
        pieces = (a[..., piece] if axes and a.shape[-1] > 1 else a for a, axes in entries)
        here: dict[Hashable, Any] = dict(enumerate(pieces))
        value = same.copy()
        formula.graph.add_values(value, formula.moving, here, formula.past)
        for row, node in nodes.items():
            found[row, ..., piece] = value[node]
    last = () if directions is None else (directions,)
    arrays, start = [], 0
    for shape in formula.shapes:
        rows = math.prod((*shape, *last))
        own = found[start : start + rows].reshape((*shape, *last, *lead))
        many = len(shape) + len(last)
        arrays.append(np.moveaxis(own, range(many), range(-many, 0)))
        start += rows
    return formula.results.unflatten(arrays)


def _pieces(lead: Sequence[int]) -> Iterator[slice]:
    """Parts of the last axis of instants."""
    width = max(1, _AT_A_TIME // max(1, math.prod(lead[:-1])))
    yield from (slice(start, start + width) for start in range(0, lead[-1], width))


def _by_jax(function: Callable[..., Any], arguments: Sequence[Instants], *, slopes: bool) -> Any:
    """The same by a JAX program, for functions that the graph does not support."""
    parts = [eqx.partition(tree, eqx.is_inexact_array) for tree, _ in arguments]
    axes = [many for _, many in arguments]
    leads = [np.shape(a)[:many] for (arrays, _), many in zip(parts, axes, strict=True) for a in jax.tree.leaves(arrays)]
    lead = np.broadcast_shapes(*leads)

    def rows(array: Any, many: int) -> np.ndarray:
        array = np.asarray(array)
        own = array.shape[many:]
        array = array.reshape((1,) * (len(lead) - many) + array.shape)
        return np.broadcast_to(array, (*lead, *own)).reshape(math.prod(lead), *own) if many else array.reshape(own)

    pairs = zip(parts, axes, strict=True)
    flat = [jax.tree.map(lambda a, many=many: rows(a, many), arrays) for (arrays, _), many in pairs]
    moving = tuple(0 if many else None for many in axes)
    found = _vmapped(function, flat, [fixed for _, fixed in parts], moving, math.prod(lead), slopes)
    return jax.tree.map(lambda a: np.asarray(a).reshape((*lead, *a.shape[1:])), found)


@eqx.filter_jit
def _vmapped(
    function: Callable[..., Any], arrays: Any, fixed: Any, moving: tuple[int | None, ...], instants: int, slopes: bool
) -> Any:
    def at(*arrays: Any) -> Any:
        return function(*(eqx.combine(a, f) for a, f in zip(arrays, fixed, strict=True)))

    each = jax.vmap(jax.jacfwd(at) if slopes else at, in_axes=moving, axis_size=instants)
    return each(*jax.tree.map(jnp.asarray, arrays))
