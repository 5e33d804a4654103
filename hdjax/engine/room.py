"""Memory layout and access of the function of a block."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from llvmlite import ir

from hdjax.engine.code import LANES, Code
from hdjax.engine.derivatives import Tangent
from hdjax.engine.emission import F64, I8, I64
from hdjax.engine.graph import Node
from hdjax.engine.kernel import Wanted

if TYPE_CHECKING:
    from hdjax.engine.march import March

POWERS = 6
"""Most coefficients of a signal in an interval."""


@dataclasses.dataclass(frozen=True)
class Emitted:
    """A part of the equations as a function `name(scalars, constants, inputs, passed, results)`.

    Attributes:
        function: in the module.
        slots: index of each variable node among the results.
        passed: number of values passed to the function of the derivatives by parameters.
        by_parameter: that function; None for that function itself.
    """

    function: ir.Function
    slots: dict[Node, int]
    passed: int = 0
    by_parameter: "Emitted | None" = None

    @property
    def size(self) -> int:
        """Number of results."""
        return len(self.slots)


class Room:
    """Data of a block's instructions: its stack memory, and the arrays of the call."""

    def __init__(self, march: "March", code: Code, call: ir.Value, index: ir.Value):
        self.march, self.code, self.call, self.index = march, code, call, index
        m = march
        self.jacobian = m.mode == "jacobian"
        self.tangents = m.parameters + m.states if self.jacobian else 0
        stages = len(m.nodes)
        self.segments = code.array(LANES, I64)
        self.inputs = code.array(m.inputs)
        self.state = code.array(m.states)
        self.slopes = code.array(m.states * stages)
        self.coefficients = code.array(m.signals * POWERS)
        self.degree = code.array(m.signals, I64)
        self.needed = code.array(1, I64)
        self.first = code.array(1, I64)
        self.stage_results = code.array(m.rates.size * stages)
        self.held_results, self.read_results = code.array(m.before.size), code.array(m.read.size)
        self.prior_results = code.array(m.expected.size)
        parts = (m.rates, m.before, m.read, m.expected)
        self.passed = code.array(max(part.passed for part in parts))
        self.further_results = code.array(max(part.by_parameter.size if part.by_parameter else 0 for part in parts))
        self.moved = code.array(self.tangents * m.states)
        self.rates_by_parameter = m.equations.rates.rows_along("parameter") if self.jacobian else []
        # Zero: all tangents use the same instructions.
        sizes = len(self.rates_by_parameter) * stages, m.held, m.outputs
        self.dense, self.held_dense, self.read_dense = (code.array(size * self.tangents) for size in sizes)
        self.scale = code.array(self.tangents)
        columns = self.tangents + 1
        self.collected = code.array(columns * max(m.outputs, 1))
        self.products = code.array(columns**2 if self.jacobian else 0)
        tables = self.dense, self.held_dense, self.read_dense
        self.blank = [(room, size * self.tangents) for room, size in zip(tables, sizes, strict=True)]
        self.blank += [(self.collected, columns * max(m.outputs, 1)), (self.products, columns**2)]
        self.scalars, self.constants = self.got("scalars"), self.got("constants")
        self.samples = self.got("samples", I64)
        self.rows = code.plus(code.times(self.samples, m.outputs), m.hidden)
        self.knots = code.plus(code.plus(self.samples, self.got("first 0", I64)), 1)

    def got(self, name: str, kind: Any = F64) -> ir.Value:
        """An entry of the call: an integer, or an address of numbers."""
        value = self.code.load(self.call, self.march.call[name])
        return value if kind is I64 else self.code.builder.inttoptr(value, kind.as_pointer())

    def lanes(self, base: ir.Value, row: ir.Value | int, offset: ir.Value | int) -> ir.Value:
        c = self.code
        return c.builder.call(self.march.gather, [base, self.segments, c.i(row), c.i(offset)])

    def put(self, base: ir.Value, row: ir.Value | int, offset: ir.Value | int, value: ir.Value) -> None:
        c = self.code
        c.builder.call(self.march.scatter, [base, self.segments, c.i(row), c.i(offset), value])

    def node(self, part: Emitted, node: Node, results: ir.Value, offset: ir.Value | int = 0) -> ir.Value:
        """The value of a node: a constant, a per-simulation value, or among a part's results."""
        graph = self.march.equations.graph
        known = graph.known(node)
        if known is not None:
            return self.code.number(float(known))
        if node in self.march.scalars:
            return self.march.scalar(self.code, self.scalars, self.march.scalars[node], node)
        return self.code.load(results, self.code.plus(part.slots[node], offset))

    def run(self, part: Emitted, results: ir.Value) -> None:
        if part.size:
            arguments = [self.scalars, self.constants, self.inputs, self.passed, results]
            self.code.builder.call(part.function, arguments)

    def by_parameter(self, part: Emitted, slope: Tangent, parameter: int) -> ir.Value:
        """The derivative of a row by a parameter, after a call of [`run`][] for the part."""
        node = slope.get(("parameter", parameter))
        if node is None:
            return self.code.number(0.0)
        assert part.by_parameter is not None
        return self.node(part.by_parameter, node, self.further_results)

    def wants(self, result: Wanted) -> ir.Value:
        """Whether the march is to compute this result."""
        return self.code.builder.icmp_signed("==", self.got("wanted", I64), self.code.i(get_args(Wanted).index(result)))

    def in_any(self, lanes: ir.Value) -> ir.Value:
        """Whether a condition holds in any lane."""
        b = self.code.builder
        return b.icmp_unsigned("!=", b.bitcast(lanes, I8), ir.Constant(I8, 0))

    def first_moving(self) -> ir.Value:
        """The first tangent that is not fixed."""
        return self.code.load(self.first, 0)

    def at_state(self) -> None:
        for i in range(self.march.states):
            self.code.store(self.code.load(self.state, i), self.inputs, i)

    def tangent(self, t: ir.Value) -> list[ir.Value]:
        c, states = self.code, self.march.states
        return [c.load(self.moved, c.plus(c.times(t, states), i)) for i in range(states)]

    def along_states(
        self, part: Emitted, results: ir.Value, slopes: Tangent, moved: Sequence[ir.Value], offset: int = 0
    ) -> list[ir.Value]:
        """The terms of a row's change when states change."""
        graph = self.march.equations.graph
        terms = []
        for direction, node in slopes.items():
            if direction[0] == "state":
                change = moved[direction[1]]
                one = graph.known(node) == 1.0
                terms.append(change if one else self.code.mul(self.node(part, node, results, offset), change))
        return terms

    def fill(self, part: Emitted, slopes: Sequence[Tangent], rows: Sequence[int], dense: ir.Value) -> None:
        """Store derivatives by parameters, if any is free, in a dense array for loops over them."""
        c, m = self.code, self.march
        assert part.by_parameter is not None
        with c.builder.if_then(c.builder.icmp_signed("==", self.first_moving(), c.i(0))):
            self.run(part.by_parameter, self.further_results)
            for p in range(m.parameters):
                for k, row in enumerate(rows):
                    c.store(self.by_parameter(part, slopes[row], p), dense, p * len(rows) + k)

    def finite(self, value: ir.Value, as_well: ir.Value) -> ir.Value:
        """A derivative; zero where it is not finite."""
        c = self.code
        fine = c.builder.and_(as_well, c.smaller(c.called("fabs", value), c.number(np.inf)))
        return c.builder.select(fine, value, c.number(0.0))
