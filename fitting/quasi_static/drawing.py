"""What the pictures of quasi-static logs are drawn with: plotly figures in plain dictionaries."""

from dataclasses import dataclass
from typing import Any

import numpy as np

Figure = dict[str, Any]

# Okabe and Ito's blue and vermillion, which colour-blind readers tell apart.
RISING, FALLING, CURVE = "#0072B2", "#D55E00", "#222222"
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


def drawn(x: np.ndarray, y: np.ndarray, *, mode: str, color: str | None, name: str) -> Figure:
    """Points or a line; the colour is plotly's next where None."""
    look: Figure = {"marker": {"size": 5, "opacity": 0.6}} if mode == "markers" else {"line": {"width": 1.6}}
    if color is not None:
        next(iter(look.values()))["color"] = color
    return {"type": "scatter", "mode": mode, "name": name, "x": numbers(x), "y": numbers(y)} | look


def by_direction(torque: np.ndarray, values: np.ndarray, rising: np.ndarray, *, name: str) -> list[Figure]:
    """Values against torque, in two colours.

    Args:
        torque: [N m], (n,).
        values: Likewise.
        rising: Whether the torque rises there, likewise.
        name: What they are.
    """
    ways = ((rising, RISING, "rising"), (~rising, FALLING, "falling"))
    return [
        drawn(torque[own], values[own], mode="markers", color=color, name=f"{name}, torque {way}")
        for own, color, way in ways
    ]


def numbers(values: np.ndarray) -> list[float]:
    """Values to as many digits as a screen shows."""
    return [float(f"{v:.{_DIGITS}g}") for v in values]


def figure(traces: list[Figure], height: int, x_title: str, y_title: str) -> Figure:
    """Traces with the axes' titles."""
    axis = {"gridcolor": "#e8e8e8", "zerolinecolor": "#bdbdbd", "linecolor": "#bdbdbd", "ticks": "outside"}
    layout = {
        "height": height,
        "margin": {"l": 70, "r": 20, "t": 40, "b": 50},
        "font": {"family": "system-ui, -apple-system, 'Segoe UI', sans-serif", "size": 13, "color": CURVE},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "hovermode": "closest",
        "modebar": {"orientation": "v"},
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "xanchor": "left"},
        "xaxis": axis | {"title": {"text": x_title}},
        "yaxis": axis | {"title": {"text": y_title}},
    }
    return {"data": traces, "layout": layout}
