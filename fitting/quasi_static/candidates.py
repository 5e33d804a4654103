"""Effects that a torque-twist log may hide, as columns beside the straight line: linear in their strengths.

    twist = tau/K + zero of the log + sum of (strength times column)

A column may hang on one or two shape parameters (a knee, a time constant), which are tried on a grid first.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.signal import lfilter

from fitting.quasi_static.points import Points
from fitting.quasi_static.torque_twist import MEMORIES, Memory, remembered

HIGHEST_ORDER = 12
# Points that a period must have for its order to be seen.
_POINTS_IN_PERIOD = 6
# Reaches of the hysteresis, over half the range of the torque; beyond, its branch would be a second stiffness.
_REACHES = (0.02, 0.45)
# Shares of the torque's values below which knees are tried.
_KNEES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
# Time constants: more than a few points, and so short that the log shows them through (to exp(-4)).
_POINTS_IN_CONSTANT, _CONSTANTS_IN_LOG = 8, 4
# A drift can be told from the way there and back after two full cycles.
_REVERSALS_FOR_DRIFT = 4

# Some times the 3 ms that actuators show.
_LARGEST_DELAY = 0.01
# Some times the percents of the twist that drives creep by.
_LARGEST_CREEP = 0.5

Columns = Callable[[Points, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Form:
    """One form of an effect.

    Attributes:
        family: Name of the effect, as reports use it.
        name: Of the form.
        columns: Columns (n, strengths) at points, for given shape parameters.
        strengths: Names of the strengths.
        equation: What it adds to the twist.
        shapes: Values of the shape parameters to begin with, in rows of a grid, (grid, shape parameters).
        shape_names: Names of the shape parameters; those that begin with "log " are logarithms.
        low: Least value of each shape parameter.
        high: Largest.
        sign: Sign that physics asks of the first strength; zero for either.
        of_torque: Whether its columns follow the torque, so that an error of the torque may pass for it.
    """

    family: str
    name: str
    columns: Columns
    strengths: tuple[str, ...]
    equation: str
    shapes: np.ndarray = field(default_factory=lambda: np.zeros((1, 0)))
    shape_names: tuple[str, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    sign: int = 0
    of_torque: bool = True

    @property
    def size(self) -> int:
        """Number of strengths and shape parameters; where a log begins is none of them."""
        own = [n for n in (*self.strengths, *self.shape_names) if not n.startswith("start")]
        return len(own)


def catalogue(points: Points) -> tuple[Form, ...]:
    """The forms that the logs can tell something about, the more usual ones first.

    A loop may run either way: friction on the motor's side turns it round, where the torque is a motor's current.
    """
    return (
        *_hysteresis(points),
        *_stiffness_shapes(points),
        *_creep(points),
        *_of_the_motor_angle(points),
        *_eccentricity(points),
        *_friction(points),
        *_delay(points),
        *_temperature(points),
    )


def choices(forms: Sequence[Form], families: int) -> list[tuple[Form, ...]]:
    """Forms to look at: each alone, and each bend together with each loop, of which either hides the other.

    Args:
        forms: That may be added.
        families: Number of families that may be added.
    """
    alone = [(form,) for form in forms]
    if families < 2:
        return alone
    loops = [form for form in forms if form.family == "hysteresis"]
    bends = [form for form in forms if form.family == "stiffness_shape" and not form.shape_names]
    return alone + [(loop, bend) for loop in loops for bend in bends]


def is_plausible(form: Form, strengths: np.ndarray, compliance: float | np.floating, points: Points) -> bool:
    """Whether real drives show such a strength: a channel is late by milliseconds or samples, and what creeps is a part
    of the twist that was there at once."""
    share = abs(strengths[0] / compliance) if compliance else math.inf
    if form.family == "input_delay":
        return bool(share <= max(_LARGEST_DELAY, 2.0 * points.step))
    return bool(form.family != "creep" or share <= _LARGEST_CREEP)


def base_columns(points: Points) -> np.ndarray:
    """Columns of the straight line: torque, and one for each log's zero, (n, 1 + logs)."""
    return np.column_stack([points.torque - points.centre, *(points.log == i for i in range(len(points.names)))])


def _hysteresis(points: Points) -> Iterator[Form]:
    if "one way" in points.motion or max(points.reversals) == 0:
        # Friction follows the direction of the motion, and no loop is open.
        return
    low, high = math.log(_REACHES[0] * points.reach), math.log(_REACHES[1] * points.reach)
    logs = len(points.names)
    grid = np.array([[at, *[start] * logs] for at in np.linspace(low, high, 10) for start in (-1.0, 0.0, 1.0)])
    for memory in MEMORIES:
        yield Form(
            "hysteresis",
            f"{memory} hysteresis",
            partial(_branch, memory),
            ("friction",),
            "twist = (tau - F s)/K, where s goes from -1 to 1 as the torque turns round "
            + ("(spring beside a slider)" if memory == "abrupt" else "(Dahl)"),
            grid,
            ("log reach", *(f"start {i}" for i in range(logs))),
            (low, *[-1.0] * logs),
            (high, *[1.0] * logs),
        )


