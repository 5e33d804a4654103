"""JAX programs with special compiler options."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_Tree = TypeVar("_Tree")

# Options for fast compilation, since optimisation takes longer than it saves for little work.
_SMALL: dict[str, Any] = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def jit_with(
    function: Callable[_Arguments, _Result], compiler_options: dict[str, Any]
) -> Callable[_Arguments, _Result]:
    """`eqx.filter_jit` with compiler options for CPUs; without them inside another program, which has its own, and on
    other devices, which do not support them."""
    options: Any = {"compiler_options": compiler_options}
    outside, inside = eqx.filter_jit(function, **options), eqx.filter_jit(function)

    @functools.wraps(function)
    def called(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        return (inside if is_traced(args, kwargs) or jax.default_backend() != "cpu" else outside)(*args, **kwargs)

    return called


def jit_small(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """`eqx.filter_jit` for programs of little work, compiled fast instead of optimised."""
    return jit_with(function, _SMALL)


def is_traced(*trees: Any) -> bool:
    """Whether trees contain tracers of a JAX program."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def library_of(*arrays: Any) -> Any:
    """The array library: JAX under tracing; numpy outside, where JAX would compile each operation and shape."""
    return jnp if any(isinstance(array, Tracer) for array in arrays) else np


def on_host(tree: _Tree) -> _Tree:
    """The same with numpy arrays, outside JAX programs."""
    return tree if is_traced(tree) else jax.tree.map(np.asarray, tree)
