"""Summary plot of a sweep: a heat map, a response curve, or the worst cases of a sample."""

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from fitting.commands.pictures import png

_WORST = 15
_FIRST = ("peak", "amplitude", "settling_time", "x_end", "x")
_LONGEST = 400
_WIDE = 30.0  # ratio of largest and smallest value above which the scale is logarithmic


def summary(result: Any) -> bytes:
    """A PNG of a sweep.

    Two axes give a heat map of the maximum over all others; one gives a curve; a sample alone its worst cases.

    Args:
        result: an xarray.Dataset from [`hdjax.sweep.sweep`][].
    """
    name = next(n for n in (*_FIRST, *result.data_vars) if n in result.data_vars)
    field = abs(result[name]).assign_attrs(result[name].attrs)
    axes = [d for d in field.dims if d in result.coords and d not in ("motion", "harmonic", "window", "sample")]
    wide = sorted(axes, key=lambda d: -field.sizes[d])[:2]
    label = f"{field.attrs['long_name']} [{field.attrs['units']}]"
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    plot = figure.subplots()
    kept = [d for d in axes if d in wide] or ["sample"]
    values = field.max([d for d in field.dims if d not in kept], skipna=True)
    if kept == ["sample"]:
        _worst_cases(plot, result, np.asarray(values), label)
    elif len(kept) == 1:
        plot.plot(values[kept[0]], values)
        plot.set(xlabel=_label(result, kept[0]), ylabel=label, xscale=_scale(values[kept[0]]))
    else:
        vertical, across = sorted(kept, key=lambda d: field.sizes[d])
        drawn = values.transpose(vertical, across)
        drawn = drawn[:: -(-drawn.shape[0] // _LONGEST), :: -(-drawn.shape[1] // _LONGEST)]
        norm = LogNorm() if float(drawn.min()) > 0.0 and float(drawn.max()) > _WIDE * float(drawn.min()) else None
        colours = plot.pcolormesh(drawn[across], drawn[vertical], drawn, shading="nearest", norm=norm)
        figure.colorbar(colours, label=label)
        plot.set(xlabel=_label(result, across), ylabel=_label(result, vertical))
        plot.set(xscale=_scale(drawn[across]), yscale=_scale(drawn[vertical]))
    figure.suptitle(result.attrs["route"], fontsize=9)
    return png(figure)


def _worst_cases(plot: Any, result: Any, values: np.ndarray, label: str) -> None:
    worst = np.argsort(np.nan_to_num(values, nan=-np.inf))[::-1][:_WORST]
    columns = [c for c in result.coords if result[c].dims == ("sample",) and c != "sample"]
    names = [", ".join(f"{c} = {float(result[c][i]):.4g}" for c in columns) for i in worst]
    plot.barh(np.arange(worst.size), values[worst])
    plot.set_yticks(np.arange(worst.size), names, fontsize=7)
    plot.invert_yaxis()
    plot.set(xlabel=label)


def _scale(values: Any) -> str:
    """Scale of an axis: logarithmic if its values are spaced logarithmically."""
    v = np.asarray(values, dtype=float)
    if v.size < 3 or not (v > 0.0).all():
        return "linear"
    ratios = np.diff(np.log(v))
    return "log" if np.ptp(ratios) < 1e-6 * abs(ratios[0]) else "linear"


def _label(result: Any, name: str) -> str:
    return f"{name} [{result[name].attrs.get('units', '')}]"