def _branch(memory: Memory, points: Points, shape: np.ndarray) -> np.ndarray:
    reach = math.exp(shape[0])
    each = [remembered(memory, points.torque[own], reach, shape[1 + i]) for i, own in enumerate(points.logs)]
    return np.concatenate(each)[:, None]


def _stiffness_shapes(points: Points) -> Iterator[Form]:
    stiffness = "stiffness_shape"
    yield Form(stiffness, "quadratic", partial(_powers, (2,)), ("quadratic",), "twist = tau/K + q tau^2")
    yield Form(stiffness, "cubic", partial(_powers, (3,)), ("cubic",), "twist = tau/K + c tau^3")
    both = ("quadratic", "cubic")
    yield Form(stiffness, "quadratic and cubic", partial(_powers, (2, 3)), both, "twist = tau/K + q tau^2 + c tau^3")
    size = np.abs(points.torque - points.centre)
    knees = np.log(np.quantile(size, _KNEES))
    ends = (float(knees[0]),), (float(knees[-1]),)
    line = "twist = tau/K1 up to T1, with slope 1/K2 beyond"
    yield Form(stiffness, "two slopes", _beyond, ("beyond knee",), line, knees[:, None], ("log knee",), *ends)
    if points.centre == 0.0:
        yield Form("backlash", "dead zone", _dead_zone, ("half-width",), "twist = tau/K + b sgn(tau)", sign=1)


def _powers(powers: tuple[int, ...], points: Points, shape: np.ndarray) -> np.ndarray:
    return np.column_stack([(points.torque - points.centre) ** power for power in powers])


def _beyond(points: Points, shape: np.ndarray) -> np.ndarray:
    torque, knee = points.torque - points.centre, math.exp(shape[0])
    return (torque - np.clip(torque, -knee, knee))[:, None]


def _dead_zone(points: Points, shape: np.ndarray) -> np.ndarray:
    # The torque's noise and its way between points blur the step.
    width = math.hypot(points.torque_noise, float(np.median(np.abs(np.diff(points.torque)))))
    return np.tanh(points.torque / max(width, 1e-6 * points.reach))[:, None]


def _creep(points: Points) -> Iterator[Form]:
    low, high = _POINTS_IN_CONSTANT * points.step, points.duration / _CONSTANTS_IN_LOG
    if not low < high:
        return
    logs = len(points.names)
    constants, starts = np.linspace(math.log(low), math.log(high), 10), (-1.0, 0.0, 1.0)
    yield Form(
        "creep",
        "standard linear solid",
        _lagging,
        ("delayed compliance",),
        "twist = tau/K + k z, where T z' = tau - z",
        np.array([[at, *[start] * logs] for at in constants for start in starts]),
        ("log time constant", *(f"start {i}" for i in range(logs))),
        (math.log(low), *[-1.0] * logs),
        (math.log(high), *[1.0] * logs),
        sign=1,
    )


def _lagging(points: Points, shape: np.ndarray) -> np.ndarray:
    """The torque behind a first-order lag, which begins by a share of the torque's range off it."""
    constant, lags = math.exp(shape[0]), []
    for start, own in zip(shape[1:], points.logs, strict=True):
        torque, time = points.torque[own], points.time[own]
        fading = start * points.reach * np.exp(-(time - time[0]) / constant)
        lags.append(_lag(torque - torque[0], np.diff(time), constant) + torque[0] + fading)
    return (np.concatenate(lags) - points.centre)[:, None]


def _lag(values: np.ndarray, steps: np.ndarray, constant: float) -> np.ndarray:
    """T z' = values - z from z = 0, with values straight between points."""
    if np.ptp(steps) <= 1e-6 * np.mean(steps):
        kept = math.exp(-float(np.mean(steps)) / constant)
        share = (1.0 - kept) * constant / float(np.mean(steps))
        return np.asarray(lfilter([1.0 - share, share - kept], [1.0, -kept], values))
    kept = np.exp(-steps / constant)
    share = (1.0 - kept) * constant / steps
    added = (1.0 - share) * values[1:] + (share - kept) * values[:-1]
    path = [0.0]
    for keep, add in zip(kept.tolist(), added.tolist(), strict=True):
        path.append(keep * path[-1] + add)
    return np.array(path)


def orders_seen(angle: np.ndarray, points: Points, highest: int) -> list[int]:
    """Orders of an angle of which the logs hold a full period, with enough points in it."""
    travel = max(float(np.ptp(angle[own])) for own in points.logs)
    steps = np.abs(np.concatenate([np.diff(angle[own]) for own in points.logs]))
    step = float(np.median(steps[steps >= 0.1 * np.percentile(steps, 90)]))
    return [
        n for n in range(1, highest + 1) if n * travel >= 2 * math.pi and n * step <= 2 * math.pi / _POINTS_IN_PERIOD
    ]


