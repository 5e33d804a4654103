"""Residual and Jacobian of 20,000 samples: machine code against XLA, and against a C program, on the same work.

What each is given, and what the columns mean, is in README.md beside this file.
"""

import argparse
import ctypes
import dataclasses
import os
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from bench_fit import RATE, TRUTH, C, Record, _growth, experiment, record, verdict

from fitting.estimation.engines import linearise, with_engine
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import base_paths, fitted_paths
from fitting.estimation.machine_code import task
from fitting.estimation.problem import Segmentation, pose, short_horizon
from fitting.estimation.residual import Problem, Unknowns, blocks
from fitting.estimation.scales import scales
from hdjax import Model, sampled
from hdjax.compilation import on_host
from hdjax.effects import CATALOGUE, Effect, Scales
from hdjax.engine.kernel import _MADE
from hdjax.engine.march import tableau
from hdjax.lanes import jit_lanes

# Goals: speed of one linearisation (base, median of the effects), seconds to a callable residual and Jacobian (base,
# median, worst), how much sooner than XLA (median), speed against C, bytes a sample and lane.
BASE_SPEED, EFFECT_SPEED = 4.0, 5.0
BASE_SECONDS, MEDIAN_SECONDS, WORST_SECONDS, SOONER = 0.3, 0.6, 1.5, 12.0
AGAINST_C, MEMORY = 0.5, 100.0
# The C program takes all steps to be equally long, and the stamps are rounded to 1e-12 of one: that is more of the
# residual, which is a hundredth of the motion or less.
AGREEMENT = 1e-8


# --- models ----------------------------------------------------------------------------------------------------------


def of_some_strength(model: Model) -> Model:
    """What is zero in the model's effects becomes something else, so that nothing is left out as zero."""
    random = np.random.default_rng(1)
    own = {path: float(v) for path, (v, _) in model.parameters().items() if "." in path}
    changed = {path: 10 ** random.uniform(-5, -3) for path, value in own.items() if value == 0.0}
    return model.replace(changed) if changed else model


def with_temperature(stretches: Sequence[Stretch]) -> tuple[Stretch, ...]:
    """The same log with a drive that warms up, for the effects that ask for it."""
    own = stretches[0].experiment
    warmth = sampled(own.time, 300.0 + own.time / own.time[-1], hold="linear")
    return (Stretch(dataclasses.replace(own, temperature=warmth), 0, len(own)),)


def proposed(form: type[Effect], motion: Scales) -> Effect | None:
    """An effect of the catalogue as a fit starts with it; None where such a log can't show it."""
    found = (*form.typical(motion), *form.proposals(motion))
    return found[0] if found else None


def posed(model: Model, stretches: Sequence[Stretch], paths: Sequence[str]) -> tuple[Problem, Unknowns]:
    """What the first iteration of a fit solves: short segments, one step a sample."""
    segmentation = Segmentation(short_horizon(model, stretches), halo=4, substeps=1)
    problem, unknowns = pose(model, stretches, paths, segmentation)
    # Posing has made the machine code, which is to be timed.
    _MADE.clear()
    return dataclasses.replace(problem, kernel=None), unknowns


# --- measuring -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Engines:
    """One model by both engines, times in seconds.

    Attributes:
        name: of the effect.
        lanes: sensitivities, those by parameters and by initial states.
        xla: one linearisation by XLA.
        code: likewise by machine code, with the Jacobian written.
        needed: what a fit calls: products of the Jacobian's columns.
        xla_ready: from the model to a callable residual and Jacobian.
        code_ready: likewise.
        kernel: of that, for the machine code itself; the rest is a program of JAX that depends on shapes alone.
        apart: largest difference of the two, relative to the largest number of a column, which rounding may have put
            on the other side of a corner.
    """

    name: str
    lanes: int
    xla: float
    code: float
    needed: float
    xla_ready: float
    code_ready: float
    kernel: float
    apart: float


def waited(call: Callable[[], Any]) -> tuple[Any, float]:
    """What a call gives, and the seconds it took."""
    begin = time.perf_counter()
    found = jax.block_until_ready(call())
    return found, time.perf_counter() - begin


def least(call: Callable[[], Any], repeats: int) -> float:
    """Of so many repeats: what else runs on the machine only adds."""
    return min(waited(call)[1] for _ in range(repeats))


