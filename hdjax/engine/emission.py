"""From a graph of scalars to vector code of LLVM: each node is one number in each lane."""

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from llvmlite import ir

from hdjax.engine.graph import COMPARISONS, LOGICAL, Graph, Node

F64, I64, I32, I8, BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(32), ir.IntType(8), ir.IntType(1)

# Inner products with adjacent entries of a table, computed together.
_COLUMNS = 8
# Fused multiply-adds, and no flag that changes results beyond rounding.
_FUSED = ("contract",)
_SIGNS = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
# 1.5 * 2^52: adding it rounds to an integer, which is in the last bits.
_WHOLE = 6755399441055744.0
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
_LARGEST_EXPONENT, _LEAST_EXPONENT = 709.0, -708.0


class _Same(ir.Constant):
    """A constant in each lane, written once."""

    @functools.cached_property
    def _reference(self) -> str:
        return super().get_reference()

    def get_reference(self) -> str:
        return self._reference


@functools.cache
def _number(value: float, sign: float, lanes: int) -> ir.Constant:
    """A constant; `sign` distinguishes the two zeros."""
    return ir.Constant(F64, value) if lanes == 1 else _Same(ir.VectorType(F64, lanes), [value] * lanes)


class Vectors:
    """Instructions on vectors of a number of lanes; on scalars for one lane."""

    def __init__(self, builder: ir.IRBuilder, lanes: int):
        # Untyped: a type checker would require a check of each instruction's value.
        self.builder: Any = builder
        self.lanes = lanes
        self.numbers: Any = F64 if lanes == 1 else ir.VectorType(F64, lanes)
        self.integers: Any = I64 if lanes == 1 else ir.VectorType(I64, lanes)
        self.bits: Any = BIT if lanes == 1 else ir.VectorType(BIT, lanes)

    def number(self, value: float) -> ir.Constant:
        """The same number in each lane."""
        return _number(float(value), math.copysign(1.0, value), self.lanes)

    def integer(self, value: int) -> ir.Constant:
        """The same integer in each lane."""
        return ir.Constant(self.integers, value if self.lanes == 1 else [value] * self.lanes)

    def bit(self, value: bool) -> ir.Constant:
        """The same truth value in each lane."""
        return ir.Constant(self.bits, int(value) if self.lanes == 1 else [int(value)] * self.lanes)

    def spread(self, scalar: ir.Value) -> ir.Value:
        """A scalar value, broadcast to each lane."""
        if self.lanes == 1:
            return scalar
        none = ir.Constant(self.numbers, ir.Undefined)
        first = self.builder.insert_element(none, scalar, ir.Constant(I32, 0))
        return self.builder.shuffle_vector(first, none, ir.Constant(ir.VectorType(I32, self.lanes), [0] * self.lanes))

    def add(self, a, b):
        return self.builder.fadd(a, b, flags=_FUSED)

    def sub(self, a, b):
        return self.builder.fsub(a, b, flags=_FUSED)

    def mul(self, a, b):
        return self.builder.fmul(a, b, flags=_FUSED)

    def horner(self, coefficients: Sequence[float], x: ir.Value) -> ir.Value:
        """A polynomial, its coefficients by rising power."""
        total = self.number(coefficients[-1])
        for c in coefficients[-2::-1]:
            total = self.add(self.mul(total, x), self.number(c))
        return total

    def called(self, name: str, *arguments: ir.Value) -> ir.Value:
        """An intrinsic of LLVM."""
        kind = "f64" if self.lanes == 1 else f"v{self.lanes}f64"
        name = f"llvm.{name}.{kind}"
        module = self.builder.module
        known = module.globals.get(name)
        function = known or ir.Function(module, ir.FunctionType(self.numbers, [self.numbers] * len(arguments)), name)
        return self.builder.call(function, arguments)

    def smaller(self, a: ir.Value, b: ir.Value) -> ir.Value:
        """Whether a < b; false for NaN."""
        return self.builder.fcmp_ordered("<", a, b)


