"""Machine code for this processor, from LLVM's language."""

import functools
import threading
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir

_LOCK = threading.Lock()
_KEPT: list[Any] = []


@functools.cache
def target() -> Any:
    """What this processor can do."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # Vectors of 512 bits, where there are any, are twice as fast here as those that compilers prefer.
    features = llvm.get_host_cpu_features().flatten() + ",-prefer-256-bit"
    triple = llvm.Target.from_default_triple()
    return triple.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=1, jit=True)


def compiled(module: ir.Module, *names: str) -> list[int]:
    """Compile a module; it stays in memory as long as the process.

    Args:
        module: in LLVM's language.
        names: functions in it.

    Returns:
        The address of each function.
    """
    with _LOCK:
        machine = target()
        module.triple = llvm.get_process_triple()
        parsed = llvm.parse_assembly(str(module))
        # No passes of optimisation: the graph has no expression twice, and all that they gain here is a few per cent
        # of the run for most of the time that a compilation takes.
        engine = llvm.create_mcjit_compiler(parsed, machine)
        engine.finalize_object()
        _KEPT.append(engine)
        return [engine.get_function_address(name) for name in names]
