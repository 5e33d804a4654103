"""Parallel processing of blocks of lanes, by threads that the machine code creates."""

from collections.abc import Callable, Mapping

from llvmlite import ir

from hdjax.engine.code import Code
from hdjax.engine.emission import I32, I64
from hdjax.engine.handler import POINTER

MOST_THREADS = 64


def block_of(module: ir.Module, write: Callable[[Code, ir.Value, ir.Value], None]) -> ir.Function:
    """The function `block(call, index)` of a module.

    Args:
        module: to which it is added.
        write: its instructions, with the table of the call and the block's index.
    """
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [I64.as_pointer(), I64]), "block")
    function.linkage = "internal"
    function.attributes.add("nounwind")
    code = Code(ir.IRBuilder(function.append_basic_block()))
    write(code, *function.args)
    code.builder.ret_void()
    return function


def worker(module: ir.Module, block: ir.Function, call: Mapping[str, int]) -> ir.Function:
    """A function that processes blocks until none remain.

    Args:
        module: to which it is added.
        block: function of one block, see [`block_of`][].
        call: indices in the table of a call; `next` and `blocks` hold the next block and the number of blocks.
    """
    function = ir.Function(module, ir.FunctionType(POINTER, [POINTER]), "worker")
    function.linkage = "internal"
    code = Code(ir.IRBuilder(function.append_basic_block()))
    b = code.builder
    table = b.bitcast(function.args[0], I64.as_pointer())
    head, work, done = (function.append_basic_block() for _ in range(3))
    b.branch(head)
    b.position_at_end(head)
    index = b.atomic_rmw("add", code.place(table, call["next"]), code.i(1), "monotonic")
    b.cbranch(b.icmp_signed("<", index, code.load(table, call["blocks"])), work, done)
    b.position_at_end(work)
    b.call(block, [table, index])
    b.branch(head)
    b.position_at_end(done)
    b.ret(ir.Constant(POINTER, None))
    return function


def share(code: Code, worker: ir.Function, call: ir.Value, blocks: ir.Value, wanted: ir.Value) -> None:
    """Process blocks in this thread, and in as many others as are wanted and useful.

    Args:
        code: instructions of a function's first block.
        worker: see [`worker`][].
        call: the table of the call.
        blocks: their number.
        wanted: threads.
    """
    b = code.builder
    threads, made = code.array(MOST_THREADS, I64), code.array(1, I64)
    none = ir.Constant(POINTER, None)
    kinds = {
        "pthread_create": [I64.as_pointer(), POINTER, worker.type, POINTER],
        "pthread_join": [I64, POINTER.as_pointer()],
    }
    make, join = (ir.Function(b.module, ir.FunctionType(I32, kind), name) for name, kind in kinds.items())
    work = b.bitcast(call, POINTER)

    def least(x: ir.Value, y: ir.Value) -> ir.Value:
        return b.select(b.icmp_signed("<", x, y), x, y)

    others = code.plus(least(least(wanted, blocks), code.i(MOST_THREADS)), -1)
    code.store(code.i(0), made, 0)
    with code.loop(others):
        so_far = code.load(made, 0)
        failed = b.call(make, [code.place(threads, so_far), none, worker, work])
        # If a thread can't be created, the others process its blocks.
        well = b.zext(b.icmp_signed("==", failed, ir.Constant(failed.type, 0)), I64)
        code.store(code.plus(so_far, well), made, 0)
    b.call(worker, [work])
    with code.loop(code.load(made, 0)) as k:
        b.call(join, [code.load(threads, k), ir.Constant(POINTER.as_pointer(), None)])
