"""One 20,000-sample log: this project's fit against numba RK4 with scipy.optimize.least_squares, on the same work.

Both minimise the same sum of squares, of measured minus simulated dynamic error over the whole log, over K, alpha,
B_sp and the initial state. What each is given, and what the columns mean, is in README.md beside this file.
"""

import argparse
import ctypes
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numba
import numpy as np
from scipy.optimize import least_squares

from fitting.estimation.arrow_system import normal_equations
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation, natural_frequency, short_horizon, suggested_substeps
from fitting.estimation.residual import Products, blocks, residual
from fitting.estimation.starting_values import starting_models
from hdjax import Drive, Model, ReducedDrive, ReducedModel, TwoInertiaModel, sampled
from hdjax.lanes import jit_lanes

GOAL = 5.0
AGREEMENT = 1e-6
RATE = 2000.0
NOISE = 1e-6
TRUTH = {"K": 7160.0, "alpha": 4000.0, "B_sp": 0.3}
N, J_M, J_L = 50.0, 5.26e-4, 5.0e-2
C = (N**2 * J_M + J_L) / (N**2 * J_M * J_L)
# Substeps of the agreement check: both step errors are then far below 1e-6 of any parameter.
FINE_OURS, FINE_PEER = 4, 16


# --- the log ---------------------------------------------------------------------------------------------------------


@numba.njit
def _two_inertia(state, torque, K, alpha, B_sp):
    x = state[0] / N - state[1]
    v = state[2] / N - state[3]
    tau = K * (x + alpha * x**3) + B_sp * v
    return np.array([state[2], state[3], (torque - tau / N) / J_M, tau / J_L])


@numba.njit
def _record(torque, dt, substeps, K, alpha, B_sp):
    """States of the drive at the samples: RK4 under torque that is held between samples."""
    h = dt / substeps
    state = np.zeros(4)
    out = np.empty((torque.size, 4))
    for k in range(torque.size):
        out[k] = state
        for _ in range(substeps):
            k1 = _two_inertia(state, torque[k], K, alpha, B_sp)
            k2 = _two_inertia(state + 0.5 * h * k1, torque[k], K, alpha, B_sp)
            k3 = _two_inertia(state + 0.5 * h * k2, torque[k], K, alpha, B_sp)
            k4 = _two_inertia(state + h * k3, torque[k], K, alpha, B_sp)
            state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return out


@dataclass(frozen=True)
class Record:
    """A simulated log, with encoder noise on both angles."""

    time: np.ndarray
    torque: np.ndarray
    motor_angle: np.ndarray
    dynamic_error: np.ndarray
    clean: np.ndarray

    @property
    def forcing(self) -> np.ndarray:
        """F = T_m / (N J_m) [rad/s^2]; there is no load torque."""
        return self.torque / (N * J_M)


def record(samples: int, seed: int = 0) -> Record:
    """The log that everything here fits: a multisine from 5 Hz to 150 Hz, held between samples."""
    rng = np.random.default_rng(seed)
    dt = 1.0 / RATE
    t = np.arange(samples) * dt
    lines = np.arange(5.0, 150.0, 0.5)
    phases = rng.uniform(0, 2 * np.pi, lines.size)
    torque = 0.5 * np.sqrt(2 / lines.size) * np.cos(2 * np.pi * np.outer(t, lines) + phases).sum(1)
    states = _record(torque, dt, 20, TRUTH["K"], TRUTH["alpha"], TRUTH["B_sp"])
    output, load = states[:, 0] / N, states[:, 1]
    noisy_output = output + rng.normal(0, NOISE / np.sqrt(2), samples)
    noisy_load = load + rng.normal(0, NOISE / np.sqrt(2), samples)
    return Record(t, torque, N * noisy_output, noisy_output - noisy_load, output - load)


# --- the peer: numba RK4, single shooting, scipy ---------------------------------------------------------------------


