"""Many drives under harmonic forcing against C and against SciPy, and steady states by harmonic balance.

The C program is written at run time and compiled with `cc -O3 -march=native -fopenmp`: classical Runge-Kutta, lanes of
a block in vector registers, the forcing's phase by rotation; and beside it hdjax's own splitting, so that what the
method gives and what the compiler gives can be told apart. All of them keep the same relative error.
"""

import argparse
import ctypes
import os
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from scipy.integrate import solve_ivp

from hdjax import Harmonic, ReducedDrive, ReducedModel
from hdjax.sweep.cheapest_route import choose
from hdjax.sweep.check import drawn_points
from hdjax.sweep.points import Points, drawn, spread_values
from hdjax.sweep.request import Case, Request
from hdjax.sweep.splitting import ABA864
from hdjax.sweep.steady_states import choose_steady, steady_states
from hdjax.sweep.transients import TransientRoute, transients

DURATION, TOLERANCE = 1.0, 1e-6
FORCING = 10.0 / (50 * 5.26e-4)  # the seed's 10 N m as an acceleration of the dynamic error [rad/s^2]
RANGES = {
    "omega_0": (350.0, 420.0, "linear"),
    "mu": (0.35, 35.0, "log"),
    "forcing.omega": (300.0, 500.0, "linear"),
}
# The seed's alpha, with which nothing nonlinear shows, and one with which alpha x^2 comes to 1 and motions jump.
WEAK, ALPHA = 0.1, 5e3
BLOCK = 32
C_PROGRAM = r"""
#include <math.h>
#define BLOCK 32
#define LANES _Pragma("omp simd") for (int i = 0; i < BLOCK; i++)

void rk4(long drives, long steps, double duration, double A, const double *w0, const double *mu,
         const double *alpha, const double *w, double *x_end) {
    const double h = duration / steps;
#pragma omp parallel for schedule(static)
    for (long b = 0; b < drives / BLOCK; b++) {
        double x[BLOCK], v[BLOCK], c[BLOCK], s[BLOCK], rc[BLOCK], rs[BLOCK], m[BLOCK], k[BLOCK], ka[BLOCK];
        for (int i = 0; i < BLOCK; i++) {
            long j = b * BLOCK + i;
            x[i] = v[i] = s[i] = 0.0;
            c[i] = A;
            rc[i] = cos(w[j] * h / 2);
            rs[i] = sin(w[j] * h / 2);
            m[i] = -mu[j];
            k[i] = -w0[j] * w0[j];
            ka[i] = k[i] * alpha[j];
        }
        for (long n = 0; n < steps; n++) {
            LANES {
                double cm = c[i] * rc[i] - s[i] * rs[i], sm = s[i] * rc[i] + c[i] * rs[i];
                double ce = cm * rc[i] - sm * rs[i], se = sm * rc[i] + cm * rs[i];
                double x1 = x[i], v1 = v[i];
                double a1 = c[i] + m[i] * v1 + x1 * (k[i] + ka[i] * (x1 * x1));
                double x2 = x1 + 0.5 * h * v1, v2 = v1 + 0.5 * h * a1;
                double a2 = cm + m[i] * v2 + x2 * (k[i] + ka[i] * (x2 * x2));
                double x3 = x1 + 0.5 * h * v2, v3 = v1 + 0.5 * h * a2;
                double a3 = cm + m[i] * v3 + x3 * (k[i] + ka[i] * (x3 * x3));
                double x4 = x1 + h * v3, v4 = v1 + h * a3;
                double a4 = ce + m[i] * v4 + x4 * (k[i] + ka[i] * (x4 * x4));
                x[i] = x1 + h / 6 * (v1 + 2 * (v2 + v3) + v4);
                v[i] = v1 + h / 6 * (a1 + 2 * (a2 + a3) + a4);
                c[i] = ce;
                s[i] = se;
            }
        }
        for (int i = 0; i < BLOCK; i++) x_end[b * BLOCK + i] = x[i];
    }
}

/* The splitting of underdamped drives; flows and kicks of a step, its first flow joined to the last. */
#define STAGES 7
static const double FLOW[STAGES] = {@flows@}, KICK[STAGES] = {@kicks@}, NODE[STAGES] = {@nodes@};

void split(long drives, long steps, double duration, double A, const double *w0, const double *mu,
           const double *alpha, const double *w, double *x_end) {
    const double h = duration / steps;
#pragma omp parallel for schedule(static)
    for (long b = 0; b < drives / BLOCK; b++) {
        double p[BLOCK], q[BLOCK], c[BLOCK], s[BLOCK], rc[BLOCK], rs[BLOCK], g[BLOCK], last[2][BLOCK];
        double turn[STAGES][2][BLOCK], wave[STAGES][2][BLOCK], response[2][BLOCK];
        for (int i = 0; i < BLOCK; i++) {
            long j = b * BLOCK + i;
            double square = w0[j] * w0[j], d = square - w[j] * w[j], damp = mu[j] * w[j];
            double re = A * d / (d * d + damp * damp), im = -A * damp / (d * d + damp * damp);
            double rate = sqrt(square - mu[j] * mu[j] / 4), first = NODE[0] * h;
            response[0][i] = re;
            response[1][i] = im;
            for (int n = 0; n < STAGES; n++) {
                double e = exp(-mu[j] * FLOW[n] * h / 2), t = NODE[n] * h;
                turn[n][0][i] = e * cos(rate * FLOW[n] * h);
                turn[n][1][i] = e * sin(rate * FLOW[n] * h);
                wave[n][0][i] = re * cos(w[j] * t) - im * sin(w[j] * t);
                wave[n][1][i] = re * sin(w[j] * t) + im * cos(w[j] * t);
            }
            double y = -re, v = w[j] * im, e = exp(-mu[j] * first / 2);
            double p0 = (v + mu[j] / 2 * y) / rate, cf = e * cos(rate * first), sf = e * sin(rate * first);
            p[i] = cf * p0 - sf * y;
            q[i] = cf * y + sf * p0;
            last[0][i] = cos(rate * first) / e;
            last[1][i] = -sin(rate * first) / e;
            c[i] = 1.0;
            s[i] = 0.0;
            rc[i] = cos(w[j] * h);
            rs[i] = sin(w[j] * h);
            g[i] = -h * square * alpha[j] / rate;
        }
        for (long n = 0; n < steps; n++) {
            LANES {
                double P = p[i], Q = q[i], C = c[i], S = s[i], G = g[i];
                for (int k = 0; k < STAGES; k++) {
                    double x = Q + wave[k][0][i] * C - wave[k][1][i] * S;
                    P += KICK[k] * (x * x) * (x * G);
                    double next = turn[k][0][i] * P - turn[k][1][i] * Q;
                    Q = turn[k][0][i] * Q + turn[k][1][i] * P;
                    P = next;
                }
                p[i] = P;
                q[i] = Q;
                c[i] = C * rc[i] - S * rs[i];
                s[i] = S * rc[i] + C * rs[i];
            }
        }
        for (int i = 0; i < BLOCK; i++)
            x_end[b * BLOCK + i] = last[0][i] * q[i] + last[1][i] * p[i]
                                 + response[0][i] * c[i] - response[1][i] * s[i];
    }
}
"""

