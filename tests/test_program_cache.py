"""Programs kept between processes: the same results without tracing, and never another program's."""

import dataclasses
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.free import FreeParameters, base_paths, strength_paths
from hdjax import ReducedDrive, program_cache, program_store, surroundings
from hdjax.program_cache import Kept, jit_kept


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


class Traced:
    """A function as a module of the project would have it, and how often it was traced."""

    def __init__(self, function: Callable):
        self.count = 0

        def counted(*args, **kwargs):
            self.count += 1
            return function(*args, **kwargs)

        counted.__module__, counted.__qualname__ = "hdjax.example", "example"
        self._function = counted

    def in_new_process(self) -> Kept:
        """The function, with nothing in memory of what was compiled before."""
        return jit_kept(self._function)


def times(x: Any, factor: Any) -> Any:
    return {"product": x * factor, "how": "times", "drive": ReducedDrive(mu=1.0, omega_0=2.0)}


def files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def test_a_kept_program_is_not_traced_again(folder: Path):
    traced, x = Traced(times), jnp.linspace(0.0, 1.0, 5)
    first = traced.in_new_process()(x, 3)
    assert traced.count == 1 and len(files(folder)) == 1
    again = traced.in_new_process()(x, 3)
    assert traced.count == 1
    assert eqx.tree_equal(first, again)
    plain = eqx.filter_jit(times)(x, 3)
    assert jax.tree.structure(plain) == jax.tree.structure(again) and plain["how"] == again["how"]
    np.testing.assert_array_equal(plain["product"], again["product"])


def test_a_program_is_made_before_it_is_called_for(folder: Path):
    traced, x = Traced(times), jnp.linspace(0.0, 1.0, 5)
    function = traced.in_new_process()
    function.prepare(x, 3)
    first = function(x, 3)
    function.prepare(x, 3)
    assert traced.count == 1 and len(files(folder)) == 1
    assert eqx.tree_equal(first, eqx.filter_jit(times)(x, 3))


def test_what_waits_is_called_off_or_made_at_once(folder: Path):
    traced, released = Traced(times), threading.Event()
    slow = Traced(lambda x: x if released.wait(60) else None)
    waited_for, function = slow.in_new_process(), traced.in_new_process()
    waited_for.prepare(X)
    call_off = function.prepare(X, 3)
    # The one before it is still being made.
    function(X, 3)
    assert traced.count == 1
    function.prepare(X, 4)()
    assert call_off() and traced.count == 1
    released.set()
    np.testing.assert_array_equal(waited_for(X), X)
    assert slow.count == 1
    # What was called off can be asked for again.
    function.prepare(X, 4)
    function(X, 4)
    assert traced.count == 2


def test_nothing_is_prepared_where_nothing_is_kept():
    traced = Traced(times)
    function = traced.in_new_process()
    assert not function.prepare(X, 3)()
    assert traced.count == 0


FREE = FreeParameters(("mu",), (False,), jnp.ones(1))
X = np.linspace(0.0, 1.0, 4)
DIFFERENT: dict[str, tuple[tuple[Any, Any], tuple[Any, Any]]] = {
    "dtype": ((X, 2), (X.astype(np.float32), 2)),
    "shape": ((X, 2), (X[:3], 2)),
    "weak type": ((X, jnp.asarray(2.0)), (X, jnp.asarray(np.array(2.0)))),
    "value": ((X, 2), (X, 3)),
    "kind of number": ((X, 1), (X, True)),
    "int and float": ((X, 1), (X, 1.0)),
    "sign of zero": ((X, 0.0), (X, -0.0)),
    "structure": ((X, (2.0,)), (X, [2.0])),
    "static field": ((X, FREE), (X, dataclasses.replace(FREE, logarithmic=(True,)))),
    "function": ((X, base_paths), (X, strength_paths)),
    "class": ((X, float), (X, complex)),
    "held array": ((jnp.asarray(X), 2), (jax.device_put(X, jax.devices()[0]), 2)),
}