def as_fitted(ready: Problem, unknowns: Unknowns) -> Callable[[], Any]:
    """What a fit calls."""
    own, here = task(ready, unknowns), on_host(unknowns)
    assert own is not None
    return lambda: own.look(here)


def both(name: str, problem: Problem, unknowns: Unknowns, repeats: int) -> Engines:
    """Time a model that was never seen by both engines."""
    ready, kernel = waited(lambda: with_engine(problem))
    if ready.kernel is None:
        raise SystemExit(f"{name}: there is no machine code for it here")
    needed = as_fitted(ready, unknowns)
    first = waited(needed)[1]
    reduced = least(needed, repeats)
    found, _ = waited(lambda: linearise(ready, unknowns))
    code = least(lambda: linearise(ready, unknowns), repeats)
    # A jitted function of its own: what XLA has compiled for another model is not for this one.
    by_xla = jit_lanes(lambda problem, unknowns: blocks(problem, unknowns))
    wanted, xla_first = waited(lambda: by_xla(problem, unknowns))
    xla = least(lambda: by_xla(problem, unknowns), max(2, repeats // 2))
    apart = 0.0
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        size = np.max(np.abs(theirs), axis=(0, 1) if theirs.ndim == 3 else None, keepdims=True, initial=0.0)
        apart = max(apart, float(np.max(np.abs(ours - theirs) / np.where(size > 0, size, 1.0), initial=0.0)))
    lanes = len(problem.free.paths) + unknowns.states.shape[1]
    return Engines(name, lanes, xla, code, reduced, xla_first - xla, kernel + first - reduced, kernel, apart)


# --- the C program ---------------------------------------------------------------------------------------------------

_SOURCE = """
#include <math.h>
typedef double v __attribute__((vector_size(64), aligned(8)));
#define S {stages}
#define T 6
static const double A[S][S] = {lower};
static const double B[S] = {weights};

/* x'' + mu x' + w^2 (x + alpha x^3) = gain u, eight segments side by side; sensitivities by mu, w, alpha, gain and the
   initial state. */
static void block(const double *p, const double *scale, long samples, double h, double white, const v *u, const v *y,
                  const v *start, v *rows, v *jacobian, v *products)
{{
    const double mu = p[0], w = p[1], alpha = p[2], gain = p[3], w2 = w * w;
    v x = start[0], r = start[1], tx[T], tr[T], sum[(T + 1) * (T + 1)];
    for (int t = 0; t < T; t++) tx[t] = tr[t] = (v){{0}};
    for (int k = 0; k < (T + 1) * (T + 1); k++) sum[k] = (v){{0}};
    tx[4] += 1.0;
    tr[5] += 1.0;
    for (long i = 0; i < samples; i++) {{
        v column[T + 1];
        for (int t = 0; t < T; t++) column[t] = -white * (t < 4 ? scale[t] : 1.0) * tx[t];
        column[T] = white * (y[i] - x);
        rows[i] = column[T];
        if (jacobian)
            for (int t = 0; t < T; t++) jacobian[i * T + t] = column[t];
        if (products)
            for (int a = 0; a <= T; a++)
                for (int b = a; b <= T; b++) sum[a * (T + 1) + b] += column[a] * column[b];
        if (i == samples - 1) break;
        v kx[S], kr[S], slope[S], by[S][4];
        const v force = gain * u[i];
        #pragma GCC unroll 8
        for (int s = 0; s < S; s++) {{
            v xs = x, rs = r;
            #pragma GCC unroll 8
            for (int q = 0; q < s; q++) {{ xs += (h * A[s][q]) * kx[q]; rs += (h * A[s][q]) * kr[q]; }}
            const v square = xs * xs, spring = xs + alpha * square * xs;
            kx[s] = rs;
            kr[s] = force - mu * rs - w2 * spring;
            slope[s] = -w2 * (1.0 + 3.0 * alpha * square);
            by[s][0] = -rs;
            by[s][1] = -2.0 * w * spring;
            by[s][2] = -w2 * square * xs;
            by[s][3] = u[i];
        }}
        #pragma GCC unroll 8
        for (int t = 0; t < T; t++) {{
            v dx[S], dr[S];
            #pragma GCC unroll 8
            for (int s = 0; s < S; s++) {{
                v xs = tx[t], rs = tr[t];
                #pragma GCC unroll 8
                for (int q = 0; q < s; q++) {{ xs += (h * A[s][q]) * dx[q]; rs += (h * A[s][q]) * dr[q]; }}
                dx[s] = rs;
                dr[s] = slope[s] * xs - mu * rs;
                if (t < 4) dr[s] += by[s][t];
            }}
            #pragma GCC unroll 8
            for (int s = 0; s < S; s++) {{ tx[t] += (h * B[s]) * dx[s]; tr[t] += (h * B[s]) * dr[s]; }}
        }}
        #pragma GCC unroll 8
        for (int s = 0; s < S; s++) {{ x += (h * B[s]) * kx[s]; r += (h * B[s]) * kr[s]; }}
    }}
    if (products)
        for (int k = 0; k < (T + 1) * (T + 1); k++) products[k] = sum[k];
}}

void march(const double *p, const double *scale, long blocks, long samples, double h, double white, const v *u,
           const v *y, const v *start, v *rows, v *jacobian, v *products, int threads)
{{
    #pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (long b = 0; b < blocks; b++)
        block(p, scale, samples, h, white, u + b * samples, y + b * samples, start + 2 * b, rows + b * samples,
              jacobian ? jacobian + b * samples * T : 0, products ? products + b * (T + 1) * (T + 1) : 0);
}}
"""


def _literal(rows: Sequence[Sequence[float]], width: int) -> str:
    padded = ([*row, *[0.0] * (width - len(row))] for row in rows)
    return "{" + ", ".join("{" + ", ".join(repr(float(a)) for a in row) + "}" for row in padded) + "}"


class Peer:
    """The reduced equation in C, on a problem's own segments.

    Args:
        problem: of a reduced drive, its torque held between samples.
        unknowns: where.
        threads: how many share the blocks.
        compiler: to call.
    """

    def __init__(self, problem: Problem, unknowns: Unknowns, threads: int, compiler: str):
        lower, _, weights = tableau(problem.solver)
        source = _SOURCE.format(
            stages=len(weights), lower=_literal(lower, len(weights)), weights=_literal([weights], len(weights))[1:-1]
        )
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "peer.so"
            (Path(folder) / "peer.c").write_text(source)
            options = "-O3 -march=native -mprefer-vector-width=512 -fopenmp -shared -fPIC -w".split()
            if os.uname().machine not in ("x86_64", "AMD64"):
                options.remove("-mprefer-vector-width=512")
            subprocess.run([compiler, *options, str(Path(folder) / "peer.c"), "-o", str(library)], check=True)
            self.march = ctypes.CDLL(str(library)).march
        self.march.restype = None
        segments, samples = problem.segments.weight.shape
        self.blocks, self.samples, self.threads = -(-segments // 8), samples, threads
        halo = problem.segments.halo
        self.torque = self._side_by_side(np.asarray(problem.segments.torque.coefficients)[:, halo:, 0])
        self.measured = self._side_by_side(np.asarray(problem.segments.measured)[:, :, 0])
        self.states = self._side_by_side(np.asarray(unknowns.states))
        values = problem.free.values(unknowns.parameters)
        model = problem.free.unpack(problem.model, unknowns.parameters)
        self.parameters = np.array([float(p) for p in values])
        self.scale = np.array(problem.free.slopes(model))
        knots = np.asarray(problem.segments.torque.knots)
        self.step = float(np.median(np.diff(knots, axis=1)))
        self.white = float(problem.whitening[0, 0])
        self.rows = np.empty((self.blocks, samples, 8))
        self.jacobian = np.empty((self.blocks, samples, 6, 8))
        self.products = np.empty((self.blocks, 7, 7, 8))

    def _side_by_side(self, rows: np.ndarray) -> np.ndarray:
        """Eight segments in a register; the last one again where they don't fill it."""
        filled = np.concatenate([rows, np.repeat(rows[-1:], 8 * self.blocks - len(rows), axis=0)])
        return np.ascontiguousarray(filled.reshape(self.blocks, 8, -1).transpose(0, 2, 1))

    def __call__(self, *, written: bool) -> None:
        """Residual, and either the Jacobian or the products of its columns."""

        def at(array: np.ndarray | None) -> ctypes.c_void_p:
            return ctypes.c_void_p(None if array is None else array.ctypes.data)

        self.march(
            at(self.parameters),
            at(self.scale),
            ctypes.c_long(self.blocks),
            ctypes.c_long(self.samples),
            ctypes.c_double(self.step),
            ctypes.c_double(self.white),
            at(self.torque),
            at(self.measured),
            at(self.states),
            at(self.rows),
            at(self.jacobian if written else None),
            at(None if written else self.products),
            ctypes.c_int(self.threads),
        )


def without_weights(problem: Problem) -> Problem:
    """Whole segments only: the C program knows no missing samples."""
    full = np.asarray(problem.segments.weight).min(axis=1) > 0
    keep = np.flatnonzero(full)

    def cut(leaf: Any) -> Any:
        return leaf if leaf is None or np.ndim(leaf) == 0 else jnp.asarray(np.asarray(leaf)[keep])

    return dataclasses.replace(problem, segments=jax.tree.map(cut, problem.segments))


def against_c(log: Record, threads: int, repeats: int) -> None:
    """The reduced equation, by machine code, by XLA, and by C."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        print("\nno C compiler here: nothing to compare the reduced equation with")
        return
    model, stretches = experiment(log, reduced=True)
    values = {"mu": C * TRUTH["B_sp"], "omega_0": np.sqrt(C * TRUTH["K"]), "alpha": TRUTH["alpha"], "gain": 1.0}
    model = model.replace(values)
    problem, unknowns = posed(model, stretches, base_paths(model))
    count = len(problem.segments.weight)
    problem = without_weights(problem)
    kept = len(problem.segments.weight)
    unknowns = dataclasses.replace(unknowns, states=unknowns.states[:kept])
    peer = Peer(problem, unknowns, threads, compiler)
    found = both("reduced", problem, unknowns, repeats)
    peer(written=True)
    peer(written=False)
    ours = linearise(with_engine(problem), unknowns)
    columns = np.concatenate([ours.by_parameter, ours.by_state, np.asarray(ours.residual)[..., None]], axis=2)
    wanted = np.einsum("srp,srq->spq", columns, columns)
    products = peer.products.transpose(0, 3, 1, 2).reshape(-1, 7, 7)[:kept]
    size = np.sqrt(np.einsum("spp->sp", wanted))
    upper = np.triu(np.ones((7, 7)))
    apart = np.max(np.abs(products - wanted) * upper / (size[:, :, None] * size[:, None, :]))
    print(
        f"\nthe reduced equation, {kept} of {count} segments x {peer.samples} samples, 6 lanes, Tsit5 x 1; {compiler}"
    )
    print(f"{'':<34}{'machine code':>14}{'C':>10}{'XLA':>10}{'C/code':>9}{'XLA/code':>10}   [ms]")
    for name, own, written in (("the Jacobian written", found.code, True), ("normal equations", found.needed, False)):
        c = least(lambda w=written: peer(written=w), 4 * repeats)
        times = f"{1e3 * own:14.2f}{1e3 * c:10.2f}{1e3 * found.xla:10.2f}"
        print(f"{name:<34}{times}{c / own:9.2f}{found.xla / own:10.1f}")
    verdict(f"the reduced equation at {AGAINST_C} times the speed of C: {c / own:.2f}", c / own >= AGAINST_C)
    verdict(f"its normal equations are those of C to {AGREEMENT:.0e}: {apart:.1e}", bool(apart < AGREEMENT))


# --- telling ---------------------------------------------------------------------------------------------------------


def show(rows: Sequence[Engines]) -> None:
    """Times and ratios by form."""
    print(
        f"\n{'':<44}{'lanes':>6}{'XLA':>9}{'code':>9}{'needed':>9}{'XLA/':>8}{'XLA':>9}{'code':>8}{'kernel':>8}{'XLA/':>8}"
    )
    units = f"{'':>6}{'[ms]':>9}{'[ms]':>9}{'[ms]':>9}{'needed':>8}{'[s]':>9}{'[s]':>8}{'[s]':>8}{'code':>8}"
    print(f"{'':<44}{units}{'apart':>10}")
    for r in rows:
        times = f"{1e3 * r.xla:9.2f}{1e3 * r.code:9.2f}{1e3 * r.needed:9.2f}{r.xla / r.needed:8.1f}"
        ready = f"{r.xla_ready:9.2f}{r.code_ready:8.2f}{r.kernel:8.2f}{r.xla_ready / r.code_ready:8.1f}"
        print(f"{r.name:<44}{r.lanes:6d}{times}{ready}{r.apart:10.1e}")


def show_goals(base: Engines, effects: Sequence[Engines]) -> None:
    """Whether the goals are met."""
    print()
    speed = base.xla / base.needed
    verdict(f"base model {BASE_SPEED} times as fast as XLA: {speed:.1f}", speed >= BASE_SPEED)
    verdict(f"base model ready in {BASE_SECONDS} s: {base.code_ready:.2f}", base.code_ready <= BASE_SECONDS)
    if not effects:
        return
    ratios = sorted(r.xla / r.needed for r in effects)
    median = statistics.median(ratios)
    verdict(f"one effect {EFFECT_SPEED} times, median: {median:.1f}, worst {ratios[0]:.1f}", median >= EFFECT_SPEED)
    ready = sorted(r.code_ready for r in effects)
    median = statistics.median(ready)
    text = f"ready in {MEDIAN_SECONDS} s in the median, {WORST_SECONDS} s at worst: {median:.2f}, {ready[-1]:.2f}"
    verdict(text, median <= MEDIAN_SECONDS and ready[-1] <= WORST_SECONDS)
    sooner = statistics.median(r.xla_ready / r.code_ready for r in (base, *effects))
    verdict(f"{SOONER} times sooner than XLA in the median: {sooner:.1f}", sooner >= SOONER)


def show_memory(problem: Problem, unknowns: Unknowns) -> None:
    """Peak memory of one linearisation, over that before it."""
    ready = with_engine(problem)
    by_xla = jit_lanes(blocks)
    samples = problem.segments.weight.size
    lanes = len(problem.free.paths) + unknowns.states.shape[1]
    print(f"\nmemory of one linearisation, {lanes} lanes{'[B/sample]':>40}{'[B/sample/lane]':>18}")
    kept = 0.0
    for name, call in (
        ("machine code, what a fit needs", as_fitted(ready, unknowns)),
        ("machine code, the Jacobian written", lambda: linearise(ready, unknowns)),
        ("XLA", lambda: by_xla(problem, unknowns)),
    ):
        jax.block_until_ready(call())
        grown = _growth(lambda call=call: jax.block_until_ready(call()))
        if grown is None:
            print("  this system does not tell")
            return
        kept = kept or grown / samples / lanes
        print(f"  {name:<60}{grown / samples:>17.0f}{grown / samples / lanes:>18.1f}")
    verdict(f"under {MEMORY:.0f} bytes a sample and lane: {kept:.1f}", kept < MEMORY)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1, help="of both engines and of the C program")
    parser.add_argument("--forms", type=int, default=len(CATALOGUE), help="so many forms, spread over the catalogue")
    args = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        # Before JAX counts them.
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: args.threads])
        args.threads = len(os.sched_getaffinity(0))
    else:
        print("this system does not pin threads: both engines take as many as they like")
    jax.config.update("jax_enable_x64", True)

    log = record(args.samples)
    base, stretches = experiment(log, reduced=False)
    base = base.replace(TRUTH)
    print(f"{args.samples} samples at {RATE:.0f} Hz, {args.threads} threads each, least of {args.repeats} repeats")
    motion = dataclasses.replace(
        scales(stretches, base), residual_frequencies=(300.0,), temperature=300.5, temperature_change=0.3
    )
    warm = with_temperature(stretches)
    # Whatever JAX and LLVM do when they are first called is no model's.
    other, log_alone = experiment(record(500), reduced=True)
    both("", *posed(other, log_alone, base_paths(other)), 2)

    problem, unknowns = posed(base, stretches, base_paths(base))
    rows = [both("two inertias", problem, unknowns, args.repeats)]
    chosen = np.unique(np.linspace(0, len(CATALOGUE) - 1, max(0, args.forms)).round().astype(int))
    for form in (CATALOGUE[i] for i in chosen):
        effect = proposed(form, motion)
        if effect is None:
            print(f"{form.name}: such a log can't show it")
            continue
        model = of_some_strength(base.with_effects(effect))
        data = warm if effect.needs_temperature else stretches
        rows.append(both(form.name, *posed(model, data, fitted_paths(model)), args.repeats))
    show(rows)
    show_goals(rows[0], rows[1:])
    show_memory(problem, unknowns)
    against_c(log, args.threads, args.repeats)


if __name__ == "__main__":
    main()
