"""Effects that depend on the torque: hysteresis, nonlinear stiffness, play, creep, delay, temperature."""

import math
from collections.abc import Iterator
from functools import partial
from itertools import accumulate
from typing import Any

import numpy as np

from fitting.quasi_static.form import Form
from fitting.quasi_static.intervals import Figure
from fitting.quasi_static.points import Points
from fitting.quasi_static.torque_twist import MEMORIES, Memory, hysteresis_branch

# Memory lengths of the hysteresis, over half the range of the torque; a longer one would act as a second stiffness.
_REACHES = (0.02, 0.45)
# Quantiles of the torque at which knees are tried.
_KNEES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
# Time constants: longer than a few points, and short enough to decay within the log (to exp(-4)).
_POINTS_IN_CONSTANT, _CONSTANTS_IN_LOG = 8, 4
# A drift can be separated from hysteresis after two full cycles.
_REVERSALS_FOR_DRIFT = 4


def torque_forms(points: Points) -> Iterator[Form]:
    """The forms that the logs may determine, the more common ones first."""
    # Friction depends on the direction of motion: with one direction, or without torque reversals, there is no loop.
    if "one way" not in points.motion and max(points.reversals) > 0:
        yield from _hysteresis(points)
    yield from _stiffness_shapes(points)
    if _POINTS_IN_CONSTANT * points.step < points.duration / _CONSTANTS_IN_LOG:
        yield _creep(points)
    yield delay()
    yield from _temperature(points)


def _begun(name: str, low: float, high: float, logs: int) -> dict[str, Any]:
    """Shape parameters of a memory: a positive number, and each log's initial state."""
    values = np.linspace(math.log(low), math.log(high), 10)
    return {
        "shapes": np.array([[at, *[start] * logs] for at in values for start in (-1.0, 0.0, 1.0)]),
        "shape_names": (f"log {name}", *(f"start {i}" for i in range(logs))),
        "range": np.array([[math.log(low), *[-1.0] * logs], [math.log(high), *[1.0] * logs]]),
    }


def _hysteresis(points: Points) -> Iterator[Form]:
    figures = (
        Figure("friction", lambda own: -own[1] / own[0], "N m", "friction behind the loop, half its width in torque"),
        Figure("width", lambda own: -2.0 * own[1], "rad", "width of the developed loop"),
        Figure("reach", lambda own: math.exp(own[2]), "N m", "torque over which the branch changes, half way", True),
    )
    low, high = (share * points.reach for share in _REACHES)
    for memory, law in zip(MEMORIES, ("(spring beside a slider)", "(Dahl)"), strict=True):
        yield Form(
            "hysteresis",
            f"{memory} hysteresis",
            partial(_branch, memory),
            ("friction",),
            f"twist = (tau - F s)/K, where s goes from -1 to 1 as the torque turns round {law}",
            figures,
            **_begun("reach", low, high, len(points.names)),
        )


def _branch(memory: Memory, points: Points, shape: np.ndarray) -> np.ndarray:
    starts = zip(points.logs, shape[1:], strict=True)
    each = [hysteresis_branch(memory, points.torque[own], math.exp(shape[0]), start) for own, start in starts]
    return np.concatenate(each)[:, None]


def _stiffness_shapes(points: Points) -> Iterator[Form]:
    alpha = Figure(
        "alpha",
        lambda own: -own[-1] / own[0] ** 3,
        "rad^-2",
        "cubic coefficient in tau = K (x + alpha x^3), to first order",
    )
    terms = {"quadratic": "q tau^2", "cubic": "c tau^3"}
    for names in (("quadratic",), ("cubic",), ("quadratic", "cubic")):
        powers = tuple(2 if name == "quadratic" else 3 for name in names)
        yield Form(
            "stiffness_shape",
            " and ".join(names),
            partial(_powers, powers),
            names,
            " + ".join(["twist = tau/K", *(terms[name] for name in names)]),
            (
                *(_of_a_power(i, name, power) for i, (name, power) in enumerate(zip(names, powers, strict=True), 1)),
                *((alpha,) if "cubic" in names else ()),
            ),
        )
    knees = np.log(np.quantile(np.abs(points.torque - points.centre), _KNEES))
    yield Form(
        "stiffness_shape",
        "two slopes",
        _beyond,
        ("beyond knee",),
        "twist = tau/K1 up to T1, with slope 1/K2 beyond",
        (
            Figure("K2", lambda own: 1.0 / (own[0] + own[1]), "N m/rad", "stiffness beyond the knee", True),
            Figure("T1", lambda own: math.exp(own[2]), "N m", "torque at the knee", True),
        ),
        knees[:, None],
        ("log knee",),
        knees[[0, -1], None],
    )
    if points.centre == 0.0:
        half = Figure("half_width", lambda own: own[1], "rad", "half of the dead zone", True)
        law = "twist = tau/K + b sgn(tau)"
        yield Form("backlash", "dead zone", _dead_zone, ("half-width",), law, (half,), sign=1)


