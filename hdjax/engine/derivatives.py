"""Sparse forward derivatives on a graph of scalars."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hdjax.engine.graph import PARAMETER, Graph, Node

Tangent = dict[Any, Node]
"""Nonzero derivatives by direction, which may have any name."""


def derivatives(graph: Graph, wanted: Iterable[Node], seeds: Mapping[Node, Tangent]) -> dict[Node, Tangent]:
    """Derivatives of nodes.

    Args:
        graph: receives the nodes of the derivatives.
        wanted: nodes to differentiate.
        seeds: derivatives of leaves.

    Returns:
        The derivatives of each wanted node.
    """
    wanted = list(wanted)
    found: dict[Node, Tangent] = {}
    for node in _in_order(graph, wanted):
        operation, *rest = graph.nodes[node]
        if node in seeds:
            tangent = dict(seeds[node])
        elif operation in ("select", "max", "min"):
            tangent = _of_choice(graph, operation, rest, found)
        else:
            tangent = _of_chain(graph, _partials(graph, node, found), found)
        found[node] = {d: t for d, t in tangent.items() if graph.known(t) != 0.0}
    return {node: found[node] for node in wanted}


def _in_order(graph: Graph, wanted: list[Node]) -> list[Node]:
    """The nodes on the way of derivatives; a node with given partials depends on its arguments."""
    found: set[Node] = set()
    stack = list(wanted)
    while stack:
        node = stack.pop()
        if node not in found:
            found.add(node)
            operation, *rest = graph.nodes[node]
            if operation not in ("constant", "leaf"):
                stack.extend(rest[1::2] if operation == "given" else graph.arguments(node))
    return sorted(found)


def _of_chain(graph: Graph, partials: list[tuple[Node, Node]], found: Mapping[Node, Tangent]) -> Tangent:
    tangent: Tangent = {}
    for argument, partial in partials:
        for direction, slope in found[argument].items():
            added = graph.apply("mul", partial, slope)
            tangent[direction] = graph.apply("add", tangent[direction], added) if direction in tangent else added
    return tangent


def _of_choice(graph: Graph, operation: str, arguments: list[Node], found: Mapping[Node, Tangent]) -> Tangent:
    """The tangent of the chosen one; multiplication of the other by zero could give NaN."""
    condition, first, second = arguments if operation == "select" else (None, *arguments)
    one, other = found[first], found[second]
    if not (one or other):
        return {}
    if condition is None:
        condition = graph.apply("ge" if operation == "max" else "le", first, second)
    zero = graph.constant(0.0)
    directions = dict.fromkeys([*one, *other])
    return {d: graph.apply("select", condition, one.get(d, zero), other.get(d, zero)) for d in directions}


def _partials(graph: Graph, node: Node, found: Mapping[Node, Tangent]) -> list[tuple[Node, Node]]:
    """Partial derivatives of an operation, by those of its arguments that have a tangent; none of a step (round, sign,
    a comparison), whose slope is zero."""
    operation, *rest = graph.nodes[node]
    if operation == "given":
        return [(a, p) for a, p in zip(rest[1::2], rest[2::2], strict=True) if found[a]]
    if operation == "dot":
        pairs = zip(rest[1:], graph.line(node), strict=True)
        return [(a, graph.leaf(name, PARAMETER)) for a, name in pairs if found[a]]
    rule = _RULES.get(operation)
    if rule is None:
        return []
    laws = rule(graph.apply, graph.constant, node, *rest)
    # Unneeded partials should not create nodes.
    return [(a, law()) for a, law in zip(rest, laws, strict=True) if found[a]]


_Apply = Callable[..., Node]
_Constant = Callable[[float], Node]


def _division(apply: _Apply, constant: _Constant, q: Node, a: Node, b: Node):
    inverse = apply("div", constant(1.0), b)
    return [lambda: inverse, lambda: apply("neg", apply("mul", q, inverse))]


_RULES = {
    "add": lambda apply, c, y, a, b: [lambda: c(1.0), lambda: c(1.0)],
    "sub": lambda apply, c, y, a, b: [lambda: c(1.0), lambda: c(-1.0)],
    "mul": lambda apply, c, y, a, b: [lambda: b, lambda: a],
    "div": _division,
    "neg": lambda apply, c, y, a: [lambda: c(-1.0)],
    # At zero as from the right, as in JAX.
    "abs": lambda apply, c, y, a: [lambda: apply("select", apply("ge", a, c(0.0)), c(1.0), c(-1.0))],
    "sqrt": lambda apply, c, y, a: [lambda: apply("div", c(0.5), y)],
    "exp": lambda apply, c, y, a: [lambda: y],
    "expm1": lambda apply, c, y, a: [lambda: apply("add", y, c(1.0))],
    "log": lambda apply, c, y, a: [lambda: apply("div", c(1.0), a)],
    "tanh": lambda apply, c, y, a: [lambda: apply("sub", c(1.0), apply("mul", y, y))],
}
