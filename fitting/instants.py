"""What depends on an instant alone, a fixed number of instants at a time: one program serves logs of all lengths."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

_Found = TypeVar("_Found")

INSTANTS = 1 << 15
"""How many a program takes at once."""


def at_instants(program: Callable[..., _Found], shape: tuple[int, ...], *looked_at: Any) -> _Found:
    """What a program finds at each of many instants.

    Args:
        program: from trees of arrays whose first axis has [`INSTANTS`][] places, one for each instant, to another.
        shape: of the instants.
        looked_at: trees of arrays that all begin with these axes.

    Returns:
        What the program returns, with these axes in place of its first.
    """
    return through_instants(lambda _, *pieces: (None, program(*pieces)), None, shape, *looked_at)


def through_instants(
    program: Callable[..., tuple[Any, _Found]], carried: Any, shape: tuple[int, ...], *looked_at: Any
) -> _Found:
    """[`at_instants`][] of a program that goes from each instant to the next: it takes, before all else, what it
    returned first the last time.

    Args:
        program: likewise.
        carried: what it takes at first.
        shape: likewise.
        looked_at: likewise.
    """
    many = int(np.prod(shape))

    def rows(array: Any) -> np.ndarray:
        array = np.asarray(array)
        return array.reshape(many, *array.shape[len(shape) :])

    def piece(array: np.ndarray, start: int) -> jax.Array:
        part = array[start : start + INSTANTS]
        # The last piece is filled up with what it ends with.
        return jnp.asarray(np.pad(part, [(0, INSTANTS - len(part))] + [(0, 0)] * (part.ndim - 1), mode="edge"))

    def joined(*parts: Any) -> jax.Array:
        whole = np.concatenate([np.asarray(part) for part in parts])[:many]
        return jnp.asarray(whole.reshape(*shape, *whole.shape[1:]))

    flat = jax.tree.map(rows, looked_at)
    found = []
    for start in range(0, many, INSTANTS):
        carried, here = program(carried, *jax.tree.map(lambda a, start=start: piece(a, start), flat))
        found.append(here)
    return jax.tree.map(joined, *found)
