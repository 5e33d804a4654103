"""Plots of a residual: spectrum, autocorrelation and dependences."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.report.plots.axes import (
    AFTER,
    FAINT,
    axis,
    axis_scale,
    figure,
    line_trace,
    names_and_colors,
    note,
    numbers,
    vertical_line,
)
from fitting.report.plots.plot import Figure, Plot
from fitting.validation.residual_diagnostics import ResidualDiagnostics
from fitting.validation.residual_tests import InputCorrelation


def spectrum(
    before: ResidualDiagnostics, after: ResidualDiagnostics | None, *, noise: float, omega_0: float, unit: str
) -> Plot:
    """Amplitude spectral density of the residual against that of white measurement noise."""
    nyquist = float(before.frequency[-1])
    white = noise / np.sqrt(nyquist)
    density = [np.sqrt(r.spectral_density[1:]) for r in (before, after) if r is not None]
    factor, label = scaled_unit(float(np.max(density[0])), unit)
    traces = [
        line_trace(before.frequency[1:], factor * d, name=name, color=color)
        for (name, color), d in zip(names_and_colors(after is not None), density, strict=False)
    ]
    traces.append(line_trace(np.array([before.frequency[1], nyquist]), factor * np.full(2, white), name="noise"))
    resonance = omega_0 / (2 * np.pi)
    layout: dict[str, Any] = {
        "xaxis": axis("frequency [Hz]", **axis_scale(True, float(before.frequency[1]), nyquist)),
        "yaxis": axis(
            f"residual [{label or '1'}/√Hz]", exponentformat="power", **_density_scale([factor * d for d in density])
        ),
    }
    if before.frequency[1] < resonance < nyquist:
        layout["shapes"] = [vertical_line(x=resonance)]
        layout["annotations"] = [note("natural frequency", x=float(np.log10(resonance)))]
    return Plot(
        "spectrum",
        "left_over",
        "Spectrum of the residual",
        "Lines and humps above the noise level are physics that the model lacks, or noise that is not white.",
        figure(traces, 340, **layout),
    )


def orders(before: ResidualDiagnostics, after: ResidualDiagnostics | None, *, unit: str) -> Plot:
    """Amplitude of the residual locked to the motor angle."""
    amplitudes = [r.order_amplitude for r in (before, after) if r is not None and r.order.size]
    factor, label = scaled_unit(max(float(np.max(a)) for a in amplitudes), unit)
    traces = [
        line_trace(before.order, factor * a, name=name, color=color)
        for (name, color), a in zip(names_and_colors(after is not None), amplitudes, strict=False)
    ]
    layout = {
        "xaxis": axis("order [cycles per motor revolution]", dtick=1),
        "yaxis": axis(axis_label("amplitude", label), rangemode="tozero"),
    }
    return Plot(
        "orders",
        "left_over",
        "Residual locked to the motor angle",
        "Peaks at whole orders indicate errors of the gear, the motor or an encoder.",
        figure(traces, 320, **layout),
    )


def autocorrelation(before: ResidualDiagnostics, after: ResidualDiagnostics | None) -> Plot:
    """Autocorrelation of the residual."""
    step = 0.5 / float(before.frequency[-1])
    found = [r.autocorrelation for r in (before, after) if r is not None]
    factor, label = scaled_unit(step * found[0].size, "s")
    traces = [
        line_trace(factor * step * np.arange(a.size), a, name=name, color=color)
        for (name, color), a in zip(names_and_colors(after is not None), found, strict=False)
    ]
    limit = float(before.white_limit)
    # Lag zero, which is 1 by definition, is outside the view.
    reach = min(1.05, max(4 * limit, 1.1 * max(float(np.max(np.abs(a[1:]), initial=0.0)) for a in found)))
    layout = {
        "xaxis": axis(axis_label("lag", label)),
        "yaxis": axis("autocorrelation", range=[-reach, reach]),
        "shapes": [_band(limit)],
    }
    return Plot(
        "autocorrelation",
        "left_over",
        "Autocorrelation of the residual",
        "At lag zero it is 1. The grey band holds 95 % of the lags of white noise. "
        "A residual that stays outside it is not white: the model lacks something, or the noise is coloured.",
        figure(traces, 300, **layout),
    )


def input_correlation(found: InputCorrelation, *, step: float) -> Plot:
    """Correlation of the residual with an input.

    Args:
        found: the correlations.
        step: sampling interval [s].
    """
    factor, label = scaled_unit(step * float(found.lag[-1]), "s")
    reach = max(3 * found.limit, 1.1 * float(np.max(np.abs(found.correlation))))
    layout = {
        "xaxis": axis(axis_label("residual after input by", label)),
        "yaxis": axis("correlation", range=[-reach, reach]),
        "shapes": [_band(found.limit)],
    }
    return Plot(
        f"input-{found.name.replace(' ', '-')}",
        "left_over",
        f"Residual and {found.name}",
        "The grey band holds 95 % of the correlations of a residual that is independent of the input. Outside it to "
        "the right, the model lacks a part of the response; to the left only, the input responds to the error, as "
        "under feedback.",
        figure([line_trace(factor * step * found.lag, found.correlation, name="model", color=AFTER)], 280, **layout),
    )


def _band(limit: float) -> Figure:
    """The band of insignificant values, from -limit to limit."""
    return {
        "type": "rect",
        "xref": "paper",
        "x0": 0,
        "x1": 1,
        "y0": -limit,
        "y1": limit,
        "fillcolor": FAINT,
        "opacity": 0.6,
        "line": {"width": 1, "color": FAINT},
        "layer": "below",
    }


def dependences(before: ResidualDiagnostics, after: ResidualDiagnostics | None, *, unit: str, twist_unit: str) -> Plot:
    """Mean residual against twist, twist rate, motor angle and motor speed."""
    residuals = [r for r in (before, after) if r is not None]
    largest = max(float(np.max(np.abs(d.mean), initial=0.0)) for d in before.dependence.values())
    factor, label = scaled_unit(largest, unit)
    traces: list[Figure] = []
    rows = -(-len(before.dependence) // 2)
    layout: dict[str, Any] = {"grid": {"rows": rows, "columns": 2, "pattern": "independent", "ygap": 0.32}}
    for i, quantity in enumerate(before.dependence):
        suffix = "" if i == 0 else str(i + 1)
        scale, x_label = _quantity_scale(quantity, before, twist_unit)
        for (name, color), residual in zip(names_and_colors(after is not None), residuals, strict=False):
            part = residual.dependence[quantity]
            traces.append(
                {
                    "type": "scatter",
                    "mode": "lines+markers",
                    "name": name,
                    "legendgroup": name,
                    "showlegend": i == 0,
                    "x": numbers(scale * part.centre),
                    "y": numbers(factor * part.mean),
                    "error_y": {
                        "type": "data",
                        "array": numbers(factor * part.standard_error),
                        "thickness": 1,
                        "width": 0,
                    },
                    "line": {"color": color, "width": 1},
                    "marker": {"size": 4},
                    "xaxis": f"x{suffix}",
                    "yaxis": f"y{suffix}",
                }
            )
        layout[f"xaxis{suffix}"] = axis(x_label)
        layout[f"yaxis{suffix}"] = axis(axis_label("mean residual", label) if i % 2 == 0 else "")
    return Plot(
        "dependence",
        "left_over",
        "Dependence of the residual",
        "Mean residual in bins of equally many samples, with its standard error. A curve away from zero is a force "
        "that the model lacks, over the quantity that it depends on.",
        figure(traces, 270 * rows, **layout),
    )


def _quantity_scale(name: str, residual: ResidualDiagnostics, unit: str) -> tuple[float, str]:
    base = {"x": unit, "v": f"{unit}/s", "motor angle": "rad", "motor speed": "rad/s"}[name]
    shown = {"x": "dynamic error x", "v": "its rate v"}.get(name, name)
    factor, label = scaled_unit(float(np.max(np.abs(residual.dependence[name].centre))), base)
    return factor, axis_label(shown, label)


def _density_scale(densities: Sequence[np.ndarray]) -> Figure:
    together = np.concatenate(densities)
    return axis_scale(True, float(np.min(together[together > 0], initial=np.inf)), float(np.max(together)))