@numba.njit(fastmath=True)
def _shoot(forcing, dt, substeps, w2, cubic, mu, x, v):
    """RK4 of x'' + mu x' + w2 x + cubic x^3 = F, in scalars; x at the samples."""
    h = dt / substeps
    out = np.empty(forcing.size)
    for k in range(forcing.size):
        out[k] = x
        F = forcing[k]
        for _ in range(substeps):
            a1 = F - mu * v - x * (w2 + cubic * x * x)
            x2, v2 = x + 0.5 * h * v, v + 0.5 * h * a1
            a2 = F - mu * v2 - x2 * (w2 + cubic * x2 * x2)
            x3, v3 = x + 0.5 * h * v2, v + 0.5 * h * a2
            a3 = F - mu * v3 - x3 * (w2 + cubic * x3 * x3)
            x4, v4 = x + h * v3, v + h * a3
            a4 = F - mu * v4 - x4 * (w2 + cubic * x4 * x4)
            x += h / 6.0 * (v + 2.0 * (v2 + v3) + v4)
            v += h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)
    return out


def simulate_peer(log: Record, values: Sequence[float], substeps: int) -> np.ndarray:
    """The dynamic error at K, alpha, B_sp and initial x, v."""
    K, alpha, B_sp, x, v = values
    return _shoot(log.forcing, 1.0 / RATE, substeps, C * K, C * K * alpha, C * B_sp, x, v)


def fit_peer(log: Record, start: np.ndarray, scale: np.ndarray, *, method: str, substeps: int):
    """What a strong user writes. Unknowns are in units of `scale`, the residual in units of the noise."""

    def residual(scaled):
        return (simulate_peer(log, scaled * scale, substeps) - log.dynamic_error) / NOISE

    found = least_squares(residual, start / scale, method=method, jac="2-point", x_scale=1.0)
    return found.x * scale, found


def peer_start(log: Record, away: float) -> tuple[np.ndarray, np.ndarray]:
    """A start: K a fraction `away` off, alpha and B_sp 10 % off, the state from the first samples; and a scale."""
    rate = float(np.polyfit(log.time[:9], log.dynamic_error[:9], 3)[-2])
    start = np.array([TRUTH["K"] * (1 + away), 0.9 * TRUTH["alpha"], 0.9 * TRUTH["B_sp"], log.dynamic_error[0], rate])
    spread = float(np.std(log.dynamic_error))
    scale = np.array([*TRUTH.values(), spread, spread * np.sqrt(C * TRUTH["K"])])
    return start, scale


# --- ours ------------------------------------------------------------------------------------------------------------


def experiment(log: Record, *, reduced: bool) -> tuple[Model, tuple[Stretch, ...]]:
    """The log as `fitting` takes it: both encoders, or the dynamic error alone with gain 1."""
    torque = sampled(log.time, log.forcing if reduced else log.torque, hold="zero-order")
    if reduced:
        model: Model = ReducedModel(ReducedDrive(mu=1.0, omega_0=100.0, alpha=0.0, gain=1.0))
        measured = log.dynamic_error[:, None]
    else:
        model = TwoInertiaModel(Drive(N=N, J_m=J_M, J_l=J_L, K=1e4))
        measured = np.stack([log.motor_angle / N, log.dynamic_error], axis=1)
    angle = None if reduced else log.motor_angle
    ours = Experiment("bench", log.time, torque, None, measured, angle)
    return model, (Stretch(ours, 0, len(ours)),)


def free_paths(model: Model) -> tuple[str, ...]:
    """K, alpha, B_sp, or what stands for them in the reduced equation."""
    return tuple(p for p in base_paths(model) if p != "gain")


def start_ours(model: Model, stretches: Sequence[Stretch]) -> Model:
    """The first start that the weak form finds; a reduced model's gain is known to be 1."""
    found = starting_models(model, stretches)[0]
    return found.replace({"gain": 1.0}) if isinstance(found, ReducedModel) else found


