"""Steps of the solver along a sample interval, with sensitivities, as instructions of a block."""

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir

from hdjax.engine.emission import F64, I64
from hdjax.engine.room import POWERS, Room


def interval(room: Room, i: ir.Value) -> None:
    c, b = room.code, room.code.builder
    begin, end = _enter(room, i)
    width, substeps = c.sub(end, begin), room.got("substeps", I64)
    step = b.fdiv(width, c.spread(b.sitofp(substeps, F64)))
    with c.loop(substeps) as j:
        start = c.mul(c.spread(b.sitofp(j, F64)), step)
        _step(room, begin, start, step)
    if room.march.reads_signals:
        _surround(room, begin, width)


def surround_start(room: Room) -> None:
    """Time and signals at the first sample, where the outputs depend on them."""
    if room.march.reads_signals:
        _surround(room, _enter(room, room.code.i(0))[0], room.code.number(0.0))


def _enter(room: Room, i: ir.Value) -> tuple[ir.Value, ir.Value]:
    """Load the signals' polynomials in a sample interval; its two ends."""
    c, m = room.code, room.march
    for k in range(m.signals):
        powers, first = room.got(f"powers {k}", I64), room.got(f"first {k}", I64)
        row = c.times(c.plus(room.samples, first), powers)
        with c.loop(c.plus(c.load(room.degree, k), 1)) as power:
            offset = c.plus(c.times(c.plus(i, first), powers), power)
            value = room.lanes(room.got(f"signal {k}"), row, offset)
            c.store(value, room.coefficients, c.plus(power, k * POWERS))
    at = c.plus(i, room.got("first 0", I64))
    begin, end = (room.lanes(room.got("knots"), room.knots, c.plus(at, late)) for late in (0, 1))
    return begin, end


def _surround(room: Room, begin: ir.Value, late: ir.Value) -> None:
    """Time and signals, as inputs of the equations."""
    c, m = room.code, room.march
    c.store(c.add(begin, late), room.inputs, m.at_time)
    for k in range(m.signals):
        degree = c.load(room.degree, k)
        place = c.place(room.inputs, m.at_signal + k)
        c.builder.store(c.load(room.coefficients, c.plus(degree, k * POWERS)), place, align=8)
        with c.loop(degree) as down:
            power = c.builder.sub(c.plus(degree, -1), down)
            value = c.builder.load(place, align=8)
            lower = c.load(room.coefficients, c.plus(power, k * POWERS))
            c.builder.store(c.add(c.mul(value, late), lower), place, align=8)


def _step(room: Room, begin: ir.Value, start: ir.Value, step: ir.Value) -> None:
    c, m = room.code, room.march
    c.store(step, room.inputs, m.at_step)
    if m.held:
        room.at_state()
        _surround(room, begin, start)
        room.run(m.before, room.held_results)
        for k, node in enumerate(m.equations.held.values):
            c.store(room.node(m.before, node, room.held_results), room.inputs, m.at_held + k)
        if room.jacobian:
            room.fill(m.before, m.equations.held.slopes, range(m.held), room.held_dense)
    old = [c.load(room.state, i) for i in range(m.states)]
    for j, node in enumerate(m.nodes):
        _stage(room, j, begin, c.add(start, c.mul(c.number(node), step)), old, step)
    for i in range(m.states):
        value = c.total([old[i], _weighted(room, m.weights, lambda j, i=i: c.load(room.slopes, j * m.states + i))])
        assert value is not None
        c.store(value, room.state, i)
    if room.jacobian:
        with c.loop(room.tangents, room.first_moving()) as t:
            _move_tangent(room, t, step)


def _weighted(room: Room, weights: Sequence[float], slope: Callable[[int], ir.Value]) -> ir.Value | None:
    c = room.code
    return c.total([c.mul(c.number(w), slope(j)) for j, w in enumerate(weights) if w != 0.0])


def _stage(room: Room, j: int, begin: ir.Value, late: ir.Value, old: list[ir.Value], step: ir.Value) -> None:
    c, m = room.code, room.march
    _surround(room, begin, late)
    for i in range(m.states):
        moved = _weighted(room, m.lower[j], lambda k, i=i: c.load(room.slopes, k * m.states + i))
        value = old[i] if moved is None else c.add(old[i], moved)
        c.store(value, room.inputs, i)
    offset = j * m.rates.size
    results = c.place(room.stage_results, offset)
    room.run(m.rates, results)
    for i, node in enumerate(m.equations.rates.values):
        c.store(c.mul(step, room.node(m.rates, node, results)), room.slopes, j * m.states + i)
    if room.jacobian:
        rows = room.rates_by_parameter
        dense = c.place(room.dense, j * len(rows) * room.tangents)
        room.fill(m.rates, m.equations.rates.slopes, rows, dense)


def _move_tangent(room: Room, t: ir.Value, step: ir.Value) -> None:
    """Propagate one tangent through the stages of a step."""
    c, m = room.code, room.march
    rates = m.equations.rates
    old = room.tangent(t)
    held: list[Any] = []
    for k, slopes in enumerate(m.equations.held.slopes):
        terms = room.along_states(m.before, room.held_results, slopes, old)
        held.append(c.total([*terms, c.load(room.held_dense, c.plus(c.times(t, m.held), k))]))
    rows = {row: k for k, row in enumerate(room.rates_by_parameter)}
    found: list[list[ir.Value | None]] = []
    for j in range(len(m.nodes)):
        now: list[Any] = [c.total([old[i], _weighted_tangents(room, m.lower[j], found, i)]) for i in range(m.states)]
        results = c.place(room.stage_results, j * m.rates.size)
        stage: list[Any] = []
        for i in range(m.states):
            terms: list[Any] = [*room.along_states(m.rates, results, rates.slopes[i], now)]
            for direction, node in rates.slopes[i].items():
                if direction[0] == "held":
                    terms.append(c.mul(room.node(m.rates, node, results), held[direction[1]]))
            if i in rows:
                place = c.plus(c.times(t, len(rows)), j * len(rows) * room.tangents + rows[i])
                terms.append(c.load(room.dense, place))
            rate = c.total(terms)
            stage.append(None if rate is None else c.mul(step, rate))
        found.append(stage)
    for i in range(m.states):
        value = c.total([old[i], _weighted_tangents(room, m.weights, found, i)])
        assert value is not None
        c.store(value, room.moved, c.plus(c.times(t, m.states), i))


def _weighted_tangents(
    room: Room, weights: Sequence[float], found: Sequence[Sequence[ir.Value | None]], state: int
) -> ir.Value | None:
    c = room.code
    pairs = [(w, stage[state]) for w, stage in zip(weights, found, strict=False) if w != 0.0]
    return c.total([c.mul(c.number(w), s) for w, s in pairs if s is not None])
