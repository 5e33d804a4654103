"""Compiled programs that outlive their process: what is kept need neither be traced nor lowered nor compiled again.

JAX's own cache spares a new process the compiling alone: it looks there with a program that has been traced and
lowered, which takes longer than many a fit. Here a program is looked up by what it is made from: the function and all
source of this project, the versions of what it stands on, JAX's settings, the processor and its devices, and the
[`fingerprint`][hdjax.fingerprint.fingerprint] of the arguments. What has no fingerprint, or calls back into Python, is
compiled as always.

Programs are kept in a folder of JAX's compilation cache (`jax_compilation_cache_dir`), and nowhere where that is not
set. They are machine code and pickles: whoever may write there may run code, as with JAX's own.
"""

import enum
import functools
import hashlib
import re
import uuid
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

from hdjax.fingerprint import OWN_PACKAGES, UnknownCode, fingerprint
from hdjax.program_store import store, stored
from hdjax.surroundings import source, surroundings

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_Program = Callable[[list[Any]], Any]

_held: list[dict[Hashable, _Program | None]] = []
_SUFFIX = ".program"
# Calls out of a program, and those that mean the same in every process: a Python callback is an address in this one.
_CALL = re.compile(r"custom_call @\"?([\w.]+)")
_LASTING_CALL = re.compile(r"lapack_\w+|ducc_fft\w*|Sharding|SPMD\w+")


def jit_kept(function: Callable[_Arguments, _Result], **options: Any) -> Callable[_Arguments, _Result]:
    """`eqx.filter_jit` whose programs are kept between processes, where JAX keeps those that it compiles.

    Inside another program, or where JAX keeps nothing, it is `eqx.filter_jit`.

    Args:
        function: a function of a module, not one made inside another.
        options: of `jax.jit`.
    """
    plain = eqx.filter_jit(function, **options)
    programs: dict[Hashable, _Program | None] = {}
    _held.append(programs)

    @functools.wraps(function)
    def call(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        folder = _folder()
        leaves, structure = jax.tree.flatten((args, kwargs))
        if folder is None or any(isinstance(leaf, Tracer) for leaf in leaves):
            return plain(*args, **kwargs)
        key = (structure, *map(_kind, leaves), *_settings().values())
        if key not in programs:
            programs[key] = _program(folder, function, options, (args, kwargs))
        program = programs[key]
        return plain(*args, **kwargs) if program is None else program(_arrays(leaves))

    return call


def forget() -> None:
    """Let go of the programs that this process holds, as `jax.clear_caches` does of JAX's own; kept ones stay kept."""
    for programs in _held:
        programs.clear()


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
    found = stored(path)
    return _made(path, function, options, arguments) if found is None else _calling(*found)


def _key(function: Callable, options: dict[str, Any], arguments: Any) -> str:
    """Digest of all that a program is made from."""
    name = f"{function.__module__}.{function.__qualname__}"
    if "<" in name or name.split(".")[0] not in OWN_PACKAGES:
        raise UnknownCode(f"{name} is not of a module of this project")
    settings = sorted((name, str(value)) for name, value in _settings().items())
    made_from = (name, sorted(options.items()), settings, surroundings(), source(), fingerprint(arguments))
    return hashlib.sha256(repr(made_from).encode()).hexdigest()


def _settings() -> dict[str, Any]:
    return jax.config.values  # pyright: ignore[reportAttributeAccessIssue]


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
    store(path, compiled, calls=frozenset(calls), beside=returned[-1])
    return _calling(compiled, returned[-1])


def _calling(compiled: jax.stages.Compiled, returned: Any) -> _Program:
    return lambda arrays: _filled(returned, compiled(arrays))
