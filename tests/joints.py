"""Random joints of realistic parameters: two inertias on a mesh, with friction on the motor or the load.

The equations of motion are written independently in numpy (DESIGN 2.1), without hdjax' simulator.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import rig
from fitting.logs.log import Log

SENSORS = ("motor_angle", "load_angle", "motor_velocity", "load_velocity", "joint_torque")
COUNT, STEP = 5000, 2e-3


@dataclass(frozen=True)
class Joint:
    """One joint; the torque is held between samples.

    Attributes:
        N: reduction ratio.
        J_m: motor inertia [kg m^2].
        J_l: load inertia [kg m^2].
        K: stiffness [N m/rad].
        B_sp: mesh damping [N m s/rad].
        alpha: cubic coefficient [rad^-2].
        coulomb: friction on the motor [N m].
        viscous: likewise [N m s/rad].
        rms: of the motor torque [N m].
        load_friction: Coulomb torque on the load [N m], which builds up over `bend` (Dahl).
        bend: load angle [rad].
        gravity: largest torque of gravity on the load [N m].
    """

    N: float
    J_m: float
    J_l: float
    K: float
    B_sp: float
    alpha: float = 0.0
    coulomb: float = 0.0
    viscous: float = 0.0
    rms: float = 1.0
    load_friction: float = 0.0
    bend: float = 1e-3
    gravity: float = 0.0

    @property
    def omega_0(self) -> float:
        """Natural frequency of the twist [rad/s]."""
        return float(np.sqrt(self.K * (1.0 / self.J_l + 1.0 / (self.N**2 * self.J_m))))


def torque_of(joint: Joint, *, count: int = COUNT, step: float = STEP, seed: int = 0) -> np.ndarray:
    """A multisine from 5 % to 150 % of the natural frequency."""
    natural = joint.omega_0 / (2 * np.pi)
    low, high = max(2.0 / (count * step), 0.05 * natural), min(1.5 * natural, 0.2 / step)
    return rig.multisine(count, step, rms=joint.rms, low=low, high=high, seed=seed)


def motion_of(joint: Joint, torque: np.ndarray, *, step: float = STEP, substeps: int = 8) -> np.ndarray:
    """States (theta_m, theta_l, omega_m, omega_l) at the samples, from rest."""
    rest, width = 1e-3 * joint.rms / (joint.J_m * joint.omega_0), joint.N

    def rates(y, T):
        theta_m, theta_l, omega_m, omega_l, z = y
        x, v = theta_m / width - theta_l, omega_m / width - omega_l
        tau = joint.K * (x + joint.alpha * x**3) + joint.B_sp * v
        friction = joint.coulomb * math.tanh(omega_m / rest) + joint.viscous * omega_m
        held = joint.load_friction * z / joint.bend + joint.gravity * math.sin(theta_l)
        sliding = omega_l - abs(omega_l) * z / joint.bend
        return omega_m, omega_l, (T - friction - tau / width) / joint.J_m, (tau - held) / joint.J_l, sliding

    return rig.rk4(rates, (0.0,) * 5, torque, step, substeps)[:, :4]


@functools.cache
def _motion_at(joint: Joint, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Torque and motion of a log; many tests read the same motion through other sensors."""
    torque = torque_of(joint, count=count, seed=seed)
    return torque, motion_of(joint, torque)


@functools.cache
def with_friction(joint: Joint, coulomb: float, viscous: float, *, seed: int = 0) -> Joint:
    """The joint with Coulomb and viscous friction as shares of the rms torque in its motion."""
    torque = torque_of(joint, seed=seed)
    joint = replace(joint, coulomb=coulomb * joint.rms)
    for _ in range(4):
        speed = np.std(motion_of(joint, torque, substeps=4)[:, 2])
        joint = replace(joint, viscous=viscous * joint.rms / speed)
    return joint


@functools.cache
def drawn(seed: int) -> Joint:
    """A joint with a natural frequency from 3 to 15 Hz, and friction of up to 60 % of the rms torque of either kind."""
    random = np.random.default_rng(seed)
    N = float(random.choice([1.0, 50.0, 100.0]))
    J_l = float(10 ** random.uniform(-1.5, 1.0))
    J_m = J_l * float(10 ** random.uniform(-0.7, 0.7)) / N**2
    frequency = float(random.uniform(3.0, 15.0))
    reduced = 1.0 / (1.0 / J_l + 1.0 / (N**2 * J_m))
    K = reduced * (2 * np.pi * frequency) ** 2
    damping = float(10 ** random.uniform(-2.0, -1.0))
    joint = Joint(N, J_m, J_l, K, 2 * damping * np.sqrt(K * reduced), rms=K * N**-1.0 * 5e-3)
    coulomb, viscous = random.uniform(0.0, 0.6, size=2)
    return with_friction(joint, float(coulomb), float(viscous), seed=seed)


def log_of(joint: Joint, *, seed: int = 0, count: int = COUNT, name: str = "joint") -> Log:
    """The joint's log; the encoders' noise at the output is a thousandth of the twist's rms."""
    random = np.random.default_rng(10_000 + seed)
    torque, motion = (a.copy() for a in _motion_at(joint, count, seed))
    noise = 1e-3 * np.std(motion[:, 0] / joint.N - motion[:, 1])
    motor = motion[:, 0] + joint.N * noise * random.normal(size=count)
    load = motion[:, 1] + noise * random.normal(size=count)
    return rig.log_of_angles(motor, load, torque, ratio=joint.N, step=STEP, name=name)


def log_of_sensors(
    joint: Joint, sensors: Sequence[str], *, seed: int = 0, count: int = COUNT, noise: float = 1e-3, name: str = "joint"
) -> Log:
    """The joint's log of some sensors, with white noise as a share of the signal that the twist causes in each."""
    random = np.random.default_rng(20_000 + seed)
    torque, motion = (a.copy() for a in _motion_at(joint, count, seed))
    theta_m, theta_l, omega_m, omega_l = motion.T
    x, v = theta_m / joint.N - theta_l, omega_m / joint.N - omega_l
    tau = joint.K * (x + joint.alpha * x**3) + joint.B_sp * v
    read = {
        "motor_angle": (theta_m, joint.N * np.std(x)),
        "load_angle": (theta_l, np.std(x)),
        "motor_velocity": (omega_m, joint.N * np.std(v)),
        "load_velocity": (omega_l, np.std(v)),
        "joint_torque": (tau, np.std(tau)),
    }
    seen = {s: read[s][0] + noise * read[s][1] * random.normal(size=count) for s in sensors}
    log = rig.log_of_angles(theta_m, theta_l, torque, ratio=joint.N, step=STEP, name=name)
    return replace(log, dynamic_error=None, **(dict.fromkeys(SENSORS) | seen))
