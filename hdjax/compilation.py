"""Programs of JAX that are compiled in a way of their own."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

# Compiling well takes longer than what it saves where there is little work.
_SMALL: dict[str, Any] = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def jit_with(
    function: Callable[_Arguments, _Result], compiler_options: dict[str, Any]
) -> Callable[_Arguments, _Result]:
    """`eqx.filter_jit` with options of the compiler for processors; without them inside another program, which has
    options of its own, and on other devices, whose compiler does not know them."""
    options: Any = {"compiler_options": compiler_options}
    outside, inside = eqx.filter_jit(function, **options), eqx.filter_jit(function)

    @functools.wraps(function)
    def called(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs)))
        return (inside if traced or jax.default_backend() != "cpu" else outside)(*args, **kwargs)

    return called


def jit_small(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """`eqx.filter_jit` for programs of so little work that they are rather compiled in no time than well."""
    return jit_with(function, _SMALL)
