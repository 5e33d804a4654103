"""Drives simulated by MuJoCo: is K right, and is what acts on them named? See README.md beside this file.

The truth is another engine's: its integrator, the gear as a tendon with a cubic spring, and dry friction as a
constraint, which is not quite a law of the catalogue.

    pip install -e '.[mujoco]'
    python benchmarks/mujoco_rig.py --draws 3 --seed 0 [--kinds NAME ...] [--out FOLDER]
"""

import argparse
import time
from pathlib import Path

import jax
import mujoco
import numpy as np
import polars as pl
from scipy.signal import cont2discrete

import fitting

SUBSTEPS = 20
# Time constant of the friction constraints [s]: MuJoCo's own, 0.02 s, is slower than a drive reverses.
FRICTION_TIME = 1e-3
SECONDS = {"train_1": 8.0, "train_2": 6.0, "test": 6.0}
HIDDEN = {
    "nothing": [],
    "motor_friction": ["motor_friction"],
    "load_friction": ["load_friction"],
    "mesh_friction": ["coulomb_friction"],
    "pendulum": ["gravity_load"],
    "pendulum_with_friction": ["gravity_load", "motor_friction"],
}
"""Kinds of rigs, and the families of the effects that the base model lacks."""


class Rig:
    """A drive drawn at random.

    Args:
        kind: what acts on it.
        random: of the draw, its torques and its noise.
    """

    def __init__(self, kind: str, random: np.random.Generator) -> None:
        self.kind, self.random, draw = kind, random, random.uniform
        self.N = float(random.choice([50, 80, 100, 120, 160]))
        self.J_m = float(np.exp(draw(np.log(5e-5), np.log(6e-4))))
        self.J_l = self.J_m * self.N**2 * float(np.exp(draw(np.log(0.015), 0.0)))
        self.mobility = 1 / self.J_l + 1 / (self.N**2 * self.J_m)
        self.frequency = float(np.exp(draw(np.log(12.0), np.log(80.0))))
        omega_0, twist = 2 * np.pi * self.frequency, 9e-4 * float(np.exp(draw(-0.5, 0.5)))
        self.K = omega_0**2 / self.mobility
        self.B_sp = 0.02 * omega_0 * float(np.exp(draw(-0.5, 1.0))) / self.mobility
        self.alpha = draw(0.005, 0.03) / twist**2
        self.time_step = 1 / (1000.0 if self.frequency < 40.0 else 25.0 * round(self.frequency))
        self.noise = 6e-7 * float(np.exp(draw(-0.3, 0.6)))
        self.amplitude = twist / self._linear_twist(self.torque(4.0))
        # Largest torque of each effect that may act, at its shaft.
        sizes = {
            "motor_friction": self.amplitude * draw(0.03, 0.12),
            "load_friction": self.amplitude * self.N * draw(0.01, 0.03),
            "coulomb_friction": self.K * twist * draw(0.01, 0.06),
            "gravity_load": self.K * twist * draw(0.05, 0.4),
        }
        self.sizes = {name: size if name in HIDDEN[kind] else 0.0 for name, size in sizes.items()}

    def torque(self, seconds: float) -> np.ndarray:
        """A multisine up to 1.6 times the natural frequency, of unit rms value."""
        count = round(seconds / self.time_step)
        lines = np.fft.rfftfreq(count, self.time_step)
        used = (lines > 0.3) & (lines < 1.6 * self.frequency)
        torque = np.fft.irfft(used * np.exp(2j * np.pi * self.random.random(lines.size)), count)
        return torque / torque.std()

    def _linear_twist(self, torque: np.ndarray) -> float:
        """Rms twist of the drive without its cubic spring and friction."""
        rates = np.array([[0.0, 1.0], [-self.K * self.mobility, -self.B_sp * self.mobility]])
        push = np.array([[0.0], [1 / (self.N * self.J_m)]])
        step, pushed, *_ = cont2discrete((rates, push, np.eye(2), np.zeros((2, 1))), self.time_step)
        states = [np.zeros(2)]
        for value in torque:
            states.append(step @ states[-1] + pushed[:, 0] * value)
        return float(np.std(np.array(states)[len(states) // 4 :, 0]))

    def simulated(self, seconds: float) -> dict[str, np.ndarray]:
        """A log, from rest."""
        model = mujoco.MjModel.from_xml_string(self._mjcf())
        data, torque = mujoco.MjData(model), self.amplitude * self.torque(seconds)
        angles = np.empty((torque.size, 2))
        for k, value in enumerate(torque):
            angles[k], data.ctrl[0] = data.qpos, value
            for _ in range(SUBSTEPS):
                data.qfrc_applied[1] = -self.sizes["gravity_load"] * np.sin(data.qpos[1])
                mujoco.mj_step(model, data)
        noise = 0.7 * self.noise * self.random.normal(size=angles.shape) * [self.N, 1.0]
        motor, load = (angles + noise).T
        time = self.time_step * np.arange(torque.size)
        return {"time": time, "motor_angle": motor, "load_angle": load, "motor_torque": torque}

    def _mjcf(self) -> str:
        def dry(name: str) -> str:
            return f'frictionloss="{self.sizes[name]}" solreffriction="{FRICTION_TIME} 1"'

        bodies = "".join(
            f'<body><joint name="{name}" type="hinge" axis="0 0 1" {dry(f"{name}_friction")}/>'
            f'<inertial pos="0 0 0" mass="1" diaginertia="{J} {J} {J}"/></body>'
            for name, J in (("motor", self.J_m), ("load", self.J_l))
        )
        spring = f'stiffness="{self.K} 0 {self.K * self.alpha}" damping="{self.B_sp}" springlength="0"'
        return (
            f'<mujoco><option timestep="{self.time_step / SUBSTEPS}" integrator="RK4" gravity="0 0 0"/>'
            f"<worldbody>{bodies}</worldbody><tendon><fixed {spring} {dry('coulomb_friction')}>"
            f'<joint joint="motor" coef="{1 / self.N}"/><joint joint="load" coef="-1"/></fixed></tendon>'
            '<actuator><motor joint="motor"/></actuator></mujoco>'
        )

    def drive(self) -> dict[str, dict[str, object]]:
        """The tables of its drive file."""
        known = {"reduction_ratio": self.N, "motor_inertia": self.J_m, "load_inertia": self.J_l}
        return {"drive": known, "signals": {"torque_hold": "zero-order"}}


def row(rig: Rig, out: Path | None) -> str:
    """What the loop finds, as a row of the table.

    Args:
        rig: the drive.
        out: folder for its logs and its report, if any.
    """
    logs = {name: rig.simulated(seconds) for name, seconds in SECONDS.items()}
    begin = time.perf_counter()
    found = fitting.close_loop(fitting.load([logs["train_1"], logs["train_2"]], rig.drive(), test=logs["test"]))
    seconds = time.perf_counter() - begin
    if out is not None:
        found.save(out)
        for name, log in logs.items():
            pl.DataFrame(log).write_csv(out / f"{name}.csv")
    named = [f for f in found.effects["family"].to_list() if f != "unknown"]
    right = "yes" if sorted(named) == sorted(HIDDEN[rig.kind]) else "no: " + (" and ".join(named) or "nothing")
    K = found.report["after"]["parameters"]["K"]
    error = found.rmse["test"] / found.report["noise"][found.report["output"]]
    low, high = K["ci95"]
    off = f"{100 * abs(K['value'] / rig.K - 1):.2g} %"
    inside = "withheld" if low is None else "yes" if low <= rig.K <= high else "no"
    return f"| {rig.kind} | {found.decision} | {right} | {off} | {inside} | {error:.3g} | {seconds:.0f} |"


def main() -> None:
    """Draw rigs, close the loop on their logs, and print a table."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=3, help="rigs of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=HIDDEN, default=list(HIDDEN))
    parser.add_argument("--out", type=Path, help="folder for the logs and reports")
    args = parser.parse_args()
    print("| kind | decision | named rightly | error of K | in its interval | test error over noise | seconds |")
    print("|---|---|---|---|---|---|---|")
    for kind in args.kinds:
        for draw in range(args.draws):
            random = np.random.default_rng([args.seed, draw, *kind.encode()])
            out = None if args.out is None else args.out / f"{kind}-{args.seed}-{draw}"
            print(row(Rig(kind, random), out), flush=True)


if __name__ == "__main__":
    main()
