"""A graph of scalar expressions, in which equal expressions are one node."""

import math
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

Node = int
"""A node's index in its graph. Arguments precede the nodes that use them."""

CONSTANT, PARAMETER, VARYING = 0, 1, 2
"""Dependence of a node: on nothing, on values that are constant during a simulation, or on the motion."""

COMPARISONS = {"eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater}
COMPARISONS["ge"] = np.greater_equal
LOGICAL = {"and": np.logical_and, "or": np.logical_or, "not": np.logical_not, "xor": np.logical_xor}
FUNCTIONS = {
    "abs": np.abs,
    "sign": np.sign,
    "sqrt": np.sqrt,
    "round": np.rint,
    "floor": np.floor,
    "ceil": np.ceil,
    "exp": np.exp,
    "expm1": np.expm1,
    "log": np.log,
    "tanh": np.tanh,
    "is_finite": np.isfinite,
}
_ARITHMETIC = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "max": np.maximum,
    "min": np.minimum,
}
_OPERATIONS = {
    **COMPARISONS,
    **LOGICAL,
    **FUNCTIONS,
    **_ARITHMETIC,
    "select": np.where,
    "given": lambda value, *partials: value,
}


class Graph:
    """Expressions of scalars, built node by node; equal nodes are shared.

    Attributes:
        nodes: each as its operation and arguments: `("constant", value)`, `("leaf", name)`, or an operation and nodes.
            `("given", value, argument, partial, ...)` is the value, with its partial derivatives; `("dot", (name,
            first, stride), *factors)` see [`Graph.dot`][].
        level: dependence of each, see [`CONSTANT`][].
    """

    def __init__(self, tables: Collection[str] = ()):
        """
        Args:
            tables: names of leaves `(name, place)` that are entries of tables.
        """
        self.tables = tables
        self.nodes: list[tuple[Any, ...]] = []
        self.level: list[int] = []
        self._found: dict[tuple[Hashable, ...], Node] = {}

    def constant(self, value: float | bool) -> Node:
        """A number, or a truth value."""
        value = value if isinstance(value, bool) else float(value)
        # Distinguished by type and sign, unlike by equality: True == 1.0, and 0.0 == -0.0.
        return self._make(("constant", value), (type(value), repr(value)), CONSTANT)

    def leaf(self, name: Hashable, level: int = VARYING) -> Node:
        """An input by name."""
        return self._make(("leaf", name), ("leaf", name), level)

    def known(self, node: Node) -> float | bool | None:
        """The value of a constant node; None for others."""
        operation, *rest = self.nodes[node]
        return rest[0] if operation == "constant" else None

    def apply(self, operation: str, *arguments: Node) -> Node:
        """An operation on nodes, simplified if some of them are constant."""
        values = [self.known(a) for a in arguments]
        if operation not in ("given", "leaf") and None not in values:
            with np.errstate(all="ignore"):
                return self.constant(_OPERATIONS[operation](*values).item())
        simpler = self._simplified(operation, arguments, values)
        if simpler is not None:
            return simpler
        if operation in ("add", "mul", "max", "min", "and", "or", "eq", "ne") and arguments[0] > arguments[1]:
            arguments = arguments[::-1]
        return self._make((operation, *arguments), (operation, *arguments), max(self.level[a] for a in arguments))

    def power(self, base: Node, exponent: int) -> Node:
        """An integer power, as products."""
        if exponent < 0:
            return self.apply("div", self.constant(1.0), self.power(base, -exponent))
        if exponent == 0:
            return self.constant(1.0)
        if exponent == 1:
            return base
        half = self.power(base, exponent // 2)
        square = self.apply("mul", half, half)
        return self.apply("mul", square, base) if exponent % 2 else square

    def dot(self, numbers: Sequence[Node], factors: Sequence[Node]) -> Node | None:
        """The sum of products of numbers and factors as one node, since large matrices would give thousands. None where
        the numbers are not evenly spaced leaves of a table."""
        names = [self.nodes[n][1] for n in numbers if self.nodes[n][0] == "leaf"]
        if not self.tables or len(numbers) < 2 or len(names) < len(numbers):
            return None
        if len({name for name, *_ in names}) > 1 or names[0][0] not in self.tables:
            return None
        places = [place for _, place in names]
        stride = places[1] - places[0]
        if any(place != places[0] + i * stride for i, place in enumerate(places)):
            return None
        node = "dot", (names[0][0], places[0], stride), *factors
        return self._make(node, node, max(PARAMETER, *(self.level[f] for f in factors)))

    def line(self, node: Node) -> list[Hashable]:
        """The names of the leaves that a `dot` node multiplies."""
        (name, first, stride), *factors = self.nodes[node][1:]
        return [(name, first + i * stride) for i in range(len(factors))]

    def needed(self, wanted: Iterable[Node]) -> list[Node]:
        """The nodes that the wanted ones depend on, including themselves, in order."""
        found: set[Node] = set()
        stack = list(wanted)
        while stack:
            node = stack.pop()
            if node in found:
                continue
            found.add(node)
            stack.extend(self.arguments(node))
        return sorted(found)

    def steady(self, wanted: Iterable[Node]) -> dict[Node, int]:
        """Nodes that are constant during a simulation and needed by the wanted nodes, each with an index."""
        wanted = list(wanted)

        def is_steady(node: Node) -> bool:
            # Nodes of constants only count as constant, even if not simplified to a number.
            return self.level[node] < VARYING and self.known(node) is None

        asked = {n for n in wanted if is_steady(n)}
        for node in self.needed(wanted):
            if self.level[node] == VARYING:
                asked |= {a for a in self.arguments(node) if is_steady(a)}
        return {node: i for i, node in enumerate(sorted(asked))}

    def arguments(self, node: Node) -> Sequence[Node]:
        """The arguments of a node."""
        operation, *rest = self.nodes[node]
        if operation in ("constant", "leaf"):
            return ()
        if operation == "dot":
            return rest[1:]
        return rest[:1] if operation == "given" else rest

    def evaluate(self, wanted: Sequence[Node], leaves: Mapping[Hashable, Any]) -> list[Any]:
        """Values of nodes for leaves that are numbers or arrays of one shape: no compilation, one numpy call per
        node."""
        value: dict[Node, Any] = {}
        self.add_values(value, self.needed(wanted), leaves)
        return [value[node] for node in wanted]

    def add_values(
        self,
        value: dict[Node, Any],
        nodes: Iterable[Node],
        leaves: Mapping[Hashable, Any],
        past: Mapping[Node, Iterable[Node]] = {},
    ) -> None:
        """Likewise add the values of nodes to those of their arguments, in order.

        Args:
            value: receives the values.
            nodes: to evaluate.
            leaves: numbers or arrays.
            past: after which nodes which others are no longer needed: their memory is used again, from the cache.
        """
        with np.errstate(all="ignore"):
            for node in nodes:
                operation, *rest = self.nodes[node]
                if operation == "constant":
                    value[node] = rest[0]
                elif operation == "leaf":
                    value[node] = leaves[rest[0]]
                elif operation == "dot":
                    pairs = zip(self.line(node), rest[1:], strict=True)
                    value[node] = sum(leaves[name] * value[factor] for name, factor in pairs)
                else:
                    value[node] = _OPERATIONS[operation](*(value[a] for a in self.arguments(node)))
                for other in past.get(node, ()):
                    del value[other]

    def _make(self, node: tuple[Any, ...], key: tuple[Hashable, ...], level: int) -> Node:
        if key not in self._found:
            self._found[key] = len(self.nodes)
            self.nodes.append(node)
            self.level.append(level)
        return self._found[key]

    def _simplified(self, operation: str, arguments: Sequence[Node], values: Sequence[Any]) -> Node | None:
        """A simpler node of the same value; None without one. Zero times anything is zero here, as valid simulations
        contain no infinity."""
        first, second = arguments[0], arguments[-1]
        x, y = values[0], values[-1]
        if operation == "mul":
            for value, other in ((x, second), (y, first)):
                if value == 0.0:
                    return self.constant(0.0)
                if value == 1.0:
                    return other
                if value == -1.0:
                    return self.apply("neg", other)
        elif operation == "add":
            if x == 0.0:
                return second
            if y == 0.0:
                return first
        elif operation == "sub":
            if y == 0.0:
                return first
            if x == 0.0:
                return self.apply("neg", second)
        elif operation == "div":
            if x == 0.0:
                return first
            if y is not None and y != 0.0 and math.frexp(y)[0] in (0.5, -0.5):
                return self.apply("mul", first, self.constant(1.0 / y))
            # Divide once per simulation, not in each stage.
            if self.level[second] < VARYING and self.level[first] == VARYING:
                return self.apply("mul", first, self.apply("div", self.constant(1.0), second))
        elif operation == "neg" and self.nodes[first][0] == "neg":
            return self.nodes[first][1]
        elif operation == "select":
            if x is not None:
                return arguments[1] if x else arguments[2]
            if arguments[1] == arguments[2]:
                return arguments[1]
        elif operation in ("max", "min", "and", "or") and first == second:
            return first
        elif operation in ("and", "or") and (x is not None or y is not None):
            value, other = (x, second) if x is not None else (y, first)
            return other if value == (operation == "and") else self.constant(operation == "or")
        return None
