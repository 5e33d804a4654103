"""Pictures of the loop on quasi-static logs: errors before and after, and the evidence for each effect."""

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.quasi_static.attribution import Trial
from fitting.quasi_static.drawing import CURVE, FALLING, RISING, Figure, Picture, by_direction, drawn, figure
from fitting.quasi_static.loop import Finding, QuasiStaticLoop
from fitting.quasi_static.motion_forms import HIGHEST_ORDER
from fitting.quasi_static.points import Points
from fitting.quasi_static.strengths import contribution

_ORDERS = ("kinematic_error", "position_dependent_stiffness", "position_dependent_friction", "encoder_eccentricity")
_IN_TIME = ("creep", "motor_friction", "temperature")


def loop_pictures(loop: QuasiStaticLoop) -> list[Picture]:
    """All pictures, in the order of the page: the curve, the errors, then one an effect."""
    return [_curve(loop), _errors(loop), *(_evidence(loop, one) for one in loop.findings)]


def _curve(loop: QuasiStaticLoop) -> Picture:
    points, model = loop.held.points, loop.after.model
    # Each log's zero is of no interest.
    zero = model.jacobian[:, 1 : 1 + len(points.names)] @ model.coefficients[1 : 1 + len(points.names)]
    measured = points.twist - zero
    factor, unit = scaled_unit(float(np.max(np.abs(measured))), "rad")
    traces = _by_direction(points, factor * measured)
    for name, own in zip(points.names, points.logs, strict=True):
        fitted = factor * (measured - model.misfit)[own]
        label = "fitted" if len(points.names) == 1 else f"fitted, {name}"
        traces.append(drawn(points.torque[own], fitted, mode="lines", color=CURVE, name=label))
    return Picture(
        "curve",
        "Twist against joint torque",
        "Measured, and what the final equation gives along the logged torque and angles, each less the log's zero.",
        figure(traces, 440, "joint torque [N m]", axis_label("twist", unit)),
    )


def _errors(loop: QuasiStaticLoop) -> Picture:
    points = loop.held.points
    trials: list[tuple[str, Trial]] = [("straight line", loop.before)]
    trials += [(f"with {r.rivals[0].lead.name}", r.rivals[0].trial) for r in loop.rounds if r.accepted]
    if loop.at_rest is not None and loop.at_rest.form is not None:
        trials.append((f"with {loop.at_rest.form.name}", loop.after))
    factor, unit = scaled_unit(loop.before.rmse, "rad")
    time = points.time + np.array([sum(np.ptp(points.time[o]) for o in points.logs[:i]) for i in points.log])
    traces = [
        drawn(time, factor * trial.held_out, mode="lines", color=RISING if i == 0 else None, name=name)
        for i, (name, trial) in enumerate(trials)
    ]
    return Picture(
        "errors",
        "Held-out errors, step by step",
        "Measured less predicted twist; each stretch by a fit that has not seen it. Several logs stand in a row.",
        figure(traces, 340, "time [s]", axis_label("held-out error", unit)),
    )


def _evidence(loop: QuasiStaticLoop, finding: Finding) -> Picture:
    if finding.family in _ORDERS:
        return _spectrum(loop, finding)
    points, model, forms = loop.told_by(finding)
    own = contribution(points, model, forms)
    factor, unit = scaled_unit(float(np.max(np.abs(own + model.misfit))), "rad")
    if finding.family in _IN_TIME:
        at, label = points.time, f"time from the start of the {'log' if finding.at_rest is None else 'rest'} [s]"
    else:
        at, label = points.torque, "joint torque [N m]"
    if finding.family in _IN_TIME:
        traces = [drawn(at, factor * (own + model.misfit), mode="markers", color=RISING, name="measured")]
    else:
        traces = _by_direction(points, factor * (own + model.misfit))
    for rows in points.logs:
        traces.append(drawn(at[rows], factor * own[rows], mode="lines", color=CURVE, name="fitted"))
    return Picture(
        f"evidence-{finding.family}",
        f"Evidence for {finding.family.replace('_', ' ')}",
        "The measured twist less everything else that was fitted, and what the effect adds.",
        figure(traces, 360, label, axis_label("twist", unit)),
    )


def _spectrum(loop: QuasiStaticLoop, finding: Finding) -> Picture:
    """Amplitude of each order of the angle, with and without the effect."""
    points, model = loop.held.points, loop.after.model
    side = "load" if finding.family == "encoder_eccentricity" else "motor"
    angle = points.load_angle if side == "load" else points.motor_angle
    assert angle is not None
    orders = np.arange(0.25, HIGHEST_ORDER + 0.5, 0.125)
    # At rest every order is a constant.
    moves = np.full(len(angle), True) if points.direction is None else points.direction != 0
    own = contribution(points, model, finding.forms)
    before, after = (_amplitudes(angle[moves], v[moves], orders) for v in (model.misfit + own, model.misfit))
    factor, unit = scaled_unit(float(np.max(before)), "rad")
    traces = [
        drawn(orders, factor * before, mode="lines", color=FALLING, name="without the effect"),
        drawn(orders, factor * after, mode="lines", color=RISING, name="with it"),
    ]
    return Picture(
        f"evidence-{finding.family}",
        f"Evidence for {finding.family.replace('_', ' ')}: orders of the {side}'s angle",
        f"Amplitude of waves in the twist that repeat so many times in a revolution of the {side}, without and with "
        "the effect in the equation, while the joint moves.",
        figure(traces, 360, f"order of the {side}'s revolution", axis_label("amplitude", unit)),
    )


def _amplitudes(angle: np.ndarray, values: np.ndarray, orders: np.ndarray) -> np.ndarray:
    found = []
    for order in orders:
        waves = np.column_stack([np.cos(order * angle), np.sin(order * angle), np.ones(len(angle))])
        solution, *_ = np.linalg.lstsq(waves, values, rcond=None)
        found.append(float(np.hypot(*solution[:2])))
    return np.array(found)


def _by_direction(points: Points, values: np.ndarray) -> list[Figure]:
    rising = points.in_each_log(lambda own: np.gradient(points.torque[own])) >= 0
    return by_direction(points.torque, values, rising, name="measured")
