"""Torque-twist curves: twist of a gear under a slowly changing torque, with hysteresis.

NumPy in double precision: the curve is algebraic, so that a fit takes milliseconds without compilation.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate
from typing import Literal, get_args

import numpy as np
from scipy.special import ndtr

Shape = Literal["linear", "cubic", "two slopes", "three slopes"]
Memory = Literal["abrupt", "gradual"]
SHAPES: tuple[Shape, ...] = get_args(Shape)
MEMORIES: tuple[Memory, ...] = get_args(Memory)

SHAPE_NAMES: dict[Shape, tuple[str, ...]] = {
    "linear": ("log K1",),
    "cubic": ("log K1", "alpha"),
    "two slopes": ("log K1", "log K2", "log T1"),
    "three slopes": ("log K1", "log K2", "log K3", "log T1", "log gap"),
}


def positive(logarithm: np.ndarray | float) -> np.ndarray:
    """The positive number of a logarithm, limited to finite values."""
    return np.asarray(np.exp(np.clip(logarithm, -80.0, 80.0)))


def twist(
    shape: Shape, coefficients: np.ndarray, torque: np.ndarray, *, blur: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The elastic twist under a torque, and its slope; odd in the torque.

    Two and three slopes are the vendors' straight lines through the origin: K1 up to T1, K2 from there to
    T2 = T1 + gap, K3 beyond. The cubic is tau = K (x + alpha x^3), solved for x in closed form.

    Args:
        shape: Of the curve.
        coefficients: As `SHAPE_NAMES` lists them; K in N m/rad, alpha in rad^-2, torques in N m.
        torque: Relative to the centre of the curve [N m], (n,).
        blur: Standard deviation of the true torque around the stated one [N m]. The expected twist then has rounded
            knees; straight parts are unchanged.

    Returns:
        Twist [rad] and its derivative with respect to the torque [rad/(N m)], both (n,).
    """
    if shape == "cubic":
        return _cubic(float(positive(-coefficients[0])), coefficients[1], torque)
    size = len(SHAPE_NAMES[shape])
    compliances = positive(-coefficients[: (size + 1) // 2])
    knees = np.cumsum(positive(coefficients[len(compliances) : size]))
    x, slope = compliances[0] * torque, np.full_like(torque, compliances[0])
    for knee, added in zip(knees, np.diff(compliances), strict=True):
        beyond, share = _beyond(torque, knee, blur)
        x, slope = x + added * beyond, slope + added * share
    return x, slope


def _beyond(torque: np.ndarray, knee: float, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Expected signed excess of the torque beyond a knee on either side, and the probability of an excess."""
    # Without blur the normal distribution function is a step, to within rounding.
    blur = max(blur, 1e-14 * knee)
    above, below = (torque - knee) / blur, (-torque - knee) / blur
    chance_above, chance_below = ndtr(above), ndtr(below)
    density = (np.exp(-0.5 * above**2) - np.exp(-0.5 * below**2)) / np.sqrt(2.0 * np.pi)
    return blur * (above * chance_above - below * chance_below + density), chance_above + chance_below


def _cubic(compliance: float, alpha: float, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    y = compliance * torque
    scale = np.sqrt(3.0 * abs(alpha))
    if scale * np.max(np.abs(y), initial=0.0) < 1e-6:
        # Below this the closed form is less accurate than the series.
        x = y - alpha * y**3
    elif alpha > 0:
        x = 2.0 / scale * np.sinh(np.arcsinh(1.5 * scale * y) / 3.0)
    else:
        # A softening cubic has a largest torque at its fold; just below it the slope is steep but finite.
        x = 2.0 / scale * np.sin(np.arcsin(np.clip(1.5 * scale * y, -0.999, 0.999)) / 3.0)
    return x, compliance / (1.0 + 3.0 * alpha * x**2)


def hysteresis_branch(memory: Memory, torque: np.ndarray, reach: float, start: float) -> np.ndarray:
    """Branch of the loop at each sample: +1 loading, -1 unloading, in between after a reversal.

    The abrupt law is a Jenkins element (play in series with the spring): the branch changes linearly while the torque
    reverses by twice the reach. The gradual law is Dahl's: the distance to the new branch decays by e per reach. Both
    depend on the torque's path only, not on time, and are exact where it is monotone between samples.

    Args:
        memory: The law.
        torque: In order of time [N m], (n,).
        reach: Torque over which the branch changes [N m].
        start: Branch at the first sample, from -1 to 1.

    Returns:
        (n,).

    References:
        Dahl 1976, AIAA Journal 14(12); Visintin 1994, Differential Models of Hysteresis (play and stop).
    """
    law = _abrupt if memory == "abrupt" else _gradual
    return np.array(list(accumulate((np.diff(torque) / reach).tolist(), law, initial=float(start))))


def _abrupt(branch: float, step: float) -> float:
    moved = branch + step
    # Comparisons, since most of a fit's time is spent here, and min and max take twice as long.
    return 1.0 if moved > 1.0 else -1.0 if moved < -1.0 else moved


def _gradual(branch: float, step: float) -> float:
    towards = math.copysign(1.0, step)
    return towards + (branch - towards) * math.exp(-abs(step))


@dataclass(frozen=True, eq=False)
class Blocks:
    """Means over short runs of rows, of one log or of several.

    Attributes:
        torque: Joint torque [N m], (n,).
        twist: [rad], (n,).
        time: [s], (n,).
        log: Number of each block's log, (n,), rising.
        paths: Torque of blocks and of reversals between them [N m], in order, by log.
        seat: Index of each block in the concatenated paths, (n,).
        names: Of the logs.
        torque_noise: Standard deviation of the noise of a block's torque [N m].
        twist_noise: Likewise of its twist [rad].
        blur: Standard deviation of the torque within a block, due to noise and change [N m].
        rows: Approximate number of rows in a block, by log.
        reversals: Reversals of the torque, by log.
    """

    torque: np.ndarray
    twist: np.ndarray
    time: np.ndarray
    log: np.ndarray
    paths: tuple[np.ndarray, ...]
    seat: np.ndarray
    names: tuple[str, ...]
    torque_noise: float
    twist_noise: float
    blur: float
    rows: tuple[int, ...]
    reversals: tuple[int, ...]

    @cached_property
    def centred_time(self) -> np.ndarray:
        """Time from the middle of each block's log [s], (n,)."""
        logs = range(len(self.names))
        middle = np.array([0.5 * np.sum(self.time[self.log == i][[0, -1]]) for i in logs])
        return self.time - middle[self.log]

    @property
    def amplitude(self) -> float:
        """Half the range of the torque [N m]."""
        return 0.5 * float(np.ptp(self.torque))


@lru_cache(maxsize=8)
def branch(memory: Memory, blocks: Blocks, reach: float, starts: tuple[float, ...]) -> np.ndarray:
    """Branch of each block, from -1 to 1, (n,). Cached, since most parameters of a curve do not change it.

    Args:
        memory: The law.
        blocks: The data.
        reach: Torque over which the branch changes [N m].
        starts: Branch at the first block of each log, from -1 to 1.
    """
    each = [hysteresis_branch(memory, path, reach, start) for path, start in zip(blocks.paths, starts, strict=True)]
    return np.concatenate(each)[blocks.seat]


@dataclass(frozen=True)
class Curve:
    """A form of torque-twist curve, by its terms. Its parameters are a vector in the order of `names`.

    Attributes:
        shape: Of the elastic part.
        memory: Law of the hysteresis, or None for no hysteresis.
        biased: Whether the torque at the curve's centre is free; zero otherwise.
        drifting: Whether the twist may drift with time.
        logs: Number of logs; each has its own twist zero, initial branch and drift.
    """

    shape: Shape
    memory: Memory | None
    biased: bool
    drifting: bool
    logs: int

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        each = [f"offset {i}" for i in range(self.logs)]
        each += [f"drift {i}" for i in range(self.logs) if self.drifting]
        if self.memory is not None:
            each += ["friction", "log reach", *(f"start {i}" for i in range(self.logs))]
        return (*SHAPE_NAMES[self.shape], *(["torque_bias"] if self.biased else []), *each)

    @cached_property
    def places(self) -> dict[str, int]:
        """Index of each parameter, by name."""
        return {name: i for i, name in enumerate(self.names)}

    def value(self, name: str, parameters: np.ndarray) -> float:
        """A parameter by name; zero if the curve lacks it."""
        return float(parameters[self.places[name]]) if name in self.places else 0.0

    def elastic(
        self, parameters: np.ndarray, torque: np.ndarray, *, blur: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Twist of the spring above the twist zero [rad], and its slope, at a torque as logged."""
        return twist(self.shape, parameters, torque - self.value("torque_bias", parameters), blur=blur)

    def branch(self, parameters: np.ndarray, blocks: Blocks) -> np.ndarray:
        """Branch of each block, from -1 to 1, (n,)."""
        if self.memory is None:
            return np.zeros_like(blocks.torque)
        starts = tuple(self.value(f"start {i}", parameters) for i in range(self.logs))
        return branch(self.memory, blocks, math.exp(self.value("log reach", parameters)), starts)

    def predict(self, parameters: np.ndarray, blocks: Blocks) -> tuple[np.ndarray, np.ndarray]:
        """Twist [rad] and the slope of the elastic part [rad/(N m)] at each block, both (n,).

        Hysteresis is a friction torque parallel to the spring, as in `hdjax`: on loading it bears part of the torque,
        on unloading it opposes the spring.
        """
        torque = blocks.torque - self.value("friction", parameters) * self.branch(parameters, blocks)
        x, slope = self.elastic(parameters, torque, blur=blocks.blur)
        return x + self.zero(parameters, blocks), slope

    def zero(self, parameters: np.ndarray, blocks: Blocks) -> np.ndarray:
        """Twist zero and drift of each block's log [rad], (n,)."""
        x = parameters[self.places["offset 0"] + blocks.log]
        return x + parameters[self.places["drift 0"] + blocks.log] * blocks.centred_time if self.drifting else x


def loop(curve: Curve, parameters: np.ndarray, amplitude: float, *, steps: int = 200) -> tuple[np.ndarray, ...]:
    """The closed loop of the curve under torque cycles around its centre.

    Args:
        curve: The form.
        parameters: Its parameters.
        amplitude: Of the torque cycles [N m].
        steps: Points on each branch.

    Returns:
        Torque relative to its centre [N m], twist while it rises and twist while it falls [rad], each (steps + 1,).
    """
    torque = np.linspace(-amplitude, amplitude, steps + 1)
    if curve.memory is None:
        elastic, _ = twist(curve.shape, parameters, torque)
        return torque, elastic, elastic
    way = np.concatenate([torque, torque[-2::-1]])
    # After two cycles the loop is closed, for any initial state.
    reach = math.exp(curve.value("log reach", parameters))
    closed = hysteresis_branch(curve.memory, np.concatenate([way, way[1:], way[1:]]), reach, -1.0)[-2 * steps - 1 :]
    x, _ = twist(curve.shape, parameters, way - curve.value("friction", parameters) * closed)
    return torque, x[: steps + 1], x[: steps - 1 : -1]
