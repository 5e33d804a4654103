"""The proposed experiment: its command, the motion it makes, and what tells the explanations apart."""

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.next_experiment import NextExperiment
from fitting.plots.long_trace import decimated
from fitting.plots.look import AFTER, BEFORE, FAINT, INK, axis, figure, line_trace
from fitting.plots.plot import Figure, Plot

_COLORS = (BEFORE, AFTER, "#009E73")


def next_experiment_plot(found: NextExperiment, *, unit: str, forcing_unit: str) -> Plot:
    """The command above, the motion in the middle, and below what stays of the dynamic error after the refit.

    Args:
        found: the experiment.
        unit: of the dynamic error.
        forcing_unit: of the command of a reduced drive.
    """
    motion, label = _motion(found, unit)
    command = (
        axis_label("motor torque", "N m") if found.motor_speed is not None else axis_label("forcing", forcing_unit)
    )
    curves = _left(found)
    largest = max((float(np.max(np.abs(c))) for _, c in curves), default=found.noise)
    factor, told = scaled_unit(max(largest, found.noise), unit)
    traces = [_trace(found.time, found.command, "command", INK, "y"), _trace(found.time, motion, "motion", INK, "y2")]
    traces += [
        _trace(found.time, factor * c, name, color, "y3") | {"showlegend": True}
        for (name, c), color in zip(curves, _COLORS, strict=False)
    ]
    layout = {
        "xaxis": axis("time [s]", anchor="y3"),
        "yaxis": axis(command, domain=[0.7, 1]),
        "yaxis2": axis(label, domain=[0.36, 0.64]),
        "yaxis3": axis(axis_label("what tells", told), domain=[0, 0.3]),
        "shapes": [_noise_band(factor * found.noise)],
    }
    return Plot(
        "next-experiment",
        "next",
        "The next experiment",
        f"Above the command, which grew out of {found.begins_like}. In the middle the motion that {found.found} "
        f"predicts. Below the dynamic error by which {_what(found)}; grey: one standard deviation of a sample's noise.",
        figure(traces, 560, **layout),
    )


def _motion(found: NextExperiment, unit: str) -> tuple[np.ndarray, str]:
    if found.motor_speed is not None:
        return found.motor_speed, axis_label("motor speed", "rad/s")
    factor, told = scaled_unit(float(np.max(np.abs(found.dynamic_error))), unit)
    return factor * found.dynamic_error, axis_label("dynamic error", told)


def _left(found: NextExperiment) -> list[tuple[str, np.ndarray]]:
    if found.precision is not None:
        return [("an alpha as large as its standard error", found.precision.left)]
    return [(f"against {s.rival}", s.left) for s in found.separations if s.left is not None]


def _what(found: NextExperiment) -> str:
    if found.precision is not None:
        return "an alpha as large as its standard error shows, after everything else has been refitted"
    return "it differs from each rival, after that has been refitted to it"


def _trace(time: np.ndarray, values: np.ndarray, name: str, color: str, place: str) -> Figure:
    return line_trace(*decimated(time, values), name=name, color=color) | {"yaxis": place, "showlegend": False}


def _noise_band(noise: float) -> Figure:
    return {
        "type": "rect",
        "xref": "paper",
        "x0": 0,
        "x1": 1,
        "yref": "y3",
        "y0": -noise,
        "y1": noise,
        "fillcolor": FAINT,
        "opacity": 0.5,
        "line": {"width": 0},
        "layer": "below",
    }
