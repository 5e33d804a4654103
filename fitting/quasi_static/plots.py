"""Pictures of a quasi-static fit, as plotly figures in plain dictionaries."""

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.quasi_static.drawing import CURVE, Picture, by_direction, drawn, figure
from fitting.quasi_static.fit import QuasiStaticFit
from fitting.quasi_static.torque_twist import Blocks


def pictures(fit: QuasiStaticFit) -> list[Picture]:
    """All pictures of a fit, in the order of the page."""
    return [_loops(fit), _misfit_by_torque(fit), _misfit_by_time(fit)]


def _loops(fit: QuasiStaticFit) -> Picture:
    """Twist against torque: the blocks, and the curve that was fitted to them."""
    blocks, best = fit.blocks, fit.best
    zero = best.curve.zero(best.parameters, blocks)
    predicted = blocks.twist - best.misfit - zero
    measured = blocks.twist - zero
    factor, unit = scaled_unit(float(np.max(np.abs(measured))), "rad")
    traces = by_direction(blocks.torque, factor * measured, _is_rising(blocks), name="measured")
    for i, name in enumerate(blocks.names):
        own = blocks.log == i
        trace = drawn(blocks.torque[own], factor * predicted[own], mode="lines", color=CURVE, name=f"fitted, {name}")
        traces.append(trace if len(blocks.names) > 1 else trace | {"name": "fitted"})
    line = best.curve.elastic(best.parameters, np.sort(blocks.torque))[0]
    middle = drawn(np.sort(blocks.torque), factor * line, mode="lines", color=CURVE, name="middle of the loop")
    traces.append(middle | {"line": {"color": CURVE, "width": 1.2, "dash": "dot"}})
    return Picture(
        "loops",
        "Twist against joint torque",
        "Each point is the mean of a short run of rows, less the twist zero and drift of its log. The full line is the "
        "fitted curve along the torque's own path; the dotted one is the middle between its branches, where stiffness "
        "is read.",
        figure(traces, 480, "joint torque [N m]", axis_label("twist", unit)),
    )


def _misfit_by_torque(fit: QuasiStaticFit) -> Picture:
    factor, unit = scaled_unit(float(np.sqrt(np.mean(fit.best.misfit**2))), "rad")
    blocks = fit.blocks
    traces = by_direction(blocks.torque, factor * fit.best.misfit, _is_rising(blocks), name="misfit")
    return Picture(
        "misfit-torque",
        "What the curve leaves over, against torque",
        "A bend that is the same both ways belongs to the curve's shape; one that differs belongs to the hysteresis.",
        figure(traces, 300, "joint torque [N m]", axis_label("measured less fitted", unit)),
    )


def _misfit_by_time(fit: QuasiStaticFit) -> Picture:
    blocks = fit.blocks
    factor, unit = scaled_unit(float(np.sqrt(np.mean(fit.best.misfit**2))), "rad")
    traces = []
    for i, name in enumerate(blocks.names):
        own = blocks.log == i
        time = blocks.time[own] - blocks.time[own][0]
        traces.append(drawn(time, factor * fit.best.misfit[own], mode="lines", color=None, name=name))
    return Picture(
        "misfit-time",
        "What the curve leaves over, against time",
        "A slope is a drift, a slow wave an effect that the curve lacks; the intervals allow for both as far as they "
        "look like chance.",
        figure(traces, 300, "time from the start [s]", axis_label("measured less fitted", unit)),
    )


def _is_rising(blocks: Blocks) -> np.ndarray:
    return np.gradient(blocks.torque) >= 0
