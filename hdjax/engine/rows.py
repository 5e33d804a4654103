"""Rows of the residual and their derivatives, as instructions of a block."""

from collections.abc import Sequence

from llvmlite import ir

from hdjax.engine.emission import I64
from hdjax.engine.room import Room

LOST = 1e8
"""Limit of whitened errors in standard deviations; also the value for NaN."""


def record(room: Room, i: ir.Value) -> None:
    """Rows of the residual at a sample, and their derivatives."""
    c, b, m = room.code, room.code.builder, room.march
    room.at_state()
    room.run(m.read, room.read_results)
    weight = room.lanes(room.got("weight"), room.samples, i)
    counts = b.fcmp_ordered(">", weight, c.number(0.0))
    row = c.times(room.samples, m.outputs)
    errors = []
    for k, node in enumerate(m.equations.outputs.values):
        offset = c.plus(c.times(i, m.outputs), k)
        error = c.sub(room.lanes(room.got("measured"), row, offset), room.node(m.read, node, room.read_results))
        errors.append(b.select(counts, c.mul(error, weight), c.number(0.0)))
    whitening = [
        [c.spread(c.load(room.got("whitening"), p * m.outputs + q)) for q in range(m.outputs)] for p in range(m.outputs)
    ]
    lost = c.number(LOST)
    inside, values = [], []
    for p in range(m.outputs):
        white = c.total([c.mul(w, e) for w, e in zip(whitening[p], errors, strict=True)])
        assert white is not None
        inside.append(c.smaller(c.called("fabs", white), lost))
        values.append(b.select(inside[p], white, lost))
        room.put(room.got("rows"), room.rows, c.plus(c.times(i, m.outputs), p), values[p])
    if not room.jacobian:
        return
    # A sample that is invalid in all lanes adds nothing to products.
    useful = b.and_(room.in_any(counts), room.wants("products"))
    with b.if_then(b.or_(useful, room.wants("jacobian"))):
        _record_tangents(room, i, weight, counts, whitening, inside, values)


def _record_tangents(
    room: Room,
    i: ir.Value,
    weight: ir.Value,
    counts: ir.Value,
    whitening: Sequence[Sequence[ir.Value]],
    inside: Sequence[ir.Value],
    values: Sequence[ir.Value],
) -> None:
    """Derivatives of the rows at a sample."""
    c, b, m = room.code, room.code.builder, room.march
    scale = b.fneg(weight)
    slopes = m.equations.outputs.slopes
    room.fill(m.read, slopes, range(m.outputs), room.read_dense)

    with c.loop(room.tangents, room.first_moving()) as t:
        moved = room.tangent(t)
        factor = c.mul(scale, c.load(room.scale, t))
        change = []
        for k, slope in enumerate(slopes):
            own = c.load(room.read_dense, c.plus(c.times(t, m.outputs), k))
            total = c.total([*room.along_states(m.read, room.read_results, slope, moved), own])
            change.append(b.select(counts, c.mul(factor, total), c.number(0.0)))
        for p in range(m.outputs):
            white = c.total([c.mul(w, x) for w, x in zip(whitening[p], change, strict=True)])
            assert white is not None
            c.store(room.finite(white, inside[p]), _columns_of(room, p), t)
    for p in range(m.outputs):
        _put_row(room, c.plus(c.times(i, m.outputs), p), _columns_of(room, p), values[p])


def _columns_of(room: Room, row: int) -> ir.Value:
    """Memory for the derivatives of a row, followed by its value."""
    return room.code.place(room.collected, row * (room.tangents + 1))


def _put_row(room: Room, row: ir.Value, columns: ir.Value, value: ir.Value) -> None:
    """Write a row of the Jacobian, or add it to the products of the columns with each other."""
    c, b = room.code, room.code.builder
    c.store(value, columns, room.tangents)
    with b.if_else(room.wants("jacobian")) as (written, taken):
        with taken, c.loop(room.tangents + 1, room.first_moving()) as i:
            left = c.load(columns, i)
            with c.loop(room.tangents + 1, i) as j:
                place = c.plus(c.times(i, room.tangents + 1), j)
                product = c.mul(left, c.load(columns, j))
                c.store(c.add(c.load(room.products, place), product), room.products, place)
        with written:
            _write_row(room, row, columns)


