"""Joints drawn at random, seen by some of their sensors: is K right, and is what acts on them named? See README.md
beside this file.

The truth is this script's own: the equations of two inertias (DESIGN 2.1) integrated by scipy, dry friction with a
corner that its step control resolves. It shares no code with the simulator.

    python benchmarks/sensor_subsets.py --draws 3 --seed 0 [--kinds NAME ...] [--only-fit] [--out FILE]
    python benchmarks/sensor_subsets.py --of FILE ...
"""

import argparse
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.integrate import ode
from scipy.stats import binomtest

import fitting

COUNT = 6000
# An error of K within it counts as right: 1 %, or so many standard errors.
RIGHT, ERRORS = 0.01, 2.5


@dataclass(frozen=True)
class Kind:
    """What is logged of a joint, and what is known of it.

    Attributes:
        outputs: signals of its sensors.
        inertias: "known", "tolerance", "fit", or "wrong": that of the load is stated 5 to 15 % off.
        friction: share of the rms torque that Coulomb friction of the motor takes at most.
        current: whether the motor's current is logged in the place of its torque.
        noisy: noise of the logged torque, as a share of its rms value.
        late: the sensor that is read late, by up to a sample interval.
        load_friction: Coulomb friction of the load at most, as a share of N times the rms torque.
        gravity: largest torque of gravity on the load at most, likewise.
    """

    outputs: tuple[str, ...]
    inertias: str = "known"
    friction: float = 0.0
    current: bool = False
    noisy: float = 0.0
    late: str = ""
    load_friction: float = 0.0
    gravity: float = 0.0

    @property
    def missing(self) -> list[str]:
        """Families of the effects that the base model lacks."""
        there = {
            "motor_friction": self.friction,
            "load_friction": self.load_friction,
            "gravity_load": self.gravity,
            "sensor_delay": len(self.late),
            "inertia_error": self.inertias == "wrong",
        }
        return [family for family, size in there.items() if size]


MOTOR, BOTH, BOTH_SPEEDS = ("motor_angle",), ("motor_angle", "load_angle"), ("motor_velocity", "load_velocity")
TORQUE = ("motor_angle", "joint_torque")
KINDS = {
    "motor angle": Kind(MOTOR),
    "motor angle, free inertias": Kind(MOTOR, "fit"),
    "motor angle, inertias to 5 %": Kind(MOTOR, "tolerance"),
    "motor angle, friction": Kind(MOTOR, friction=0.5),
    "motor angle, friction, free inertias": Kind(MOTOR, "fit", 0.5),
    "motor angle, current": Kind(MOTOR, current=True),
    "motor velocity, friction": Kind(("motor_velocity",), friction=0.5),
    "motor angle and joint torque, friction": Kind(TORQUE, "fit", 0.5),
    "motor velocity and joint torque": Kind(("motor_velocity", "joint_torque")),
    "both velocities, friction": Kind(BOTH_SPEEDS, "fit", 0.5),
    "motor angle and load velocity": Kind(("motor_angle", "load_velocity"), "tolerance"),
    "both angles, friction": Kind(BOTH, "fit", 0.5),
    "both angles, free inertias": Kind(BOTH, "fit"),
    "both angles, noisy torque": Kind(BOTH, noisy=0.03),
    "both angles, late encoder": Kind(BOTH, late="load_angle"),
    "motor angle, noisy torque": Kind(MOTOR, noisy=0.03),
    "both angles, friction of the load": Kind(BOTH, load_friction=0.8),
    "both angles, friction, gravity": Kind(BOTH, friction=0.5, gravity=1.0),
    "motor angle, wrong inertia": Kind(MOTOR, "wrong"),
    "both angles, wrong inertia": Kind(BOTH, "wrong"),
    "both angles, friction, wrong inertia": Kind(BOTH, "wrong", 0.5),
    "motor angle, late joint torque": Kind(TORQUE, late="joint_torque"),
    "motor angle, late joint torque, friction": Kind(TORQUE, "fit", 0.5, late="joint_torque"),
    "late motor angle, joint torque": Kind(TORQUE, late="motor_angle"),
}


