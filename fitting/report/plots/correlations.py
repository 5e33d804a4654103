"""Correlation of the fitted parameters' errors."""

import numpy as np

from fitting.report.plots.axes import axis, figure, numbers
from fitting.report.plots.plot import Plot
from fitting.uncertainty.standard_errors import Uncertainty

_NEGATIVE, _POSITIVE = "#762a83", "#1b7837"


def correlations(uncertainty: Uncertainty) -> Plot:
    """Correlation of the fitted parameters' errors."""
    names = list(uncertainty.estimates)
    matrix = np.asarray(uncertainty.correlation)
    few = len(names) <= 14
    heat = {
        "type": "heatmap",
        "x": names,
        "y": names,
        "z": [numbers(row, 3) for row in matrix],
        "zmin": -1,
        "zmax": 1,
        "colorscale": [[0, _NEGATIVE], [0.5, "#ffffff"], [1, _POSITIVE]],
        "text": [[_two_decimals(v) if few else "" for v in row] for row in matrix],
        "texttemplate": "%{text}",
        "xgap": 1,
        "ygap": 1,
        "colorbar": {"thickness": 12, "outlinewidth": 0, "tickvals": [-1, 0, 1]},
    }
    layout = {
        "xaxis": axis("", showgrid=False, tickangle=-40, automargin=True),
        "yaxis": axis("", showgrid=False, autorange="reversed", automargin=True),
    }
    return Plot(
        "correlations",
        "left_over",
        "Correlation of the fitted parameters",
        "Near +1 or -1 the data determine a combination of the two rather than each.",
        figure([heat], 170 + 34 * len(names), **layout),
    )


def _two_decimals(value: float) -> str:
    # Adding zero turns a rounded -0.0 into 0.0.
    return f"{np.round(value, 2) + 0.0:.2f}".replace("-", "\N{MINUS SIGN}")
