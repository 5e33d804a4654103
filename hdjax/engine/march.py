"""The march as machine code: samples, steps and stages of a model's equations, for blocks of segments.

A step of an explicit Runge-Kutta method first computes its stages, and at each the derivatives of the rates by states
and parameters. These are shared by all tangents, which are then propagated through the stages one by one.
"""

from collections.abc import Callable, Iterable
from typing import Any

import diffrax as dfx
import numpy as np
from llvmlite import ir

from hdjax.engine.block import write_block
from hdjax.engine.code import LANES, Code
from hdjax.engine.emission import F64, I64, Vectors, emitted, restored, storable
from hdjax.engine.equations import Equations, Part
from hdjax.engine.graph import VARYING, Node
from hdjax.engine.handler import ENTRY, data, dimension
from hdjax.engine.kernel import Mode
from hdjax.engine.room import Emitted, Room
from hdjax.engine.sharing import block_of, share, worker

OPERANDS = ("address", "free", "slopes", "constants", "states", "knots", "measured", "weight", "joined", "whitening")
OPERANDS += ("settings",)
"""Operands in order, followed by the signals: torque, those of `Equations.signals`, and derivatives of the torque by
each of `Equations.acting`. `settings` are solver steps in a sample interval, whether to compute the end of a segment,
threads, and which of `kernel.Wanted` a march with derivatives returns. `free` and `slopes` may have more numbers than
the model has parameters; their columns are zero."""

RESULTS: dict[Mode, tuple[str, ...]] = {
    "values": ("rows", "end"),
    "jacobian": ("rows", "end", "by_parameter", "by_state", "end_by_parameter", "end_by_state", "products"),
}
"""Results in order; `by_parameter` and `by_state`, or instead `products` of each segment's columns: by parameters, by
states, and the residual."""

MARCH = "march"
"""The function's name in its module."""


def tableau(solver: dfx.AbstractERK) -> tuple[list[list[float]], list[float], list[float]]:
    """Weights within the stages, nodes, and weights of the result; without final stages of weight zero."""
    table: Any = solver.tableau
    weights = [float(w) for w in np.asarray(table.b_sol)]
    nodes = [0.0, *(float(c) for c in np.asarray(table.c))]
    lower: list[list[float]] = [[], *([float(w) for w in np.asarray(row)] for row in table.a_lower)]
    while weights[-1] == 0.0:
        for row in (weights, nodes, lower):
            row.pop()
    return lower, nodes, weights


