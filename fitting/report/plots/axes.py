"""Common style of plots: colours, axes, lines, and numbers for plotly."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from fitting.formatting import number
from fitting.report.plots.plot import Figure

# Okabe and Ito's vermillion and blue, which colour-blind readers can distinguish, also in grey print.
BEFORE, AFTER = "#D55E00", "#0072B2"
MEASURED, FAINT, INK = "#8c8c8c", "#c9c9c9", "#222222"

_DIGITS = 6


def figure(traces: Sequence[Figure], height: int, **layout: Any) -> Figure:
    """A figure in the common style."""
    # Labels of vertical lines are above the plot, the legend above them.
    top = 58 if "annotations" in layout else 40
    legend = 1 + (top - 38) / (height - top - 50)
    look: dict[str, Any] = {
        "height": height,
        "margin": {"l": 70, "r": 20, "t": top, "b": 50},
        "font": {"family": "system-ui, -apple-system, 'Segoe UI', sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "hovermode": "closest",
        "legend": {"orientation": "h", "x": 0, "y": legend, "yanchor": "bottom", "xanchor": "left"},
        "showlegend": sum(t.get("showlegend", True) and "name" in t for t in traces) > 1,
    }
    return {"data": list(traces), "layout": look | layout}


def axis(title: str, **more: Any) -> Figure:
    """An axis in the common style."""
    look = {
        "title": {"text": title, "standoff": 8},
        "gridcolor": "#e8e8e8",
        "zerolinecolor": "#bdbdbd",
        "linecolor": "#bdbdbd",
        "ticks": "outside",
        "tickcolor": "#bdbdbd",
        "ticklen": 4,
    }
    return look | more


def vertical_line(*, x: float) -> Figure:
    """A dotted line across the plot."""
    return {
        "type": "line",
        "x0": x,
        "x1": x,
        "yref": "paper",
        "y0": 0,
        "y1": 1,
        "line": {"color": INK, "width": 1.2, "dash": "dot"},
    }


def note(text: str, *, x: float) -> Figure:
    """A label above a vertical line. On a logarithmic axis plotly needs the logarithm here, but not in the line."""
    return {
        "text": text,
        "x": x,
        "yref": "paper",
        "y": 1,
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 11, "color": INK},
    }


def axis_scale(logarithmic: bool, low: float, high: float) -> Figure:
    """A linear axis, or a logarithmic one with a label at each decade (more where there are few)."""
    if not logarithmic:
        return {"type": "linear"}
    if high > 100 * low or not 0 < low < high:
        return {"type": "log", "dtick": 1}
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
    ticks = [float(f"{digit}e{decade}") for decade in decades for digit in (1, 2, 5)]
    return {"type": "log", "tickvals": ticks, "ticktext": [number(t, 1) for t in ticks]}


def line_trace(x: np.ndarray, y: np.ndarray, *, name: str, color: str = MEASURED, width: float | None = None) -> Figure:
    """A curve; the one named "noise" is dotted."""
    line: Figure = {"color": color, "width": width or 1.5}
    if name == "noise":
        line |= {"dash": "dot", "color": INK}
    # Times need more digits than values: samples of a long log would coincide.
    return {"type": "scatter", "mode": "lines", "name": name, "x": numbers(x, 9), "y": numbers(y), "line": line}


def names_and_colors(two: bool) -> list[tuple[str, str]]:
    """Names and colours of the curves of one model or two."""
    return [("before", BEFORE), ("after", AFTER)] if two else [("model", AFTER)]


def numbers(values: np.ndarray, digits: int = _DIGITS) -> list[float | None]:
    """Numbers for JSON: rounded to screen resolution, null for NaN."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=float)]


def text(value: float) -> str:
    """A number beside its bar."""
    return number(float(value), 3) if np.isfinite(value) else "diverged"