Columns = dict[str, np.ndarray]
Solver = Callable[[Columns, int], np.ndarray]


def compiled(folder: Path) -> ctypes.CDLL | None:
    """The C program, or nothing where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        print("no C compiler (cc) here: the comparison with C is left out")
        return None
    flows = [*ABA864.flows[1:-1], 2 * ABA864.flows[0]]
    numbers = {"flows": flows, "kicks": ABA864.kicks, "nodes": np.cumsum(ABA864.flows[:-1])}
    text = C_PROGRAM
    for name, values in numbers.items():
        text = text.replace(f"@{name}@", ", ".join(repr(float(v)) for v in values))
    source, library = folder / "peer.c", folder / f"peer_{time.monotonic_ns()}.so"
    source.write_text(text)
    flags = ["-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512", "-fopenmp", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, str(source), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library))


def c_solver(function: Callable) -> Solver:
    """A function of the C program, of columns and steps."""

    def solve(columns: Columns, steps: int) -> np.ndarray:
        names = ("omega_0", "mu", "alpha", "forcing.omega")
        count = len(columns["mu"])
        lanes = -(-count // BLOCK) * BLOCK
        arrays = [np.pad(columns[name], (0, lanes - count), mode="edge") for name in names]
        x = np.empty(lanes)
        pointers = [a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in (*arrays, x)]
        numbers = (ctypes.c_long(lanes), ctypes.c_long(steps), ctypes.c_double(DURATION), ctypes.c_double(FORCING))
        function(*numbers, *pointers)
        return x[:count]

    return solve


def steps_for(solve: Solver, columns: Columns, truth: np.ndarray, size: np.ndarray) -> tuple[int, float]:
    """Fewest steps, in tenths of a power of two, that keep the tolerance on a sample, and their error."""
    for exponent in np.arange(6, 18, 0.1):
        steps = int(2**exponent)
        error = float(np.max(np.abs(solve(columns, steps) - truth) / size))
        if error <= TOLERANCE:
            return steps, error
    raise SystemExit("the C program does not reach the tolerance")


def best_of(runs: dict[str, Callable[[], object]], repeats: int) -> tuple[dict[str, float], dict[str, float]]:
    """Shortest time and least processor time of each [s], taken in turns so that a disturbance meets all of them.

    Other work on the machine lengthens processor time less.
    """
    best, busy = {name: np.inf for name in runs}, {name: np.inf for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter(), time.process_time()
            run()
            best[name] = min(best[name], time.perf_counter() - start[0])
            busy[name] = min(busy[name], time.process_time() - start[1])
    return best, busy


def requested(drives: int, alpha: float = ALPHA) -> Request:
    sample = drawn(RANGES | {"alpha": (0.0, alpha, "linear")}, drives, seed=1)
    return Request(Points(sample=sample), "transient", ("final",), duration=DURATION, windows=1, tolerance=TOLERANCE)


def transient_benchmark(drives: int, alpha: float, repeats: int, folder: Path) -> None:
    case = Case(ReducedModel(ReducedDrive(mu=1.0, omega_0=400.0, alpha=0.0)), Harmonic(FORCING, 400.0))
    request = requested(drives, alpha)
    print(f"-- alpha up to {alpha:g} rad^-2")
    start = time.perf_counter()
    route, check = choose(case, request)
    print(f"hdjax: {route.description}; chosen and checked in {time.perf_counter() - start:.1f} s (compilation in it)")
    print(f"  error against {check.reference}: {check.error:.1e} at most, {check.median:.1e} in the median")
    assert check.error <= TOLERANCE
    columns = request.points.values(np.arange(drives))
    runs: dict[str, Callable[[], object]] = {"hdjax": lambda: transients(case, request, route, columns)}
    few = request.points.values(np.concatenate(drawn_points(request)))
    exact, _ = transients(case, request, TransientRoute("adaptive", 256), few)
    truth, size = exact.x[:, -1], exact.peak.max(axis=1)
    print(f"  alpha x^2 in the sample: up to {np.max(few['alpha'] * size**2):.2f}")
    library = compiled(folder)
    if library is not None:
        for name, label in (("rk4", "C, Runge-Kutta"), ("split", "C, hdjax's splitting")):
            solve = c_solver(getattr(library, name))
            steps, error = steps_for(solve, few, truth, size)
            print(f"{label}: {steps} steps, error {error:.1e}")
            runs[label] = lambda solve=solve, steps=steps: solve(columns, steps)
    times, busy = best_of(runs, repeats)
    for name, seconds in times.items():
        print(
            f"{name}: {drives} drives x {DURATION:g} s in {seconds:.3f} s, {seconds / drives * 1e6:.2f} us a drive, "
            f"{busy[name] / drives * 1e6:.2f} us of processors"
        )
    for name in times:
        if name != "hdjax":
            ratio, of_processors = times[name] / times["hdjax"], busy[name] / busy["hdjax"]
            print(f"  throughput of hdjax over {name}: {ratio:.2f}; by processor time {of_processors:.2f}")
    against_scipy(few, truth, size, times["hdjax"] / drives)


def against_scipy(few: Columns, truth: np.ndarray, size: np.ndarray, ours: float) -> None:
    """The loosest tolerance of DOP853 that keeps the error on a few drives, which is SciPy's fastest method here."""
    rows = range(8)

    def one(i: int, rtol: float) -> float:
        w0, mu, alpha, w = (float(few[name][i]) for name in ("omega_0", "mu", "alpha", "forcing.omega"))

        def field(t: float, y: np.ndarray) -> list[float]:
            x, v = y
            return [v, FORCING * np.cos(w * t) - mu * v - w0 * w0 * x * (1.0 + alpha * x * x)]

        return solve_ivp(field, (0.0, DURATION), [0.0, 0.0], method="DOP853", rtol=rtol, atol=1e-2 * rtol).y[0, -1]

    for rtol in 10.0 ** np.arange(-6, -13, -0.5):
        start = time.perf_counter()
        found = np.array([one(i, rtol) for i in rows])
        each = (time.perf_counter() - start) / len(rows)
        error = float(np.max(np.abs(found - truth[: len(rows)]) / size[: len(rows)]))
        if error <= TOLERANCE:
            break
    print(
        f"SciPy DOP853 at rtol {rtol:.0e}: error {error:.1e}, {each * 1e3:.1f} ms a drive, "
        f"{each / ours:.0f} times hdjax's"
    )


