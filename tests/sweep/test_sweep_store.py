"""Result and store of a sweep, and its continuation after killed processes. Needs the extra `sweep`."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hdjax import Harmonic, ReducedDrive, ReducedModel
from hdjax.sweep import Points, Request, sweep
from hdjax.sweep.check import Check
from hdjax.sweep.outputs import Plan, answers
from hdjax.sweep.request import Case, digest
from hdjax.sweep.store import Store
from hdjax.sweep.transients import TransientRoute

for name in ("xarray", "zarr", "distributed"):
    pytest.importorskip(name, reason=f"needs the extra `sweep`: {name} is not installed")

CHUNK, CHUNKS = 64, 32
CASE = Case(ReducedModel(ReducedDrive(mu=0.1, omega_0=1.0, alpha=0.5)), Harmonic(0.3, 1.0))
CLIENT = """
import sys, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
from distributed import Client
from test_sweep_store import CASE, slow_request
from hdjax.sweep import sweep
if __name__ == "__main__":
    with Client(sys.argv[3]) as client:
        client.wait_for_workers(int(sys.argv[4]))
    sweep(CASE.model, CASE.forcing, slow_request(), store=sys.argv[2], scheduler=sys.argv[3])
"""


def steady_request() -> Request:
    return Request(Points({"alpha": np.array([0.0, 0.5]), "forcing.omega": np.linspace(0.5, 2.0, 40)}))


def slow_request() -> Request:
    """Many short steps: a program that compiles fast and then computes for a fraction of a second on each chunk."""
    points = Points({"forcing.omega": np.linspace(0.5, 2.0, CHUNK * CHUNKS)})
    return Request(points, "transient", ("final",), duration=500.0, windows=1)


def started_store(folder: Path) -> Store:
    """A store of slow chunks, without the search for a route."""
    store = Store(folder, CASE, slow_request(), chunk=CHUNK)
    store.begin(Plan(TransientRoute("strang", 10_000), Check(0, 0, 0.0, 0.0, "none")))
    return store


def test_sweep_result_has_names_units_and_the_values_of_its_points():
    found = sweep(CASE.model, CASE.forcing, steady_request())
    assert found.peak.dims == ("alpha", "forcing.omega", "motion") and found.peak.units == "rad"
    assert found["forcing.omega"].units == "rad/s" and "harmonic balance" in found.route
    assert 0.0 < found.checked_error < found.tolerance
    # Without the cubic the amplitude is A / sqrt((omega_0^2 - omega^2)^2 + (mu omega)^2).
    omega = np.asarray(found["forcing.omega"])
    linear = 0.3 / np.hypot(1.0 - omega**2, 0.1 * omega)
    np.testing.assert_allclose(found.amplitude[0].max("motion"), linear, rtol=1e-9)
    assert (found.motions[0] == 1).all() and (found.motions[1] == 3).any()
    edges = np.flatnonzero(np.diff(found.motions[1]))
    assert np.array_equal(np.flatnonzero(found.fold[1]), edges) and edges.size == 2


@pytest.mark.slow
def test_transient_sweep_has_the_steady_peak_and_a_settling_time():
    points = Points({"forcing.omega": np.array([0.4, 0.6, 1.9])})
    request = Request(points, "transient", ("peak", "settling_time", "trace"), periods=40.0, windows=40)
    found = sweep(CASE.model, CASE.forcing, request)
    steady = sweep(CASE.model, CASE.forcing, Request(points, outputs=("peak",)))
    assert found.x.dims == ("forcing.omega", "window") and found.tolerance_kept
    # exp(-mu t / 2) falls to the band of 2 % of the transient's own size in about 80 s; from rest it is of the order
    # of the motion.
    assert ((found.settling_time > 10.0) & (found.settling_time < 160.0)).all()
    assert (found.peak >= 0.99 * steady.peak.max("motion")).all()


def test_marks_of_a_lost_plan_do_not_count(tmp_path):
    kept = started_store(tmp_path)
    (kept.path / "finished" / "0").touch()
    assert kept.finished().any()
    (kept.path / "plan.json").unlink()
    assert not started_store(tmp_path).finished().any()


def test_finished_chunk_is_not_computed_again(tmp_path, monkeypatch):
    first = sweep(CASE.model, CASE.forcing, steady_request(), store=tmp_path)
    monkeypatch.setattr("hdjax.sweep.run.work", lambda *_: pytest.fail("a finished chunk was worked out"))
    again = sweep(CASE.model, CASE.forcing, steady_request(), store=tmp_path)
    assert first.drop_attrs().identical(again.drop_attrs())
    assert [p.name for p in tmp_path.iterdir()] == [digest(CASE, steady_request())] == [first.request]


@pytest.mark.parametrize(
    ("column", "settings", "words"),
    [
        ("kappa", {}, "`kappa` is no parameter of this sweep; there are mu, omega_0"),
        ("omega_0", {}, "`omega_0` must lie between 0 and 1e\\+09, but runs from -1 to 1"),
        ("forcing.omega", {}, "`forcing.omega` must lie between 0 and inf"),
        (
            "forcing.omega",
            {"response": "transient", "outputs": ("peak",), "periods": 3.0},
            "must lie between 0 and inf",
        ),
        ("mu", {}, "needs damping"),
    ],
)
def test_invalid_sweep_points_are_refused(column, settings, words):
    request = Request(Points({column: np.array([-1.0, 0.0, 1.0])}), **settings)
    with pytest.raises(ValueError, match=words):
        sweep(CASE.model, CASE.forcing, request)


def started_process(*arguments: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "JAX_PLATFORMS": "cpu"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    return subprocess.Popen([sys.executable, *arguments], **quiet)


def wait_for(what: Callable[[], bool], *needed: subprocess.Popen, seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "waited in vain"
        assert all(process.poll() is None for process in needed), "a process has ended by itself"
        time.sleep(0.02)


def marks(store: Store) -> dict[str, tuple[int, int]]:
    """By chunk: the process that computed it, and the time of completion [ns]."""
    found = [p for p in (store.path / "finished").iterdir() if p.name.isdigit()]
    return {p.name: (int(p.read_text().split()[-1]), p.stat().st_mtime_ns) for p in found}


@pytest.mark.slow
def test_sweep_after_killed_workers_and_client_is_bitwise_equal(tmp_path):
    store, address_file = started_store(tmp_path / "store"), tmp_path / "scheduler.json"
    module, joins = "distributed.cli.dask_", ("--scheduler-file", str(address_file))
    processes = [started_process("-m", module + "scheduler", "--port", "0", "--no-dashboard", *joins)]
    worker = ("-m", module + "worker", *joins, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--preload", "hdjax")
    processes += [started_process(*worker) for _ in range(2)]
    _, first, second = processes
    try:
        wait_for(address_file.exists, *processes)
        address = json.loads(address_file.read_text())["address"]
        ask = ("-c", CLIENT, str(Path(__file__).parent), str(tmp_path / "store"), address)
        client = started_process(*ask, "2")
        processes.append(client)
        # Both workers have finished a chunk.
        wait_for(lambda: {pid for pid, _ in marks(store).values()} == {first.pid, second.pid}, *processes)
        first.send_signal(signal.SIGKILL)
        first.wait()
        killed = len(marks(store))
        wait_for(lambda: len(marks(store)) >= killed + 3, second, client)
        client.send_signal(signal.SIGKILL)
        client.wait()
        # The other worker may still finish its chunk.
        time.sleep(1.0)
        left = marks(store)
        assert killed < len(left) < store.chunks
        client = started_process(*ask, "1")
        processes.append(client)
        assert client.wait(timeout=240) == 0
    finally:
        for process in processes:
            process.kill()
            process.wait()
    done = marks(store)
    assert store.finished().all() and left.items() <= done.items()
    plan = store.plan
    assert plan is not None
    own = [slow_request().points.values(store.points(chunk)) for chunk in range(store.chunks)]
    undisturbed = [answers(CASE, slow_request(), plan, values) for values in own]
    for name, rows in store.read().items():
        assert rows.tobytes() == np.concatenate([found[name] for found in undisturbed]).tobytes()