def own_function(vectors: Vectors, name: str, body: Callable[[Vectors, ir.Value], ir.Value], x: ir.Value) -> ir.Value:
    """Call an elementary function, which is added to the module if necessary."""
    module = vectors.builder.module
    full = f"{name}.{vectors.lanes}"
    function = module.globals.get(full)
    if function is None:
        function = ir.Function(module, ir.FunctionType(vectors.numbers, [vectors.numbers]), full)
        function.linkage = "internal"
        builder = ir.IRBuilder(function.append_basic_block())
        builder.ret(body(Vectors(builder, vectors.lanes), function.args[0]))
    return vectors.builder.call(function, [x])


def _reduced(v: Vectors, x: ir.Value) -> tuple[ir.Value, ir.Value]:
    """Power of two and remainder of an exponent (Cody and Waite 1980)."""
    shifted = v.add(v.mul(x, v.number(1.0 / math.log(2.0))), v.number(_WHOLE))
    n = v.builder.fsub(shifted, v.number(_WHOLE))
    rest = v.sub(x, v.mul(n, v.number(_LN2_HIGH)))
    rest = v.sub(rest, v.mul(n, v.number(_LN2_LOW)))
    bits = v.builder.shl(v.builder.bitcast(shifted, v.integers), v.integer(52))
    power = v.builder.bitcast(v.builder.add(bits, v.integer(1023 << 52)), v.numbers)
    return power, rest


def _exponential(v: Vectors, x: ir.Value) -> ir.Value:
    high, low = v.smaller(v.number(_LARGEST_EXPONENT), x), v.smaller(x, v.number(_LEAST_EXPONENT))
    inside = v.builder.select(high, v.number(0.0), v.builder.select(low, v.number(0.0), x))
    power, rest = _reduced(v, inside)
    value = v.mul(power, v.horner([1.0 / math.factorial(k) for k in range(14)], rest))
    value = v.builder.select(low, v.number(0.0), value)
    return v.builder.select(high, v.number(math.inf), value)


def _exponential_less_one(v: Vectors, x: ir.Value) -> ir.Value:
    high, low = v.smaller(v.number(_LARGEST_EXPONENT), x), v.smaller(x, v.number(-40.0))
    inside = v.builder.select(high, v.number(0.0), v.builder.select(low, v.number(-40.0), x))
    power, rest = _reduced(v, inside)
    tail = v.horner([1.0 / math.factorial(k) for k in range(2, 15)], rest)
    small = v.add(rest, v.mul(v.mul(rest, rest), tail))
    value = v.add(v.mul(power, small), v.sub(power, v.number(1.0)))
    return v.builder.select(high, v.number(math.inf), value)


def _logarithm(v: Vectors, x: ir.Value) -> ir.Value:
    b = v.builder
    root = 0x3FE6A09E667F3BCD  # of a half
    bits = b.bitcast(x, v.integers)
    biased = b.lshr(b.add(b.sub(bits, v.integer(root)), v.integer(1023 << 52)), v.integer(52))
    # Or-ed into the mantissa of 2^52, an integer becomes a float without conversion.
    exponent = b.bitcast(b.or_(biased, v.integer(0x4330000000000000)), v.numbers)
    exponent = b.fsub(exponent, v.number(2.0**52 + 1023))
    scaled = b.sub(bits, b.shl(b.sub(biased, v.integer(1023)), v.integer(52)))
    f = b.fsub(b.bitcast(scaled, v.numbers), v.number(1.0))
    s = b.fdiv(f, v.add(f, v.number(2.0)))
    z = v.mul(s, s)
    tail = v.horner([2.0 / (2 * k + 3) for k in range(11)], z)
    value = v.add(v.add(s, s), v.mul(v.mul(s, z), tail))
    value = v.add(v.mul(exponent, v.number(_LN2_HIGH)), v.add(value, v.mul(exponent, v.number(_LN2_LOW))))
    zero = v.number(0.0)
    value = b.select(v.smaller(zero, x), value, v.number(math.nan))
    value = b.select(b.fcmp_ordered("==", x, zero), v.number(-math.inf), value)
    return b.select(b.fcmp_ordered("==", x, v.number(math.inf)), v.number(math.inf), value)