@dataclass(frozen=True)
class Joint:
    """A drawn joint [SI]; `rest` is the motor's rate over which the sign of its friction turns, and N times the
    load's."""

    N: float
    J_m: float
    J_l: float
    K: float
    B_sp: float
    coulomb: float
    viscous: float
    rest: float
    late: float
    load_coulomb: float
    gravity: float
    step: float
    torque: np.ndarray

    def states(self) -> tuple[np.ndarray, np.ndarray]:
        """(theta_m, theta_l, omega_m, omega_l) at the samples, and when a late sensor is read, from rest; the torque is
        held between samples."""

        def rates(t, y, T):
            x, v = y[0] / self.N - y[1], y[2] / self.N - y[3]
            tau = self.K * x + self.B_sp * v
            rubbing = self.coulomb * np.tanh(y[2] / self.rest) + self.viscous * y[2]
            held = self.load_coulomb * np.tanh(y[3] * self.N / self.rest) + self.gravity * np.sin(y[1])
            return [y[2], y[3], (T - rubbing - tau / self.N) / self.J_m, (tau - held) / self.J_l]

        solver = ode(rates).set_integrator("dop853", rtol=1e-9, atol=1e-12, nsteps=100_000)
        solver.set_initial_value(np.zeros(4), 0.0)
        found, late = np.zeros((self.torque.size, 4)), np.zeros((self.torque.size, 4))
        for i, T in enumerate(self.torque.tolist()[:-1]):
            solver.set_f_params(T)
            if self.late:
                late[i + 1] = solver.integrate((i + 1) * self.step - self.late)
            found[i + 1] = solver.integrate((i + 1) * self.step)
        return found, late

    def readings(self, states: np.ndarray) -> dict[str, tuple[np.ndarray, float]]:
        """What each sensor reads, and the rms of what the twist does to it."""
        theta_m, theta_l, omega_m, omega_l = states.T
        x, v = theta_m / self.N - theta_l, omega_m / self.N - omega_l
        tau = self.K * x + self.B_sp * v
        return {
            "motor_angle": (theta_m, self.N * np.std(x)),
            "load_angle": (theta_l, np.std(x)),
            "motor_velocity": (omega_m, self.N * np.std(v)),
            "load_velocity": (omega_l, np.std(v)),
            "joint_torque": (tau, np.std(tau)),
        }


def drawn(kind: Kind, random: np.random.Generator) -> Joint:
    """A joint of a kind: 3 to 40 Hz, inertias at the output that differ by up to five, sampled 20 to 80 times a
    period."""
    N = float(random.choice([1.0, 30.0, 50.0, 100.0, 160.0]))
    J_l = float(10 ** random.uniform(-2.0, 1.0))
    J_m = J_l * float(10 ** random.uniform(-0.7, 0.7)) / N**2
    natural, damping = 2 * np.pi * float(10 ** random.uniform(0.5, 1.6)), float(10 ** random.uniform(-2.2, -1.0))
    reduced = 1.0 / (1.0 / J_l + 1.0 / (N**2 * J_m))
    K = reduced * natural**2
    step = 2 * np.pi / natural / float(random.uniform(20.0, 80.0))
    rms = K * 5e-3 / N
    lines = np.fft.rfftfreq(COUNT, step)
    inside = (lines >= 0.05 * natural / (2 * np.pi)) & (lines <= 1.5 * natural / (2 * np.pi))
    torque = np.fft.irfft(inside * np.exp(2j * np.pi * random.uniform(size=lines.size)), COUNT)
    torque *= rms / np.std(torque)
    speed = rms / (J_m + J_l / N**2) / natural
    coulomb, viscous = (kind.friction * rms * random.uniform(0.2, 1.0) for _ in range(2))
    own = N, J_m, J_l, K, 2 * damping * np.sqrt(K * reduced), float(coulomb), float(viscous / speed)
    late = bool(kind.late) * step * random.uniform(0.1, 1.0)
    held = N * rms * kind.load_friction * random.uniform(0.2, 1.0) if kind.load_friction else 0.0
    gravity = N * rms * kind.gravity * random.uniform(0.2, 1.0) if kind.gravity else 0.0
    return Joint(*own, 2e-3 * speed, late, float(held), float(gravity), step, torque)


