"""A function of scalars translated to machine code by itself."""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from hdjax.engine.derivatives import derivatives
from hdjax.engine.emission import F64, I64, Vectors, emitted, is_truth
from hdjax.engine.graph import PARAMETER, VARYING, Graph
from hdjax.engine.machine import compiled
from hdjax.engine.translate import traced, translated

LANES = 8


class MachineFunction:
    """A function of some scalars as machine code, with its derivatives, for arrays of points.

    Args:
        function: of JAX scalars; gives one scalar.
        arguments: how many.
        lanes: points side by side; one is what the engine does with parameters.
        constant: which arguments are constant during a simulation.
    """

    def __init__(self, function: Callable[..., Any], arguments: int, lanes: int = LANES, constant: Sequence[int] = ()):
        self.arguments, self.lanes = arguments, lanes
        self.graph = graph = Graph()
        levels = [PARAMETER if i in constant else VARYING for i in range(arguments)]
        leaves = [graph.leaf(("x", i), level) for i, level in enumerate(levels)]
        program = traced(function, *(np.float64(0.5) for _ in leaves))
        (result,) = translated(graph, program, [np.array(n, dtype=object) for n in leaves])
        (self.value,) = result.reshape(-1)
        one = graph.constant(1.0)
        (tangent,) = derivatives(graph, [self.value], {n: {i: one} for i, n in enumerate(leaves)}).values()
        zero = graph.constant(0.0)
        self.wanted = [self.value, *(tangent.get(i, zero) for i in range(arguments))]
        self.address = self._compiled()

    def _compiled(self) -> int:
        pointer = F64.as_pointer()
        module = ir.Module("function")
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer, pointer]), "function")
        v = Vectors(ir.IRBuilder(function.append_basic_block()), self.lanes)
        inputs, outputs = (v.builder.bitcast(a, v.numbers.as_pointer()) for a in function.args)

        def place(base, index):
            return v.builder.gep(base, [ir.Constant(I64, index)])

        given = {
            self.graph.leaf(("x", i)): lambda i=i: v.builder.load(place(inputs, i), align=8)
            for i in range(self.arguments)
        }
        found = emitted(v, self.graph, self.wanted, given)
        for i, node in enumerate(self.wanted):
            value = found[node]
            if is_truth(self.graph, node):
                value = v.builder.uitofp(value, v.numbers)
            v.builder.store(value, place(outputs, i), align=8)
        v.builder.ret_void()
        (address,) = compiled(module, "function")
        return address

    def __call__(self, *points: np.ndarray) -> np.ndarray:
        """Value and derivatives by row."""
        count = len(points[0])
        pad = -count % self.lanes
        blocks = np.stack([np.pad(np.asarray(p, dtype=float), (0, pad), mode="edge") for p in points])
        blocks = np.ascontiguousarray(blocks.reshape(len(points), -1, self.lanes).transpose(1, 0, 2))
        found = np.empty((len(blocks), len(self.wanted), self.lanes))
        call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(self.address)
        for block, result in zip(blocks, found, strict=True):
            call(block.ctypes.data, result.ctypes.data)
        return found.transpose(1, 0, 2).reshape(len(self.wanted), -1)[:, :count]

    def by_numpy(self, *points: np.ndarray) -> np.ndarray:
        """The same by [`Graph.evaluate`][hdjax.engine.graph.Graph.evaluate]."""
        leaves = {("x", i): np.asarray(p, dtype=float) for i, p in enumerate(points)}
        found = self.graph.evaluate(self.wanted, leaves)
        return np.stack([np.broadcast_to(np.asarray(f, dtype=float), points[0].shape) for f in found])
