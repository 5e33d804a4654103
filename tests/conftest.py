"""Settings for every test, which are stricter than a user's, and fixtures that many tests share."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import jaxtyping
import pytest
from jax.experimental.compilation_cache import compilation_cache
from shape_checks import CALLS, checked

# Tests spend more time on compilation than on computation. XLA reads this when the first program is compiled, also in
# processes that tests start. A user's command compiles with more optimisation, see `jit_small`.
_QUICK = (
    "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
os.environ.setdefault("XLA_FLAGS", _QUICK)
# The processes of pytest-xdist inherit this. They occupy all cores, and a waiting thread of OpenBLAS keeps a core busy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# As the command line does, for the same reason.
gc.set_threshold(200_000)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The first example of a property compiles, so that time limits have no meaning. Examples are the same in every run:
# the result of the gate depends on the code alone.
hypothesis.settings.register_profile(
    "gate", deadline=None, derandomize=True, max_examples=40, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("gate")

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"

# Modules that annotate shapes are checked at run time. The others are checked statically, since a check at run time
# takes longer than most of their functions.
_SHAPED = [
    f for package in ("hdjax", "fitting") for f in (ROOT / package).rglob("*.py") if "jaxtyping" in f.read_text()
]
jaxtyping.jaxtyped = checked  # which the hook puts at each function and class
jaxtyping.install_import_hook(
    [".".join(f.relative_to(ROOT).with_suffix("").parts) for f in _SHAPED], "beartype.beartype"
)


# Files that take longest: begun last, one would keep a process busy while the others have nothing left to do.
_FIRST = ("test_one_side_check.py", "test_notebooks.py", "test_close_loop.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Move the tests of the longest files to the front."""
    items.sort(key=lambda item: _FIRST.index(item.path.name) if item.path.name in _FIRST else len(_FIRST))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the measured data and the simulated rig's logs; skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("needs the folder `shared` beside the repository, which is absent here")
    return SHARED


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """For a test of the command line: compiled programs go to the test's folder, and JAX's settings are restored."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    # JAX decides once in a process whether and where it stores programs: later tests would use the same folder.
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(autouse=True, scope="module")
def few_programs() -> Iterator[None]:
    """Clear compiled programs before their memory mappings reach the limit of the system (65,530 on Linux), at which a
    compilation crashes.

    What is checked in a file depends on the file alone.
    """
    CALLS.clear()
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_text().count("\n") > 20_000:
        jax.clear_caches()
