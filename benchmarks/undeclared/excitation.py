"""What the rig's operator commands: shaking on top of a slow motion, or a brake on the load."""

from dataclasses import dataclass

import numpy as np

from undeclared.mechanism import Mechanism

STANDING = ("multisine", "chirp", "steps")
TURNING = ("rotation", "staircase", "triangles")


@dataclass(frozen=True)
class Excitation:
    """One experiment's commands.

    Attributes:
        kind: one of STANDING or TURNING.
        twist: rms of the dynamic error that was meant [rad].
        shaking: motor torque that is commanded openly [N m].
        follow: motor angle and rate that the slow controller follows, (samples, 2).
        pull: the controller's gains on angle and rate.
        brake: logged torque on the load [N m].
    """

    kind: str
    twist: float
    shaking: np.ndarray
    follow: np.ndarray
    pull: tuple[float, float]
    brake: np.ndarray

    @property
    def start(self) -> tuple[float, float]:
        """Motor angle and rate at which the reference begins."""
        return float(self.follow[0, 0]), float(self.follow[0, 1])


def excitation(kind: str, random: np.random.Generator, base: Mechanism, *, twist: float, count: int, dt: float):
    """Commands that give about `twist` [rad rms] on the undisturbed drive.

    Args:
        kind: one of STANDING or TURNING.
        random: where phases, speeds and levels come from.
        base: the drive without hidden effects.
        twist: rms of the dynamic error.
        count: samples.
        dt: sampling interval [s].
    """
    f_0 = base.omega_0 / (2 * np.pi)
    time = dt * np.arange(count)
    brake = np.zeros(count)
    share = 1.0
    if kind == "chirp":
        shaking = _chirp(time, 0.1 * f_0, random.uniform(1.3, 1.8) * f_0)
    elif kind == "steps":
        shaking = _steps(random, count, dt, f_0)
    else:
        shaking = _multisine(random, count, dt, random.uniform(0.02, 0.1) * f_0, random.uniform(1.3, 1.8) * f_0)
    if kind == "rotation":
        rate = np.full(count, random.choice([-1, 1]) * np.exp(random.uniform(np.log(8.0), np.log(60.0))))
    elif kind == "staircase":
        rate = _staircase(random, time)
    else:
        swing, beat = random.uniform(1.0, 6.0), 2 * np.pi * random.uniform(0.15, 0.5)
        rate = swing * beat * np.cos(beat * time)
    if kind == "triangles":
        share = 0.2
        phase = random.uniform(0.4, 1.2) * time
        wave = 4 * np.abs((phase + 0.25) % 1 - 0.5) - 1
        level = 1.0 + random.uniform(0.2, 0.6) * np.cos(2 * np.pi * phase / random.uniform(2.5, 4.0))
        brake = -1.7 * twist * base.k1 * wave * level
        rate = 0.2 * rate
    shaking = shaking * (share * twist / _twist_rms(base, shaking, dt)) - brake / base.ratio
    angle = dt * (np.cumsum(rate) - rate)
    whole = base.motor_inertia + base.load_inertia / base.ratio**2
    bandwidth = 2 * np.pi * random.uniform(0.8, 2.0)
    pull = (whole * bandwidth**2, 1.4 * whole * bandwidth)
    return Excitation(kind, twist, shaking, np.column_stack([angle, rate]), pull, brake)


def _multisine(random: np.random.Generator, count: int, dt: float, low: float, high: float) -> np.ndarray:
    lines = np.fft.rfftfreq(count, dt)
    return np.fft.irfft(np.exp(2j * np.pi * random.uniform(size=lines.size)) * ((lines > low) & (lines < high)), count)


def _chirp(time: np.ndarray, low: float, high: float) -> np.ndarray:
    """Up and down once."""
    share = time / time[-1]
    frequency = low + (high - low) * (1 - np.abs(1 - 2 * share))
    return np.sin(2 * np.pi * np.cumsum(frequency) * (time[1] - time[0]))


def _steps(random: np.random.Generator, count: int, dt: float, f_0: float) -> np.ndarray:
    """Levels of random height and length, a third of a natural period to five of them."""
    lengths = np.maximum(1, (random.uniform(0.3, 5.0, size=count) / (f_0 * dt)).astype(int))
    signal = np.repeat(random.normal(size=count), lengths)[:count]
    return signal - signal.mean()


def _staircase(random: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """Five speeds of both signs with ramps between them [rad/s]."""
    levels = random.choice([-1, 1], size=5) * np.exp(random.uniform(np.log(4.0), np.log(50.0), size=5))
    edges = time[-1] * np.arange(1, 5) / 5
    ramp = 0.03 * time[-1]
    rate = np.full(time.size, levels[0])
    for edge, change in zip(edges, np.diff(levels), strict=True):
        rate += change * np.clip((time - edge) / ramp + 0.5, 0, 1)
    return rate


def _twist_rms(base: Mechanism, shaking: np.ndarray, dt: float) -> float:
    """Of the linear drive in the steady state."""
    omega = 2 * np.pi * np.fft.rfftfreq(shaking.size, dt)
    answer = base.omega_0**2 - omega**2 + 1j * omega * base.compliance * base.c1
    x = np.fft.irfft(np.fft.rfft(shaking) / answer, shaking.size) / (base.ratio * base.motor_inertia)
    return float(np.std(x))
