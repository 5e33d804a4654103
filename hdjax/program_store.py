"""A folder of compiled programs: written whole, checked before they are loaded, and dropped when there are too many."""

import contextlib
import functools
import hashlib
import os
import pickle
import tempfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize

# Programs that have not been used for longest go where all of them take more room than this [bytes].
_MOST_BYTES = 256 * 2**20
_DIGEST = hashlib.sha256().digest_size
_LAPACK = "lapack_"


class _Entry(NamedTuple):
    """A program as it is kept.

    Attributes:
        executable: what XLA has made.
        arguments: structure of what it takes.
        results: structure of what it gives.
        devices: identities of the devices that it runs on, in its order.
        calls: libraries' functions that it calls.
        beside: what belongs to it.
    """

    executable: bytes
    arguments: Any
    results: Any
    devices: tuple[int, ...]
    calls: frozenset[str]
    beside: Any


def stored(path: Path) -> tuple[jax.stages.Compiled, Any] | None:
    """A program from a file, and what was kept beside it; None where there is no file, or none that is whole."""
    entry = _read(path)
    program = None if entry is None else _load(entry)
    if entry is None or program is None:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return program, entry.beside


def store(path: Path, compiled: jax.stages.Compiled, *, calls: frozenset[str], beside: Any) -> None:
    """Write a program to a file, or do nothing where that does not go.

    Args:
        path: of the file; older programs in its folder may have to go.
        compiled: what XLA compiled itself: it can't write down what it has read.
        calls: libraries' functions that it calls.
        beside: anything that a pickle brings back as it was.
    """
    try:
        executable, arguments, results = serialize(compiled)
        entry = _Entry(executable, arguments, results, _devices(compiled), calls, beside)
        pickled = pickle.dumps(entry)
        if not _same(pickle.loads(pickled).beside, beside):
            return
    except (
        ValueError,
        TypeError,
        AttributeError,
        NotImplementedError,
        pickle.PicklingError,
        jax.errors.JaxRuntimeError,
    ):
        # An executable that XLA does not write down, or something of unknown make beside it.
        return
    packed = zlib.compress(pickled, 1)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        _make_room(path.parent, len(packed))
        # Beside its place first: nobody reads half a program.
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(packed).digest() + packed)
            os.replace(name, path)
        except OSError:
            os.unlink(name)


def _read(path: Path) -> _Entry | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, packed = content[:_DIGEST], content[_DIGEST:]
    # Checked before anything is made of it: spoilt machine code would end the process.
    if hashlib.sha256(packed).digest() != digest:
        return None
    return pickle.loads(zlib.decompress(packed))


def _load(entry: _Entry) -> jax.stages.Compiled | None:
    """The program of an entry; None where XLA does not take it."""
    if any(name.startswith(_LAPACK) for name in entry.calls):
        _load_lapack()
    devices = {device.id: device for device in jax.devices()}
    try:
        return deserialize_and_load(
            entry.executable,
            entry.arguments,
            entry.results,
            execution_devices=[devices[i] for i in entry.devices],
        )
    except jax.errors.JaxRuntimeError:
        return None


@functools.cache
def _load_lapack() -> None:
    """Point XLA's calls of LAPACK to the library.

    JAX does so where it lowers such a call. A program that comes without lowering would jump to an empty address (jax
    issue 28908).
    """
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))


def _same(one: Any, other: Any) -> bool:
    (own, structure), (its, other_structure) = map(jax.tree.flatten, (one, other))
    return structure == other_structure and own == its


def _devices(compiled: jax.stages.Compiled) -> tuple[int, ...]:
    """Identities of a program's devices in its order.

    Raises:
        ValueError: where that can't be told.
    """
    shardings = jax.tree.leaves((compiled.input_shardings, compiled.output_shardings))
    for sharding in shardings:
        if isinstance(sharding, jax.sharding.NamedSharding) and isinstance(sharding.mesh, jax.sharding.Mesh):
            return tuple(device.id for device in sharding.mesh.devices.flat)
    # One device, or nothing that could be told.
    ((device,),) = {frozenset(sharding.device_set) for sharding in shardings}
    return (device.id,)


def _make_room(folder: Path, size: int) -> None:
    """Drop the programs that have not been used for longest, where all of them would take too much room."""
    kept = sorted(((p.stat().st_mtime, p.stat().st_size, p) for p in folder.iterdir()), reverse=True)
    for _, own, path in kept:
        size += own
        if size > _MOST_BYTES:
            path.unlink(missing_ok=True)
