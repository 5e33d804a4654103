"""A learned torque or angle error over its variables, or over frequency."""

import numpy as np

from fitting.discrepancy.curve import WORDS, LearnedCurve
from fitting.discrepancy.dynamic_stiffness import LearnedResponse
from fitting.formatting import axis_label, pretty_unit
from fitting.report.plots.axes import AFTER, FAINT, axis, axis_scale, figure, line_trace, numbers
from fitting.report.plots.plot import Figure, Plot
from fitting.uncertainty.normal_law import NORMAL_95

_BINS = 60


def learned_plot(curve: LearnedCurve, *, unit: str, units: dict[str, str]) -> Plot:
    """The learned function with its band and the density of the data.

    Args:
        curve: the function.
        unit: of its value.
        units: of the variables, by name.
    """
    if len(curve.variables) == 1:
        return _line(curve, unit, units)
    return _surface(curve, unit, units)


def response_plot(found: LearnedResponse, *, unit: str) -> Plot:
    """The stiffness over frequency of a learned lagging torque, with its band.

    Args:
        found: the response.
        unit: of its stiffness.
    """
    widest = np.exp(np.minimum(NORMAL_95 * found.std, np.log(1e3)))
    low, high = found.stiffness / widest, found.stiffness * widest
    traces = [
        _band(found.frequency, low, high),
        line_trace(found.frequency, found.stiffness, name="learned", color=AFTER, width=2.0),
    ]
    ends = float(found.frequency[0]), float(found.frequency[-1])
    sizes = float(np.min(found.stiffness)), float(np.max(found.stiffness))
    layout = {
        "xaxis": axis("frequency [Hz]", **axis_scale(True, *ends)),
        "yaxis": axis(axis_label("magnitude of torque over angle", pretty_unit(unit)), **axis_scale(True, *sizes)),
    }
    return Plot(
        "learned-torque",
        "found",
        f"The learned {WORDS[found.place]}",
        "What is missing, as learned inside the equations of motion: a torque that lags behind an angle, over the "
        "angle, at each frequency. The band is that of the standard errors; where the logs have no excitation, the "
        "curve is extrapolated by the law.",
        figure(traces, 360, **layout),
    )


def _line(curve: LearnedCurve, unit: str, units: dict[str, str]) -> Plot:
    name = curve.variables[0]
    at, value, reach = curve.grid[0], curve.on_grid, NORMAL_95 * curve.std_on_grid
    count, edges = np.histogram(curve.at[:, 0], _BINS, range=(float(at[0]), float(at[-1])))
    density = {
        "type": "bar",
        "name": "data",
        "x": numbers(0.5 * (edges[1:] + edges[:-1])),
        "y": numbers(count / max(count.max(), 1)),
        "yaxis": "y2",
        "marker": {"color": FAINT},
        "opacity": 0.5,
        "hoverinfo": "skip",
    }
    band = _band(at, value - reach, value + reach)
    layout = {
        "xaxis": axis(axis_label(name, pretty_unit(units[name])), exponentformat="power"),
        "yaxis": axis(axis_label(curve.quantity, pretty_unit(unit)), exponentformat="power", overlaying="y2"),
        # The density has no axis.
        "yaxis2": {"range": [0, 4], "visible": False, "side": "right"},
        "bargap": 0,
    }
    traces = [density, band, line_trace(at, value, name="learned", color=AFTER, width=2.0)]
    return _plot(curve, figure(traces, 360, **layout))


def _band(at: np.ndarray, low: np.ndarray, high: np.ndarray) -> Figure:
    return {
        "type": "scatter",
        "name": "95 % band",
        "x": numbers(np.concatenate([at, at[::-1]])),
        "y": numbers(np.concatenate([high, low[::-1]])),
        "fill": "toself",
        "fillcolor": "rgba(0, 114, 178, 0.2)",
        "line": {"width": 0},
        "hoverinfo": "skip",
    }


def _surface(curve: LearnedCurve, unit: str, units: dict[str, str]) -> Plot:
    one, other = curve.variables
    edges = [_edges(g) for g in curve.grid]
    count, _, _ = np.histogram2d(curve.at[:, 0], curve.at[:, 1], bins=edges)
    # Unknown where there are no data.
    shown = np.where(count > 0, curve.on_grid, np.nan)
    heat = {
        "type": "heatmap",
        "x": numbers(curve.grid[0]),
        "y": numbers(curve.grid[1]),
        "z": [numbers(row) for row in shown.T],
        "colorscale": "RdBu",
        "zmid": 0,
        "colorbar": {"title": {"text": axis_label(curve.quantity, pretty_unit(unit))}, "exponentformat": "power"},
    }
    layout = {
        "xaxis": axis(axis_label(one, pretty_unit(units[one])), exponentformat="power"),
        "yaxis": axis(axis_label(other, pretty_unit(units[other])), exponentformat="power"),
    }
    return _plot(curve, figure([heat], 420, **layout))


def _edges(grid: np.ndarray) -> np.ndarray:
    step = grid[1] - grid[0]
    return np.append(grid - 0.5 * step, grid[-1] + 0.5 * step)


def _plot(curve: LearnedCurve, drawn: Figure) -> Plot:
    return Plot(
        "learned-torque",
        "found",
        f"The learned {WORDS[curve.place]}",
        "What is missing, as learned inside the equations of motion, without what the drive's parameters can "
        "represent. "
        "The band is that of the standard errors; it is uncertain where there are few data."
        if len(curve.variables) == 1
        else "What is missing, as learned inside the equations of motion, without what the drive's parameters can "
        "represent. Only where there are data.",
        drawn,
    )
