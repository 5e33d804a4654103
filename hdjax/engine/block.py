"""The march of one block of segments: samples, steps, stages, sensitivities, and rows of the residual."""

import dataclasses
from collections.abc import Callable, Sequence
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

LOST = 1e8
"""A whitened error beyond this many standard deviations, or no number at all, is counted as this many."""

_POWERS = 6


@dataclasses.dataclass(frozen=True)
class Emitted:
    """A part of the equations as a function `name(scalars, constants, inputs, passed, results)`.

    Attributes:
        function: in the module.
        slots: where among the results each node is that moves.
        passed: how many numbers it passes on to the function of the derivatives by parameters.
        by_parameter: that function; None of itself.
    """

    function: ir.Function
    slots: dict[Node, int]
    passed: int = 0
    by_parameter: "Emitted | None" = None

    @property
    def size(self) -> int:
        """How many results there are."""
        return len(self.slots)


class Block:
    """What the function of a block is made of: its room on the stack, and its instructions in order."""

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
        self.coefficients = code.array(m.signals * _POWERS)
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
        # What states do at once is nothing: all tangents go through the same instructions.
        sizes = len(self.rates_by_parameter) * stages, m.held, m.outputs
        self.dense, self.held_dense, self.read_dense = (code.array(size * self.tangents) for size in sizes)
        self.scale = code.array(self.tangents)
        columns = self.tangents + 1
        self.collected = code.array(columns * max(m.outputs, 1))
        self.products = code.array(columns**2 if self.jacobian else 0)
        tables = self.dense, self.held_dense, self.read_dense
        self.blank = [(room, size * self.tangents) for room, size in zip(tables, sizes, strict=True)]
        self.blank += [(self.collected, columns * max(m.outputs, 1)), (self.products, columns**2)]

    def _got(self, name: str, kind: Any = F64) -> ir.Value:
        """An entry of the call: an integer, or where numbers stand."""
        value = self.code.load(self.call, self.march.call[name])
        return value if kind is I64 else self.code.builder.inttoptr(value, kind.as_pointer())

    def _lanes(self, base: ir.Value, row: ir.Value | int, offset: ir.Value | int) -> ir.Value:
        c = self.code
        return c.builder.call(self.march.gather, [base, self.segments, c.i(row), c.i(offset)])

    def _put(self, base: ir.Value, row: ir.Value | int, offset: ir.Value | int, value: ir.Value) -> None:
        c = self.code
        c.builder.call(self.march.scatter, [base, self.segments, c.i(row), c.i(offset), value])

    def _node(self, part: Emitted, node: Node, results: ir.Value, offset: ir.Value | int = 0) -> ir.Value:
        """The value of a node: known, the same throughout, or among a part's results."""
        graph = self.march.equations.graph
        known = graph.known(node)
        if known is not None:
            return self.code.number(float(known))
        if node in self.march.scalars:
            return self.march.scalar(self.code, self.scalars, self.march.scalars[node], node)
        return self.code.load(results, self.code.plus(part.slots[node], offset))

    def _run(self, part: Emitted, results: ir.Value) -> None:
        if part.size:
            arguments = [self.scalars, self.constants, self.inputs, self.passed, results]
            self.code.builder.call(part.function, arguments)

    def _by_parameter(self, part: Emitted, slope: Tangent, parameter: int) -> ir.Value:
        """The derivative of a row by a parameter, behind a call of [`_run`][] for those of a part."""
        node = slope.get(("parameter", parameter))
        if node is None:
            return self.code.number(0.0)
        assert part.by_parameter is not None
        return self._node(part.by_parameter, node, self.further_results)

    def write(self) -> None:
        m, c = self.march, self.code
        self.scalars, self.constants = self._got("scalars"), self._got("constants")
        self.samples = self._got("samples", I64)
        self.rows = c.plus(c.times(self.samples, m.outputs), m.hidden)
        self.knots = c.plus(c.plus(self.samples, self._got("first 0", I64)), 1)
        self._choose_segments()
        self._choose_work()
        for i in range(m.states):
            c.store(self._lanes(self._got("states"), m.states, i), self.state, i)
        for t in range(self.tangents):
            for i in range(m.states):
                c.store(c.number(1.0 if t - m.parameters == i else 0.0), self.moved, t * m.states + i)
        if self.jacobian:
            self._begin_tangents()
        self._write_prior()
        with c.loop(self.samples) as i:
            self._record(i)
            go = c.builder.icmp_signed("<", i, c.load(self.needed, 0))
            with c.builder.if_then(go):
                self._interval(i)
        self._write_end()
        if self.jacobian:
            with c.builder.if_then(self._wants("products")):
                self._write_products()

    def _wants(self, result: Wanted) -> ir.Value:
        """Whether this is what the march is to give."""
        return self.code.builder.icmp_signed(
            "==", self._got("wanted", I64), self.code.i(get_args(Wanted).index(result))
        )

    def _in_any(self, lanes: ir.Value) -> ir.Value:
        """Whether something holds in any lane."""
        b = self.code.builder
        return b.icmp_unsigned("!=", b.bitcast(lanes, I8), ir.Constant(I8, 0))

    def _choose_segments(self) -> None:
        """The lanes' segments; behind the last one it stands again, and what it writes is the same."""
        c, b = self.code, self.code.builder
        last = c.plus(self._got("segments", I64), -1)
        for lane in range(LANES):
            mine = c.plus(c.times(self.index, LANES), lane)
            c.store(b.select(b.icmp_signed("<", mine, last), mine, last), self.segments, lane)

    def _choose_work(self) -> None:
        """How many intervals have to be simulated, and how many powers of each signal there are."""
        c, b, m = self.code, self.code.builder, self.march
        c.store(c.i(0), self.needed, 0)
        with c.loop(self.samples) as i:
            some = self._lanes(self._got("weight"), self.samples, i)
            counts = b.fcmp_ordered(">", some, c.number(0.0))
            with b.if_then(self._in_any(counts)):
                c.store(i, self.needed, 0)
        whole = b.icmp_signed("!=", self._got("whole", I64), c.i(0))
        c.store(b.select(whole, self.samples, c.load(self.needed, 0)), self.needed, 0)
        for k in range(m.signals):
            powers = self._got(f"powers {k}", I64)
            row = c.times(c.plus(self.samples, self._got(f"first {k}", I64)), powers)
            c.store(c.i(0), self.degree, k)
            with c.loop(self.samples) as i, c.loop(powers, 1) as power:
                offset = c.plus(c.times(c.plus(i, self._got(f"first {k}", I64)), powers), power)
                some = b.fcmp_unordered("!=", self._lanes(self._got(f"signal {k}"), row, offset), c.number(0.0))
                higher = b.icmp_signed(">", power, c.load(self.degree, k))
                there = b.and_(higher, self._in_any(some))
                with b.if_then(there):
                    c.store(power, self.degree, k)

    def _begin_tangents(self) -> None:
        c, m = self.code, self.march
        for room, size in self.blank:
            with c.loop(size) as k:
                c.store(c.number(0.0), room, k)
        with c.loop(m.parameters) as t:
            c.store(c.spread(c.load(self._got("slopes"), t)), self.scale, t)
        with c.loop(self.tangents, m.parameters) as t:
            c.store(c.number(1.0), self.scale, t)
        # Where all parameters are held, the tangents that move are those of the states; none for rows alone.
        c.store(c.i(m.parameters), self.first, 0)
        with c.loop(m.parameters) as t:
            slope = c.load(self._got("slopes"), t)
            with c.builder.if_then(c.builder.fcmp_unordered("!=", slope, ir.Constant(F64, 0.0))):
                c.store(c.i(0), self.first, 0)
        with c.builder.if_then(self._wants("rows")):
            c.store(c.i(self.tangents), self.first, 0)

    def _first(self) -> ir.Value:
        """The first tangent that moves."""
        return self.code.load(self.first, 0)

    # -- what is read ------------------------------------------------------------------------------------------

    def _at_state(self) -> None:
        for i in range(self.march.states):
            self.code.store(self.code.load(self.state, i), self.inputs, i)

    def _record(self, i: ir.Value) -> None:
        """Rows of the residual at a sample, and their derivatives."""
        c, b, m = self.code, self.code.builder, self.march
        self._at_state()
        self._run(m.read, self.read_results)
        weight = self._lanes(self._got("weight"), self.samples, i)
        counts = b.fcmp_ordered(">", weight, c.number(0.0))
        row = c.times(self.samples, m.outputs)
        errors = []
        for k, node in enumerate(m.equations.outputs.values):
            offset = c.plus(c.times(i, m.outputs), k)
            error = c.sub(self._lanes(self._got("measured"), row, offset), self._node(m.read, node, self.read_results))
            errors.append(b.select(counts, c.mul(error, weight), c.number(0.0)))
        whitening = [
            [c.spread(c.load(self._got("whitening"), p * m.outputs + q)) for q in range(m.outputs)]
            for p in range(m.outputs)
        ]
        lost = c.number(LOST)
        inside, values = [], []
        for p in range(m.outputs):
            white = c.total([c.mul(w, e) for w, e in zip(whitening[p], errors, strict=True)])
            assert white is not None
            inside.append(c.smaller(c.called("fabs", white), lost))
            values.append(b.select(inside[p], white, lost))
            self._put(self._got("rows"), self.rows, c.plus(c.times(i, m.outputs), p), values[p])
        if not self.jacobian:
            return
        # What counts in no lane adds nothing to products.
        useful = b.and_(self._in_any(counts), self._wants("products"))
        with b.if_then(b.or_(useful, self._wants("jacobian"))):
            self._record_tangents(i, weight, counts, whitening, inside, values)

    def _record_tangents(
        self,
        i: ir.Value,
        weight: ir.Value,
        counts: ir.Value,
        whitening: Sequence[Sequence[ir.Value]],
        inside: Sequence[ir.Value],
        values: Sequence[ir.Value],
    ) -> None:
        """Derivatives of the rows at a sample."""
        c, b, m = self.code, self.code.builder, self.march
        scale = b.fneg(weight)
        slopes = m.equations.outputs.slopes
        self._fill(m.read, slopes, range(m.outputs), self.read_dense)

        with c.loop(self.tangents, self._first()) as t:
            moved = self._tangent(t)
            factor = c.mul(scale, c.load(self.scale, t))
            change = []
            for k, slope in enumerate(slopes):
                own = c.load(self.read_dense, c.plus(c.times(t, m.outputs), k))
                total = c.total([*self._along_states(m.read, self.read_results, slope, moved), own])
                change.append(b.select(counts, c.mul(factor, total), c.number(0.0)))
            for p in range(m.outputs):
                white = c.total([c.mul(w, x) for w, x in zip(whitening[p], change, strict=True)])
                assert white is not None
                c.store(self._finite(white, inside[p]), self._columns_of(p), t)
        for p in range(m.outputs):
            self._put_row(c.plus(c.times(i, m.outputs), p), self._columns_of(p), values[p])

    def _columns_of(self, row: int) -> ir.Value:
        """Where the derivatives of a row, and then its value, are collected."""
        return self.code.place(self.collected, row * (self.tangents + 1))

    def _put_row(self, row: ir.Value, columns: ir.Value, value: ir.Value) -> None:
        """Write a row of the Jacobian, or add it to the products of the columns with each other."""
        c, b = self.code, self.code.builder
        c.store(value, columns, self.tangents)
        with b.if_else(self._wants("jacobian")) as (written, taken):
            with taken, c.loop(self.tangents + 1, self._first()) as i:
                left = c.load(columns, i)
                with c.loop(self.tangents + 1, i) as j:
                    place = c.plus(c.times(i, self.tangents + 1), j)
                    product = c.mul(left, c.load(columns, j))
                    c.store(c.add(c.load(self.products, place), product), self.products, place)
            with written:
                self._write_row(row, columns)

    def _write_row(self, row: ir.Value, columns: ir.Value) -> None:
        """Derivatives of a row; zero behind the last parameter."""
        c, m = self.code, self.march
        width = self._got("width", I64)
        for first, last, count, result in (
            (0, m.parameters, width, "by_parameter"),
            (m.parameters, self.tangents, c.i(m.states), "by_state"),
        ):

            def put(t: ir.Value, value: ir.Value, count=count, result=result) -> None:
                self._put(self._got(result), c.times(self.rows, count), c.plus(c.times(row, count), t), value)

            with c.loop(last - first) as t:
                put(t, c.load(columns, c.plus(t, first)))
            with c.loop(count, last - first) as t:
                put(t, c.number(0.0))

    def _write_products(self) -> None:
        """The upper half of the products, mirrored; zero in the columns behind the last parameter."""
        c, b = self.code, self.code.builder
        count = self.tangents + 1
        padding = b.sub(self._got("width", I64), c.i(self.march.parameters))
        columns = c.plus(padding, count)
        size, out = c.times(columns, columns), self._got("products")
        with c.loop(size) as k:
            self._put(out, size, k, c.number(0.0))

        def column(i: ir.Value) -> ir.Value:
            own = b.icmp_signed("<", i, c.i(self.march.parameters))
            return c.plus(i, b.select(own, c.i(0), padding))

        with c.loop(count) as i, c.loop(count, i) as j:
            value = c.load(self.products, c.plus(c.times(i, count), j))
            for row, other in ((i, j), (j, i)):
                self._put(out, size, c.plus(c.times(column(row), columns), column(other)), value)

    def _finite(self, value: ir.Value, as_well: ir.Value) -> ir.Value:
        """A derivative; zero where it is none."""
        c = self.code
        fine = c.builder.and_(as_well, c.smaller(c.called("fabs", value), c.number(np.inf)))
        return c.builder.select(fine, value, c.number(0.0))

    def _tangent(self, t: ir.Value) -> list[ir.Value]:
        c, states = self.code, self.march.states
        return [c.load(self.moved, c.plus(c.times(t, states), i)) for i in range(states)]

    def _along_states(
        self, part: Emitted, results: ir.Value, slopes: Tangent, moved: Sequence[ir.Value], offset: int = 0
    ) -> list[ir.Value]:
        """The terms of a row's change when states change."""
        graph = self.march.equations.graph
        terms = []
        for direction, node in slopes.items():
            if direction[0] == "state":
                change = moved[direction[1]]
                one = graph.known(node) == 1.0
                terms.append(change if one else self.code.mul(self._node(part, node, results, offset), change))
        return terms

    def _fill(self, part: Emitted, slopes: Sequence[Tangent], rows: Sequence[int], dense: ir.Value) -> None:
        """Put derivatives by parameters, where any of these moves, where a loop over them finds them."""
        c, m = self.code, self.march
        assert part.by_parameter is not None
        with c.builder.if_then(c.builder.icmp_signed("==", self._first(), c.i(0))):
            self._run(part.by_parameter, self.further_results)
            for p in range(m.parameters):
                for k, row in enumerate(rows):
                    c.store(self._by_parameter(part, slopes[row], p), dense, p * len(rows) + k)

    def _write_prior(self) -> None:
        """Rows that say how far hidden states start from where they are expected; none where a segment is joined."""
        c, b, m = self.code, self.code.builder, self.march
        if not m.hidden:
            return
        self._at_state()
        self._run(m.expected, self.prior_results)
        if m.expected.by_parameter is not None:
            self._run(m.expected.by_parameter, self.further_results)
        fresh = b.fcmp_ordered("==", self._lanes(self._got("joined"), 1, 0), c.number(0.0))
        top = c.times(self.samples, m.outputs)
        zero, lost = c.number(0.0), c.number(LOST)
        for h, node in enumerate(m.equations.prior.values):
            value = self._node(m.expected, node, self.prior_results)
            inside = c.smaller(c.called("fabs", value), lost)
            value = b.select(fresh, b.select(inside, value, lost), zero)
            row = c.plus(top, h)
            self._put(self._got("rows"), self.rows, row, value)
            if not self.jacobian:
                continue
            both = b.and_(fresh, inside)
            slopes = m.equations.prior.slopes[h]
            for t in range(self.tangents):
                change = zero
                if t < m.parameters:
                    change = self._by_parameter(m.expected, slopes, t)
                elif ("state", t - m.parameters) in slopes:
                    change = self._node(m.expected, slopes["state", t - m.parameters], self.prior_results)
                change = c.mul(change, c.load(self.scale, t))
                c.store(self._finite(change, both), self._columns_of(0), t)
            self._put_row(row, self._columns_of(0), value)

    def _write_end(self) -> None:
        c, m = self.code, self.march
        for i in range(m.states):
            self._put(self._got("end"), m.states, i, c.load(self.state, i))
        if self.jacobian:
            with c.builder.if_then(c.builder.not_(self._wants("rows"))):
                self._write_end_tangents()

    def _write_end_tangents(self) -> None:
        c, m = self.code, self.march
        for own, first, count, result in (
            (True, 0, m.parameters, "end_by_parameter"),
            (False, m.parameters, m.states, "end_by_state"),
        ):
            width = self._got("width", I64) if own else c.i(count)

            def put(i: int, t: ir.Value, change: ir.Value, width=width, result=result) -> None:
                self._put(self._got(result), c.times(width, m.states), c.plus(c.times(width, i), t), change)

            with c.loop(count) as t:
                for i, value in enumerate(self._tangent(c.plus(t, first))):
                    put(i, t, c.mul(value, c.load(self.scale, c.plus(t, first))))
            with c.loop(width, count) as t:
                for i in range(m.states):
                    put(i, t, c.number(0.0))

    # -- steps -------------------------------------------------------------------------------------------------

    def _interval(self, i: ir.Value) -> None:
        c, b, m = self.code, self.code.builder, self.march
        for k in range(m.signals):
            powers, first = self._got(f"powers {k}", I64), self._got(f"first {k}", I64)
            row = c.times(c.plus(self.samples, first), powers)
            with c.loop(c.plus(c.load(self.degree, k), 1)) as power:
                offset = c.plus(c.times(c.plus(i, first), powers), power)
                value = self._lanes(self._got(f"signal {k}"), row, offset)
                c.store(value, self.coefficients, c.plus(power, k * _POWERS))
        at = c.plus(i, self._got("first 0", I64))
        begin, end = (self._lanes(self._got("knots"), self.knots, c.plus(at, late)) for late in (0, 1))
        substeps = self._got("substeps", I64)
        step = b.fdiv(c.sub(end, begin), c.spread(b.sitofp(substeps, F64)))
        with c.loop(substeps) as j:
            start = c.mul(c.spread(b.sitofp(j, F64)), step)
            self._step(begin, start, step)

    def _surround(self, begin: ir.Value, late: ir.Value) -> None:
        """Time and signals, as inputs of the equations."""
        c, m = self.code, self.march
        c.store(c.add(begin, late), self.inputs, m.at_time)
        for k in range(m.signals):
            degree = c.load(self.degree, k)
            place = c.place(self.inputs, m.at_signal + k)
            c.builder.store(c.load(self.coefficients, c.plus(degree, k * _POWERS)), place, align=8)
            with c.loop(degree) as down:
                power = c.builder.sub(c.plus(degree, -1), down)
                value = c.builder.load(place, align=8)
                lower = c.load(self.coefficients, c.plus(power, k * _POWERS))
                c.builder.store(c.add(c.mul(value, late), lower), place, align=8)

    def _step(self, begin: ir.Value, start: ir.Value, step: ir.Value) -> None:
        c, m = self.code, self.march
        c.store(step, self.inputs, m.at_step)
        if m.held:
            self._at_state()
            self._surround(begin, start)
            self._run(m.before, self.held_results)
            for k, node in enumerate(m.equations.held.values):
                c.store(self._node(m.before, node, self.held_results), self.inputs, m.at_held + k)
            if self.jacobian:
                self._fill(m.before, m.equations.held.slopes, range(m.held), self.held_dense)
        old = [c.load(self.state, i) for i in range(m.states)]
        for j, node in enumerate(m.nodes):
            self._stage(j, begin, c.add(start, c.mul(c.number(node), step)), old, step)
        for i in range(m.states):
            value = c.total([old[i], self._weighted(m.weights, lambda j, i=i: c.load(self.slopes, j * m.states + i))])
            assert value is not None
            c.store(value, self.state, i)
        if self.jacobian:
            with c.loop(self.tangents, self._first()) as t:
                self._move_tangent(t, step)

    def _weighted(self, weights: Sequence[float], slope: Callable[[int], ir.Value]) -> ir.Value | None:
        c = self.code
        return c.total([c.mul(c.number(w), slope(j)) for j, w in enumerate(weights) if w != 0.0])

    def _stage(self, j: int, begin: ir.Value, late: ir.Value, old: list[ir.Value], step: ir.Value) -> None:
        c, m = self.code, self.march
        self._surround(begin, late)
        for i in range(m.states):
            moved = self._weighted(m.lower[j], lambda k, i=i: c.load(self.slopes, k * m.states + i))
            value = old[i] if moved is None else c.add(old[i], moved)
            c.store(value, self.inputs, i)
        offset = j * m.rates.size
        results = c.place(self.stage_results, offset)
        self._run(m.rates, results)
        for i, node in enumerate(m.equations.rates.values):
            c.store(c.mul(step, self._node(m.rates, node, results)), self.slopes, j * m.states + i)
        if self.jacobian:
            rows = self.rates_by_parameter
            dense = c.place(self.dense, j * len(rows) * self.tangents)
            self._fill(m.rates, m.equations.rates.slopes, rows, dense)

    def _move_tangent(self, t: ir.Value, step: ir.Value) -> None:
        """Take one tangent through the stages of a step."""
        c, m = self.code, self.march
        rates = m.equations.rates
        old = self._tangent(t)
        held: list[Any] = []
        for k, slopes in enumerate(m.equations.held.slopes):
            terms = self._along_states(m.before, self.held_results, slopes, old)
            held.append(c.total([*terms, c.load(self.held_dense, c.plus(c.times(t, m.held), k))]))
        rows = {row: k for k, row in enumerate(self.rates_by_parameter)}
        found: list[list[ir.Value | None]] = []
        for j in range(len(m.nodes)):
            now: list[Any] = [c.total([old[i], self._weighted_tangents(m.lower[j], found, i)]) for i in range(m.states)]
            results = c.place(self.stage_results, j * m.rates.size)
            stage: list[Any] = []
            for i in range(m.states):
                terms: list[Any] = [*self._along_states(m.rates, results, rates.slopes[i], now)]
                for direction, node in rates.slopes[i].items():
                    if direction[0] == "held":
                        terms.append(c.mul(self._node(m.rates, node, results), held[direction[1]]))
                if i in rows:
                    place = c.plus(c.times(t, len(rows)), j * len(rows) * self.tangents + rows[i])
                    terms.append(c.load(self.dense, place))
                rate = c.total(terms)
                stage.append(None if rate is None else c.mul(step, rate))
            found.append(stage)
        for i in range(m.states):
            value = c.total([old[i], self._weighted_tangents(m.weights, found, i)])
            assert value is not None
            c.store(value, self.moved, c.plus(c.times(t, m.states), i))

    def _weighted_tangents(
        self, weights: Sequence[float], found: Sequence[Sequence[ir.Value | None]], state: int
    ) -> ir.Value | None:
        c = self.code
        pairs = [(w, stage[state]) for w, stage in zip(weights, found, strict=False) if w != 0.0]
        return c.total([c.mul(c.number(w), s) for w, s in pairs if s is not None])