def _of_the_motor_angle(points: Points) -> Iterator[Form]:
    if points.motor_angle is None or points.direction is None:
        return
    for n in orders_seen(points.motor_angle, points, HIGHEST_ORDER):
        names = (f"cosine {n}", f"sine {n}")
        yield Form(
            "kinematic_error",
            f"order {n} of the motor",
            partial(_order, n, None),
            names,
            f"twist = tau/K + a cos({n} theta_m) + b sin({n} theta_m)",
            of_torque=False,
        )
        yield Form(
            "position_dependent_stiffness",
            f"stiffness ripple of order {n}",
            partial(_order, n, "torque"),
            names,
            f"twist = (1 + a cos({n} theta_m) + b sin({n} theta_m)) tau/K",
        )
        if "both ways" in points.motion:
            yield Form(
                "position_dependent_friction",
                f"friction ripple of order {n}",
                partial(_order, n, "direction"),
                names,
                f"twist = (tau - F sgn(speed) (a cos({n} theta_m) + b sin({n} theta_m)))/K",
            )


def _order(order: int, factor: str | None, points: Points, shape: np.ndarray) -> np.ndarray:
    assert points.motor_angle is not None
    phase = order * points.motor_angle
    waves = np.column_stack([np.cos(phase), np.sin(phase)])
    return waves if factor is None else waves * getattr(points, factor)[:, None]


def _eccentricity(points: Points) -> Iterator[Form]:
    if points.load_angle is None or points.direction is None:
        return
    for n in orders_seen(points.load_angle, points, 2):
        yield Form(
            "encoder_eccentricity",
            f"order {n} of the load",
            partial(_load_order, n),
            (f"cosine {n}", f"sine {n}"),
            f"reading of theta_l = theta_l - a cos({n} theta_l) - b sin({n} theta_l)",
            of_torque=False,
        )


def _load_order(order: int, points: Points, shape: np.ndarray) -> np.ndarray:
    assert points.load_angle is not None
    return np.column_stack([np.cos(order * points.load_angle), np.sin(order * points.load_angle)])


def _friction(points: Points) -> Iterator[Form]:
    if points.direction is None:
        return
    rests = tuple(f"rest {i}" for i in range(int(points.rest.max()) + 1))
    if "both ways" not in points.motion and not rests:
        return
    law = "twist = (tau - F sgn(speed))/K, and at rest a level of its own"
    yield Form("motor_friction", "Coulomb friction", partial(_direction, False), ("friction", *rests), law)
    yield Form(
        "motor_friction",
        "Coulomb friction that grows with the load",
        partial(_direction, True),
        ("friction", "share of load", *rests),
        "twist = (tau - (F + m |tau|) sgn(speed))/K, and at rest a level of its own",
    )


def _direction(grows: bool, points: Points, shape: np.ndarray) -> np.ndarray:
    assert points.direction is not None
    rests = [(points.rest == i).astype(float) for i in range(int(points.rest.max()) + 1)]
    growing = [points.direction * np.abs(points.torque)] if grows else []
    return np.column_stack([points.direction, *growing, *rests])


def _delay(points: Points) -> Iterator[Form]:
    yield Form("input_delay", "delay", _rate, ("delay",), "twist = tau(t - d)/K, to first order in d")


def _rate(points: Points, shape: np.ndarray) -> np.ndarray:
    return points.in_each_log(lambda own: np.gradient(points.torque[own], points.time[own]))[:, None]


def _temperature(points: Points) -> Iterator[Form]:
    if points.temperature is not None and np.ptp(points.temperature) > 0:
        law = "twist = (1 - k (T - T0)) tau/K"
        yield Form("temperature", "stiffness that falls with temperature", _warm_compliance, ("compliance",), law)
        law = "twist = tau/K + d (T - T0)"
        yield Form("temperature", "thermal drift of the twist", _warm_drift, ("drift",), law)
    elif min(points.reversals) >= _REVERSALS_FOR_DRIFT:
        yield Form("temperature", "drift of the twist", _drift, ("drift",), "twist = tau/K + d t")


def _warm(points: Points) -> np.ndarray:
    assert points.temperature is not None
    return points.temperature - np.mean(points.temperature)


def _warm_compliance(points: Points, shape: np.ndarray) -> np.ndarray:
    return ((points.torque - points.centre) * _warm(points))[:, None]


def _warm_drift(points: Points, shape: np.ndarray) -> np.ndarray:
    return _warm(points)[:, None]


def _drift(points: Points, shape: np.ndarray) -> np.ndarray:
    return points.in_each_log(lambda own: points.time[own] - np.mean(points.time[own]))[:, None]