def _of_a_power(at: int, name: str, power: int) -> Figure:
    return Figure(name, lambda own: own[at], f"rad/(N m)^{power}", f"{name} term of the twist in the torque")


def _powers(powers: tuple[int, ...], points: Points, shape: np.ndarray) -> np.ndarray:
    return np.power.outer(points.torque - points.centre, powers)


def _beyond(points: Points, shape: np.ndarray) -> np.ndarray:
    torque, knee = points.torque - points.centre, math.exp(shape[0])
    return (torque - np.clip(torque, -knee, knee))[:, None]


def _dead_zone(points: Points, shape: np.ndarray) -> np.ndarray:
    # The torque's noise and its change within a point blur the step.
    width = math.hypot(points.torque_noise, float(np.median(np.abs(np.diff(points.torque)))))
    return np.tanh(points.torque / max(width, 1e-6 * points.reach))[:, None]


def _creep(points: Points) -> Form:
    ends = _POINTS_IN_CONSTANT * points.step, points.duration / _CONSTANTS_IN_LOG
    return Form(
        "creep",
        "standard linear solid",
        _lagging,
        ("delayed compliance",),
        "twist = tau/K + k z, where T z' = tau - z",
        (
            Figure("time_constant", lambda own: math.exp(own[2]), "s", "of the relaxation", True),
            Figure("share", lambda own: own[1] / own[0], "1", "delayed twist over immediate twist", True),
        ),
        sign=1,
        **_begun("time constant", *ends, len(points.names)),
    )


def _lagging(points: Points, shape: np.ndarray) -> np.ndarray:
    """The torque after a first-order lag, whose initial deviation is a share of the torque's range."""
    lags = []
    for start, own in zip(shape[1:], points.logs, strict=True):
        torque = points.torque[own]
        lags.append(_lag(torque, np.diff(points.time[own]), math.exp(shape[0]), torque[0] + start * points.reach))
    return (np.concatenate(lags) - points.centre)[:, None]


def _lag(values: np.ndarray, steps: np.ndarray, constant: float, start: float) -> np.ndarray:
    """Solution of T z' = values - z, with values linear between points."""
    kept = np.exp(-steps / constant)
    share = (1.0 - kept) * constant / steps
    added = (1.0 - share) * values[1:] + (share - kept) * values[:-1]
    pairs = zip(kept.tolist(), added.tolist(), strict=True)
    return np.array(list(accumulate(pairs, lambda z, step: step[0] * z + step[1], initial=start)))


def delay() -> Form:
    """The twist lags the torque as logged."""
    figure = Figure("delay", lambda own: -own[1] / own[0], "s", "by which the twist lags the torque as logged")
    return Form("input_delay", "delay", _rate, ("delay",), "twist = tau(t - d)/K, to first order in d", (figure,))


def _rate(points: Points, shape: np.ndarray) -> np.ndarray:
    return points.torque_rate[:, None]


def _temperature(points: Points) -> Iterator[Form]:
    warmed = points.temperature is not None and np.ptp(points.temperature) > 0
    drift = Figure("drift", lambda own: own[1], "rad/K" if warmed else "rad/s", "drift of the twist")
    if warmed:
        yield Form(
            "temperature",
            "stiffness that falls with temperature",
            _warm_compliance,
            ("compliance",),
            "twist = (1 - k (T - T0)) tau/K",
            (
                Figure(
                    "coefficient",
                    lambda own: -own[1] / own[0],
                    "1/K",
                    "share by which the stiffness changes with temperature",
                ),
            ),
        )
        law = "twist = tau/K + d (T - T0)"
        yield Form("temperature", "thermal drift of the twist", _warm_drift, ("drift",), law, (drift,))
    elif min(points.reversals) >= _REVERSALS_FOR_DRIFT:
        yield Form("temperature", "drift of the twist", _drift, ("drift",), "twist = tau/K + d t", (drift,))


def _warm_compliance(points: Points, shape: np.ndarray) -> np.ndarray:
    return (points.torque - points.centre)[:, None] * _warm_drift(points, shape)


def _warm_drift(points: Points, shape: np.ndarray) -> np.ndarray:
    return points.warmth[:, None]


def _drift(points: Points, shape: np.ndarray) -> np.ndarray:
    return points.in_each_log(lambda own: points.time[own] - np.mean(points.time[own]))[:, None]