def written(folder: Path, kind: Kind, joint: Joint, random: np.random.Generator) -> None:
    """The joint's log and drive file; each sensor has white noise of a thousandth of what the twist does to it."""
    in_time, late = (joint.readings(states) for states in joint.states())
    sensors = {name: (late if name == kind.late else in_time)[name] for name in in_time}
    constant = 0.1
    columns = {"time": joint.step * np.arange(COUNT)}
    logged = joint.torque + kind.noisy * np.std(joint.torque) * random.normal(size=COUNT)
    columns["iq" if kind.current else "motor_torque"] = logged / (constant if kind.current else 1.0)
    for name in kind.outputs:
        values, size = sensors[name]
        columns[name] = values + 1e-3 * size * random.normal(size=COUNT)
    np.savetxt(
        folder / "log.csv", np.stack([*columns.values()], axis=1), "%.12g", ",", header=",".join(columns), comments=""
    )
    off = {"J_m": joint.J_m * (1 + 0.03 * random.normal()), "J_l": joint.J_l * (1 + 0.03 * random.normal())}
    wrong = 1 + random.choice([-1, 1]) * random.uniform(0.05, 0.15)
    told = {
        "known": {"J_m": f"{joint.J_m!r}", "J_l": f"{joint.J_l!r}"},
        "tolerance": {p: f'{{ value = {value!r}, tolerance = "5 %" }}' for p, value in off.items()},
        "fit": {"J_m": '"fit"', "J_l": '"fit"'},
        "wrong": {"J_m": f"{joint.J_m!r}", "J_l": f"{float(joint.J_l * wrong)!r}"},
    }[kind.inertias]
    text = f"[drive]\nreduction_ratio = {joint.N}\nlargest_twist = 0.5\n"
    text += f'motor_inertia = {told["J_m"]}\nload_inertia = {told["J_l"]}\n[signals]\ntorque_hold = "zero-order"\n'
    if kind.current:
        text += f'[columns]\nmotor_current = {{ column = "iq", unit = "A", torque_constant = {constant} }}\n'
    (folder / "drive.toml").write_text(text)


def tried(kind: Kind, seed: list[int], *, only_fit: bool) -> dict:
    """What a fit, or the loop, makes of one draw."""
    random = np.random.default_rng(seed)
    joint = drawn(kind, random)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        written(folder, kind, joint, random)
        begun = time.process_time()
        try:
            data = fitting.load(folder / "log.csv", drive=folder / "drive.toml")
            report = (fitting.fit(data) if only_fit else fitting.close_loop(data)).report
        except fitting.DataError as error:
            return {"error": np.inf, "says": str(error), "right": False, "inside": False, "seconds": 0.0}
    final = report["after"] if report["after"]["parameters"] else report["before"]
    K = final["parameters"]["K"]
    error = abs(K["value"] / joint.K - 1)
    low, high = (np.nan if end is None else end for end in K["ci95"])
    families = [e["family"] for e in report["after"]["effects"]]
    return {
        "error": error,
        "bound": max(RIGHT, ERRORS * (K["std"] or 0.0) / joint.K),
        "right": only_fit or (sorted(families) == sorted(kind.missing) and report["decision"] != "unexplained"),
        "decision": f"{report['decision']} {families}",
        "inside": bool(low <= joint.K <= high),
        "seconds": time.process_time() - begun,
        "joint": {k: v for k, v in vars(joint).items() if k != "torque"},
    }


def row(name: str, found: Sequence[Mapping[str, Any]]) -> str:
    """A line of the table."""
    errors = [f["error"] for f in found]
    right = sum(f["error"] <= f.get("bound", 0.0) for f in found)
    decided, inside = (sum(f[key] for f in found) for key in ("right", "inside"))
    seconds = np.median([f["seconds"] for f in found])
    figures = len(found), right, f"{np.median(errors):.1e}", f"{max(errors):.1e}", decided, inside, f"{seconds:.0f}"
    return f"| {name} | {' | '.join(map(str, figures))} |"


def main() -> None:
    """Print a line a kind, and one of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS), metavar="KIND")
    parser.add_argument("--only-fit", action="store_true")
    parser.add_argument("--out", type=Path, help="JSON file of all draws")
    parser.add_argument("--of", type=Path, nargs="*", default=(), help="table of the draws in these files instead")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("| kind | draws | K right | error of K, median | worst | decision right | K in its interval | processor s |")
    print("|---|---|---|---|---|---|---|---|")
    kept = {name: found for path in asked.of for name, found in json.loads(path.read_text()).items()}
    for name in kept or asked.kinds:
        if not asked.of:
            place = list(KINDS).index(name)
            kept[name] = [
                tried(KINDS[name], [asked.seed, place, i], only_fit=asked.only_fit) for i in range(asked.draws)
            ]
        print(row(name, kept[name]), flush=True)
        if asked.out:
            asked.out.write_text(json.dumps(kept, indent=1, default=float))
    draws = [f for found in kept.values() for f in found]
    print(row("all", draws))
    low, high = binomtest(sum(f["inside"] for f in draws), len(draws)).proportion_ci()
    print(f"\nK in its 95 % interval: exact interval {low:.1%} to {high:.1%}")


if __name__ == "__main__":
    main()
