"""Pictures of the loop on quasi-static logs: errors before and after, and the evidence for each effect."""

import numpy as np

from fitting.plots import Plot
from fitting.plots.look import AFTER, BEFORE
from fitting.quasi_static.drawing import against, by_direction, drawn, fitted_lines, scaled
from fitting.quasi_static.loop import Finding, QuasiStaticLoop
from fitting.quasi_static.motion_forms import HIGHEST_ORDER
from fitting.quasi_static.strengths import contribution

_ORDERS = ("kinematic_error", "position_dependent_stiffness", "position_dependent_friction", "encoder_eccentricity")
_IN_TIME = ("creep", "motor_friction", "temperature")


def loop_pictures(loop: QuasiStaticLoop) -> list[Plot]:
    """All pictures, in the order of the page: the curve, the errors, then one an effect."""
    return [_curve(loop), _errors(loop), *(_evidence(loop, one) for one in loop.findings)]


def _curve(loop: QuasiStaticLoop) -> Plot:
    points, model = loop.held.points, loop.after.model
    # Each log's zero is of no interest.
    zeros = slice(1, 1 + len(points.names))
    measured = points.twist - model.jacobian[:, zeros] @ model.coefficients[zeros]
    factor, label = scaled(measured, "twist")
    traces = by_direction(points, factor * measured, name="measured")
    traces += fitted_lines(points, points.torque, factor * (measured - model.misfit))
    return Plot(
        "curve",
        "fit",
        "Twist against joint torque",
        "Measured, and what the final equation gives along the logged torque and angles, each less the log's zero.",
        against(traces, 440, "joint torque [N m]", label),
    )


def _errors(loop: QuasiStaticLoop) -> Plot:
    points = loop.held.points
    factor, label = scaled(loop.before.held_out, "held-out error")
    ends = np.cumsum([0.0, *(np.ptp(points.time[own]) for own in points.logs)])
    traces = [
        drawn(points.time + ends[points.log], factor * trial.held_out, mode="lines", color=None, name=f"with {added}")
        for added, trial in loop.steps
    ]
    traces[0] |= {"name": "straight line", "line": {"width": 1.6, "color": AFTER}}
    return Plot(
        "errors",
        "left_over",
        "Held-out errors, step by step",
        "Measured less predicted twist; each stretch by a fit that has not seen it. Several logs stand in a row.",
        against(traces, 340, "time [s]", label),
    )


def _evidence(loop: QuasiStaticLoop, finding: Finding) -> Plot:
    if finding.family in _ORDERS:
        return _spectrum(loop, finding)
    points, model, forms = loop.told_by(finding)
    own = contribution(points, model, forms)
    factor, label = scaled(own + model.misfit, "twist")
    if finding.family in _IN_TIME:
        at, x = points.time, f"time from the start of the {'log' if finding.at_rest is None else 'rest'} [s]"
        traces = [drawn(at, factor * (own + model.misfit), mode="markers", color=AFTER, name="measured")]
    else:
        at, x = points.torque, "joint torque [N m]"
        traces = by_direction(points, factor * (own + model.misfit), name="measured")
    return Plot(
        f"evidence-{finding.family}",
        "found",
        f"Evidence for {finding.family.replace('_', ' ')}",
        "The measured twist less everything else that was fitted, and what the effect adds.",
        against(traces + fitted_lines(points, at, factor * own), 360, x, label),
    )


def _spectrum(loop: QuasiStaticLoop, finding: Finding) -> Plot:
    """Amplitude of each order of the angle, with and without the effect."""
    points, model = loop.held.points, loop.after.model
    side = "load" if finding.family == "encoder_eccentricity" else "motor"
    orders = np.arange(0.25, HIGHEST_ORDER + 0.5, 0.125)
    # At rest every order is a constant.
    moves = points.direction != 0
    angle, own = getattr(points, f"{side}_angle")[moves], contribution(points, model, finding.forms)
    before, after = (_amplitudes(angle, v[moves], orders) for v in (model.misfit + own, model.misfit))
    factor, label = scaled(before, "amplitude")
    traces = [
        drawn(orders, factor * before, mode="lines", color=BEFORE, name="without the effect"),
        drawn(orders, factor * after, mode="lines", color=AFTER, name="with it"),
    ]
    return Plot(
        f"evidence-{finding.family}",
        "found",
        f"Evidence for {finding.family.replace('_', ' ')}: orders of the {side}'s angle",
        f"Amplitude of waves in the twist that repeat so many times in a revolution of the {side}, without and with "
        "the effect in the equation, while the joint moves.",
        against(traces, 360, f"order of the {side}'s revolution", label),
    )


def _amplitudes(angle: np.ndarray, values: np.ndarray, orders: np.ndarray) -> np.ndarray:
    found = []
    for order in orders:
        waves = np.column_stack([np.cos(order * angle), np.sin(order * angle), np.ones(len(angle))])
        solution, *_ = np.linalg.lstsq(waves, values, rcond=None)
        found.append(float(np.hypot(*solution[:2])))
    return np.array(found)
