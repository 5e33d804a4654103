"""Effects of a joint that moves: ripples in an angle, and friction on the motor's side."""

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from fitting.quasi_static.form import Form
from fitting.quasi_static.points import Points

HIGHEST_ORDER = 12
# Points that a period must have for its order to be seen.
_POINTS_IN_PERIOD = 6


def motion_forms(points: Points) -> Iterator[Form]:
    """The forms that the logs can tell something about, the more usual ones first; none where no joint moved."""
    yield from _of_the_motor_angle(points)
    yield from _eccentricity(points)
    yield from _friction(points)


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
