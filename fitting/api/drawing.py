"""The report's plots on axes of matplotlib."""

from typing import Any

import numpy as np

from fitting.report.plots import Plot

# Resolution of a screen, since plots state their height in pixels.
_DOTS_PER_INCH = 80.0
_DASHES = {"dot": ":", "dash": "--", "dashdot": "-."}
_MARKERS = {"circle": "o", "square": "s", "diamond": "D", "cross": "P", "x": "x"}


def draw(plot: Plot, axes: Any = None) -> Any:
    """Draw a plot.

    Args:
        plot: The plot.
        axes: One axes of matplotlib for each pair of axes of the plot, from the top; created where not given.

    Returns:
        The axes, or an array of them where the plot has several.
    """
    import matplotlib.pyplot as plt

    layout, traces = plot.figure["layout"], plot.figure["data"]
    pairs = list(dict.fromkeys((t.get("xaxis", "x"), t.get("yaxis", "y")) for t in traces)) or [("x", "y")]
    if axes is None:
        size = (8.0, layout.get("height", 0) / _DOTS_PER_INCH or 4.0)
        axes = plt.subplots(len(pairs), 1, squeeze=False, figsize=size, layout="constrained")[1][:, 0]
    places = np.atleast_1d(np.asarray(axes, dtype=object))
    if places.size != len(pairs):
        raise ValueError(f"'{plot.key}' needs {len(pairs)} axes, but {places.size} were given")
    for place, pair in zip(places, pairs, strict=True):
        own = [t for t in traces if (t.get("xaxis", "x"), t.get("yaxis", "y")) == pair]
        bars = [t for t in own if t.get("type") == "bar"]
        for trace in own:
            if trace in bars:
                _bars(place, trace, bars.index(trace), len(bars))
            else:
                _trace(place, trace)
        _look(place, layout, pair)
    places[0].set_title(plot.title, fontsize="medium")
    if any(t.get("name") and t.get("showlegend", True) for t in traces) and len(traces) > 1:
        places[0].legend(loc="best", fontsize="small", frameon=False)
    return places[0] if places.size == 1 else places


def _trace(place: Any, trace: dict[str, Any]) -> None:
    kind = trace.get("type", "scatter")
    label = trace.get("name") if trace.get("showlegend", True) else None
    if kind == "heatmap":
        values = np.array(trace["z"], dtype=float)
        most = trace.get("zmax", np.nanmax(np.abs(values)))
        look = {"cmap": "RdBu", "vmin": -most, "vmax": most}
        if isinstance(trace["x"][0], str):
            shown = place.imshow(values, aspect="auto", **look)
            place.set_xticks(range(values.shape[1]), trace["x"], rotation=45, ha="right")
            place.set_yticks(range(values.shape[0]), trace["y"])
        else:
            shown = place.pcolormesh(trace["x"], trace["y"], values, shading="nearest", **look)
        place.figure.colorbar(shown, ax=place)
        return
    color = trace.get("line", {}).get("color") or trace.get("marker", {}).get("color")
    x = [np.nan if v is None else v for v in trace["x"]]
    y = [np.nan if v is None else v for v in trace["y"]]
    mode = trace.get("mode", "lines")
    line = trace.get("line", {})
    place.plot(
        x,
        y,
        color=_of_matplotlib(color),
        label=label,
        linestyle=_DASHES.get(line.get("dash", ""), "-") if "lines" in mode else "none",
        linewidth=line.get("width", 1.5),
        marker=_MARKERS.get(trace.get("marker", {}).get("symbol", "circle"), "o") if "markers" in mode else None,
        markersize=3.0,
    )
    if "error_y" in trace:
        reach = [np.nan if v is None else v for v in trace["error_y"]["array"]]
        place.errorbar(x, y, reach, fmt="none", ecolor=_of_matplotlib(color), elinewidth=1.0)


def _bars(place: Any, trace: dict[str, Any], number: int, count: int) -> None:
    """One of several groups of adjacent bars."""
    flat = trace.get("orientation") == "h"
    lengths, names = (trace["x"], trace["y"]) if flat else (trace["y"], trace["x"])
    lengths = [np.nan if v is None else v for v in lengths]
    width = 0.8 / count
    at = np.arange(len(names)) + width * (number - 0.5 * (count - 1))
    color, label = trace.get("marker", {}).get("color"), trace.get("name")
    if flat:
        place.barh(at, lengths, width, color=color, label=label)
        place.set_yticks(range(len(names)), names, fontsize="small")
    else:
        place.bar(at, lengths, width, color=color, label=label)
        place.set_xticks(range(len(names)), names, fontsize="small")


def _of_matplotlib(color: Any) -> Any:
    """A matplotlib colour from plotly's rgba notation."""
    if isinstance(color, str) and color.startswith("rgb"):
        parts = [float(part) for part in color[color.index("(") + 1 : -1].split(",")]
        return (*(part / 255.0 for part in parts[:3]), *parts[3:])
    return color if isinstance(color, str) else None


def _look(place: Any, layout: dict[str, Any], pair: tuple[str, str]) -> None:
    """Labels, scales and ranges of the plot."""
    for letter, name in zip("xy", pair, strict=True):
        own = layout.get(f"{letter}axis{name[1:]}", {})
        getattr(place, f"set_{letter}label")(own.get("title", {}).get("text", ""))
        logarithmic = own.get("type") == "log"
        if logarithmic:
            getattr(place, f"set_{letter}scale")("log")
        if own.get("range") is not None:
            ends = 10.0 ** np.array(own["range"]) if logarithmic else own["range"]
            getattr(place, f"set_{letter}lim")(*ends)
    for shape in layout.get("shapes", ()):
        if shape.get("type") == "line" and shape.get("x0") == shape.get("x1"):
            place.axvline(shape["x0"], color="#222222", linestyle=":", linewidth=1.2)
    place.grid(color="#e8e8e8")
    place.set_axisbelow(True)
