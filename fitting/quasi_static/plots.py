"""Pictures of a quasi-static fit, as plotly figures in plain dictionaries."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.quasi_static.fit import QuasiStaticFit
from fitting.quasi_static.torque_twist import Blocks

Figure = dict[str, Any]

# Okabe and Ito's blue and vermillion, which colour-blind readers tell apart.
_RISING, _FALLING, _CURVE = "#0072B2", "#D55E00", "#222222"
_DIGITS = 6


@dataclass(frozen=True)
class Picture:
    """A figure with its words.

    Attributes:
        key: Word for an element's id.
        title: What it shows.
        caption: How to read it.
        figure: For plotly.js, finite numbers only.
    """

    key: str
    title: str
    caption: str
    figure: Figure


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
    traces = _by_direction(blocks, factor * measured, name="measured")
    for i, name in enumerate(blocks.names):
        own = blocks.log == i
        trace = _trace(blocks.torque[own], factor * predicted[own], mode="lines", color=_CURVE, name=f"fitted, {name}")
        traces.append(trace if len(blocks.names) > 1 else trace | {"name": "fitted"})
    line = best.curve.elastic(best.parameters, np.sort(blocks.torque))[0]
    middle = _trace(np.sort(blocks.torque), factor * line, mode="lines", color=_CURVE, name="middle of the loop")
    traces.append(middle | {"line": {"color": _CURVE, "width": 1.2, "dash": "dot"}})
    return Picture(
        "loops",
        "Twist against joint torque",
        "Each point is the mean of a short run of rows, less the twist zero and drift of its log. The full line is the "
        "fitted curve along the torque's own path; the dotted one is the middle between its branches, where stiffness "
        "is read.",
        _figure(traces, 480, "joint torque [N m]", axis_label("twist", unit)),
    )


def _misfit_by_torque(fit: QuasiStaticFit) -> Picture:
    factor, unit = scaled_unit(float(np.sqrt(np.mean(fit.best.misfit**2))), "rad")
    traces = _by_direction(fit.blocks, factor * fit.best.misfit, name="misfit")
    return Picture(
        "misfit-torque",
        "What the curve leaves over, against torque",
        "A bend that is the same both ways belongs to the curve's shape; one that differs belongs to the hysteresis.",
        _figure(traces, 300, "joint torque [N m]", axis_label("measured less fitted", unit)),
    )


def _misfit_by_time(fit: QuasiStaticFit) -> Picture:
    blocks = fit.blocks
    factor, unit = scaled_unit(float(np.sqrt(np.mean(fit.best.misfit**2))), "rad")
    traces = []
    for i, name in enumerate(blocks.names):
        own = blocks.log == i
        time = blocks.time[own] - blocks.time[own][0]
        traces.append(_trace(time, factor * fit.best.misfit[own], mode="lines", color=None, name=name))
    return Picture(
        "misfit-time",
        "What the curve leaves over, against time",
        "A slope is a drift, a slow wave an effect that the curve lacks; the intervals allow for both as far as they "
        "look like chance.",
        _figure(traces, 300, "time from the start [s]", axis_label("measured less fitted", unit)),
    )


def _by_direction(blocks: Blocks, values: np.ndarray, *, name: str) -> list[Figure]:
    way = np.gradient(blocks.torque) >= 0
    return [
        _trace(blocks.torque[way], values[way], mode="markers", color=_RISING, name=f"{name}, torque rising"),
        _trace(blocks.torque[~way], values[~way], mode="markers", color=_FALLING, name=f"{name}, torque falling"),
    ]


def _trace(x: np.ndarray, y: np.ndarray, *, mode: str, color: str | None, name: str) -> Figure:
    look: Figure = {"marker": {"size": 5, "opacity": 0.6}} if mode == "markers" else {"line": {"width": 1.6}}
    if color is not None:
        next(iter(look.values()))["color"] = color
    return {"type": "scatter", "mode": mode, "name": name, "x": _numbers(x), "y": _numbers(y)} | look


def _numbers(values: np.ndarray) -> list[float]:
    return [float(f"{v:.{_DIGITS}g}") for v in values]


def _figure(traces: list[Figure], height: int, x_title: str, y_title: str) -> Figure:
    axis = {"gridcolor": "#e8e8e8", "zerolinecolor": "#bdbdbd", "linecolor": "#bdbdbd", "ticks": "outside"}
    layout = {
        "height": height,
        "margin": {"l": 70, "r": 20, "t": 40, "b": 50},
        "font": {"family": "system-ui, -apple-system, 'Segoe UI', sans-serif", "size": 13, "color": _CURVE},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "hovermode": "closest",
        "modebar": {"orientation": "v"},
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "xanchor": "left"},
        "xaxis": axis | {"title": {"text": x_title}},
        "yaxis": axis | {"title": {"text": y_title}},
    }
    return {"data": traces, "layout": layout}