def _hyperbolic_tangent(v: Vectors, x: ir.Value) -> ir.Value:
    size = v.called("fabs", x)
    size = v.builder.select(v.smaller(v.number(20.0), size), v.number(20.0), size)
    t = own_function(v, "expm1", _exponential_less_one, v.add(size, size))
    return v.called("copysign", v.builder.fdiv(t, v.add(t, v.number(2.0))), x)


_OWN = {"exp": _exponential, "expm1": _exponential_less_one, "log": _logarithm, "tanh": _hyperbolic_tangent}
_INTRINSIC = {"abs": "fabs", "sqrt": "sqrt", "round": "rint", "floor": "floor", "ceil": "ceil"}


def is_truth(graph: Graph, node: Node) -> bool:
    """Whether a node is a truth value."""
    operation, *rest = graph.nodes[node]
    if operation == "constant":
        return isinstance(rest[0], bool)
    if operation in ("select", "given"):
        return is_truth(graph, rest[1] if operation == "select" else rest[0])
    return operation in COMPARISONS or operation in LOGICAL or operation == "is_finite"


def storable(vectors: Vectors, graph: Graph, node: Node, value: ir.Value) -> ir.Value:
    """The value of a node as a number; [`restored`][] is the inverse."""
    return vectors.builder.uitofp(value, vectors.numbers) if is_truth(graph, node) else value


def restored(vectors: Vectors, graph: Graph, node: Node, number: ir.Value) -> ir.Value:
    """The value of a node from its [`storable`][] form."""
    return vectors.builder.fcmp_ordered("!=", number, vectors.number(0.0)) if is_truth(graph, node) else number


def emitted(
    vectors: Vectors,
    graph: Graph,
    wanted: Iterable[Node],
    given: Mapping[Node, Callable[[], ir.Value]],
    tables: Mapping[str, ir.Value] | None = None,
) -> dict[Node, ir.Value]:
    """Write the instructions for nodes at the builder's place.

    Args:
        vectors: instructions.
        graph: of the nodes.
        wanted: nodes to compute.
        given: access to known nodes, leaves included.
        tables: addresses of the graph's tables.

    Returns:
        The value of every needed node.
    """
    found: dict[Node, ir.Value] = {}
    wanted = list(wanted)
    needed: set[Node] = set()
    stack = list(wanted)
    while stack:
        node = stack.pop()
        if node not in needed:
            needed.add(node)
            stack.extend(() if node in given else graph.arguments(node))
    alike: dict[tuple[Any, ...], list[Node]] = {}
    for node in sorted(needed - given.keys()):
        if graph.nodes[node][0] == "dot":
            alike.setdefault(_alike(graph, node), []).append(node)
    for node in sorted(needed):
        if node in found:
            continue
        if node in given:
            found[node] = given[node]()
        elif graph.nodes[node][0] == "dot":
            key = table, stride, *factors = _alike(graph, node)
            assert tables is not None
            same = alike[key]
            firsts = [graph.nodes[n][1][1] for n in same]
            sums = _inner_products(vectors, [found[f] for f in factors], tables[table], firsts, stride)
            found.update(zip(same, sums, strict=True))
        else:
            found[node] = _instruction(vectors, graph, node, [found[a] for a in graph.arguments(node)])
    return found


def _alike(graph: Graph, node: Node) -> tuple[Any, ...]:
    """Key of inner products that are computed together: table, stride and factors."""
    (table, _, stride), *factors = graph.nodes[node][1:]
    return table, stride, *factors


