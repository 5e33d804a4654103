"""Does a fit without starting values end in the right minimum? Drives and logs drawn at random, each with its verdict.

Every draw is simulated by this script's own Runge-Kutta in dimensionless form (omega_0 = 1, twist of order 1) and then
scaled to units; `fitting.estimation.base_fit.base_fit` gets nothing but the log. See README.md beside this file.
"""

import argparse
import json
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import jax
import numba
import numpy as np
from scipy.signal import lfilter

from fitting.errors import DataError
from fitting.estimation.base_fit import base_fit, leaves_white_noise
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.outliers import left_out
from fitting.estimation.problem import Segmentation
from fitting.estimation.whole_log_fit import long_fit
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, Model, ReducedDrive, ReducedModel, TwoInertiaModel, sampled

EXCITATIONS = ("multisine", "chirp", "steps", "slow", "harmonic")
# RK4 turns the fastest oscillation by this angle a step [rad]: phase errors of 1e-9 a radian.
STEP_ANGLE = 0.02
# Within so many standard errors of the truth a minimum is the right one.
SIGMAS = 5.0


@dataclass(frozen=True)
class Draw:
    """One drive and its log. Twist is in units of its largest value, time in units of 1/omega_0.

    Attributes:
        index: of the draw; with the study's seed it fixes everything.
        reduced: whether the log holds the dynamic error alone.
        excitation: one of EXCITATIONS.
        stiffness: K [N m/rad].
        inertias: J_m, J_l [kg m^2].
        ratio: N.
        zeta: damping ratio.
        hardening: alpha x_max^2.
        twist: x_max [rad].
        gain: of a reduced log's forcing, in the dimensionless equation.
        noise: rms of the dynamic error's noise in units of its signal's.
        motor_share: share of that noise's variance that comes from the motor's encoder.
        torque_noise: rms of the logged torque's noise in units of the torque's.
        samples_a_period: sampling rate over natural frequency.
        count: samples.
        outliers: share of samples with a spike, of 0.05 to 20 times the signal's rms.
        colour: correlation time of the angles' noise in natural periods; 0 is white.
    """

    index: int
    reduced: bool
    excitation: str
    stiffness: float
    inertias: tuple[float, float]
    ratio: float
    zeta: float
    hardening: float
    twist: float
    gain: float
    noise: float
    motor_share: float
    torque_noise: float
    samples_a_period: float
    count: int
    outliers: float
    colour: float

    @property
    def c(self) -> float:
        """(N^2 J_m + J_l) / (N^2 J_m J_l) [1/(kg m^2)]."""
        motor = self.ratio**2 * self.inertias[0]
        return (motor + self.inertias[1]) / (motor * self.inertias[1])

    @property
    def omega_0(self) -> float:
        """Natural frequency [rad/s]."""
        return float(np.sqrt(self.c * self.stiffness))


