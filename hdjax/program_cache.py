"""Compiled programs that outlive their process: what is kept need neither be traced nor lowered nor compiled again.

JAX's own cache spares a new process the compiling alone: it looks there with a program that has been traced and
lowered, which takes longer than many a fit. Here a program is looked up by what it is made from: the function and all
source of this project, the versions of what it stands on, JAX's settings, the processor and its devices, and the
[`fingerprint`][hdjax.fingerprint.fingerprint] of the arguments. What has no fingerprint, or calls back into Python, is
compiled as always.

Programs are kept in a folder of JAX's compilation cache (`jax_compilation_cache_dir`), and nowhere where that is not
set. They are machine code and pickles: whoever may write there may run code, as with JAX's own.
"""

import contextlib
import enum
import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import pickle
import platform
import re
import sys
import tempfile
import uuid
import zlib
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from hdjax.fingerprint import OWN_PACKAGES, PACKAGES, UnknownCode, fingerprint

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_Program = Callable[[list[Any]], Any]

# Programs that have not been used for longest go where all of them take more room than this [bytes].
_MOST_BYTES = 256 * 2**20
_SUFFIX = ".program"
_DIGEST = hashlib.sha256().digest_size
# Calls out of a program, and those that mean the same in every process: a Python callback is an address in this one.
_CALL = re.compile(r"custom_call @\"?([\w.]+)")
_LASTING_CALL = re.compile(r"lapack_\w+|ducc_fft\w*|Sharding|SPMD\w+")
_LAPACK = "lapack_"


