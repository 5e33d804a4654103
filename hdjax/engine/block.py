"""The march of one block of segments: samples, steps, stages, sensitivities, and rows of the residual."""

from llvmlite import ir

from hdjax.engine.code import LANES
from hdjax.engine.emission import F64, I64
from hdjax.engine.room import Room
from hdjax.engine.rows import record, write_end, write_prior, write_products
from hdjax.engine.steps import interval, surround_start


def write_block(room: Room) -> None:
    """Write all instructions, in order."""
    m, c = room.march, room.code
    _choose_segments(room)
    _choose_work(room)
    for i in range(m.states):
        c.store(room.lanes(room.got("states"), m.states, i), room.state, i)
    for t in range(room.tangents):
        for i in range(m.states):
            c.store(c.number(1.0 if t - m.parameters == i else 0.0), room.moved, t * m.states + i)
    if room.jacobian:
        _begin_tangents(room)
    write_prior(room)
    surround_start(room)
    with c.loop(room.samples) as i:
        record(room, i)
        go = c.builder.icmp_signed("<", i, c.load(room.needed, 0))
        with c.builder.if_then(go):
            interval(room, i)
    write_end(room)
    if room.jacobian:
        with c.builder.if_then(room.wants("products")):
            write_products(room)


def _choose_segments(room: Room) -> None:
    """The lanes' segments; the last one is repeated to fill the block, with the same results."""
    c, b = room.code, room.code.builder
    last = c.plus(room.got("segments", I64), -1)
    for lane in range(LANES):
        mine = c.plus(c.times(room.index, LANES), lane)
        c.store(b.select(b.icmp_signed("<", mine, last), mine, last), room.segments, lane)


def _choose_work(room: Room) -> None:
    """Number of intervals to simulate, and number of powers of each signal."""
    c, b, m = room.code, room.code.builder, room.march
    c.store(c.i(0), room.needed, 0)
    with c.loop(room.samples) as i:
        some = room.lanes(room.got("weight"), room.samples, i)
        counts = b.fcmp_ordered(">", some, c.number(0.0))
        with b.if_then(room.in_any(counts)):
            c.store(i, room.needed, 0)
    whole = b.icmp_signed("!=", room.got("whole", I64), c.i(0))
    c.store(b.select(whole, room.samples, c.load(room.needed, 0)), room.needed, 0)
    for k in range(m.signals):
        powers = room.got(f"powers {k}", I64)
        row = c.times(c.plus(room.samples, room.got(f"first {k}", I64)), powers)
        c.store(c.i(0), room.degree, k)
        with c.loop(room.samples) as i, c.loop(powers, 1) as power:
            offset = c.plus(c.times(c.plus(i, room.got(f"first {k}", I64)), powers), power)
            some = b.fcmp_unordered("!=", room.lanes(room.got(f"signal {k}"), row, offset), c.number(0.0))
            higher = b.icmp_signed(">", power, c.load(room.degree, k))
            there = b.and_(higher, room.in_any(some))
            with b.if_then(there):
                c.store(power, room.degree, k)


def _begin_tangents(room: Room) -> None:
    c, m = room.code, room.march
    for table, size in room.blank:
        with c.loop(size) as k:
            c.store(c.number(0.0), table, k)
    with c.loop(m.parameters) as t:
        c.store(c.spread(c.load(room.got("slopes"), t)), room.scale, t)
    with c.loop(room.tangents, m.parameters) as t:
        c.store(c.number(1.0), room.scale, t)
    # With all parameters fixed, only the states have tangents; none for rows alone.
    c.store(c.i(m.parameters), room.first, 0)
    with c.loop(m.parameters) as t:
        slope = c.load(room.got("slopes"), t)
        with c.builder.if_then(c.builder.fcmp_unordered("!=", slope, ir.Constant(F64, 0.0))):
            c.store(c.i(0), room.first, 0)
    with c.builder.if_then(room.wants("rows")):
        c.store(c.i(room.tangents), room.first, 0)