def _inner_products(
    v: Vectors, factors: Sequence[ir.Value], table: ir.Value, firsts: Sequence[int], stride: int
) -> list[ir.Value]:
    """Sums of products of the same factors with strided numbers of a table, for several first places: as a loop, since
    unrolled code takes long to compile and to load."""
    b = v.builder
    with b.goto_entry_block():
        room = b.alloca(ir.ArrayType(v.numbers, len(factors)))
    for i, factor in enumerate(factors):
        b.store(factor, b.gep(room, [ir.Constant(I64, 0), ir.Constant(I64, i)]), align=8)
    found = []
    for start in range(0, len(firsts), _COLUMNS):
        before, loop, after = b.block, b.function.append_basic_block(), b.function.append_basic_block()
        b.branch(loop)
        b.position_at_end(loop)
        index = b.phi(I64)
        totals = [b.phi(v.numbers) for _ in firsts[start : start + _COLUMNS]]
        index.add_incoming(ir.Constant(I64, 0), before)
        factor = b.load(b.gep(room, [ir.Constant(I64, 0), index]), align=8)
        row = b.mul(index, ir.Constant(I64, stride))
        for first, total in zip(firsts[start:], totals, strict=False):
            number = b.load(b.gep(table, [b.add(row, ir.Constant(I64, first))]), align=8)
            total.add_incoming(v.number(0.0), before)
            found.append(v.add(total, v.mul(v.spread(number), factor)))
            total.add_incoming(found[-1], loop)
        following = b.add(index, ir.Constant(I64, 1))
        index.add_incoming(following, loop)
        b.cbranch(b.icmp_signed("<", following, ir.Constant(I64, len(factors))), loop, after)
        b.position_at_end(after)
    return found


def _instruction(v: Vectors, graph: Graph, node: Node, x: list[ir.Value]) -> ir.Value:
    operation, *rest = graph.nodes[node]
    b = v.builder
    if operation == "constant":
        return v.bit(rest[0]) if isinstance(rest[0], bool) else v.number(rest[0])
    if operation in ("add", "sub", "mul"):
        return getattr(v, operation)(*x)
    if operation in COMPARISONS:
        if is_truth(graph, rest[0]):
            return b.icmp_unsigned(_SIGNS[operation], *x)
        return (b.fcmp_unordered if operation == "ne" else b.fcmp_ordered)(_SIGNS[operation], *x)
    if operation in _INTRINSIC:
        return v.called(_INTRINSIC[operation], *x)
    if operation in _OWN:
        return own_function(v, operation, _OWN[operation], *x)
    return _SIMPLE[operation](v, *x)


def _sign(v: Vectors, x: ir.Value) -> ir.Value:
    zero = v.number(0.0)
    negative = v.builder.select(v.smaller(x, zero), v.number(-1.0), x)
    return v.builder.select(v.smaller(zero, x), v.number(1.0), negative)


_SIMPLE: dict[str, Callable[..., ir.Value]] = {
    "div": lambda v, p, q: v.builder.fdiv(p, q),
    "neg": lambda v, p: v.builder.fneg(p),
    "select": lambda v, which, p, q: v.builder.select(which, p, q),
    "max": lambda v, p, q: v.builder.select(v.builder.fcmp_ordered(">", p, q), p, q),
    "min": lambda v, p, q: v.builder.select(v.builder.fcmp_ordered("<", p, q), p, q),
    "and": lambda v, p, q: v.builder.and_(p, q),
    "or": lambda v, p, q: v.builder.or_(p, q),
    "xor": lambda v, p, q: v.builder.xor(p, q),
    "not": lambda v, p: v.builder.not_(p),
    "given": lambda v, p: p,
    "sign": _sign,
    "is_finite": lambda v, p: v.smaller(v.called("fabs", p), v.number(math.inf)),
}
