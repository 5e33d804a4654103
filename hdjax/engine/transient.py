"""Transients of many drives as vectorised machine code, without derivatives.

A harmonic forcing is advanced by rotation: a lane's steps are equal, so that its phase advances by the same angle from
stage to stage.
"""

import functools
from collections.abc import Callable, Mapping, Sequence

import diffrax as dfx
import numpy as np
from jaxtyping import Float
from llvmlite import ir

from hdjax.engine.code import LANES, Code
from hdjax.engine.emission import F64, I64, emitted, restored, storable
from hdjax.engine.forced import Forced
from hdjax.engine.graph import Node
from hdjax.engine.handler import ENTRY, called, data, dimension
from hdjax.engine.machine import compiled
from hdjax.engine.march import tableau
from hdjax.engine.sharing import block_of, share, worker

_NAME = "transients"
_OPERANDS = ("address", "numbers", "settings")
_RESULTS = ("x", "v", "peak")


def made(forced: Forced, solver: dfx.AbstractERK, *, peaks: bool) -> int:
    """Address of the machine code for transients, see [`run`][].

    Args:
        forced: the drive under its forcing.
        solver: explicit Runge-Kutta solver of diffrax; its tableau is used.
        peaks: whether to compute the largest |x| of each window.
    """
    (address,) = compiled(_Transients(forced, solver, peaks=peaks).module, _NAME)
    return address


def run(
    address: int, numbers: Float[np.ndarray, "numbers points"], *, windows: int, substeps: int, threads: int
) -> tuple[Float[np.ndarray, "points windows"], ...]:
    """Simulate many points from rest.

    Args:
        address: of the machine code.
        numbers: of each point.
        windows: number of equal parts of each point's length, at whose ends the motion is returned.
        substeps: solver steps in a window.
        threads: that share the points.

    Returns:
        Twist and its rate at the windows' ends, and the largest |x| in each window; zero where it is not computed.
    """
    count = numbers.shape[1]
    filled = np.pad(numbers, ((0, 0), (0, -count % LANES)), mode="edge")
    found = [np.zeros((windows, filled.shape[1])) for _ in _RESULTS]
    settings = np.array([windows, substeps, threads], dtype=np.int64)
    called(address, [np.array(address), np.ascontiguousarray(filled), settings], found)
    return tuple(array[:, :count].T for array in found)


class _Transients:
    """The module with its functions."""

    def __init__(self, forced: Forced, solver: dfx.AbstractERK, *, peaks: bool):
        self.forced, self.peaks = forced, peaks
        self.lower, self.nodes, self.weights = tableau(solver)
        self.module = ir.Module(_NAME)
        names = ("numbers", *_RESULTS, "lanes", "windows", "substeps", "blocks", "next")
        self.call = {name: i for i, name in enumerate(names)}
        block = block_of(self.module, lambda code, call, index: _Block(self, code, call, index).write())
        self._entry(worker(self.module, block, self.call))

    def _entry(self, worker: ir.Function) -> None:
        function = ir.Function(self.module, ENTRY, _NAME)
        code = Code(ir.IRBuilder(function.append_basic_block()))
        operands, results = function.args
        call = code.array(len(self.call), I64)
        settings = data(code.builder, operands, _OPERANDS.index("settings"), I64)
        lanes = dimension(code.builder, operands, _OPERANDS.index("numbers"), 1)
        blocks = code.builder.sdiv(lanes, code.i(LANES))
        tables = {"numbers": data(code.builder, operands, _OPERANDS.index("numbers"))}
        tables |= {name: data(code.builder, results, i) for i, name in enumerate(_RESULTS)}
        entries = {name: code.builder.ptrtoint(table, I64) for name, table in tables.items()}
        entries |= {"windows": code.load(settings, 0), "substeps": code.load(settings, 1)}
        entries |= {"lanes": lanes, "blocks": blocks, "next": code.i(0)}
        for name, value in entries.items():
            code.store(value, call, self.call[name])
        share(code, worker, call, blocks, code.load(settings, 2))
        code.builder.ret_void()


