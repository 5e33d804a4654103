"""Lanes of one program shared among the devices of this machine."""

from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

_Tree = TypeVar("_Tree")
# With fewer lanes to each device, what the devices tell each other would take longer than what they save.
_LEAST_LANES = 8


def spread(tree: _Tree, lanes: int) -> _Tree:
    """Share the lanes of arrays among the devices of this process; every other array is on each of them.

    Compiled programs follow where their arrays are. Everything stays where it is on one device, where the lanes are
    few or can't be shared evenly, and where `jax.default_device` names a device.

    Args:
        tree: arrays whose first axis is `lanes` long carry one lane a row.
        lanes: how many there are.
    """
    if jax.config.jax_default_device is not None:
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
    return eqx.combine(jax.device_put(arrays, places), rest)