def _write_row(room: Room, row: ir.Value, columns: ir.Value) -> None:
    """Derivatives of a row; zero after the last parameter."""
    c, m = room.code, room.march
    width = room.got("width", I64)
    for first, last, count, result in (
        (0, m.parameters, width, "by_parameter"),
        (m.parameters, room.tangents, c.i(m.states), "by_state"),
    ):

        def put(t: ir.Value, value: ir.Value, count=count, result=result) -> None:
            room.put(room.got(result), c.times(room.rows, count), c.plus(c.times(row, count), t), value)

        with c.loop(last - first) as t:
            put(t, c.load(columns, c.plus(t, first)))
        with c.loop(count, last - first) as t:
            put(t, c.number(0.0))


def write_products(room: Room) -> None:
    """The upper half of the products, mirrored; zero in the columns after the last parameter."""
    c, b = room.code, room.code.builder
    count = room.tangents + 1
    padding = b.sub(room.got("width", I64), c.i(room.march.parameters))
    columns = c.plus(padding, count)
    size, out = c.times(columns, columns), room.got("products")
    with c.loop(size) as k:
        room.put(out, size, k, c.number(0.0))

    def column(i: ir.Value) -> ir.Value:
        own = b.icmp_signed("<", i, c.i(room.march.parameters))
        return c.plus(i, b.select(own, c.i(0), padding))

    with c.loop(count) as i, c.loop(count, i) as j:
        value = c.load(room.products, c.plus(c.times(i, count), j))
        for row, other in ((i, j), (j, i)):
            room.put(out, size, c.plus(c.times(column(row), columns), column(other)), value)


def write_prior(room: Room) -> None:
    """Rows of the hidden initial states' prior; none where a segment is joined."""
    c, b, m = room.code, room.code.builder, room.march
    if not m.hidden:
        return
    room.at_state()
    room.run(m.expected, room.prior_results)
    if m.expected.by_parameter is not None:
        room.run(m.expected.by_parameter, room.further_results)
    fresh = b.fcmp_ordered("==", room.lanes(room.got("joined"), 1, 0), c.number(0.0))
    top = c.times(room.samples, m.outputs)
    zero, lost = c.number(0.0), c.number(LOST)
    for h, node in enumerate(m.equations.prior.values):
        value = room.node(m.expected, node, room.prior_results)
        inside = c.smaller(c.called("fabs", value), lost)
        value = b.select(fresh, b.select(inside, value, lost), zero)
        row = c.plus(top, h)
        room.put(room.got("rows"), room.rows, row, value)
        if not room.jacobian:
            continue
        both = b.and_(fresh, inside)
        slopes = m.equations.prior.slopes[h]
        for t in range(room.tangents):
            change = zero
            if t < m.parameters:
                change = room.by_parameter(m.expected, slopes, t)
            elif ("state", t - m.parameters) in slopes:
                change = room.node(m.expected, slopes["state", t - m.parameters], room.prior_results)
            change = c.mul(change, c.load(room.scale, t))
            c.store(room.finite(change, both), _columns_of(room, 0), t)
        _put_row(room, row, _columns_of(room, 0), value)


def write_end(room: Room) -> None:
    c, m = room.code, room.march
    for i in range(m.states):
        room.put(room.got("end"), m.states, i, c.load(room.state, i))
    if room.jacobian:
        with c.builder.if_then(c.builder.not_(room.wants("rows"))):
            _write_end_tangents(room)


def _write_end_tangents(room: Room) -> None:
    c, m = room.code, room.march
    for own, first, count, result in (
        (True, 0, m.parameters, "end_by_parameter"),
        (False, m.parameters, m.states, "end_by_state"),
    ):
        width = room.got("width", I64) if own else c.i(count)

        def put(i: int, t: ir.Value, change: ir.Value, width=width, result=result) -> None:
            room.put(room.got(result), c.times(width, m.states), c.plus(c.times(width, i), t), change)

        with c.loop(count) as t:
            for i, value in enumerate(room.tangent(c.plus(t, first))):
                put(i, t, c.mul(value, c.load(room.scale, c.plus(t, first))))
        with c.loop(width, count) as t:
            for i in range(m.states):
                put(i, t, c.number(0.0))