def physical(model: Model) -> np.ndarray:
    """K, alpha, B_sp of a fitted model."""
    drive = model.drive
    if isinstance(drive, Drive):
        return np.array([float(drive.K), float(drive.alpha), float(drive.B_sp)])
    return np.array([float(drive.omega_0) ** 2 / C, float(drive.alpha), float(drive.mu) / C])


def at(model: Model, values: np.ndarray) -> Model:
    """The model at given K, alpha, B_sp."""
    K, alpha, B_sp = values
    if isinstance(model, ReducedModel):
        return model.replace({"omega_0": np.sqrt(C * K), "alpha": alpha, "mu": C * B_sp})
    return model.replace({"K": K, "alpha": alpha, "B_sp": B_sp})


@dataclass(frozen=True)
class Ours:
    """The calls that are timed, on one formulation of the log."""

    model: Model
    stretches: tuple[Stretch, ...]

    def short(self) -> Fit:
        """From the weak form's start, in short segments."""
        return self.short_from(start_ours(self.model, self.stretches))

    def short_from(self, start: Model) -> Fit:
        """From a given start, in short segments."""
        return fit(start, self.stretches, free_paths(start), Segmentation(short_horizon(start, self.stretches)))

    def whole_from(self, start: Model, *, substeps: int | None = None, reweigh: bool = True) -> Fit:
        """From a given start, the log as one segment: the peer's problem."""
        length = len(self.stretches[0])
        return fit(
            start,
            self.stretches,
            free_paths(start),
            Segmentation(length, substeps=substeps),
            strategy=Strategy(reweigh=reweigh),
        )

    def both(self) -> Fit:
        """From nothing but the log, to the fit of the whole log."""
        return self.whole_from(self.short().model)


# --- measuring -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One line of the table, times in seconds."""

    name: str
    first: float
    median: float
    least: float
    result: Any
    memory: float | None


def timed(name: str, call: Callable[[], Any], repeats: int) -> Row:
    """First call (with compilation), then the median of `repeats`, then the growth of memory in one more."""
    begin = time.perf_counter()
    result = call()
    first = time.perf_counter() - begin
    spent = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        spent.append(time.perf_counter() - begin)
    return Row(name, first, statistics.median(spent), min(spent), result, _growth(call))


def _growth(call: Callable[[], Any]) -> float | None:
    """Peak resident memory during a call over that before it [bytes]; Linux only."""
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except (OSError, AttributeError):
        return None
    before = _status("VmRSS")
    call()
    return max(0.0, _status("VmHWM") - before)


def _status(key: str) -> float:
    with open("/proc/self/status") as file:
        for line in file:
            if line.startswith(key + ":"):
                return 1024.0 * float(line.split()[1])
    raise OSError(f"/proc/self/status has no {key}")


# --- telling ---------------------------------------------------------------------------------------------------------


def show_table(rows: Sequence[Row], peer: Row, samples: int) -> None:
    """Times, ratios and memory."""
    print(f"\n{'':<62}{'median':>9}{'least':>9}{'first':>9}{'peer/this':>11}{'memory':>11}")
    print(f"{'':<62}{'[ms]':>9}{'[ms]':>9}{'[ms]':>9}{'':>11}{'[B/sample]':>11}")
    for row in rows:
        memory = "" if row.memory is None else f"{row.memory / samples:.0f}"
        times = f"{1e3 * row.median:9.1f}{1e3 * row.least:9.1f}{1e3 * row.first:9.0f}"
        print(f"{row.name:<62}{times}{peer.median / row.median:11.2f}{memory:>11}")


def show_parameters(entries: Sequence[tuple[str, np.ndarray]], reference: np.ndarray) -> None:
    """Parameters, and how far each is from the reference (both methods with fine steps agree on it)."""
    print(f"\n{'':<46}{'K':>14}{'alpha':>14}{'B_sp':>14}   relative to the last line")
    for name, values in entries:
        shown = f"{values[0]:14.6f}{values[1]:14.6f}{values[2]:14.9f}"
        apart = " ".join(f"{d:+.1e}" for d in values / reference - 1)
        print(f"{name:<46}{shown}   {apart}")


