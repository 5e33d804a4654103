"""Programs of many lanes: compiled for wide vectors, and distributed over the devices of this machine."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from hdjax.compilation import jit_small, jit_with

_Tree = TypeVar("_Tree")
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
# The stages of a Runge-Kutta step then fit into wide registers: twice as fast.
_WIDE: dict[str, Any] = {"xla_cpu_prefer_vector_width": 512}
# With fewer lanes per device, communication would take longer than it saves.
_LEAST_LANES = 8


def jit_lanes(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """`eqx.filter_jit` for programs with lanes of [`hdjax.simulate.march`][], compiled for wide vectors and distributed
    over the devices of their arrays."""
    return _on_devices(function, jit_with(function, _WIDE))


def jit_small_lanes(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """[`jit_lanes`][] for programs of little work, as [`jit_small`][hdjax.compilation.jit_small]."""
    return _on_devices(function, jit_small(function))


def _on_devices(
    function: Callable[_Arguments, _Result], jitted: Callable[_Arguments, _Result]
) -> Callable[_Arguments, _Result]:
    @functools.wraps(function)
    def called(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        args, kwargs = _together((args, kwargs))
        return jitted(*args, **kwargs)

    return called


def _together(tree: _Tree) -> _Tree:
    """The same arrays, all on the devices that share the lanes; otherwise the program would be compiled again."""
    mesh = next((a.sharding.mesh for a in jax.tree.leaves(tree) if _is_shared(a)), None)
    if mesh is None:
        return tree
    everywhere = NamedSharding(mesh, PartitionSpec())

    def placed(leaf: Any) -> Any:
        return jax.device_put(np.asarray(leaf), everywhere) if eqx.is_array(leaf) and not _is_shared(leaf) else leaf

    return jax.tree.map(placed, tree)


def _is_shared(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and isinstance(leaf.sharding, NamedSharding)


def on_one_device(tree: _Tree) -> _Tree:
    """The same arrays on one device, for little work."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)) if _is_shared(leaf) else leaf, tree)


def placed_like(tree: _Tree, like: _Tree) -> _Tree:
    """The same arrays, placed like those of another tree."""

    def placed(leaf: Any, other: Any) -> Any:
        return jax.device_put(np.asarray(leaf), other.sharding) if _is_shared(other) else leaf

    return jax.tree.map(placed, tree, like)


def spread(tree: _Tree, lanes: int) -> _Tree:
    """Distribute the lanes of arrays over the devices of this process; other arrays are replicated.

    Compiled programs follow their arrays. Nothing is distributed on a single device, for few lanes or an uneven number,
    or if `jax.default_device` names a device.

    Args:
        tree: arrays with a first axis of length `lanes` have one lane per row.
        lanes: their number.
    """
    if jax.config.jax_default_device is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return tree
    devices = jax.local_devices()
    while len(devices) > 1 and (lanes % len(devices) or lanes // len(devices) < _LEAST_LANES):
        devices = devices[:-1]
    if len(devices) == 1:
        return tree
    mesh = Mesh(np.array(devices), ("lanes",), axis_types=(AxisType.Auto,))
    shared, everywhere = NamedSharding(mesh, PartitionSpec("lanes")), NamedSharding(mesh, PartitionSpec())
    arrays, rest = eqx.partition(tree, eqx.is_array)
    places = jax.tree.map(lambda a: shared if a.ndim and a.shape[0] == lanes else everywhere, arrays)
    # Via the host: JAX would compile a program for each shape of slices.
    hosts = jax.tree.map(np.asarray, arrays)
    return eqx.combine(jax.device_put(hosts, places), rest)
