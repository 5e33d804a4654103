"""Effects of a moving joint: ripples in an angle, and friction on the motor's side.

A kinematic error is a function of the angle where it arises. With the motor's angle theta_m on one side and N theta_l
on the other, that is theta_m - s N tau/K, where s is the share of the twist between motor and error. To first order, s
adds n s N A tau/K sin(n theta_m + psi) to A cos(n theta_m + psi): the regressor of a stiffness ripple.
"""

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from fitting.quasi_static.form import REST, Form
from fitting.quasi_static.intervals import Figure
from fitting.quasi_static.points import Points
from fitting.quasi_static.twist_model import fit_twist

HIGHEST_ORDER = 12
# Least number of points per period of an order.
_POINTS_IN_PERIOD = 6
# Starting values of the share of the twist between motor and kinematic error.
_SHARES = (0.5, 1.0)


def motion_forms(points: Points) -> Iterator[Form]:
    """The forms that the logs may determine, the more common ones first; none where no joint moved."""
    if points.direction is not None:
        yield from _of_the_motor_angle(points)
        yield from _eccentricity(points)
        yield from _friction(points)


def orders_seen(angle: np.ndarray | None, points: Points, highest: int) -> list[int]:
    """Orders of an angle with a full period and enough points per period in the logs; none where the angle is
    unknown."""
    if angle is None:
        return []
    travel = max(float(np.ptp(angle[own])) for own in points.logs)
    steps = np.abs(np.concatenate([np.diff(angle[own]) for own in points.logs]))
    step = float(np.median(steps[steps >= 0.1 * np.percentile(steps, 90)]))
    return [
        n for n in range(1, highest + 1) if n * travel >= 2 * math.pi and n * step <= 2 * math.pi / _POINTS_IN_PERIOD
    ]


def _of_the_motor_angle(points: Points) -> Iterator[Form]:
    if points.motor_angle is None:
        return
    # Motor angle per torque: the shift by the whole twist.
    shift = (points.ratio or 0.0) * float(fit_twist(points).coefficients[0])
    # Where twist alone turns the motor, its share would be a change of the order.
    behind = orders_seen(_shifted(shift, points), points, HIGHEST_ORDER) if shift > 0.0 else []
    for n in orders_seen(points.motor_angle, points, HIGHEST_ORDER):
        waves, names = partial(_waves, "motor_angle", n), (f"cosine {n}", f"sine {n}")
        wave = f"a cos({n} theta_m) + b sin({n} theta_m)"
        yield Form(
            "kinematic_error",
            _at_the_motor(n),
            partial(waves, None),
            names,
            f"twist = tau/K + {wave}",
            _of_a_wave(n, "kinematic error"),
            of_torque=False,
        )
        if n in behind:
            yield _behind_the_motor(n, shift, points)
        yield Form(
            "position_dependent_stiffness",
            f"stiffness ripple of order {n}",
            partial(waves, "torque"),
            names,
            f"twist = (1 + {wave}) tau/K",
            (
                Figure(f"amplitude_{n}", _share, "1", "of the stiffness, as a share of it", True),
                Figure(f"phase_{n}", _phase, "rad", "of the stiffness at theta_m = 0"),
            ),
        )
        if "both ways" in points.motion:
            yield Form(
                "position_dependent_friction",
                f"friction ripple of order {n}",
                partial(waves, "direction"),
                names,
                f"twist = (tau - F sgn(speed) ({wave}))/K",
                (Figure(f"amplitude_{n}", _share, "N m", "of the friction", True),),
            )


def _behind_the_motor(order: int, shift: float, points: Points) -> Form:
    """A kinematic error with a part of the twist between it and the motor."""
    assert points.ratio is not None
    share = partial(_share_of_twist, points.ratio)
    return Form(
        "kinematic_error",
        f"order {order} between motor and load",
        partial(_shifted_waves, order),
        (f"cosine {order}", f"sine {order}"),
        f"twist = tau/K + a cos({order} phi) + b sin({order} phi), where phi = theta_m - s N tau/K",
        (
            *_of_a_wave(order, "kinematic error"),
            Figure(f"share_of_twist_{order}", share, "1", "share s of the twist between motor and kinematic error"),
        ),
        shift * np.array(_SHARES)[:, None],
        ("shift",),
        np.array([[0.0], [shift]]),
        of_torque=False,
        includes=_at_the_motor(order),
    )


def _at_the_motor(order: int) -> str:
    return f"order {order} of the motor"


def _shifted(shift: float, points: Points) -> np.ndarray:
    """The motor's angle less a shift per torque [rad], (n,)."""
    assert points.motor_angle is not None
    return points.motor_angle - shift * (points.torque - points.centre)


def _shifted_waves(order: int, points: Points, shape: np.ndarray) -> np.ndarray:
    return _turning(order * _shifted(shape[0], points))


def _share_of_twist(ratio: float, own: np.ndarray) -> float:
    return own[3] / (ratio * own[0])


def _eccentricity(points: Points) -> Iterator[Form]:
    for n in orders_seen(points.load_angle, points, 2):
        yield Form(
            "encoder_eccentricity",
            f"order {n} of the load",
            partial(_waves, "load_angle", n, None),
            (f"cosine {n}", f"sine {n}"),
            f"reading of theta_l = theta_l - a cos({n} theta_l) - b sin({n} theta_l)",
            _of_a_wave(n, "reading"),
            of_torque=False,
        )


def _waves(angle: str, order: int, factor: str | None, points: Points, shape: np.ndarray) -> np.ndarray:
    return _turning(order * getattr(points, angle)) * (1.0 if factor is None else getattr(points, factor)[:, None])


def _turning(phase: np.ndarray) -> np.ndarray:
    return np.column_stack([np.cos(phase), np.sin(phase)])


def _amplitude(own: np.ndarray) -> float:
    return math.hypot(own[1], own[2])


def _share(own: np.ndarray) -> float:
    return _amplitude(own) / abs(own[0])


def _phase(own: np.ndarray) -> float:
    return math.atan2(own[2], -own[1])


def _of_a_wave(order: int, what: str) -> tuple[Figure, Figure]:
    return (
        Figure(f"amplitude_{order}", _amplitude, "rad", f"of the {what}, zero to peak", True),
        Figure(f"phase_{order}", _phase, "rad", f"psi in A cos({order} theta + psi)"),
    )


def _friction(points: Points) -> Iterator[Form]:
    rests = tuple(f"{REST} {i}" for i in range(int(points.rest.max()) + 1))
    if "both ways" not in points.motion and not rests:
        return
    friction = Figure("friction", lambda own: -own[1] / own[0], "N m", "friction while the joint moves, at its output")
    yield Form(
        "motor_friction",
        "Coulomb friction",
        partial(_direction, False),
        ("friction", *rests),
        "twist = (tau - F sgn(speed))/K, and at rest a free level",
        (friction,),
    )
    yield Form(
        "motor_friction",
        "Coulomb friction that grows with the load",
        partial(_direction, True),
        ("friction", "share of load", *rests),
        "twist = (tau - (F + m |tau|) sgn(speed))/K, and at rest a free level",
        (
            friction,
            Figure("share_of_load", lambda own: -own[2] / own[0], "1", "by which the friction grows with the torque"),
        ),
    )


def _direction(grows: bool, points: Points, shape: np.ndarray) -> np.ndarray:
    assert points.direction is not None
    rests = [(points.rest == i).astype(float) for i in range(int(points.rest.max()) + 1)]
    growing = [points.direction * np.abs(points.torque)] if grows else []
    return np.column_stack([points.direction, *growing, *rests])
