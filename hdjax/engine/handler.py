"""Calls of machine code from JAX programs: the address is an operand, so that one program serves all models."""

import ctypes
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from llvmlite import ir

from hdjax.engine.emission import F64, I8, I32, I64
from hdjax.engine.machine import compiled

POINTER = I8.as_pointer()
ENTRY = ir.FunctionType(ir.VoidType(), [POINTER.as_pointer(), POINTER.as_pointer()])
"""Type of the function at the address: of the tables of operands (the first is the address) and results."""

TARGET = "hdjax_machine_code"

# Offsets in the structures of XLA's foreign-function interface (xla/ffi/api/c_api.h, version 0.3).
_EXTENSION, _OPERANDS, _RESULTS = 8, 72, 112
_METADATA, _MAJOR, _MINOR = 24, 24, 28
_DATA, _DIMENSIONS = 24, 40
_VERSION = (0, 3)


def at(builder: Any, base: ir.Value, offset: int, kind: ir.Type) -> ir.Value:
    """The value at an offset in bytes."""
    place = builder.gep(base, [ir.Constant(I64, offset)])
    return builder.load(builder.bitcast(place, kind.as_pointer()))


def data(builder: Any, table: ir.Value, index: int, kind: ir.Type = F64) -> ir.Value:
    """Address of the numbers of an operand or a result."""
    buffer = builder.load(builder.gep(table, [ir.Constant(I64, index)]))
    return builder.bitcast(at(builder, buffer, _DATA, POINTER), kind.as_pointer())


def dimension(builder: Any, table: ir.Value, index: int, axis: int) -> ir.Value:
    """Length of an axis of an operand or a result."""
    buffer = builder.load(builder.gep(table, [ir.Constant(I64, index)]))
    return at(builder, at(builder, buffer, _DIMENSIONS, POINTER), 8 * axis, I64)


@functools.cache
def register() -> str:
    """Register the handler with XLA once; returns its name."""
    module = ir.Module(TARGET)
    function = ir.Function(module, ir.FunctionType(POINTER, [POINTER]), TARGET)
    frame = function.args[0]
    builder = ir.IRBuilder(function.append_basic_block())
    asked, runs = function.append_basic_block(), function.append_basic_block()
    extension = at(builder, frame, _EXTENSION, POINTER)
    is_asked = builder.icmp_unsigned("!=", builder.ptrtoint(extension, I64), ir.Constant(I64, 0))
    builder.cbranch(is_asked, asked, runs)
    builder.position_at_end(asked)
    metadata = at(builder, extension, _METADATA, POINTER)
    for offset, value in zip((_MAJOR, _MINOR), _VERSION, strict=True):
        place = builder.gep(metadata, [ir.Constant(I64, offset)])
        builder.store(ir.Constant(I32, value), builder.bitcast(place, I32.as_pointer()))
    builder.ret(ir.Constant(POINTER, None))
    builder.position_at_end(runs)
    operands, results = (at(builder, frame, o, POINTER.as_pointer()) for o in (_OPERANDS, _RESULTS))
    address = builder.load(data(builder, operands, 0, I64))
    builder.call(builder.inttoptr(address, ENTRY.as_pointer()), [operands, results])
    builder.ret(ir.Constant(POINTER, None))
    (handler,) = compiled(module, TARGET)
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype, capsule.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    jax.ffi.register_ffi_target(TARGET, capsule(handler, b"xla._CUSTOM_CALL_TARGET", None), platform="cpu")
    return TARGET


def called(address: int, operands: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
    """Call machine code from Python, without JAX's compilation per array shape.

    Args:
        address: of the code.
        operands: inputs.
        results: outputs.
    """
    kept = []

    def table(arrays: Sequence[np.ndarray]) -> int:
        buffers = np.zeros((len(arrays), _DIMENSIONS // 8 + 1), np.int64)
        for buffer, array in zip(buffers, arrays, strict=True):
            kept.append(np.array(array.shape, np.int64))
            buffer[_DATA // 8], buffer[_DIMENSIONS // 8] = array.ctypes.data, kept[-1].ctypes.data
        places = buffers.ctypes.data + buffers.strides[0] * np.arange(len(arrays))
        kept.extend([buffers, places])
        return places.ctypes.data

    code = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(address)
    code(table(operands), table(results))