def scaling(sizes: list[int]) -> None:
    """Cost of a drive over decades of drives, and the memory that the process has ever held."""
    case = Case(ReducedModel(ReducedDrive(mu=1.0, omega_0=400.0, alpha=0.0)), Harmonic(FORCING, 400.0))
    route = None
    for drives in sizes:
        request = requested(drives)
        route = route or choose(case, request)[0]
        columns = request.points.values(np.arange(drives))
        runs = {"run": lambda c=columns, r=request, o=route: transients(case, r, o, c)}
        best, busy = (times["run"] / drives * 1e6 for times in best_of(runs, 4))
        held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{drives:>8} drives: {best:.2f} us a drive, {busy:.2f} us of processors; {held:.0f} MiB at most so far")


def steady_benchmark(points: int) -> None:
    """Harmonic balance of many (drive, frequency) points."""
    case = Case(ReducedModel(ReducedDrive(mu=0.1, omega_0=1.0, alpha=0.5)), Harmonic(0.3, 1.0))
    drives = max(1, points // 1000)
    sample = drawn({"mu": (0.03, 0.3, "log"), "alpha": (0.0, 1.0, "linear")}, drives, seed=1)
    request = Request(Points({"forcing.omega": spread_values(0.3, 2.5, points // drives)}, sample))
    start = time.perf_counter()
    route, check = choose_steady(case, request)
    chosen = time.perf_counter() - start
    print(f"steady: {route.description}; chosen and checked in {chosen:.1f} s, error {check.error:.1e}")
    size, begin, several, lost = request.points.size, (time.perf_counter(), time.process_time()), 0, 0
    for first in range(0, size, 65536):
        found = steady_states(case, route, request.points.values(np.arange(first, min(first + 65536, size))))
        several, lost = several + int(np.sum(found.exists.sum(axis=1) > 1)), lost + int(found.lost.sum())
    seconds, busy = time.perf_counter() - begin[0], time.process_time() - begin[1]
    print(f"  {size} points in {seconds:.1f} s, {busy:.1f} s of processors (compilation of the wide programs in it)")
    print(f"  {several} with several motions, {lost} with one that was not found")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--drives", type=int, default=100_000)
    arguments.add_argument("--repeats", type=int, default=5)
    arguments.add_argument("--points", type=int, default=1_000_000)
    arguments.add_argument("--sizes", type=int, nargs="*", default=[1_000, 10_000, 100_000, 1_000_000])
    arguments.add_argument("--devices", type=int, default=os.cpu_count())
    # `make bench` gives every script the same options.
    options, _ = arguments.parse_known_args()
    jax.config.update("jax_num_cpu_devices", options.devices)
    jax.config.update("jax_enable_x64", True)
    kinds = {device.device_kind for device in jax.local_devices()}
    print(f"{len(jax.local_devices())} devices ({', '.join(kinds)}), {os.cpu_count()} processors for the C programs;")
    print("other work on the machine disturbs times, less so their ratios")
    with tempfile.TemporaryDirectory() as folder:
        for alpha in (WEAK, ALPHA):
            transient_benchmark(options.drives, alpha, options.repeats, Path(folder))
    scaling(options.sizes)
    steady_benchmark(options.points)


if __name__ == "__main__":
    main()