def verdict(text: str, held: bool) -> None:
    """One line that says whether a goal is met."""
    print(f"  {'met   ' if held else 'MISSED'}  {text}")


def show_profile(row: Row, repeats: int) -> None:
    """Where the time of one fit goes: compiled parts, timed apart, times how often they run."""
    found: Fit = row.result
    problem, unknowns = found.problem, found.unknowns
    at_solution = _linearise(problem, unknowns)
    system = _system(at_solution, problem.segments.joined)
    parts = {
        "simulation with sensitivities": lambda: _linearise(problem, unknowns),
        "normal equations": lambda: _system(at_solution, problem.segments.joined),
        "step": lambda: _step(system),
    }
    print(f"\nwhere the time of '{row.name}' goes ({found.steps} iterations, least of {repeats}):")
    known = 0.0
    for name, call in parts.items():
        each = timed(name, lambda c=call: jax.block_until_ready(c()), repeats).least
        known += each * found.steps
        print(f"  {name:<32}{1e3 * each:7.2f} ms each {1e3 * each * found.steps:8.1f} ms together")
    rest = "rest: host, blocks of the last step"
    print(f"  {rest:<32}{'':15} {1e3 * (row.least - known):8.1f} ms")
    print(f"  simulation alone, without sensitivities: {1e3 * timed('', _residual(found), repeats).least:.2f} ms")


_linearise = jit_lanes(blocks)
_system = eqx.filter_jit(lambda found, joined: normal_equations(Products.of(found), joined))
_step = eqx.filter_jit(lambda system: system.step(jnp.zeros(())))
_simulated = jit_lanes(residual)


