"""Simulated quasi-static logs with known effects, by independent equations: twist from torque, row by row."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from fitting.logs.log import Log
from fitting.quasi_static.loop import QuasiStaticLoop, close_loop
from fitting.quasi_static.points import points_of
from fitting.quasi_static.preparation import Motion

K = 4e4
RATIO = 100.0
STEP = 0.004

Effect = Callable[["JointMotion"], np.ndarray]


class JointMotion:
    """Motion and torque of a simulated joint.

    Attributes:
        time: [s].
        torque: True torque through the gear [N m].
        motor: theta_m [rad].
        speed: Of the joint [rad/s].
    """

    def __init__(self, *, moves: str, cycles: float, rows: int, largest: float, kind: str):
        self.time = STEP * np.arange(rows)
        phase = cycles * np.arange(rows) / rows
        wave = np.sin(2 * np.pi * phase) if kind == "sine" else 2 / np.pi * np.arcsin(np.sin(2 * np.pi * phase))
        if moves == "held":
            self.speed = np.zeros(rows)
        elif moves == "one way":
            # Constant speed for two thirds, then a rest.
            self.speed = 0.2 * np.clip((rows - 1.5 * np.arange(rows)) / (0.05 * rows), 0.0, 1.0)
        else:
            self.speed = 0.2 * np.sign(np.sin(2 * np.pi * 2 * np.arange(rows) / rows + 0.3))
        path = np.zeros(rows)
        path[1:] = STEP * np.cumsum(self.speed[:-1])
        self.motor = 3.0 + RATIO * path
        # A weight's torque depends on the angle, and is constant while the joint rests.
        if kind == "weight":
            wave = np.sin(2 * np.pi * cycles * path / path[-1])
        self.torque = largest * wave


def slow_joint(
    effects: Sequence[Effect] = (),
    *,
    moves: str = "held",
    cycles: float = 2.0,
    rows: int = 1500,
    largest: float = 60.0,
    kind: str = "sine",
    twist_noise: float = 4e-6,
    torque_noise: float = 0.5,
    colour: float = 0.0,
    friction: Effect | None = None,
    seed: int = 0,
    name: str = "log",
) -> tuple[Log, Motion]:
    """A log, and the kind of motion of its joint.

    Args:
        effects: Contributions to the twist [rad].
        moves: "held", "one way" or "both ways".
        cycles: Of the torque.
        rows: 4 ms apart.
        largest: Amplitude of the torque [N m].
        kind: Course of the torque, "sine", "triangle", or that of a "weight" on the joint.
        twist_noise: [rad].
        torque_noise: [N m].
        colour: Correlation of neighbouring noises of the twist.
        friction: Error of the measured torque [N m].
        seed: Of the noise.
        name: Of the log.
    """
    random = np.random.default_rng(seed)
    motion = JointMotion(moves=moves, cycles=cycles, rows=rows, largest=largest, kind=kind)
    noises = lfilter([np.sqrt(1 - colour**2)], [1.0, -colour], random.normal(size=rows + 500))[500:]
    twist = 0.3 + motion.torque / K + sum((effect(motion) for effect in effects), np.zeros(rows))
    read = motion.torque + (0.0 if friction is None else friction(motion))
    log = Log(
        name=name,
        path=Path(f"{name}.csv"),
        kind="quasi-static",
        time=motion.time,
        motor_angle=motion.motor,
        load_angle=motion.motor / RATIO - twist,
        motor_torque=None,
        load_torque=None,
        temperature=None,
        dynamic_error=twist + twist_noise * noises,
        forcing=None,
        units={"dynamic_error": "rad"},
        joint_torque=read + torque_noise * random.normal(size=rows),
    )
    return log, ("held" if moves == "held" else "one way" if moves == "one way" else "both ways")


def closed(*logs: tuple[Log, Motion], **options) -> QuasiStaticLoop:
    """Close the loop on simulated logs."""
    return close_loop(points_of([log for log, _ in logs], [how for _, how in logs], RATIO), **options)


def ripple(amplitude: float, order: int, phase: float = 0.7, *, share: float = 0.0) -> Effect:
    """Kinematic error: it acts on the spring, and encoders do not measure it.

    Args:
        amplitude: [rad].
        order: Periods per turn of the motor.
        phase: [rad].
        share: Of the twist between the motor and the place of the error; 1 for a function of N theta_l.
    """
    return lambda motion: -amplitude * np.cos(order * (motion.motor - share * RATIO * motion.torque / K) + phase)


def soft_spots(depth: float, order: int) -> Effect:
    """Position-dependent stiffness: compliance that varies with the motor's angle."""
    return lambda motion: depth * np.cos(order * motion.motor) * motion.torque / K


def sliders(width: float, yields: Sequence[float] = (4.0, 10.0)) -> Effect:
    """Hysteresis of the twist by friction elements between the gear's sides (Maxwell slip along the torque)."""

    def effect(motion: JointMotion) -> np.ndarray:
        total = np.zeros_like(motion.torque)
        for most in yields:
            borne, path = 0.0, []
            for step in np.diff(motion.torque, prepend=motion.torque[0]).tolist():
                borne = min(most, max(-most, borne + step))
                path.append(borne / most)
            total -= 0.5 * width / len(yields) * np.array(path)
        return total

    return effect


def relaxation(share: float, constant: float) -> Effect:
    """Standard linear solid, by small Euler steps."""

    def effect(motion: JointMotion) -> np.ndarray:
        z, path = 0.0, []
        for torque in motion.torque.tolist():
            path.append(z)
            z += STEP / constant * (torque - z)
        return share / K * np.array(path)

    return effect


def relaxing_rests(amplitude: float, constant: float) -> Effect:
    """The twist at a stop differs by an amplitude from its final value, to which it relaxes while the joint rests."""

    def effect(motion: JointMotion) -> np.ndarray:
        off, path, rested = 0.0, [], motion.speed[0] == 0
        for rests in (motion.speed == 0).tolist():
            off = (amplitude if not rested else off) * (1.0 - STEP / constant) if rests else 0.0
            rested = rests
            path.append(off)
        return np.array(path)

    return effect


def hardening(alpha: float) -> Effect:
    """Twist of the cubic spring tau = K (x + alpha x^3), by Newton's method, less that of the linear spring."""

    def effect(motion: JointMotion) -> np.ndarray:
        line = motion.torque / K
        x = line.copy()
        for _ in range(30):
            x -= (x + alpha * x**3 - line) / (1 + 3 * alpha * x**2)
        return x - line

    return effect


def knee(knee_torque: float, ratio: float) -> Effect:
    """A second slope `ratio` times as stiff beyond a torque."""
    return lambda motion: (
        (1 / ratio - 1) / K * np.sign(motion.torque) * np.maximum(np.abs(motion.torque) - knee_torque, 0.0)
    )


def play(half_width: float) -> Effect:
    """A dead zone."""
    return lambda motion: half_width * np.sign(motion.torque)


def coulomb(torque: float) -> Effect:
    """Friction on the motor's side while the joint moves; half of it at rest."""

    def friction(motion: JointMotion) -> np.ndarray:
        rest = np.where(motion.speed == 0, 0.5, 0.0)
        return torque * (np.sign(motion.speed) + rest)

    return friction


def late(delay: float) -> Effect:
    """Delay of the twist behind the logged torque."""
    return lambda motion: (np.interp(motion.time - delay, motion.time, motion.torque) - motion.torque) / K