def jit_kept(function: Callable[_Arguments, _Result], **options: Any) -> Callable[_Arguments, _Result]:
    """`eqx.filter_jit` whose programs are kept between processes, where JAX keeps those that it compiles.

    Inside another program, or where JAX keeps nothing, it is `eqx.filter_jit`.

    Args:
        function: a function of a module, not one made inside another.
        options: of `jax.jit`.
    """
    plain = eqx.filter_jit(function, **options)
    programs: dict[Hashable, _Program | None] = {}

    @functools.wraps(function)
    def call(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        folder = _folder()
        leaves, structure = jax.tree.flatten((args, kwargs))
        if folder is None or any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return plain(*args, **kwargs)
        try:
            key = (structure, *map(_kind, leaves), *_settings().values())
            program = programs[key]
        except KeyError:
            program = programs[key] = _program(folder, function, options, (args, kwargs))
        if program is None:
            return plain(*args, **kwargs)
        return program(_arrays(leaves))

    return call


def _folder() -> Path | None:
    """Where programs are kept; None where they are not."""
    settings = _settings()
    place = settings["jax_compilation_cache_dir"]
    if place is None or "://" in place or not settings["jax_enable_compilation_cache"] or settings["jax_disable_jit"]:
        return None
    return Path(place) / "programs"


def _kind(leaf: Any) -> Hashable:
    """What of an argument's leaf a compiled program depends on."""
    if isinstance(leaf, jax.Array):
        return (leaf.shape, leaf.dtype, leaf.weak_type, leaf.sharding, leaf.committed)
    if eqx.is_array(leaf):
        return (leaf.shape, leaf.dtype)
    return (type(leaf), leaf)


def _arrays(leaves: Sequence[Any]) -> list[Any]:
    return [leaf for leaf in leaves if eqx.is_array(leaf)]


class _Entry(NamedTuple):
    """A program as it is kept.

    Attributes:
        executable: what XLA has made.
        arguments: structure of what it takes.
        results: structure of what it gives.
        devices: identities of the devices that it runs on, in its order.
        calls: libraries' functions that it calls.
        returned: what the function returns, with holes in place of arrays.
    """

    executable: bytes
    arguments: jax.tree_util.PyTreeDef
    results: jax.tree_util.PyTreeDef
    devices: tuple[int, ...]
    calls: frozenset[str]
    returned: Any


class _Hole(enum.Enum):
    """Stands for an array in a tree; an enumeration is the same object in every process."""

    ARRAY = enum.auto()


def _frame(tree: Any) -> Any:
    """A tree with holes in place of its arrays."""
    return jax.tree.map(lambda leaf: _Hole.ARRAY if eqx.is_array(leaf) else leaf, tree)


def _filled(frame: Any, arrays: Sequence[Any]) -> Any:
    """The tree again, with arrays in its holes."""
    found = iter(arrays)
    return jax.tree.map(lambda leaf: next(found) if leaf is _Hole.ARRAY else leaf, frame)


def _program(folder: Path, function: Callable, options: dict[str, Any], arguments: Any) -> _Program | None:
    """A program for such arguments; None where it can't be kept."""
    try:
        path = folder / (_key(function, options, arguments) + _SUFFIX)
    except UnknownCode:
        return None
    entry = _read(path)
    loaded = None if entry is None else _load(entry)
    if entry is not None and loaded is not None:
        _touch(path)
        return _calling(loaded, entry.returned)
    return _made(path, function, options, arguments)


def _key(function: Callable, options: dict[str, Any], arguments: Any) -> str:
    """Digest of all that a program is made from."""
    name = f"{function.__module__}.{function.__qualname__}"
    if "<" in name or name.split(".")[0] not in OWN_PACKAGES:
        raise UnknownCode(f"{name} is not of a module of this project")
    settings = sorted((name, str(value)) for name, value in _settings().items())
    made_from = (name, sorted(options.items()), settings, surroundings(), _source(), fingerprint(arguments))
    return hashlib.sha256(repr(made_from).encode()).hexdigest()


def _settings() -> dict[str, Any]:
    return jax.config.values  # pyright: ignore[reportAttributeAccessIssue]


def surroundings() -> tuple[str, ...]:
    """What compiled programs depend on besides function, settings and arguments: versions, processor and devices.

    Raises:
        UnknownCode: where that can't be told.
    """
    devices = [f"{d.platform} {d.device_kind} {d.id} {d.process_index}" for d in jax.devices()]
    return (*_versions(), *devices, *_processor(), os.environ.get("XLA_FLAGS", ""))


@functools.cache
def _versions() -> tuple[str, ...]:
    return (sys.version, *(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES))


@functools.cache
def _processor() -> tuple[str, ...]:
    """What the processor can do: code for another one may end the process."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
    except OSError as error:
        raise UnknownCode("only Linux says what its processor can do") from error
    telling = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU ")
    return (platform.machine(), str(os.cpu_count()), *(line for line in lines if line.startswith(telling)))


@functools.cache
def _source() -> str:
    """Digest of all source files of this project."""
    digest = hashlib.sha256()
    for package in OWN_PACKAGES:
        found = importlib.util.find_spec(package)
        for folder in [] if found is None else found.submodule_search_locations or []:
            for path in sorted(Path(folder).rglob("*.py")):
                digest.update(f"{package}/{path.relative_to(folder)}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _made(path: Path, function: Callable, options: dict[str, Any], arguments: Any) -> _Program | None:
    """A program compiled now, and kept under `path`; None where it can't be kept."""
    frame, returned = _frame(arguments), []

    def program(arrays: list[Any]) -> list[Any]:
        args, kwargs = _filled(frame, arrays)
        result = function(*args, **kwargs)
        returned.append(_frame(result))
        return _arrays(jax.tree.leaves(result))

    # XLA can't write down what JAX's cache has read, so JAX must not find it there: a name that nothing else has.
    program.__name__ = f"{function.__name__}_{uuid.uuid4().hex}"
    lowered = jax.jit(program, **options).lower(_arrays(jax.tree.leaves(arguments)))
    text = lowered.as_text()
    calls = _CALL.findall(text)
    if len(calls) < text.count("custom_call") or not all(_LASTING_CALL.fullmatch(name) for name in calls):
        return None
    compiled = lowered.compile()
    _write(path, compiled, frozenset(calls), returned[-1])
    return _calling(compiled, returned[-1])


def _calling(compiled: jax.stages.Compiled, returned: Any) -> _Program:
    return lambda arrays: _filled(returned, compiled(arrays))


def _read(path: Path) -> _Entry | None:
    """What is kept under `path`; None where nothing is, or nothing whole."""
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


def _write(path: Path, compiled: jax.stages.Compiled, calls: frozenset[str], returned: Any) -> None:
    """Keep a program, or do nothing where that does not go."""
    try:
        executable, arguments, results = serialize(compiled)
        entry = _Entry(executable, arguments, results, _devices(compiled), calls, returned)
        pickled = pickle.dumps(entry)
        # A result may hold what a pickle does not bring back as it was.
        if not _same(pickle.loads(pickled).returned, returned):
            return
    except (
        ValueError,
        TypeError,
        AttributeError,
        NotImplementedError,
        pickle.PicklingError,
        jax.errors.JaxRuntimeError,
    ):
        # Results of unknown make, or an executable that XLA does not write down.
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
        if isinstance(sharding, jax.sharding.NamedSharding):
            return tuple(device.id for device in sharding.mesh.devices.flat)
    ((device,),) = {frozenset(sharding.device_set) for sharding in shardings}
    return (device.id,)


def _touch(path: Path) -> None:
    with contextlib.suppress(OSError):
        os.utime(path)


def _make_room(folder: Path, size: int) -> None:
    """Drop the programs that have not been used for longest, where all of them would take too much room."""
    kept = sorted(((p.stat().st_mtime, p.stat().st_size, p) for p in folder.iterdir()), reverse=True)
    for _, own, path in kept:
        size += own
        if size > _MOST_BYTES:
            path.unlink(missing_ok=True)
