"""A linear system of given transitions under many forces, side by side in machine code."""

import functools

import numpy as np
from jaxtyping import Float
from llvmlite import ir

from hdjax.engine.code import LANES, Code
from hdjax.engine.emission import I64
from hdjax.engine.handler import ENTRY, called, data
from hdjax.engine.machine import compiled

_MOST_STATES = 64
_NAME = "linear_response"


def linear_response(
    transition: Float[np.ndarray, "segments samples states states"],
    readout: Float[np.ndarray, "segments samples outputs states"],
    pushed: Float[np.ndarray, "segments samples states columns"],
    start: Float[np.ndarray, "segments states columns"],
) -> tuple[Float[np.ndarray, "segments samples outputs columns"], Float[np.ndarray, "segments states columns"]]:
    """Outputs at the samples, and the state in which each segment ends.

    Args:
        transition: of the state through each sample interval.
        readout: of the outputs from the state.
        pushed: what each force adds to the state by the end of each interval.
        start: where each segment starts.
    """
    segments, samples, states, columns = pushed.shape
    if states > _MOST_STATES:
        raise ValueError(f"`pushed` must have at most {_MOST_STATES} states, but has {states}")
    if columns < LANES:
        more = [(0, 0)] * 3 + [(0, LANES - columns)]
        outputs, end = linear_response(transition, readout, np.pad(pushed, more), np.pad(start, more[1:]))
        return outputs[..., :columns], end[..., :columns]
    outputs = np.empty((segments, samples, readout.shape[2], columns))
    end = np.empty((segments, states, columns))
    sizes = np.array([segments, samples, states, outputs.shape[2], columns])
    operands = [sizes, *map(np.ascontiguousarray, (transition, readout, pushed, start))]
    called(_address(), operands, [outputs, end])
    return outputs, end


@functools.cache
def _address() -> int:
    module = ir.Module(_NAME)
    function = ir.Function(module, ENTRY, _NAME)
    code = Code(ir.IRBuilder(function.append_basic_block()))
    b = code.builder
    operands, results = function.args
    sizes = data(b, operands, 0, I64)
    segments, samples, states, outputs, columns = (code.load(sizes, i) for i in range(5))
    transition, readout, pushed, start = (data(b, operands, i) for i in range(1, 5))
    read, end = (data(b, results, i) for i in range(2))
    now, after, total = code.array(_MOST_STATES), code.array(_MOST_STATES), code.array(1)

    def entry(table: ir.Value, row: ir.Value, column: ir.Value, width: ir.Value) -> ir.Value:
        """A place in a table of rows so wide."""
        return code.place(table, code.plus(code.times(row, width), column))

    def lanes(place: ir.Value) -> ir.Value:
        return b.bitcast(place, code.pointers)

    def product(table: ir.Value, row: ir.Value, begin: ir.Value) -> ir.Value:
        """A row of a table times the state, added to something."""
        code.store(begin, total, 0)
        with code.loop(states) as j:
            weight = code.spread(b.load(entry(table, row, j, states)))
            code.store(code.add(code.load(total, 0), code.mul(weight, code.load(now, j))), total, 0)
        return code.load(total, 0)

    last = b.sub(columns, code.i(LANES))
    blocks = b.sdiv(code.plus(columns, LANES - 1), code.i(LANES))
    with code.loop(segments) as segment, code.loop(blocks) as block:
        first = code.times(block, LANES)
        # The last block takes some columns of the one before it once more.
        first = b.select(b.icmp_signed("<", first, last), first, last)
        with code.loop(states) as j:
            row = code.plus(code.times(segment, states), j)
            code.store(code.load(lanes(entry(start, row, first, columns)), 0), now, j)
        with code.loop(samples) as sample:
            instant = code.plus(code.times(segment, samples), sample)
            with code.loop(outputs) as r:
                row = code.plus(code.times(instant, outputs), r)
                code.store(product(readout, row, code.number(0.0)), lanes(entry(read, row, first, columns)), 0)
            with code.loop(states) as r:
                row = code.plus(code.times(instant, states), r)
                own = code.load(lanes(entry(pushed, row, first, columns)), 0)
                code.store(product(transition, row, own), after, r)
            with code.loop(states) as r:
                code.store(code.load(after, r), now, r)
        with code.loop(states) as j:
            row = code.plus(code.times(segment, states), j)
            code.store(code.load(now, j), lanes(entry(end, row, first, columns)), 0)
    b.ret_void()
    (address,) = compiled(module, _NAME)
    return address
