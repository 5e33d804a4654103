"""An accepted effect, with its estimate from the data without a law."""

import numpy as np

from fitting.attribution.effect_evidence import Evidence
from fitting.formatting import axis_label, pretty_unit
from fitting.report.outputs import in_words
from fitting.report.plots.axes import AFTER, BEFORE, INK, axis, figure, numbers
from fitting.report.plots.plot import Figure, Plot
from fitting.uncertainty.normal_law import NORMAL_95


def evidence_plot(found: Evidence, *, units: dict[str, str]) -> Plot:
    """The effect along the motion as points, and the estimate from the data with error bars.

    Args:
        found: the evidence.
        units: of the torque and of its variable, by name.
    """
    cloud = {
        "type": "scatter",
        "mode": "markers",
        "name": "as fitted",
        "x": numbers(found.at),
        "y": numbers(found.does),
        "marker": {"color": AFTER, "size": 3, "opacity": 0.5},
        "hoverinfo": "skip",
    }
    layout = {
        "xaxis": axis(axis_label(found.variable, pretty_unit(units[found.variable])), exponentformat="power"),
        "yaxis": axis(axis_label("torque", pretty_unit(units["torque"])), exponentformat="power"),
    }
    caption = (
        f"Contribution of {in_words(found.effect)} along the fitted motion. With error bars (95 %): the torque "
        "estimated from the data at this place without a law, with all other parameters as fitted. Under the right "
        "law, the points agree with it."
    )
    if len(found.told) > 1:
        caption += " The two directions of motion are estimated separately."
    return Plot(
        f"evidence-{found.effect.replace('_', '-')}",
        "found",
        f"{in_words(found.effect).capitalize()} in the data",
        caption,
        figure([cloud, *_told(found)], 380, **layout),
    )


def _told(found: Evidence) -> list[Figure]:
    apart = len(found.told) > 1
    traces = []
    for row, (places, told, std) in enumerate(zip(found.places, found.told, found.std, strict=True)):
        asked = np.isfinite(places)
        color = (BEFORE, INK)[row] if apart else INK
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": ("data, backward", "data, forward")[row] if apart else "data",
                "x": numbers(places[asked]),
                "y": numbers(told[asked]),
                "error_y": {
                    "type": "data",
                    "array": numbers(NORMAL_95 * std[asked]),
                    "color": color,
                    "thickness": 1.2,
                },
                "marker": {"color": color, "size": 6, "symbol": "circle-open"},
            }
        )
    return traces
