"""Rms errors of free runs."""

from typing import Any

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.report.outputs import in_words
from fitting.report.plots.axes import axis, axis_scale, figure, names_and_colors, note, numbers, text, vertical_line
from fitting.report.plots.plot import Plot
from fitting.validation.account import Account


def rmse_bars(before: Account, after: Account | None, *, noise: float, unit: str) -> Plot:
    """Rms error on each part of the data against the measurement noise."""
    output = in_words(before.judged[0].output)
    accounts = [before] if after is None else [before, after]
    values = [list(a.rmse.values()) for a in accounts]
    finite = [v for pair in values for v in pair if np.isfinite(v)]
    factor, label = scaled_unit(max([noise, *finite]), unit)
    wide = max([noise, *finite]) > 20 * min([noise, *finite])
    bars = [
        {
            "type": "bar",
            "orientation": "h",
            "name": name,
            "y": list(before.rmse),
            "x": numbers(factor * np.array(pair)),
            "marker": {"color": color},
            "text": [f" {text(factor * v)} " for v in pair],
            "textposition": "outside",
            "cliponaxis": False,
        }
        for (name, color), pair in zip(names_and_colors(after is not None), values, strict=False)
    ]
    layout: dict[str, Any] = {
        "barmode": "group",
        "bargap": 0.35,
        "xaxis": axis(axis_label(f"rms error of the {output}", label), rangemode="tozero", exponentformat="power"),
        "yaxis": axis("", autorange="reversed", showgrid=False),
        "shapes": [vertical_line(x=factor * noise)],
        "annotations": [note("noise", x=float(np.log10(factor * noise)) if wide else factor * noise)],
    }
    if wide:
        low, high = min([noise, *finite]), max([noise, *finite])
        layout["xaxis"] |= axis_scale(wide, factor * low, factor * high)
        layout["xaxis"]["range"] = [float(np.log10(factor * low / 2)), float(np.log10(factor * high * 2))]
    return Plot(
        "rmse",
        "fit",
        "Rms error of the free runs",
        "The dotted line is the measurement noise: no model can do better.",
        figure(bars, 250, **layout),
    )
