"""Translation rules for array primitives of JAX; each array entry is a separate node."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hdjax.engine.graph import Graph, Node

Nodes = np.ndarray[Any, np.dtype[np.object_]]
"""Nodes in the shape of an array."""

# Number of multiplications above which a matrix product is not written out.
_LARGE = 64
# Largest table that is looked up by comparisons.
_LONGEST_TABLE = 64


class UntranslatableError(Exception):
    """A function that the graph does not support."""


def constants(graph: Graph, array: Any) -> Nodes:
    """An array of numbers as nodes."""
    array = np.asarray(array)
    if array.dtype != bool and not np.issubdtype(array.dtype, np.number):
        raise UntranslatableError(f"a constant of type {array.dtype}")
    found = np.empty(array.shape, dtype=object)
    if array.ndim == 0:
        found[()] = _constant(graph, array.item())
        return found
    for index in np.ndindex(array.shape):
        found[index] = _constant(graph, array[index].item())
    return found


def _constant(graph: Graph, value: Any) -> Node:
    return graph.constant(value if isinstance(value, bool) else float(value))


def each(rule: Callable[..., Node], *arguments: Nodes) -> Nodes:
    """Apply a rule entry by entry."""
    # Most equations are of scalars.
    if all(a.ndim == 0 for a in arguments):
        single = np.empty((), dtype=object)
        single[()] = rule(*(a.item() for a in arguments))
        return single
    arrays = np.broadcast_arrays(*arguments) if len(arguments) > 1 else list(arguments)
    found = np.empty(arrays[0].shape, dtype=object)
    for index in np.ndindex(found.shape):
        found[index] = rule(*(a[index] for a in arrays))
    return found


def _sum(graph: Graph, nodes: Sequence[Node], operation: str = "add", start: float | bool = 0.0) -> Node:
    return functools.reduce(lambda a, b: graph.apply(operation, a, b), nodes) if len(nodes) else graph.constant(start)


def _broadcast(graph: Graph, equation: Any, a: Nodes, *_: Nodes) -> Nodes:
    shape, places = equation.params["shape"], equation.params["broadcast_dimensions"]
    spread = [1] * len(shape)
    for size, place in zip(a.shape, places, strict=True):
        spread[place] = size
    return np.broadcast_to(a.reshape(spread), shape)


def _slice(graph: Graph, equation: Any, a: Nodes) -> Nodes:
    p = equation.params
    strides = p["strides"] or (1,) * a.ndim
    return a[tuple(slice(*s) for s in zip(p["start_indices"], p["limit_indices"], strides, strict=True))]


def _pad(graph: Graph, equation: Any, a: Nodes, value: Nodes) -> Nodes:
    for axis, (low, high, inner) in enumerate(equation.params["padding_config"]):
        if low < 0 or high < 0 or inner:
            raise UntranslatableError("the primitive `pad` with holes or negative widths")
        shape = [*a.shape[:axis], -1, *a.shape[axis + 1 :]]
        before, after = (np.full([n if k < 0 else k for k in shape], value[()], dtype=object) for n in (low, high))
        a = np.concatenate([before, a, after], axis=axis)
    return a


def _dot(graph: Graph, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    ((over_a, over_b), (batch_a, batch_b)) = equation.params["dimension_numbers"]
    if batch_a or batch_b:
        raise UntranslatableError("the primitive `dot_general` with batches")
    rest_a = [i for i in range(a.ndim) if i not in over_a]
    rest_b = [i for i in range(b.ndim) if i not in over_b]
    left = a.transpose(*rest_a, *over_a).reshape(math.prod(a.shape[i] for i in rest_a), -1)
    right = b.transpose(*over_b, *rest_b).reshape(-1, math.prod(b.shape[i] for i in rest_b))
    found = np.empty((left.shape[0], right.shape[1]), dtype=object)
    for i, j in np.ndindex(found.shape):
        row, column = list(left[i]), list(right[:, j])
        whole = None
        if left.size * right.shape[1] >= _LARGE:
            whole = graph.dot(row, column) or graph.dot(column, row)
        if whole is None:
            whole = _sum(graph, [graph.apply("mul", x, y) for x, y in zip(row, column, strict=True)])
        found[i, j] = whole
    return found.reshape([a.shape[i] for i in rest_a] + [b.shape[i] for i in rest_b])


def _reduced(operation: str, start: float | bool) -> Callable[..., Nodes]:
    def rule(graph: Graph, equation: Any, a: Nodes) -> Nodes:
        axes = equation.params["axes"]
        kept = [i for i in range(a.ndim) if i not in axes]
        rows = a.transpose(*kept, *axes).reshape(math.prod(a.shape[i] for i in kept), -1)
        found = np.empty(len(rows), dtype=object)
        for i, row in enumerate(rows):
            found[i] = _sum(graph, list(row), operation, start)
        return found.reshape([a.shape[i] for i in kept])

    return rule


def _cumulative(graph: Graph, equation: Any, a: Nodes) -> Nodes:
    axis, back = equation.params["axis"], equation.params["reverse"]
    rows = np.moveaxis(a, axis, 0)[:: -1 if back else 1]
    sums = [rows[:1]]
    for i in range(1, len(rows)):
        sums.append(each(functools.partial(graph.apply, "add"), sums[-1], rows[i : i + 1]))
    return np.moveaxis(np.concatenate(sums)[:: -1 if back else 1], 0, axis)


def _place_of(better: str) -> Callable[..., Nodes]:
    """Index of the first best entry along an axis."""

    def rule(graph: Graph, equation: Any, a: Nodes) -> Nodes:
        (axis,) = equation.params["axes"]
        rows = np.moveaxis(a, axis, -1)
        found = np.empty(rows.shape[:-1], dtype=object)
        for place in np.ndindex(found.shape):
            best, index = rows[place][0], graph.constant(0.0)
            for i, node in enumerate(rows[place][1:], 1):
                beats = graph.apply(better, node, best)
                best, index = (
                    graph.apply("select", beats, *pair) for pair in ((node, best), (graph.constant(float(i)), index))
                )
            found[place] = index
        return found

    return rule


def _gathered(graph: Graph, equation: Any, a: Nodes, index: Nodes) -> Nodes:
    """One entry, or one row along the first axis, of a table at an index that may depend on the motion."""
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    if index.size != 1 or tuple(numbers.start_index_map) != (0,) or sizes[0] != 1 or tuple(sizes[1:]) != a.shape[1:]:
        raise UntranslatableError("the primitive `gather` of several entries")
    return _picked(graph, a, index.reshape(-1)[0], keep=not numbers.collapsed_slice_dims)


def _dynamic_slice(graph: Graph, equation: Any, a: Nodes, *index: Nodes) -> Nodes:
    sizes = equation.params["slice_sizes"]
    starts = [graph.known(i.item()) for i in index]
    if None not in starts:
        whole = [int(s) for s in starts if s is not None]
        begins = [min(max(s, 0), n - k) for s, n, k in zip(whole, a.shape, sizes, strict=True)]
        return a[tuple(slice(s, s + k) for s, k in zip(begins, sizes, strict=True))]
    if sizes[0] != 1 or tuple(sizes[1:]) != a.shape[1:]:
        raise UntranslatableError("the primitive `dynamic_slice` of several rows")
    return _picked(graph, a, index[0].item(), keep=True)


def _picked(graph: Graph, a: Nodes, index: Node, *, keep: bool) -> Nodes:
    if len(a) > _LONGEST_TABLE:
        raise UntranslatableError(f"a table of {len(a)} entries")
    found = np.asarray(a[-1], dtype=object)
    for i in range(len(a) - 2, -1, -1):
        before = graph.apply("le", index, graph.constant(float(i)))
        found = each(lambda x, y, before=before: graph.apply("select", before, x, y), np.asarray(a[i], object), found)
    return found[None] if keep else found


def _iota(graph: Graph, equation: Any) -> Nodes:
    shape, axis = equation.params["shape"], equation.params["dimension"]
    along = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return constants(graph, np.broadcast_to(along, shape))


ARRAYS: dict[str, Callable[..., Nodes]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda graph, e, a: a.reshape(e.params["new_sizes"]),
    "squeeze": lambda graph, e, a: a.squeeze(tuple(e.params["dimensions"])),
    "expand_dims": lambda graph, e, a: np.expand_dims(a, e.params["dimensions"]),
    "transpose": lambda graph, e, a: a.transpose(e.params["permutation"]),
    "rev": lambda graph, e, a: np.flip(a, e.params["dimensions"]),
    "concatenate": lambda graph, e, *parts: np.concatenate(parts, axis=e.params["dimension"]),
    "slice": _slice,
    "pad": _pad,
    "dynamic_slice": _dynamic_slice,
    "gather": _gathered,
    "dot_general": _dot,
    "reduce_sum": _reduced("add", 0.0),
    "reduce_max": _reduced("max", -math.inf),
    "reduce_min": _reduced("min", math.inf),
    "reduce_prod": _reduced("mul", 1.0),
    "reduce_and": _reduced("and", True),
    "reduce_or": _reduced("or", False),
    "argmax": _place_of("gt"),
    "argmin": _place_of("lt"),
    "cumsum": _cumulative,
    "iota": _iota,
}
"""Rules by the name of the primitive, of the graph, the equation and its arguments."""
