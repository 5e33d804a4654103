"""The proposed experiment: command, predicted motion, and separation of the explanations over time."""

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.next_experiment.proposal import NextExperiment
from fitting.report.plots.axes import AFTER, BEFORE, INK, axis, figure, line_trace
from fitting.report.plots.long_trace import decimated
from fitting.report.plots.plot import Figure, Plot

_COLORS = (BEFORE, AFTER, "#009E73")


def next_experiment_plot(found: NextExperiment, *, unit: str, forcing_unit: str) -> Plot:
    """The command above, the motion in the middle, and the accumulated information below.

    Args:
        found: the experiment.
        unit: of the dynamic error.
        forcing_unit: of the command of a reduced drive.
    """
    motion, label = _motion(found, unit)
    drive = found.motor_speed is not None
    command = axis_label("motor torque", "N m") if drive else axis_label("forcing", forcing_unit)
    traces = [_trace(found.time, found.command, "command", "y"), _trace(found.time, motion, "motion", "y2")]
    layout = {
        "xaxis": axis("time [s]", anchor="y3"),
        "yaxis": axis(command, domain=[0.7, 1]),
        "yaxis2": axis(label, domain=[0.36, 0.64]),
        "yaxis3": axis("information so far", domain=[0, 0.3], rangemode="tozero"),
    }
    what = "the expected log-likelihood ratio up to then, dashed where the rival is right"
    if found.precision is not None:
        what = "the share of the information about alpha up to then"
    return Plot(
        "next-experiment",
        "next",
        "The proposed command",
        f"Above the command, which was optimised from {found.begins_like}. In the middle the motion that {found.found} "
        f"predicts. Below {what}.",
        figure([*traces, *_told(found)], 560, **layout),
    )


def _motion(found: NextExperiment, unit: str) -> tuple[np.ndarray, str]:
    if found.motor_speed is not None:
        return found.motor_speed, axis_label("motor speed", "rad/s")
    factor, told = scaled_unit(float(np.max(np.abs(found.dynamic_error))), unit)
    return factor * found.dynamic_error, axis_label("dynamic error", told)


def _told(found: NextExperiment) -> list[Figure]:
    if found.precision is not None:
        return [_trace(found.time, found.precision.gathered, "alpha", "y3", AFTER)]
    traces = []
    asked = [s for s in found.separations if s.gathered is not None]
    for separation, color in zip(asked, _COLORS, strict=False):
        assert separation.gathered is not None
        own, rivals = separation.gathered.T
        traces.append(_trace(found.time, own, f"against {separation.rival}", "y3", color) | {"showlegend": True})
        dashed = _trace(found.time, rivals, f"{separation.rival} is right", "y3", color)
        traces.append(dashed | {"line": dashed["line"] | {"dash": "dash"}, "showlegend": True})
    return traces


def _trace(time: np.ndarray, values: np.ndarray, name: str, place: str, color: str = INK) -> Figure:
    return line_trace(*decimated(time, values), name=name, color=color) | {"yaxis": place, "showlegend": False}