def _residual(found: Fit) -> Callable[[], Any]:
    return lambda: jax.block_until_ready(_simulated(found.problem, found.unknowns))


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--away", type=float, default=1e-3, help="the peer's start is this fraction off in K")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)

    log = record(args.samples)
    x = log.dynamic_error
    stiffening = TRUTH["alpha"] * np.max(np.abs(x)) ** 2
    print(f"{args.samples} samples at {RATE:.0f} Hz; twist rms {np.std(x):.2e}, max {np.max(np.abs(x)):.2e} rad,")
    print(f"alpha x_max^2 {stiffening:.3f}; noise {NOISE:.0e} rad; {args.repeats} repeats, {jax.devices()[0]}")

    # What either solver's steps do to the dynamic error, at the truth.
    truth = np.array([*TRUTH.values(), 0.0, 0.0])
    for n in (1, 2, 4):
        step_error = np.sqrt(np.mean((simulate_peer(log, truth, n) - log.clean) ** 2))
        print(
            f"step error of the peer's RK4 with {n} substeps: {step_error:.1e} rad rms, {step_error / NOISE:.3f} noise"
        )

    start, scale = peer_start(log, args.away)
    reduced, both_encoders = (Ours(*experiment(log, reduced=r)) for r in (True, False))
    rows = []
    peers = {}
    for method in ("lm", "trf"):
        for n in (2, 4):
            name = f"peer: numba RK4 x {n} + scipy {method}, start {args.away:.1%} off"
            row = timed(name, lambda m=method, n=n: fit_peer(log, start, scale, method=m, substeps=n), args.repeats)
            peers[method, n] = row
            rows.append(row)
    ours = {}
    for label, case in (("x", reduced), ("both encoders", both_encoders)):

        def run(key: str, what: str, call: Callable[[], Any], label: str = label) -> Any:
            ours[label, key] = timed(f"ours ({label}): {what}", call, args.repeats)
            rows.append(ours[label, key])
            return ours[label, key].result

        first = run("start", "weak-form start", lambda c=case: start_ours(c.model, c.stretches))
        near = run("short", "short segments", lambda c=case, m=first: c.short_from(m)).model
        run("whole", "whole log, after short segments", lambda c=case, m=near: c.whole_from(m))
        run("finer", "the same, 2 substeps", lambda c=case, m=near: c.whole_from(m, substeps=2))
        away = at(first, start[:3])
        run("peer_start", "whole log, from the peer's start", lambda c=case, m=away: c.whole_from(m))
        run("all", "start, short segments, whole log", lambda c=case: c.both())
    # The strongest peer is the one to beat: the fastest, however rough its steps.
    peer = min(peers.values(), key=lambda r: r.median)
    show_table(rows, peer, args.samples)
    print(f"first: with compilation, where something had to be compiled. peer/this: against {peer.name}.")

    show_profile(ours["x", "peer_start"], args.repeats)
    print()
    for key, row in peers.items():
        found = row.result[1]
        print(f"peer {key}: {found.nfev} calls, cost {2 * found.cost / args.samples:.4f} noise^2")
    for away in (0.01, 0.1):
        found = fit_peer(log, peer_start(log, away)[0], scale, method="lm", substeps=2)[1]
        print(f"peer lm from {away:.0%} off in K: {found.nfev} calls, cost {2 * found.cost / args.samples:.4g} noise^2")
    for (label, key), row in ours.items():
        if isinstance(row.result, Fit):
            f = row.result
            shape = f"{f.error.shape[0]} x {f.error.shape[1]}, {f.substeps} substeps"
            rms = f.principal_std / NOISE
            print(f"ours {label}, {key}: {shape}, {f.steps} steps, converged {f.converged}, x error {rms:.4f} noise")
    model, stretches = ours["x", "short"].result.model, reduced.stretches
    angle = natural_frequency(model, stretches) / RATE
    print(f"omega_0 dt at full twist {angle:.3f} rad; suggested substeps {suggested_substeps(model, stretches)}")

    # The agreement: the same sum of squares, steps fine in both, so that only the minimisers differ.
    fine_peer, _ = fit_peer(log, peer.result[0], scale, method="lm", substeps=FINE_PEER)
    fine_ours = physical(reduced.whole_from(model, substeps=FINE_OURS).model)
    entries = [("truth", np.array(list(TRUTH.values())))]
    entries += [(f"peer {m}, RK4 x {n}", row.result[0][:3]) for (m, n), row in peers.items()]
    for (label, key), row in ours.items():
        if isinstance(row.result, Fit):
            entries.append((f"ours ({label}), {key}", physical(row.result.model)))
    entries += [(f"ours (x), whole, Tsit5 x {FINE_OURS}", fine_ours), (f"peer lm, RK4 x {FINE_PEER}", fine_peer[:3])]
    show_parameters(entries, fine_peer[:3])

    def apart(values: np.ndarray) -> float:
        return float(np.max(np.abs(values / fine_peer[:3] - 1)))

    print(f"\ngoals ({GOAL:.0f} times faster, same answer to {AGREEMENT:.0e} relative):")
    for label in ("x", "both encoders"):
        for key in ("whole", "finer", "all", "peer_start"):
            ratio = peer.median / ours[label, key].median
            verdict(f"speed, {ours[label, key].name}: {ratio:.2f} = {ratio / GOAL:.2f} of the goal", ratio >= GOAL)
    gap = apart(fine_ours)
    verdict(f"same answer with fine steps in both: {gap:.1e} (dynamic error only)", gap <= AGREEMENT)
    print("  the answers as timed, against the answer with fine steps:")
    for key in ("whole", "finer", "all"):
        gap = apart(physical(ours["x", key].result.model))
        verdict(f"{ours['x', key].name}: {gap:.1e}", gap <= AGREEMENT)
    for row in peers.values():
        gap = apart(row.result[0][:3])
        verdict(f"{row.name}: {gap:.1e}", gap <= AGREEMENT)
    if ours["x", "all"].memory is not None:
        each = ours["x", "all"].memory / args.samples
        lanes = len(free_paths(reduced.model)) + 2
        verdict(f"memory {each / lanes:.0f} bytes a sample and lane ({lanes} lanes)", each / lanes < 100)


if __name__ == "__main__":
    main()
