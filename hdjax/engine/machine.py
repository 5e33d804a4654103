"""Compilation of LLVM code for this processor."""

import functools
import threading
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir

_LOCK = threading.Lock()
_KEPT: list[Any] = []


@functools.cache
def target() -> Any:
    """Target machine of this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # Vectors of 512 bits, where available, are twice as fast here as those that compilers prefer.
    features = llvm.get_host_cpu_features().flatten() + ",-prefer-256-bit"
    triple = llvm.Target.from_default_triple()
    return triple.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=1, jit=True)


def compiled(module: ir.Module, *names: str) -> list[int]:
    """Compile a module; it stays in memory as long as the process.

    Args:
        module: in LLVM's language.
        names: of functions in it.

    Returns:
        The address of each function.
    """
    with _LOCK:
        machine = target()
        module.triple = llvm.get_process_triple()
        parsed = llvm.parse_assembly(str(module))
        # No optimisation passes: the graph has no common subexpressions, and passes would save a few per cent of run
        # time for most of the compilation time.
        engine = llvm.create_mcjit_compiler(parsed, machine)
        engine.finalize_object()
        _KEPT.append(engine)
        return [engine.get_function_address(name) for name in names]
