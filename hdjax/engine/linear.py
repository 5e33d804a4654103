"""Response of a linear system of given transitions to many forces, in machine code."""

import functools

import numpy as np
from jaxtyping import Float
from llvmlite import ir

from hdjax.engine.code import LANES, Code
from hdjax.engine.emission import F64, I64
from hdjax.engine.handler import ENTRY, called, data
from hdjax.engine.kernel import threads
from hdjax.engine.machine import compiled
from hdjax.engine.sharing import block_of, share, worker

_MOST_STATES = 64
_NAME = "linear_response"
_COUNTS = ("segments", "samples", "states", "outputs", "parts", "columns", "threads")
_OPERANDS = ("transition", "readout", "lands", "sizes", "start")
_RESULTS = ("read", "end")
# Indices in the table of a call.
_PLACES = {name: i for i, name in enumerate((*_COUNTS, *_OPERANDS, *_RESULTS, "blocks", "next"))}


def linear_response(
    transition: Float[np.ndarray, "segments samples states states"],
    readout: Float[np.ndarray, "segments samples outputs states"],
    lands: Float[np.ndarray, "segments samples states parts"],
    sizes: Float[np.ndarray, "segments samples parts columns"],
    start: Float[np.ndarray, "segments states columns"],
) -> tuple[Float[np.ndarray, "segments samples outputs columns"], Float[np.ndarray, "segments states columns"]]:
    """Outputs at the samples, and the final state of each segment.

    Args:
        transition: of the state through each sample interval.
        readout: of the outputs from the state.
        lands: change of the state at each interval's end by a unit of each part of a force.
        sizes: coefficient of each part in each force.
        start: initial state of each segment.
    """
    segments, samples, parts, columns = sizes.shape
    states = lands.shape[2]
    if states > _MOST_STATES:
        raise ValueError(f"`lands` must have at most {_MOST_STATES} states, but has {states}")
    if columns < LANES:
        more = [(0, 0)] * 3 + [(0, LANES - columns)]
        wide, begin = np.pad(sizes, more), np.pad(start, more[1:])
        outputs, end = linear_response(transition, readout, lands, wide, begin)
        return outputs[..., :columns], end[..., :columns]
    outputs = np.empty((segments, samples, readout.shape[2], columns))
    end = np.empty((segments, states, columns))
    counts = np.array([segments, samples, states, outputs.shape[2], parts, columns, threads()])
    operands = [counts, *map(np.ascontiguousarray, (transition, readout, lands, sizes, start))]
    called(_address(), operands, [outputs, end])
    return outputs, end


@functools.cache
def _address() -> int:
    module = ir.Module(_NAME)
    work = worker(module, block_of(module, _segment), _PLACES)
    function = ir.Function(module, ENTRY, _NAME)
    code = Code(ir.IRBuilder(function.append_basic_block()))
    b = code.builder
    operands, results = function.args
    call = code.array(len(_PLACES), I64)
    counts = data(b, operands, 0, I64)
    for i, name in enumerate(_COUNTS):
        code.store(code.load(counts, i), call, _PLACES[name])
    tables = [(name, operands, 1 + i) for i, name in enumerate(_OPERANDS)]
    tables += [(name, results, i) for i, name in enumerate(_RESULTS)]
    for name, among, i in tables:
        code.store(b.ptrtoint(data(b, among, i), I64), call, _PLACES[name])
    segments = code.load(counts, _COUNTS.index("segments"))
    code.store(segments, call, _PLACES["blocks"])
    code.store(code.i(0), call, _PLACES["next"])
    share(code, work, call, segments, code.load(counts, _COUNTS.index("threads")))
    b.ret_void()
    (address,) = compiled(module, _NAME)
    return address


def _segment(code: Code, call: ir.Value, segment: ir.Value) -> None:
    """All forces along one segment, in blocks."""
    b = code.builder
    samples, states, outputs, parts, columns = (code.load(call, _PLACES[name]) for name in _COUNTS[1:6])
    tables = (code.load(call, _PLACES[name]) for name in (*_OPERANDS, *_RESULTS))
    transition, readout, lands, sizes, start, read, end = (b.inttoptr(t, F64.as_pointer()) for t in tables)
    now, after, total = code.array(_MOST_STATES), code.array(_MOST_STATES), code.array(1)

    def entry(table: ir.Value, row: ir.Value, column: ir.Value, width: ir.Value) -> ir.Value:
        """Address of an entry in a table of rows of given width."""
        return code.place(table, code.plus(code.times(row, width), column))

    def lanes(place: ir.Value) -> ir.Value:
        return b.bitcast(place, code.pointers)

    def add(table: ir.Value, row: ir.Value, index: ir.Value, width: ir.Value, factor: ir.Value) -> None:
        product = code.mul(code.spread(b.load(entry(table, row, index, width))), factor)
        code.store(code.add(code.load(total, 0), product), total, 0)

    def of_state(table: ir.Value, row: ir.Value) -> ir.Value:
        """A row of a table times the state, added to a value."""
        with code.loop(states) as j:
            add(table, row, j, states, code.load(now, j))
        return code.load(total, 0)

    last = b.sub(columns, code.i(LANES))
    with code.loop(b.sdiv(code.plus(columns, LANES - 1), code.i(LANES))) as block:
        first = code.times(block, LANES)
        # The last block overlaps the one before it.
        first = b.select(b.icmp_signed("<", first, last), first, last)
        with code.loop(states) as j:
            row = code.plus(code.times(segment, states), j)
            code.store(code.load(lanes(entry(start, row, first, columns)), 0), now, j)
        with code.loop(samples) as sample:
            instant = code.plus(code.times(segment, samples), sample)
            with code.loop(outputs) as r:
                row = code.plus(code.times(instant, outputs), r)
                code.store(code.number(0.0), total, 0)
                code.store(of_state(readout, row), lanes(entry(read, row, first, columns)), 0)
            with code.loop(states) as r:
                row = code.plus(code.times(instant, states), r)
                code.store(code.number(0.0), total, 0)
                with code.loop(parts) as j:
                    size = code.load(lanes(entry(sizes, code.plus(code.times(instant, parts), j), first, columns)), 0)
                    add(lands, row, j, parts, size)
                code.store(of_state(transition, row), after, r)
            with code.loop(states) as r:
                code.store(code.load(after, r), now, r)
        with code.loop(states) as j:
            row = code.plus(code.times(segment, states), j)
            code.store(code.load(now, j), lanes(entry(end, row, first, columns)), 0)
