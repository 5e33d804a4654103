"""Many logs, many refits, a long log, and the first answer of a new process: the same work as `bench_fit.py`, at size.

What each side is given, and what the columns mean, is in README.md beside this file.
"""

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import bench_fit
import jax
import jax.numpy as jnp
import numpy as np
from bench_fit import NOISE, RATE, Ours, Record, at, experiment, fit_peer, peer_start, record

from fitting.estimation.estimate import Fit
from fitting.uncertainty.refits import refits
from hdjax.engine import one_thread

PEER_SUBSTEPS = 2


def peer_fit(log: Record) -> np.ndarray:
    """The strong user's fit of one log."""
    start, scale = peer_start(log, 1e-3)
    return fit_peer(log, start, scale, method="lm", substeps=PEER_SUBSTEPS)[0]


def peer_refit(argument: tuple[Record, np.ndarray]) -> np.ndarray:
    """The strong user's refit, from the solution of the first fit."""
    log, solution = argument
    _, scale = peer_start(log, 0.0)
    return fit_peer(log, solution, scale, method="lm", substeps=PEER_SUBSTEPS)[0]


def our_fit(log: Record, *, reweigh: bool = True) -> Fit:
    """Ours from the peer's start, on the dynamic error alone."""
    case = Ours(*experiment(log, reduced=True))
    return case.whole_from(at(case.model, peer_start(log, 1e-3)[0][:3]), reweigh=reweigh)


def with_noise(log: Record, seed: int) -> Record:
    """The same motion, measured again."""
    noise = NOISE * np.random.default_rng(seed).normal(size=log.clean.size)
    return Record(log.time, log.torque, log.motor_angle, log.clean + noise, log.clean)


def timed(call: Callable[[], object]) -> tuple[float, object]:
    """Seconds, and the result."""
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


def tell(name: str, peer: float, ours: float, goal: float | None) -> None:
    """One line: both times and their ratio."""
    ratio = peer / ours
    verdict = "" if goal is None else f"; goal {goal:g}: {'met' if ratio >= goal else 'MISSED'}"
    print(f"{name:<44}peer {peer:8.2f} s   ours {ours:8.2f} s   peer/ours {ratio:6.2f}{verdict}", flush=True)


def many_logs(count: int, samples: int, pool: ProcessPoolExecutor) -> None:
    """Each log has a drive's noise and torque of its own."""
    logs = [record(samples, seed=seed) for seed in range(count)]
    our_fit(logs[0])
    peer, theirs = timed(lambda: list(pool.map(peer_fit, logs)))

    def alone(log: Record) -> Fit:
        """One log a thread keeps all cores busy, as in a fleet."""
        with one_thread():
            return our_fit(log)

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        ours, found = timed(lambda: list(threads.map(alone, logs)))
    tell(f"{count} logs of {samples} samples", peer, ours, 20.0)
    apart = [np.max(np.abs(bench_fit.physical(f.model) / t[:3] - 1)) for f, t in zip(found, theirs, strict=True)]
    print(f"  answers apart by {max(apart):.1e} at most (RK4 x {PEER_SUBSTEPS} is itself 1e-5 off)")


def many_refits(count: int, samples: int, pool: ProcessPoolExecutor) -> None:
    """One log, measured again and again."""
    log = record(samples)
    found = our_fit(log, reweigh=False)
    solution = peer_fit(log)
    logs = [with_noise(log, seed) for seed in range(count)]
    peer, theirs = timed(lambda: list(pool.map(peer_refit, [(again, solution) for again in logs], chunksize=8)))
    shape = found.problem.segments.measured.shape
    padded = np.zeros((count, shape[0] * shape[1]))
    padded[:, :samples] = [again.dynamic_error for again in logs]
    measured = jnp.asarray(padded.reshape(count, *shape))
    refits(found, measured)[0].block_until_ready()
    ours, (vectors, moved) = timed(lambda: jax.block_until_ready(refits(found, measured)))
    tell(f"{count} refits of {samples} samples", peer, ours, None)
    names = found.free.paths
    spread = np.std([np.exp(vector[names.index("omega_0")]) for vector in np.asarray(vectors)])
    peers = np.std([np.sqrt(bench_fit.C * t[0]) for t in theirs])
    print(f"  std of omega_0 {spread:.3e}, of the peer's {peers:.3e}; last step at most {np.max(moved):.1e} std")


def long_log(samples: int) -> None:
    """One log, many samples."""
    log = record(samples)
    peer_fit(record(2000))
    peer, theirs = timed(lambda: peer_fit(log))
    our_fit(log)
    ours, found = timed(lambda: our_fit(log))
    tell(f"1 log of {samples} samples", peer, ours, 5.0)
    apart = np.max(np.abs(bench_fit.physical(found.model) / theirs[:3] - 1))
    row = bench_fit.timed("", lambda: our_fit(log), 1)
    each = "" if row.memory is None else f"; {row.memory / samples / 5:.0f} bytes a sample and lane (goal 100)"
    print(f"  answers apart by {apart:.1e}{each}")


def first_answer(samples: int) -> None:
    """`hdjax fit` in a new process with a warm cache, against importing jax."""
    log = record(samples)
    with tempfile.TemporaryDirectory() as folder:
        path, drive = Path(folder) / "log.csv", Path(folder) / "drive.toml"
        rows = np.stack([log.time, log.dynamic_error, log.forcing], axis=1)
        np.savetxt(path, rows, delimiter=",", header="time,dynamic_error,forcing", comments="", fmt="%.12g")
        drive.write_text('[drive]\nname = "bench"\n[signals]\ntorque_hold = "zero-order"\n', encoding="utf-8")
        command = [str(Path(sys.executable).parent / "hdjax"), "fit", str(path), "--drive", str(drive), "--out", folder]
        environment = os.environ | {"XDG_CACHE_HOME": folder}

        def run(what: list[str]) -> None:
            subprocess.run(what, check=True, capture_output=True, env=environment)

        cold, _ = timed(lambda: run(command))
        warm = min(timed(lambda: run(command))[0] for _ in range(3))
        imported = min(timed(lambda: run([sys.executable, "-c", "import jax"]))[0] for _ in range(3))
    ratio = warm / imported
    print(f"hdjax fit of {samples} samples: {cold:.1f} s with a cold cache, {warm:.1f} s with a warm one;", end=" ")
    print(f"import jax {imported:.2f} s; ratio {ratio:.1f} (goal 3: {'met' if ratio <= 3 else 'MISSED'})")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--logs", type=int, default=32)
    parser.add_argument("--refits", type=int, default=200)
    parser.add_argument("--long", type=int, default=200_000)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{os.cpu_count()} cores, {RATE:.0f} Hz")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn")) as pool:
        # Each worker compiles first.
        list(pool.map(peer_fit, [record(2000)] * 2 * (os.cpu_count() or 1)))
        many_logs(args.logs, args.samples, pool)
        many_refits(args.refits, args.samples, pool)
    long_log(args.long)
    first_answer(args.samples)


if __name__ == "__main__":
    main()
