"""Plots of quasi-static fits and loops, as plotly figures in plain dictionaries."""

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.quasi_static.fit import QuasiStaticFit
from fitting.quasi_static.loop import Finding, QuasiStaticLoop
from fitting.quasi_static.motion_forms import HIGHEST_ORDER
from fitting.quasi_static.points import Points
from fitting.quasi_static.torque_twist import Blocks
from fitting.quasi_static.twist_model import contribution
from fitting.report.plots import Plot
from fitting.report.plots.axes import AFTER, BEFORE, INK, axis, figure, numbers
from fitting.report.plots.plot import Figure
from fitting.validation.residual_diagnostics import order_amplitude

_ORDERS = ("kinematic_error", "position_dependent_stiffness", "position_dependent_friction", "encoder_eccentricity")
_IN_TIME = ("creep", "motor_friction", "temperature")


def fit_pictures(fit: QuasiStaticFit) -> list[Plot]:
    """All plots of a fit, in the order of the page."""
    return [_loops(fit), _misfit_by_torque(fit), _misfit_by_time(fit)]


def _loops(fit: QuasiStaticFit) -> Plot:
    """Twist against torque: the blocks and the fitted curve."""
    blocks, best = fit.blocks, fit.best
    measured = blocks.twist - best.curve.zero(best.parameters, blocks)
    factor, label = _scaled(measured, "twist")
    traces = _by_direction(blocks, factor * measured, name="measured")
    traces += _fitted_lines(blocks, blocks.torque, factor * (measured - best.misfit))
    torque = np.sort(blocks.torque)
    line = best.curve.elastic(best.parameters, torque)[0]
    middle = _drawn(torque, factor * line, mode="lines", color=INK, name="middle of the loop")
    traces.append(middle | {"line": {"color": INK, "width": 1.2, "dash": "dot"}})
    return Plot(
        "loops",
        "fit",
        "Twist against joint torque",
        "Each point is the mean of a short run of rows, less the twist zero and drift of its log. The full line is the "
        "fitted curve along the torque's own path; the dotted one is the middle between its branches, where stiffness "
        "is read.",
        _against(traces, 480, "joint torque [N m]", label),
    )


def _misfit_by_torque(fit: QuasiStaticFit) -> Plot:
    factor, label = _scaled(fit.best.misfit, "measured less fitted")
    return Plot(
        "misfit-torque",
        "left_over",
        "Residual against torque",
        "A bend that is equal both ways is due to the curve's shape; one that differs is due to hysteresis.",
        _against(_by_direction(fit.blocks, factor * fit.best.misfit, name="misfit"), 300, "joint torque [N m]", label),
    )


def _misfit_by_time(fit: QuasiStaticFit) -> Plot:
    blocks = fit.blocks
    factor, label = _scaled(fit.best.misfit, "measured less fitted")
    traces = []
    for i, name in enumerate(blocks.names):
        own = blocks.log == i
        time = blocks.time[own] - blocks.time[own][0]
        traces.append(_drawn(time, factor * fit.best.misfit[own], mode="lines", color=None, name=name))
    return Plot(
        "misfit-time",
        "left_over",
        "Residual against time",
        "A slope is a drift, a slow wave an effect that the curve lacks; the intervals account for both where they "
        "look random.",
        _against(traces, 300, "time from the start [s]", label),
    )


def loop_pictures(loop: QuasiStaticLoop) -> list[Plot]:
    """All plots, in the order of the page: the curve, the errors, then one per effect."""
    return [_curve(loop), _errors(loop), *(_evidence(loop, one) for one in loop.findings)]


def _curve(loop: QuasiStaticLoop) -> Plot:
    points, model = loop.held.points, loop.after.model
    # Without each log's zero.
    zeros = slice(1, 1 + len(points.names))
    measured = points.twist - model.jacobian[:, zeros] @ model.coefficients[zeros]
    factor, label = _scaled(measured, "twist")
    traces = _by_direction(points, factor * measured, name="measured")
    traces += _fitted_lines(points, points.torque, factor * (measured - model.misfit))
    return Plot(
        "curve",
        "fit",
        "Twist against joint torque",
        "Measured twist, and that of the final equation for the logged torque and angles, without each log's zero.",
        _against(traces, 440, "joint torque [N m]", label),
    )


