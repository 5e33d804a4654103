"""What the pictures of quasi-static logs have in common."""

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.plots.look import AFTER, BEFORE, INK, axis, figure, numbers
from fitting.plots.plot import Figure
from fitting.quasi_static.points import Points
from fitting.quasi_static.torque_twist import Blocks


def scaled(values: np.ndarray, name: str) -> tuple[float, str]:
    """The factor that makes angles [rad] read well, and the label of their axis."""
    factor, unit = scaled_unit(float(np.max(np.abs(values))), "rad")
    return factor, axis_label(name, unit)


def drawn(x: np.ndarray, y: np.ndarray, *, mode: str, color: str | None, name: str) -> Figure:
    """Points or a line; the colour is plotly's next where None."""
    own: Figure = {} if color is None else {"color": color}
    look = {"marker": {"size": 5, "opacity": 0.6} | own} if mode == "markers" else {"line": {"width": 1.6} | own}
    return {"type": "scatter", "mode": mode, "name": name, "x": numbers(x, 9), "y": numbers(y)} | look


def by_direction(data: Blocks | Points, values: np.ndarray, *, name: str) -> list[Figure]:
    """Values against torque, in two colours: where it rises and where it falls."""
    rising = np.gradient(data.torque) >= 0
    return [
        drawn(data.torque[own], values[own], mode="markers", color=color, name=f"{name}, torque {way}")
        for own, color, way in ((rising, AFTER, "rising"), (~rising, BEFORE, "falling"))
    ]


def fitted_lines(data: Blocks | Points, x: np.ndarray, values: np.ndarray) -> list[Figure]:
    """What was fitted, log by log."""
    several = len(data.names) > 1
    return [
        drawn(x[own], values[own], mode="lines", color=INK, name=f"fitted, {name}" if several else "fitted")
        for name, own in ((name, data.log == i) for i, name in enumerate(data.names))
    ]


def against(traces: list[Figure], height: int, x: str, y: str) -> Figure:
    """Traces with the axes' titles."""
    return figure(traces, height, xaxis=axis(x), yaxis=axis(y), modebar={"orientation": "v"})