def draw(index: int, seed: int, counts: tuple[int, ...], outliers: float, colour: float) -> Draw:
    """The draw of that number."""
    random = np.random.default_rng([seed, index])

    def logarithmic(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    kind = random.uniform()
    hardening = 0.0 if kind < 0.15 else -random.uniform(0.01, 0.6) if kind < 0.35 else logarithmic(1e-3, 1.0)
    return Draw(
        index=index,
        reduced=bool(random.uniform() < 0.5),
        excitation=str(random.choice(EXCITATIONS)),
        stiffness=logarithmic(1e3, 1e7),
        inertias=(logarithmic(1e-5, 1e-2), logarithmic(1e-2, 1e1)),
        ratio=float(random.choice([30, 50, 80, 100, 120, 160])),
        zeta=logarithmic(1e-4, 0.3),
        hardening=hardening,
        twist=logarithmic(1e-4, 1e-2),
        gain=logarithmic(1e-2, 1e2) * float(random.choice([-1, 1])),
        noise=logarithmic(1e-4, 0.3),
        motor_share=float(random.choice([0.02, 0.5, 0.98])),
        torque_noise=0.0 if random.uniform() < 0.4 else logarithmic(1e-3, 0.1),
        samples_a_period=logarithmic(6.0, 200.0),
        count=int(random.choice(counts)),
        outliers=outliers,
        colour=colour,
    )


# --- the log ---------------------------------------------------------------------------------------------------------


@numba.njit
def _twist(forcing, dt, substeps, zeta, hardening):
    """The twist of x'' + 2 zeta x' + x + hardening x^3 = f from rest, f held between samples, by RK4."""
    h = dt / substeps
    x, v = 0.0, 0.0
    out = np.empty(forcing.size)
    for k in range(forcing.size):
        out[k] = x
        f = forcing[k]
        for _ in range(substeps):
            a1 = f - 2 * zeta * v - x * (1 + hardening * x * x)
            x2, v2 = x + 0.5 * h * v, v + 0.5 * h * a1
            a2 = f - 2 * zeta * v2 - x2 * (1 + hardening * x2 * x2)
            x3, v3 = x + 0.5 * h * v2, v + 0.5 * h * a2
            a3 = f - 2 * zeta * v3 - x3 * (1 + hardening * x3 * x3)
            x4, v4 = x + h * v3, v + h * a3
            a4 = f - 2 * zeta * v4 - x4 * (1 + hardening * x4 * x4)
            x += h / 6 * (v + 2 * (v2 + v3) + v4)
            v += h / 6 * (a1 + 2 * (a2 + a3) + a4)
        if not abs(x) < 1e3:
            out[k + 1 :] = np.inf
            break
    return out


@numba.njit
def _rigid(twist, torque, dt, substeps, zeta, hardening, share):
    """Output angle of the motor, theta_m/N, when the mesh twists by the given law; RK4 of all four states.

    The motor's share of the relative acceleration is `share`, the load's 1 - share.
    """
    h = dt / substeps
    y = np.zeros(4)
    out = np.empty((torque.size, 2))
    for k in range(torque.size):
        out[k, 0], out[k, 1] = y[0], y[1]
        f = torque[k]
        for _ in range(substeps):
            total = np.zeros(4)
            slope = np.zeros(4)
            for stage in range(4):
                weight = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                z = y + h * weight * slope
                x, v = z[0] - z[1], z[2] - z[3]
                tau = x * (1 + hardening * x * x) + 2 * zeta * v
                slope = np.array([z[2], z[3], f - share * tau, (1 - share) * tau])
                total += slope * (1.0 if stage in (0, 3) else 2.0)
            y = y + h / 6 * total
    return out


def _forcing(drawn: Draw, random: np.random.Generator) -> np.ndarray:
    """Shape of the forcing at the samples, over dimensionless time."""
    dt = 2 * np.pi / drawn.samples_a_period
    t = np.arange(drawn.count) * dt
    length = drawn.count * dt
    # Far enough below half the sampling rate.
    highest = 0.4 * drawn.samples_a_period

    def lines(low: float, high: float) -> np.ndarray:
        first = max(1, int(np.ceil(low * length / (2 * np.pi))))
        last = max(first + 2, int(high * length / (2 * np.pi)))
        w = 2 * np.pi * np.arange(first, last + 1) / length
        return np.cos(np.outer(t, w) + random.uniform(0, 2 * np.pi, w.size)).sum(1)

    match drawn.excitation:
        case "multisine":
            return lines(random.uniform(0.05, 0.5), min(highest, random.uniform(1.2, 3.0)))
        case "chirp":
            low, high = random.uniform(0.1, 0.5), min(highest, random.uniform(1.5, 3.0))
            return np.sin(low * t + 0.5 * (high - low) * t**2 / length)
        case "steps":
            hold = max(2, int(random.uniform(1.0, 5.0) * drawn.samples_a_period))
            levels = random.normal(size=drawn.count // hold + 1)
            return np.repeat(levels, hold)[: drawn.count]
        case "slow":
            return lines(0.0, 0.2)
        case _:
            return np.cos(random.uniform(0.3, min(highest, 1.5)) * t + random.uniform(0, 2 * np.pi))


def _swung(drawn: Draw, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Forcing and twist with the forcing scaled until the twist reaches about 1, and the Runge-Kutta steps a sample."""
    dt = 2 * np.pi / drawn.samples_a_period
    substeps = int(np.ceil(dt * np.sqrt(1 + 3 * max(drawn.hardening, 0.0)) / STEP_ANGLE))
    # Softening: well inside the basin that ends at x^2 = -1/alpha.
    scale, best = 1e-3 / np.std(shape), None
    for _ in range(60):
        x = _twist(scale * shape, dt, substeps, drawn.zeta, drawn.hardening)
        top = float(np.max(np.abs(x)))
        if top <= 1.05:
            best = scale
        if 0.8 <= top <= 1.05:
            break
        scale *= 0.7 if top > 1e2 else float(np.clip(1 / top, 0.75, 50.0))
    assert best is not None
    return best * shape, _twist(best * shape, dt, substeps, drawn.zeta, drawn.hardening), substeps


def log_of(drawn: Draw, seed: int) -> tuple[Model, Model, tuple[Stretch, ...]]:
    """A placeholder model, the true model, and the log in units."""
    random = np.random.default_rng([seed, drawn.index, 1])
    forcing, x, substeps = _swung(drawn, _forcing(drawn, random))
    dt = 2 * np.pi / drawn.samples_a_period
    unit, omega = drawn.twist, drawn.omega_0
    time_axis = np.arange(drawn.count) * dt / omega
    spread = float(np.std(x)) * unit
    noise = drawn.noise * spread

    def spoiled(signal: np.ndarray, rms: float) -> np.ndarray:
        memory = np.exp(-1 / (drawn.colour * drawn.samples_a_period)) if drawn.colour > 0 else 0.0
        white = random.normal(size=signal.size) * np.sqrt(1 - memory**2)
        noisy = signal + rms * lfilter([1.0], [1.0, -memory], white)
        spikes = random.uniform(size=signal.size) < drawn.outliers
        size = np.exp(random.uniform(np.log(0.05), np.log(20.0), size=signal.size))
        return noisy + spread * size * spikes * random.choice([-1.0, 1.0], size=signal.size)

    logged = forcing + drawn.torque_noise * np.std(forcing) * random.normal(size=forcing.size)
    alpha = drawn.hardening / unit**2
    if drawn.reduced:
        placeholder: Model = ReducedModel(ReducedDrive(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0))
        gain = drawn.gain * unit * omega**2
        truth = placeholder.replace({"mu": 2 * drawn.zeta * omega, "omega_0": omega, "alpha": alpha, "gain": gain})
        torque = sampled(time_axis, logged / drawn.gain, hold="zero-order")
        measured = spoiled(unit * x, noise)[:, None]
        angle = None
    else:
        J_m, J_l = drawn.inertias
        N = drawn.ratio
        placeholder = TwoInertiaModel(Drive(N=N, J_m=J_m, J_l=J_l, K=1.0))
        truth = placeholder.replace({"K": drawn.stiffness, "alpha": alpha, "B_sp": 2 * drawn.zeta * omega / drawn.c})
        torque = sampled(time_axis, logged * unit * omega**2 * N * J_m, hold="zero-order")
        share = 1 / (N**2 * J_m * drawn.c)
        motion = unit * _rigid(x, forcing, dt, substeps, drawn.zeta, drawn.hardening, share)
        motor = spoiled(motion[:, 0], noise * np.sqrt(drawn.motor_share))
        load = spoiled(motion[:, 1], noise * np.sqrt(1 - drawn.motor_share))
        measured = np.stack([motor, motor - load], axis=1)
        angle = N * motor
    ours = Experiment(f"draw {drawn.index}", time_axis, torque, None, measured, angle)
    return placeholder, truth, (Stretch(ours, 0, len(ours)),)


# --- the verdict -----------------------------------------------------------------------------------------------------


def fit_from(truth: Model, found: Fit) -> Fit:
    """The fit of the same data, cut the same way, that starts at the truth."""
    return fit(
        truth,
        found.stretches,
        base_paths(truth),
        Segmentation(found.horizon, substeps=found.substeps, count=found.error.shape[0]),
    )


def judge(drawn: Draw, seed: int, *, short: bool) -> dict:
    """Fit one draw and say how it went."""
    placeholder, truth, stretches = log_of(drawn, seed)
    begin = time.perf_counter()
    try:
        found = base_fit(placeholder, stretches).fit
    except DataError as error:
        return {"draw": asdict(drawn), "verdict": "refused", "error": str(error)}
    spent = time.perf_counter() - begin
    peer = fit_from(truth, found)
    final = found if short else long_fit(found)
    try:
        estimates = uncertainty(final).estimates
    except np.linalg.LinAlgError as error:
        return {"draw": asdict(drawn), "verdict": "CRASHED", "error": str(error)}
    entries = {}
    for path, estimate in estimates.items():
        true = float(truth.get(path))
        entries[path] = {
            "true": true,
            "value": estimate.value,
            "std": estimate.std,
            "sigmas": (estimate.value - true) / estimate.std if estimate.std > 0 else None,
            "peer": float(peer.model.get(path)),
            "identifiable": estimate.identifiable,
            "inside": estimate.ci95[0] <= true <= estimate.ci95[1],
        }
    # Twice the gain in log-likelihood over the fit that began at the truth.
    excess = 2 * drawn.count * (found.objective - peer.objective)
    near = {p: e["sigmas"] is not None and abs(e["sigmas"]) < SIGMAS for p, e in entries.items()}
    if all(near.values()):
        verdict = "right"
    elif excess < 1.0:
        # Nothing better is to be found: what is off is the model (the torque's noise), not the search.
        verdict = "same minimum" if leaves_white_noise(found) else "misfit told"
    elif all(near[p] or not e["identifiable"] for p, e in entries.items()):
        verdict = "flagged"
    else:
        verdict = "WRONG"
    return {
        "draw": asdict(drawn),
        "verdict": verdict,
        "excess": excess,
        "seconds": spent,
        "horizon": found.horizon,
        "substeps": found.substeps,
        "converged": found.converged,
        "steps": found.steps,
        "left_out": left_out(found.stretches),
        "parameters": entries,
    }


def line(result: dict) -> str:
    """One line about one draw; in brackets standard errors from the truth, with a mark where not identifiable."""
    d = result["draw"]
    kind = "reduced" if d["reduced"] else "drive"
    told = (
        f"{d['index']:4d} {result['verdict']:<13} {kind:<8}{d['excitation']:<10} n {d['count']:6d} "
        f"zeta {d['zeta']:.1e} ax2 {d['hardening']:+.3f} noise {d['noise']:.1e} torque {d['torque_noise']:.1e} "
        f"spp {d['samples_a_period']:5.1f}"
    )
    if "parameters" in result:
        told += f" excess {result['excess']:.3g} {result['seconds']:.1f}s {result['horizon']}x{result['substeps']} |"
        for path, e in result["parameters"].items():
            told += f" {path} {e['value'] / e['true'] if e['true'] else e['value']:.4g}"
            told += f" ({e['sigmas']:+.1f}{'' if e['identifiable'] else '?'})"
    return told


def coverage(results: list[dict]) -> list[str]:
    """How often the 95 % intervals hold the truth, by parameter; noise of the torque apart, which no fit that takes
    the torque as it is logged knows of."""
    lines = []
    for noisy_torque in (False, True):
        chosen = [r for r in results if "parameters" in r and (r["draw"]["torque_noise"] > 0) == noisy_torque]
        inside: dict[str, list[bool]] = {}
        for result in chosen:
            for path, entry in result["parameters"].items():
                inside.setdefault(path, []).append(entry["inside"])
        told = ", ".join(f"{path} {100 * np.mean(held):.1f} % of {len(held)}" for path, held in inside.items())
        lines.append(f"coverage, torque {'with' if noisy_torque else 'without'} noise: {told}")
    return lines


def main() -> None:
    """Run the draws that are not in the output yet, and print the tally."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--only", type=int, nargs="*", help="these draws alone, without writing")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--counts", type=int, nargs="+", default=[2000])
    parser.add_argument("--outliers", type=float, default=0.0)
    parser.add_argument("--colour", type=float, default=0.0, help="of the noise, in natural periods; 0 is white")
    parser.add_argument("--short", action="store_true", help="judge the fit over six periods, not the one over the log")
    parser.add_argument("--out", type=Path, default=None, help="one JSON line a draw; what it holds is not run again")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = []
    if args.out is not None and args.out.exists() and args.only is None:
        results = [json.loads(text) for text in args.out.read_text().splitlines()]
    done = {r["draw"]["index"] for r in results}
    for index in args.only if args.only is not None else range(args.draws):
        if index in done:
            continue
        result = judge(
            draw(index, args.seed, tuple(args.counts), args.outliers, args.colour), args.seed, short=args.short
        )
        results.append(result)
        print(line(result), flush=True)
        if args.out is not None and args.only is None:
            with args.out.open("a") as file:
                file.write(json.dumps(result) + "\n")
    tally = Counter(r["verdict"] for r in results)
    print(", ".join(f"{count} {verdict}" for verdict, count in tally.most_common()))
    print("\n".join(coverage(results)))


if __name__ == "__main__":
    main()
