"""Programs over any number of points: distributed over the devices, and block by block on each."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from hdjax.lanes import jit_lanes, spread

_TILE = 1 << 14
# A GPU takes the same time for any number up to about this, as measured with 132 multiprocessors.
_WIDE_TILE = 1 << 16
_LANES, _EVERYWHERE = PartitionSpec("lanes"), PartitionSpec()


def in_tiles(
    program: Callable[[Any, dict[str, Array]], Any],
    constants: Any,
    values: Mapping[str, np.ndarray],
    *,
    tile: int,
    block: int,
    checked: bool = False,
) -> Any:
    """Run a program over points, `tile` of them at a time: one shape of program for any number.

    Args:
        program: function of `constants` and a block's values that returns arrays with one point per row. A function at
            module level, or equal to a previous one, so that it is compiled once.
        constants: arrays that all points share.
        values: arrays with one point per row.
        tile: a power of two. The last tile is padded with the last point.
        block: points per pass on a CPU, so that they stay in its cache. Other devices process the whole tile, as
            sequential passes are slow there.
        checked: whether the program contains a Python callback, like those of diffrax. Such programs can't be cached on
            disk, and trying would need a second trace.
    """
    run = _checked_tile if checked else _tile
    if jax.default_backend() != "cpu":
        block = tile
    count = len(next(iter(values.values())))
    parts = []
    for begin in range(0, count, tile):
        own = {path: v[begin : begin + tile] for path, v in values.items()}
        filled = {path: jnp.asarray(_filled(v, tile)) for path, v in own.items()}
        # The same blocks on any number of devices, so that results are identical.
        shared = spread(filled, tile) if tile >= block * len(jax.local_devices()) else filled
        sharding = next(iter(shared.values())).sharding
        mesh = sharding.mesh if isinstance(sharding, NamedSharding) else None
        assert mesh is None or isinstance(mesh, Mesh)
        parts.append(run(program, constants, shared, mesh, block))
    # Results are fetched after the next tile has been started.
    rows = [jax.tree.map(np.asarray, part) for part in parts]
    return jax.tree.map(lambda *r: np.concatenate(r)[:count], *rows)


def _each_block(program: Callable, constants: Any, values: dict[str, Array], mesh: Mesh | None, block: int) -> Any:
    arrays, rest = eqx.partition(constants, eqx.is_array)

    def local(arrays: Any, values: dict[str, Array]) -> Any:
        points = len(next(iter(values.values())))
        size = min(block, points)
        blocks = jax.tree.map(lambda v: v.reshape(-1, size, *v.shape[1:]), values)
        found = jax.lax.map(lambda v: program(eqx.combine(arrays, rest), v), blocks)
        return jax.tree.map(lambda a: a.reshape(points, *a.shape[2:]), found)

    if mesh is None or mesh.size == 1:
        return local(arrays, values)
    places = {"in_specs": (_EVERYWHERE, _LANES), "out_specs": _LANES, "check_vma": False}
    return jax.shard_map(local, mesh=mesh, **places)(arrays, values)


_tile, _checked_tile = jit_lanes(_each_block), eqx.filter_jit(_each_block)


def _filled(rows: np.ndarray, tile: int) -> np.ndarray:
    """Rows of a whole tile, of which the last one is repeated."""
    return np.pad(rows, [(0, tile - len(rows)), *[(0, 0)] * (rows.ndim - 1)], mode="edge")


def tile_for(points: int) -> int:
    """The smallest power of two for so many points, up to a limit."""
    most = _TILE if jax.default_backend() == "cpu" else _WIDE_TILE
    return min(most, 1 << max(points - 1, 63).bit_length())
