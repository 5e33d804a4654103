"""Effects that follow the torque: loops, bends, play, creep, delay, temperature."""

import math
from collections.abc import Iterator
from functools import partial

import numpy as np
from scipy.signal import lfilter

from fitting.quasi_static.form import Form
from fitting.quasi_static.points import Points
from fitting.quasi_static.torque_twist import MEMORIES, Memory, remembered

# Reaches of the hysteresis, over half the range of the torque; beyond, its branch would be a second stiffness.
_REACHES = (0.02, 0.45)
# Shares of the torque's values below which knees are tried.
_KNEES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
# Time constants: more than a few points, and so short that the log shows them through (to exp(-4)).
_POINTS_IN_CONSTANT, _CONSTANTS_IN_LOG = 8, 4
# A drift can be told from the way there and back after two full cycles.
_REVERSALS_FOR_DRIFT = 4


def torque_forms(points: Points) -> Iterator[Form]:
    """The forms that the logs can tell something about, the more usual ones first."""
    yield from _hysteresis(points)
    yield from _stiffness_shapes(points)
    yield from _creep(points)
    yield delay()
    yield from _temperature(points)


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


def delay() -> Form:
    """The twist is behind the torque as logged."""
    return Form("input_delay", "delay", _rate, ("delay",), "twist = tau(t - d)/K, to first order in d")


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