@pytest.mark.parametrize("name", DIFFERENT)
def test_other_arguments_are_another_program(folder: Path, name: str):
    traced = Traced(lambda x, what: x + 1.0)
    one, other = DIFFERENT[name]
    traced.in_new_process()(*one)
    traced.in_new_process()(*one)
    assert traced.count == 1
    traced.in_new_process()(*other)
    assert traced.count == 2 and len(files(folder)) == 2


CHANGES: dict[str, Callable[[pytest.MonkeyPatch], object]] = {
    "source": lambda patch: patch.setattr(program_cache, "source", lambda: "other"),
    "versions": lambda patch: patch.setattr(surroundings, "_versions", lambda: ("other",)),
    "processor": lambda patch: patch.setattr(surroundings, "_processor", lambda: ("other",)),
    "devices": lambda patch, found=jax.devices: patch.setattr(jax, "devices", lambda: found() * 2),
    "flags": lambda patch: patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_other_surroundings_are_another_program(folder: Path, name: str, monkeypatch: pytest.MonkeyPatch):
    traced = Traced(lambda x: x + 1.0)
    traced.in_new_process()(X)
    CHANGES[name](monkeypatch)
    traced.in_new_process()(X)
    assert traced.count == 2 and len(files(folder)) == 2


def test_other_settings_are_another_program(folder: Path):
    traced = Traced(lambda x: x @ x)
    function = traced.in_new_process()
    function(X)
    with jax.default_matmul_precision("float32"):
        # Also within one process.
        function(X)
        traced.in_new_process()(X)
    assert traced.count == 2 and len(files(folder)) == 2


def test_source_is_read_from_the_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for package in ("hdjax", "fitting"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("1")

    class Spec:
        submodule_search_locations = [str(tmp_path / "hdjax")]

    monkeypatch.setattr(surroundings.importlib.util, "find_spec", lambda name: Spec)
    before = surroundings.source.__wrapped__()
    assert before == surroundings.source.__wrapped__()
    (tmp_path / "hdjax" / "__init__.py").write_text("2")
    after = surroundings.source.__wrapped__()
    (tmp_path / "hdjax" / "more.py").write_text("")
    assert len({before, after, surroundings.source.__wrapped__()}) == 3


class Unknown(eqx.Module):
    """Of this test's own module, whose source no key knows."""

    value: float = 2.0


@pytest.mark.parametrize(
    "what", [lambda: 2.0, Unknown(), Unknown, object()], ids=["lambda", "module", "class", "object"]
)
def test_what_has_no_fingerprint_is_not_kept(folder: Path, what: Any):
    traced = Traced(lambda x, what: x + 1.0)
    for _ in range(2):
        np.testing.assert_array_equal(traced.in_new_process()(X, what), X + 1.0)
    assert not files(folder)


def test_functions_made_inside_functions_are_not_kept(folder: Path):
    np.testing.assert_array_equal(jit_kept(lambda x: x + 1.0)(X), X + 1.0)
    assert not files(folder)


def test_callbacks_are_not_kept(folder: Path):
    def with_callback(x):
        return jax.pure_callback(lambda a: 2.0 * np.asarray(a), jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    traced = Traced(with_callback)
    for _ in range(2):
        np.testing.assert_array_equal(traced.in_new_process()(X), 2.0 * X)
    assert not files(folder)


@pytest.mark.parametrize(
    "spoil",
    [lambda b: b"", lambda b: b[:100], lambda b: b[:-1], lambda b: b[:60] + bytes([b[60] ^ 1]) + b[61:]],
    ids=["empty", "cut off", "one byte short", "one bit wrong"],
)
def test_spoilt_programs_are_made_again(folder: Path, spoil: Callable[[bytes], bytes]):
    traced = Traced(lambda x: x + 1.0)
    traced.in_new_process()(X)
    (path,) = files(folder)
    whole = path.read_bytes()
    path.write_bytes(spoil(whole))
    np.testing.assert_array_equal(traced.in_new_process()(X), X + 1.0)
    assert traced.count == 2
    traced.in_new_process()(X)
    assert traced.count == 2 and files(folder) == [path]


def test_a_program_made_again_works_where_jax_still_has_it(folder: Path):
    # XLA forgets symbols where it writes down what it has read: "Function ... not found".
    before = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    try:
        traced = Traced(lambda x: jax.lax.scan(lambda c, _: (jnp.sin(c) @ jnp.ones((8, 8)), c), x, None, length=3)[0])
        x = np.ones((8, 8))
        truth = np.asarray(traced.in_new_process()(x))
        for path in files(folder):
            path.unlink()
        traced.in_new_process()(x)
        np.testing.assert_array_equal(traced.in_new_process()(x), truth)
        assert traced.count == 2
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before)


def test_inside_other_programs_it_is_an_ordinary_function(folder: Path):
    function = Traced(lambda x: jnp.sum(x**2)).in_new_process()
    rows = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(jax.vmap(function)(rows), [5.0, 50.0])
    np.testing.assert_array_equal(jax.grad(function)(jnp.asarray(rows[0])), 2 * rows[0])
    np.testing.assert_array_equal(jax.jit(function)(rows), 55.0)
    assert not files(folder)


def test_the_oldest_programs_make_room(folder: Path, monkeypatch: pytest.MonkeyPatch):
    traced = Traced(lambda x, shift: x + shift)
    for age, shift in enumerate((3, 2, 1)):
        traced.in_new_process()(X, shift)
        newest = max(files(folder), key=lambda p: p.stat().st_mtime)
        os.utime(newest, (1e9 + age, 1e9 + age))
    # Use keeps the first one young.
    traced.in_new_process()(X, 3)
    size = max(p.stat().st_size for p in files(folder))
    monkeypatch.setattr(program_store, "_MOST_BYTES", int(2.5 * size))
    traced.in_new_process()(X, 0)
    assert traced.count == 4 and len(files(folder)) == 2
    traced.in_new_process()(X, 3)
    traced.in_new_process()(X, 0)
    assert traced.count == 4


def test_a_folder_that_takes_no_files_does_no_harm(folder: Path):
    folder.write_text("a file in its place")
    np.testing.assert_array_equal(Traced(lambda x: x + 1.0).in_new_process()(X), X + 1.0)


SCRIPT = """
import sys, jax
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: compiled.append(event) if event.endswith("backend_compile_duration") else None
)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
import numpy as np
from fitting.estimate import whitening
from hdjax.lanes import spread
from hdjax.program_cache import Kept, jit_kept

def cumulated(lanes):
    return lanes.cumsum(axis=1), lanes.sum()

cumulated.__module__ = "hdjax.example"
covariance = whitening(np.array([[4.0, 1.0], [1.0, 3.0]]))
sums, total = jit_kept(cumulated)(spread(np.arange(64.0).reshape(32, 2), 32))
print(np.asarray(covariance).tobytes().hex(), np.asarray(sums).sum(), float(total), len(sums.sharding.device_set))
print(len(compiled))
"""


def test_a_new_process_compiles_nothing(tmp_path: Path):
    def run() -> list[str]:
        command = [sys.executable, "-c", SCRIPT, str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout.split()

    first, again = run(), run()
    # LAPACK is called, although no call of it was lowered.
    truth = np.linalg.inv(np.linalg.cholesky(np.array([[4.0, 1.0], [1.0, 3.0]])))
    np.testing.assert_allclose(np.frombuffer(bytes.fromhex(first[0])).reshape(2, 2), truth, rtol=1e-14)
    assert first[1:4] == [str(float(np.arange(64.0).sum() + np.arange(0.0, 64.0, 2.0).sum())), "2016.0", "2"]
    assert (first[:4], int(first[4]), int(again[4])) == (again[:4], 2, 0)
