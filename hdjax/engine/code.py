"""Instructions of one function on blocks of segments: memory access, integers, loops."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from llvmlite import ir

from hdjax.engine.emission import I64, Vectors

LANES = 8
"""Segments in a block: one wide register, or two or four narrow ones, which hide latencies."""


class Code(Vectors):
    """Instructions of one function on whole blocks."""

    def __init__(self, builder: ir.IRBuilder):
        super().__init__(builder, LANES)
        self.pointers = self.numbers.as_pointer()

    def i(self, value: int | ir.Value) -> ir.Value:
        """An integer constant."""
        return ir.Constant(I64, value) if isinstance(value, int) else value

    def place(self, base: ir.Value, index: int | ir.Value) -> ir.Value:
        return self.builder.gep(base, [self.i(index)])

    def load(self, base: ir.Value, index: int | ir.Value) -> ir.Value:
        return self.builder.load(self.place(base, index), align=8)

    def store(self, value: ir.Value, base: ir.Value, index: int | ir.Value) -> None:
        self.builder.store(value, self.place(base, index), align=8)

    def plus(self, a: int | ir.Value, b: int | ir.Value) -> ir.Value:
        return self.builder.add(self.i(a), self.i(b))

    def times(self, a: int | ir.Value, b: int | ir.Value) -> ir.Value:
        return self.builder.mul(self.i(a), self.i(b))

    def array(self, count: int, kind: Any = None) -> ir.Value:
        """Stack memory, allocated at the function's beginning."""
        room = self.builder.alloca(ir.ArrayType(kind or self.numbers, max(count, 1)))
        return self.builder.gep(room, [ir.Constant(I64, 0)] * 2)

    @contextlib.contextmanager
    def loop(self, count: int | ir.Value, start: int | ir.Value = 0) -> Iterator[ir.Value]:
        """Run the body for each index from the start on; values defined in it are local."""
        b = self.builder
        before = b.block
        head, body, after = (b.function.append_basic_block() for _ in range(3))
        b.branch(head)
        b.position_at_end(head)
        index = b.phi(I64)
        index.add_incoming(self.i(start), before)
        b.cbranch(b.icmp_signed("<", index, self.i(count)), body, after)
        b.position_at_end(body)
        yield index
        index.add_incoming(b.add(index, self.i(1)), b.block)
        b.branch(head)
        b.position_at_end(after)

    def total(self, terms: Sequence[ir.Value | None]) -> ir.Value | None:
        """Sum of values; None counts as zero."""
        found = None
        for term in terms:
            if term is not None:
                found = term if found is None else self.add(found, term)
        return found
