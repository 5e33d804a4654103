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
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

from hdjax.fingerprint import OWN_PACKAGES, UnknownCode, fingerprint
from hdjax.program_store import store, stored
from hdjax.surroundings import source, surroundings

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_Program = Callable[[list[Any]], Any]

# Compiling well takes longer than what it saves where there is little work.
_SMALL: Any = {"compiler_options": {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}}

_held: list["Kept"] = []
_SUFFIX = ".program"
# Calls out of a program, and those that mean the same in every process: a Python callback is an address in this one.
_CALL = re.compile(r"custom_call @\"?([\w.]+)")
_LASTING_CALL = re.compile(r"lapack_\w+|ducc_fft\w*|Sharding|SPMD\w+")


class Kept(Generic[_Arguments, _Result]):
    """A function whose programs are kept; see [`jit_kept`][]."""

    def __init__(self, function: Callable[_Arguments, _Result], options: dict[str, Any]):
        self._function, self._options = function, options
        self._plain = eqx.filter_jit(function, **options)
        # Only a program of its own may have options.
        self._inside = eqx.filter_jit(function)
        self._programs: dict[Hashable, _Program | None] = {}
        self._coming: dict[Hashable, Future[_Program | None]] = {}
        functools.update_wrapper(self, function)
        _held.append(self)

    def __call__(self, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        leaves, structure = jax.tree.flatten((args, kwargs))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return self._inside(*args, **kwargs)
        folder = _folder()
        if folder is None:
            return self._plain(*args, **kwargs)
        key = _made_for(leaves, structure)
        if key not in self._programs:
            coming = self._coming.pop(key, None)
            # What still waits behind others is made here.
            if coming is None or coming.cancel():
                self._programs[key] = self._program(folder, args, kwargs)
            else:
                self._programs[key] = coming.result()
        program = self._programs[key]
        return self._plain(*args, **kwargs) if program is None else program(_arrays(leaves))

    def prepare(self, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> Callable[[], object]:
        """Have the program for such arguments made beside what else is done, before it is called for.

        Returns:
            What calls it off, where it has not begun.
        """
        leaves, structure = jax.tree.flatten((args, kwargs))
        folder, key = _folder(), _made_for(leaves, structure)
        known = key in self._programs or (key in self._coming and not self._coming[key].cancelled())
        if folder is None or known:
            return lambda: None
        self._coming[key] = _beside().submit(self._program, folder, args, kwargs)
        return self._coming[key].cancel

    def forget(self) -> None:
        """Let go of the programs that this process holds."""
        self._programs.clear()
        self._coming.clear()

    def _program(self, folder: Path, args: Any, kwargs: Any) -> _Program | None:
        return _program(folder, self._function, self._options, (args, kwargs))


def jit_kept(function: Callable[_Arguments, _Result], **options: Any) -> Kept[_Arguments, _Result]:
    """`eqx.filter_jit` whose programs are kept between processes, where JAX keeps those that it compiles.

    Inside another program, or where JAX keeps nothing, it is `eqx.filter_jit`.

    Args:
        function: a function of a module, not one made inside another.
        options: of `jax.jit`.
    """
    return Kept(function, options)


def jit_small(function: Callable[_Arguments, _Result]) -> Kept[_Arguments, _Result]:
    """[`jit_kept`][] for programs of so little work that they are rather compiled in no time than well."""
    return jit_kept(function, **_SMALL)


@functools.cache
def _beside() -> ThreadPoolExecutor:
    """Where programs are made beside what else is done."""
    return ThreadPoolExecutor(1)


def _made_for(leaves: Sequence[Any], structure: Any) -> Hashable:
    """What of its arguments a program depends on."""
    return (structure, *map(_kind, leaves), *_settings().values())


def forget() -> None:
    """Let go of the programs that this process holds, as `jax.clear_caches` does of JAX's own; kept ones stay kept."""
    for kept in _held:
        kept.forget()


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