class March:
    """A march of one model, written into a module.

    Attributes:
        module: in LLVM's language; its function [`MARCH`][] has the type `handler.ENTRY`.
    """

    def __init__(self, equations: Equations, solver: dfx.AbstractERK, mode: Mode):
        self.equations = equations
        self.mode: Mode = mode
        self.lower, self.nodes, self.weights = tableau(solver)
        self.module = ir.Module("march")
        e = equations
        self.states, self.parameters = e.states, len(e.paths) if mode == "jacobian" else 0
        self.held, self.outputs, self.hidden = (len(p.values) for p in (e.held, e.outputs, e.prior))
        self.signals = 1 + len(e.signals) + (len(e.acting) if mode == "jacobian" else 0)
        # The inputs of a part: states, signals, time, step, and values computed once per step.
        self.at_signal = self.states
        self.at_time = self.at_signal + self.signals
        self.at_step, self.at_held = self.at_time + 1, self.at_time + 2
        self.inputs = self.at_held + self.held
        self.scalars = self._scalars()
        self.rates, self.before, self.read, self.expected = (
            self._part(name, part)
            for name, part in (("rates", e.rates), ("held", e.held), ("outputs", e.outputs), ("prior", e.prior))
        )
        read = [n for nodes in self._wanted(e.outputs) for n in nodes]
        leaves = (e.graph.nodes[n][1][0] for n in e.graph.needed(read) if e.graph.nodes[n][0] == "leaf")
        self.reads_signals = not {"signal", "time"}.isdisjoint(leaves)
        self._write()

    # -- the equations -------------------------------------------------------------------------------------------

    def _wanted(self, part: Part) -> tuple[list[Node], list[Node]]:
        """Values and their derivatives by states and by `held`; and those by parameters."""
        own, by_parameter = [*part.values], []
        for direction, node in (item for t in part.slopes for item in t.items() if self.mode == "jacobian"):
            (by_parameter if direction[0] == "parameter" else own).append(node)
        return own, by_parameter

    def _scalars(self) -> dict[Node, int]:
        """Values that are computed once per simulation, as scalars."""
        e = self.equations
        parts = (e.rates, e.held, e.outputs, e.prior)
        return e.graph.steady(n for part in parts for nodes in self._wanted(part) for n in nodes)

    def _part(self, name: str, part: Part) -> Emitted:
        """Two functions, since derivatives by parameters are not needed if all are fixed; the first passes common
        values on."""
        graph = self.equations.graph

        def moving(nodes: Iterable[Node]) -> list[Node]:
            return list(dict.fromkeys(n for n in nodes if graph.level[n] == VARYING))

        own, by_parameter = map(moving, self._wanted(part))
        found = set(graph.needed(own))
        asked = {a for n in graph.needed(by_parameter) if n not in found for a in graph.arguments(n)}
        both = moving(sorted(found & (asked | set(by_parameter))))
        passed = {n: i for i, n in enumerate(n for n in both if graph.nodes[n][0] != "leaf")}
        further = None
        if self.mode == "jacobian":
            further = Emitted(*self._function(name + "_by_parameter", by_parameter, passed, passes=False))
        return Emitted(*self._function(name, own, passed, passes=True), len(passed), further)

    def _function(
        self, name: str, wanted: list[Node], passed: dict[Node, int], *, passes: bool
    ) -> tuple[ir.Function, dict[Node, int]]:
        """A function of nodes, with values passed to or from another one; and indices of its results."""
        graph = self.equations.graph
        kind = ir.VectorType(F64, LANES).as_pointer()
        arguments = [*[F64.as_pointer()] * 2, kind, kind, kind]
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), arguments), name)
        function.linkage = "internal"
        function.attributes.add("nounwind")
        # Inlining at each stage would multiply the code to compile.
        function.attributes.add("noinline")
        for argument in function.args:
            argument.add_attribute("noalias")
        code = Code(ir.IRBuilder(function.append_basic_block()))
        scalars, constants, inputs, between, results = function.args
        given: dict[Node, Callable[[], ir.Value]] = {
            node: lambda node=node, i=i: self.scalar(code, scalars, i, node) for node, i in self.scalars.items()
        }
        for node in graph.needed(wanted):
            operation, *rest = graph.nodes[node]
            if operation == "leaf" and graph.level[node] == VARYING:
                given[node] = lambda place=self._input(rest[0]): code.load(inputs, place)
        if not passes:
            for node, i in passed.items():
                given[node] = lambda node=node, i=i: restored(code, graph, node, code.load(between, i))
        found = emitted(code, graph, wanted, given, {"constant": constants})
        slots = {node: slot for slot, node in enumerate(wanted)}
        for node, slot in slots.items():
            code.store(found[node], results, slot)
        for node, i in passed.items() if passes else ():
            code.store(storable(code, graph, node, found[node]), between, i)
        code.builder.ret_void()
        return function, slots

    def scalar(self, code: Vectors, scalars: ir.Value, index: int, node: Node) -> ir.Value:
        number = code.spread(code.builder.load(code.builder.gep(scalars, [ir.Constant(I64, index)])))
        return restored(code, self.equations.graph, node, number)

    def _input(self, leaf: tuple[Any, ...]) -> int:
        kind = leaf[0]
        return {
            "state": lambda: leaf[1],
            "signal": lambda: self.at_signal + leaf[1],
            "time": lambda: self.at_time,
            "step": lambda: self.at_step,
            "held": lambda: self.at_held + leaf[1],
        }[kind]()

    def _prepare(self) -> ir.Function:
        """A function of the free parameters and the model's constants that computes the scalars."""
        graph = self.equations.graph
        pointer = F64.as_pointer()
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), [pointer] * 3), "prepare")
        function.linkage = "internal"
        plain = Vectors(ir.IRBuilder(function.append_basic_block()), 1)
        free, constants, results = function.args
        given: dict[Node, Callable[[], ir.Value]] = {}
        for node in graph.needed(self.scalars):
            operation, *rest = graph.nodes[node]
            if operation == "leaf":
                name, index = rest[0]
                table = free if name == "parameter" else constants
                given[node] = lambda t=table, i=index: plain.builder.load(plain.builder.gep(t, [ir.Constant(I64, i)]))
        found = emitted(plain, graph, self.scalars, given, {"constant": constants})
        for node, index in self.scalars.items():
            value = storable(plain, graph, node, found[node])
            plain.builder.store(value, plain.builder.gep(results, [ir.Constant(I64, index)]))
        plain.builder.ret_void()
        return function

    # -- the march -----------------------------------------------------------------------------------------------

    def _write(self) -> None:
        prepare = self._prepare()
        names = [n for n in OPERANDS if n not in ("address", "settings")]
        names += [f"signal {i}" for i in range(self.signals)] + list(RESULTS[self.mode])
        names += ["substeps", "whole", "segments", "samples", "width", "wanted", "blocks", "next", "scalars"]
        names += [f"first {i}" for i in range(self.signals)] + [f"powers {i}" for i in range(self.signals)]
        self.call = {name: i for i, name in enumerate(names)}
        self.gather = self._lane_by_lane("gather", reads=True)
        self.scatter = self._lane_by_lane("scatter", reads=False)
        block = block_of(self.module, lambda code, call, index: write_block(Room(self, code, call, index)))
        self._entry(prepare, worker(self.module, block, self.call))

    def _lane_by_lane(self, name: str, *, reads: bool) -> ir.Function:
        """Read or write one number of each lane: `row[segment]` of rows of given length, at an offset."""
        vector = ir.VectorType(F64, LANES)
        arguments = [F64.as_pointer(), I64.as_pointer(), I64, I64] + ([] if reads else [vector])
        kind = ir.FunctionType(vector if reads else ir.VoidType(), arguments)
        function = ir.Function(self.module, kind, name)
        function.linkage = "internal"
        code = Code(ir.IRBuilder(function.append_basic_block()))
        base, segments, row, offset = function.args[:4]
        found: ir.Value = ir.Constant(vector, ir.Undefined)
        for lane in range(LANES):
            place = code.plus(code.times(code.load(segments, lane), row), offset)
            which = ir.Constant(ir.IntType(32), lane)
            if reads:
                found = code.builder.insert_element(found, code.load(base, place), which)
            else:
                code.store(code.builder.extract_element(function.args[4], which), base, place)
        code.builder.ret(found) if reads else code.builder.ret_void()
        return function

    def _entry(self, prepare: ir.Function, worker: ir.Function) -> None:
        function = ir.Function(self.module, ENTRY, MARCH)
        code = Code(ir.IRBuilder(function.append_basic_block()))
        b = code.builder
        operands, results = function.args
        call, scalars = code.array(len(self.call), I64), code.array(len(self.scalars), F64)

        def put(name: str, value: Any) -> None:
            whole = value if value.type == I64 else b.ptrtoint(value, I64)
            code.store(whole, call, self.call[name])

        for i, name in enumerate(OPERANDS):
            if name in self.call:
                put(name, data(b, operands, i))
        first = len(OPERANDS)
        samples = dimension(b, operands, OPERANDS.index("weight"), 1)
        for i in range(self.signals):
            put(f"signal {i}", data(b, operands, first + i))
            # A torque may begin before the segment.
            put(f"first {i}", b.sub(dimension(b, operands, first + i, 1), samples))
            put(f"powers {i}", dimension(b, operands, first + i, 2))
        for i, name in enumerate(RESULTS[self.mode]):
            put(name, data(b, results, i))
        settings = data(b, operands, OPERANDS.index("settings"), I64)
        put("substeps", code.load(settings, 0))
        put("whole", code.load(settings, 1))
        put("wanted", code.load(settings, 3))
        put("width", dimension(b, operands, OPERANDS.index("free"), 0))
        segments = dimension(b, operands, OPERANDS.index("weight"), 0)
        put("segments", segments)
        put("samples", samples)
        blocks = b.sdiv(code.plus(segments, LANES - 1), code.i(LANES))
        put("blocks", blocks)
        put("next", code.i(0))
        put("scalars", scalars)
        b.call(prepare, [data(b, operands, OPERANDS.index(n)) for n in ("free", "constants")] + [scalars])
        share(code, worker, call, blocks, code.load(settings, 2))
        b.ret_void()