class _Block:
    """The function of a block: its stack memory and instructions."""

    def __init__(self, module: _Transients, code: Code, call: ir.Value, index: ir.Value):
        self.forced, self.module, self.code, self.call = module.forced, module, code, call
        self.first = code.times(index, LANES)
        f, graph = self.forced, self.forced.graph
        self.leaf = functools.cache(lambda *name: graph.leaf(name))
        asked = [f.length, *f.start, *f.wave, *f.held, *f.rates, *f.seen, f.largest, *f.circle]
        asked += [] if f.wave else [f.torque]
        self.kept = graph.steady(asked)
        self.room = code.array(len(self.kept))
        stages = len(module.nodes)
        self.state, self.ends = code.array(len(f.start)), code.array(6)
        # Cosine and sine of the forcing's phase, and of its advance from a step's start to its stages and end.
        self.phase, self.turns = code.array(2), code.array(2 * (stages + 1))
        self.peak = code.array(1)

    def _got(self, name: str, kind: ir.Type = I64) -> ir.Value:
        """An entry of the call: an integer, or an address of numbers."""
        value = self.code.load(self.call, self.module.call[name])
        return value if kind is I64 else self.code.builder.inttoptr(value, kind.as_pointer())

    def _vector(self, base: str, row: ir.Value | int) -> ir.Value:
        """Address of the block's numbers of a row."""
        offset = self.code.plus(self.code.times(row, self._got("lanes")), self.first)
        place = self.code.place(self._got(base, F64), offset)
        return self.code.builder.bitcast(place, self.code.numbers.as_pointer())

    def _emit(self, wanted: Sequence[Node], moving: Mapping[Node, ir.Value]) -> list[ir.Value]:
        given: dict[Node, Callable[[], ir.Value]] = {n: functools.partial(self._constant, n) for n in self.kept}
        given |= {node: (lambda value=value: value) for node, value in moving.items()}
        found = emitted(self.code, self.forced.graph, wanted, given)
        return [found[node] for node in wanted]

    def _constant(self, node: Node) -> ir.Value:
        """A node that is constant in a lane."""
        return restored(self.code, self.forced.graph, node, self.code.load(self.room, self.kept[node]))

    def _prepare(self) -> None:
        graph, code = self.forced.graph, self.code
        leaves = {
            node: lambda row=graph.nodes[node][1][1]: code.load(self._vector("numbers", row), 0)
            for node in graph.needed(self.kept)
            if graph.nodes[node][0] == "leaf"
        }
        found = emitted(code, graph, self.kept, leaves)
        for node, i in self.kept.items():
            code.store(storable(code, graph, node, found[node]), self.room, i)

    def write(self) -> None:
        c, f = self.code, self.forced
        self._prepare()
        for i, value in enumerate(self._emit(f.start, {})):
            c.store(value, self.state, i)
        (length,) = self._emit([f.length], {})
        width = c.builder.fdiv(length, self._number(self._got("windows")))
        self.step = c.builder.fdiv(width, self._number(self._got("substeps")))
        if f.wave:
            _, omega, _, _ = self._emit(f.wave, {})
            for j, node in enumerate((*self.module.nodes, 1.0)):
                angle = c.mul(omega, c.mul(c.number(node), self.step))
                for k, part in enumerate(self._emit(f.circle, {self.leaf("angle"): angle})):
                    c.store(part, self.turns, 2 * j + k)
        with c.loop(self._got("windows")) as window:
            begin = c.mul(self._number(window), width)
            self._begin_window(begin)
            with c.loop(self._got("substeps")) as j:
                self._advance(c.add(begin, c.mul(self._number(j), self.step)))
            x, v, _ = self._seen(c.add(begin, width))
            for name, value in (("x", x), ("v", v), ("peak", c.load(self.peak, 0))):
                c.store(value, self._vector(name, window), 0)

    def _number(self, integer: ir.Value) -> ir.Value:
        return self.code.spread(self.code.builder.sitofp(integer, F64))

    # -- the forcing -------------------------------------------------------------------------------------------

    def _begin_window(self, begin: ir.Value) -> None:
        """Recompute the forcing's phase, so that rounding errors don't accumulate."""
        c, f = self.code, self.forced
        if f.wave:
            amplitude, omega, phase, _ = self._emit(f.wave, {})
            angle = c.add(c.mul(omega, begin), phase)
            for k, part in enumerate(self._emit(f.circle, {self.leaf("angle"): angle})):
                c.store(c.mul(amplitude, part), self.phase, k)
        c.store(c.number(0.0), self.peak, 0)
        if self.module.peaks:
            for i, value in enumerate(self._seen(begin)):
                c.store(value, self.ends, i)

    def _torque(self, time: ir.Value, stage: int | None = None) -> ir.Value:
        """The forcing at a stage of the next step, or at its start."""
        c, f = self.code, self.forced
        if not f.wave:
            return self._emit([f.torque], {self.leaf("time"): time})[0]
        cosine, sine = (c.load(self.phase, k) for k in range(2))
        if stage is not None:
            turned = [c.load(self.turns, 2 * stage + k) for k in range(2)]
            cosine = c.sub(c.mul(cosine, turned[0]), c.mul(sine, turned[1]))
        return c.add(cosine, self._emit(f.wave[3:], {})[0])

    def _turn(self) -> None:
        """Advance the forcing to the step's end."""
        c, last = self.code, len(self.module.nodes)
        cosine, sine = (c.load(self.phase, k) for k in range(2))
        a, b = (c.load(self.turns, 2 * last + k) for k in range(2))
        c.store(c.sub(c.mul(cosine, a), c.mul(sine, b)), self.phase, 0)
        c.store(c.add(c.mul(sine, a), c.mul(cosine, b)), self.phase, 1)

    # -- the motion --------------------------------------------------------------------------------------------

    def _at(self, state: Sequence[ir.Value], torque: ir.Value, time: ir.Value) -> dict[Node, ir.Value]:
        moving = {self.leaf("state", i): value for i, value in enumerate(state)}
        return moving | {self.leaf("torque"): torque, self.leaf("time"): time, self.leaf("step"): self.step}

    def _state(self) -> list[ir.Value]:
        return [self.code.load(self.state, i) for i in range(len(self.forced.start))]

    def _seen(self, time: ir.Value) -> list[ir.Value]:
        """The measured quantities at the present state."""
        return self._emit(self.forced.seen, self._at(self._state(), self._torque(time), time))

    def _advance(self, time: ir.Value) -> None:
        """One step, and the largest |x| in it."""
        c, f, m = self.code, self.forced, self.module
        old = self._state()
        held = dict(enumerate(self._emit(f.held, self._at(old, self._torque(time), time)))) if f.held else {}
        frozen = {self.leaf("held", i): value for i, value in held.items()}
        slopes: list[list[ir.Value]] = []
        for j, node in enumerate(m.nodes):
            now = [self._moved(value, m.lower[j], slopes, i) for i, value in enumerate(old)]
            at = c.add(time, c.mul(c.number(node), self.step))
            found = self._emit(f.rates, self._at(now, self._torque(at, j), at) | frozen)
            slopes.append([c.mul(self.step, rate) for rate in found])
        for i, value in enumerate(old):
            c.store(self._moved(value, m.weights, slopes, i), self.state, i)
        if f.wave:
            self._turn()
        if m.peaks:
            self._look(c.add(time, self.step))

    def _moved(
        self, value: ir.Value, weights: Sequence[float], slopes: Sequence[Sequence[ir.Value]], i: int
    ) -> ir.Value:
        c = self.code
        terms = [c.mul(c.number(w), s[i]) for w, s in zip(weights, slopes, strict=False) if w != 0.0]
        total = c.total([value, c.total(terms)])
        assert total is not None
        return total

    def _look(self, time: ir.Value) -> None:
        c, f = self.code, self.forced
        before, after = [c.load(self.ends, i) for i in range(3)], self._seen(time)
        ends = {self.leaf("before", i): value for i, value in enumerate(before)}
        ends |= {self.leaf("after", i): value for i, value in enumerate(after)}
        (largest,) = self._emit([f.largest], ends | {self.leaf("step"): self.step})
        for i, value in enumerate(after):
            c.store(value, self.ends, i)
        peak = c.load(self.peak, 0)
        # x shows whether the motion is lost; the peak need not.
        grows = c.builder.fcmp_unordered(">", largest, peak)
        c.store(c.builder.select(grows, largest, peak), self.peak, 0)
