"""Pictures of a quasi-static fit, as plotly figures in plain dictionaries."""

import numpy as np

from fitting.plots import Plot
from fitting.plots.look import INK
from fitting.quasi_static.drawing import against, by_direction, drawn, fitted_lines, scaled
from fitting.quasi_static.fit import QuasiStaticFit


def pictures(fit: QuasiStaticFit) -> list[Plot]:
    """All pictures of a fit, in the order of the page."""
    return [_loops(fit), _misfit_by_torque(fit), _misfit_by_time(fit)]


def _loops(fit: QuasiStaticFit) -> Plot:
    """Twist against torque: the blocks, and the curve that was fitted to them."""
    blocks, best = fit.blocks, fit.best
    measured = blocks.twist - best.curve.zero(best.parameters, blocks)
    factor, label = scaled(measured, "twist")
    traces = by_direction(blocks, factor * measured, name="measured")
    traces += fitted_lines(blocks, blocks.torque, factor * (measured - best.misfit))
    torque = np.sort(blocks.torque)
    line = best.curve.elastic(best.parameters, torque)[0]
    middle = drawn(torque, factor * line, mode="lines", color=INK, name="middle of the loop")
    traces.append(middle | {"line": {"color": INK, "width": 1.2, "dash": "dot"}})
    return Plot(
        "loops",
        "fit",
        "Twist against joint torque",
        "Each point is the mean of a short run of rows, less the twist zero and drift of its log. The full line is the "
        "fitted curve along the torque's own path; the dotted one is the middle between its branches, where stiffness "
        "is read.",
        against(traces, 480, "joint torque [N m]", label),
    )


def _misfit_by_torque(fit: QuasiStaticFit) -> Plot:
    factor, label = scaled(fit.best.misfit, "measured less fitted")
    return Plot(
        "misfit-torque",
        "left_over",
        "What the curve leaves over, against torque",
        "A bend that is the same both ways belongs to the curve's shape; one that differs belongs to the hysteresis.",
        against(by_direction(fit.blocks, factor * fit.best.misfit, name="misfit"), 300, "joint torque [N m]", label),
    )


def _misfit_by_time(fit: QuasiStaticFit) -> Plot:
    blocks = fit.blocks
    factor, label = scaled(fit.best.misfit, "measured less fitted")
    traces = []
    for i, name in enumerate(blocks.names):
        own = blocks.log == i
        time = blocks.time[own] - blocks.time[own][0]
        traces.append(drawn(time, factor * fit.best.misfit[own], mode="lines", color=None, name=name))
    return Plot(
        "misfit-time",
        "left_over",
        "What the curve leaves over, against time",
        "A slope is a drift, a slow wave an effect that the curve lacks; the intervals allow for both as far as they "
        "look like chance.",
        against(traces, 300, "time from the start [s]", label),
    )