def _errors(loop: QuasiStaticLoop) -> Plot:
    points = loop.held.points
    factor, label = _scaled(loop.before.held_out, "held-out error")
    ends = np.cumsum([0.0, *(np.ptp(points.time[own]) for own in points.logs)])
    traces = [
        _drawn(points.time + ends[points.log], factor * trial.held_out, mode="lines", color=None, name=f"with {added}")
        for added, trial in loop.steps
    ]
    traces[-1] |= {"line": {"width": 1.6, "color": AFTER}}
    traces[0] |= {"name": "straight line", "line": {"width": 1.6, "color": BEFORE}}
    return Plot(
        "errors",
        "left_over",
        "Held-out errors, step by step",
        "Measured minus predicted twist of each held-out stretch. Several logs are shown one after the other.",
        _against(traces, 340, "time [s]", label),
    )


def _evidence(loop: QuasiStaticLoop, finding: Finding) -> Plot:
    if finding.family in _ORDERS:
        return _spectrum(loop, finding)
    points, model, forms = loop.evidence_of(finding)
    own = contribution(model, forms)
    factor, label = _scaled(own + model.misfit, "twist")
    if finding.family in _IN_TIME:
        at, x = points.time, f"time from the start of the {'log' if finding.at_rest is None else 'rest'} [s]"
        traces = [_drawn(at, factor * (own + model.misfit), mode="markers", color=AFTER, name="measured")]
    else:
        at, x = points.torque, "joint torque [N m]"
        traces = _by_direction(points, factor * (own + model.misfit), name="measured")
    return Plot(
        f"evidence-{finding.family}",
        "found",
        f"Evidence for {finding.family.replace('_', ' ')}",
        "The measured twist without all other fitted terms, and the effect's contribution.",
        _against(traces + _fitted_lines(points, at, factor * own), 360, x, label),
    )


def _spectrum(loop: QuasiStaticLoop, finding: Finding) -> Plot:
    """Amplitude of each order of the angle, with and without the effect."""
    points, model = loop.held.points, loop.after.model
    side = "load" if finding.family == "encoder_eccentricity" else "motor"
    orders = np.arange(0.25, HIGHEST_ORDER + 0.5, 0.125)
    # At rest every order is a constant.
    moves = points.direction != 0
    angle, own = getattr(points, f"{side}_angle")[moves], contribution(model, finding.forms)
    misfits = (misfit[moves] - np.mean(misfit[moves]) for misfit in (model.misfit + own, model.misfit))
    before, after = (order_amplitude(misfit, angle, orders) for misfit in misfits)
    factor, label = _scaled(before, "amplitude")
    traces = [
        _drawn(orders, factor * before, mode="lines", color=BEFORE, name="without the effect"),
        _drawn(orders, factor * after, mode="lines", color=AFTER, name="with it"),
    ]
    return Plot(
        f"evidence-{finding.family}",
        "found",
        f"Evidence for {finding.family.replace('_', ' ')}: orders of the {side}'s angle",
        f"Amplitude of each harmonic of the {side}'s revolution in the twist, without and with "
        "the effect in the equation, while the joint moves.",
        _against(traces, 360, f"order of the {side}'s revolution", label),
    )


def _scaled(values: np.ndarray, name: str) -> tuple[float, str]:
    """Scale factor of angles [rad], and the label of their axis."""
    factor, unit = scaled_unit(float(np.max(np.abs(values))), "rad")
    return factor, axis_label(name, unit)


def _drawn(x: np.ndarray, y: np.ndarray, *, mode: str, color: str | None, name: str) -> Figure:
    """Points or a line; the colour is plotly's next where None."""
    own: Figure = {} if color is None else {"color": color}
    look = {"marker": {"size": 5, "opacity": 0.6} | own} if mode == "markers" else {"line": {"width": 1.6} | own}
    return {"type": "scatter", "mode": mode, "name": name, "x": numbers(x, 9), "y": numbers(y)} | look


def _by_direction(data: Blocks | Points, values: np.ndarray, *, name: str) -> list[Figure]:
    """Values against torque, in two colours: where it rises and where it falls."""
    rising = np.gradient(data.torque) >= 0
    return [
        _drawn(data.torque[own], values[own], mode="markers", color=color, name=f"{name}, torque {way}")
        for own, color, way in ((rising, AFTER, "rising"), (~rising, BEFORE, "falling"))
    ]


def _fitted_lines(data: Blocks | Points, x: np.ndarray, values: np.ndarray) -> list[Figure]:
    """The fitted lines, log by log."""
    several = len(data.names) > 1
    return [
        _drawn(x[own], values[own], mode="lines", color=INK, name=f"fitted, {name}" if several else "fitted")
        for name, own in ((name, data.log == i) for i, name in enumerate(data.names))
    ]


def _against(traces: list[Figure], height: int, x: str, y: str) -> Figure:
    """Traces with the axes' titles."""
    return figure(traces, height, xaxis=axis(x), yaxis=axis(y), modebar={"orientation": "v"})
