"""Programs of JAX that are compiled in a way of their own."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_Tree = TypeVar("_Tree")

# Programs are made for multiples of so many lanes.
_LANES = 32
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
        return (inside if is_traced(args, kwargs) or jax.default_backend() != "cpu" else outside)(*args, **kwargs)

    return called


def jit_small(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """`eqx.filter_jit` for programs of so little work that they are rather compiled in no time than well."""
    return jit_with(function, _SMALL)


def is_traced(*trees: Any) -> bool:
    """Whether trees are looked at from inside a program of JAX."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def library_of(*arrays: Any) -> Any:
    """What to calculate with: JAX inside its programs; outside it would compile one for each operation and shape, so
    there numpy."""
    return jnp if any(isinstance(array, Tracer) for array in arrays) else np


def some_at_a_time(program: Callable[..., Any], *arrays: Array | np.ndarray, most: int = _LANES) -> Any:
    """What a program of JAX makes of lanes, so many at a time that data of all sizes share few programs.

    Args:
        program: from arrays whose first axis is one of lanes to a tree of such arrays.
        arrays: of all lanes.
        most: lanes at a time; of a program that is called often, calls cost more than programs.
    """
    count = len(arrays[0])
    if count <= _LANES:
        return on_host(program(*(jnp.asarray(np.asarray(a)) for a in arrays)))
    size = -(-count // (_LANES * -(-count // most))) * _LANES
    places = (np.minimum(np.arange(start, start + size), count - 1) for start in range(0, count, size))
    found = [on_host(program(*(jnp.asarray(np.asarray(a)[own]) for a in arrays))) for own in places]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *found)


def on_host(tree: _Tree) -> _Tree:
    """The same with numpy's arrays, outside programs of JAX."""
    return tree if is_traced(tree) else jax.tree.map(np.asarray, tree)
