"""Pictures of a closed loop, as plotly figures in plain dictionaries. Statistics are computed elsewhere."""

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.attribution import Round, Verdict
from fitting.close_loop import Loop
from fitting.compare import Account
from fitting.diagnostics import ResidualDiagnostics
from fitting.formatting import axis_label, number, scaled_unit
from fitting.free_run import FreeRun
from fitting.uncertainty import Uncertainty

Figure = dict[str, Any]

# Okabe and Ito's vermillion and blue, which colour-blind readers tell apart, also in grey print.
BEFORE, AFTER = "#D55E00", "#0072B2"
MEASURED, FAINT, INK = "#8c8c8c", "#c9c9c9", "#222222"
_NEGATIVE, _POSITIVE = "#762a83", "#1b7837"

_MOST_POINTS = 4000
_MOST_LOGS = 4
# Natural periods that a trace shows at first sight.
_PERIODS = 15
_DIGITS = 6


@dataclass(frozen=True)
class Plot:
    """A figure with its place in the story.

    Attributes:
        key: unique within a report; a word for an element's id.
        section: "fit", "left_over" or "found".
        title: what it shows, as plain text.
        caption: how to read it, as plain text.
        figure: for plotly.js, finite numbers and nulls only.
    """

    key: str
    section: str
    title: str
    caption: str
    figure: Figure


def plots(loop: Loop, *, units: Mapping[str, str]) -> list[Plot]:
    """All pictures of a closed loop, in the order of the story.

    Args:
        loop: the outcome.
        units: of `dynamic_error`.
    """
    unit = units.get("dynamic_error", "rad")
    after = None if loop.after is loop.before else loop.after
    left = None if after is None else loop.residual_after
    noise = float(np.sqrt(np.asarray(loop.noise)[-1, -1]))
    return [
        *fit_plots(loop.before, loop.residual_before, after=after, residual_after=left, noise=noise, unit=unit),
        *(competition(this, turn + 1) for turn, this in enumerate(loop.rounds)),
    ]


def fit_plots(
    before: Account,
    residual_before: ResidualDiagnostics | None,
    *,
    after: Account | None = None,
    residual_after: ResidualDiagnostics | None = None,
    noise: float,
    unit: str = "rad",
) -> list[Plot]:
    """What one fitted model, or two side by side, do on the logs.

    Args:
        before: the base model's account.
        residual_before: what it leaves over, or None for no pictures of that.
        after: the final model's account, where it is another one.
        residual_after: what that leaves over.
        noise: rms measurement noise of the dynamic error.
        unit: of the dynamic error.
    """
    omega_0 = float(before.model.drive.omega_0)
    pairs = _pairs(before, after)
    found = [predictions(runs, omega_0=omega_0, unit=unit, key=f"prediction-{i}") for i, runs in enumerate(pairs)]
    found.append(rmse_bars(before, after, noise=noise, unit=unit))
    if residual_before is not None:
        found += _residual_plots(residual_before, residual_after, noise=noise, omega_0=omega_0, unit=unit)
    uncertainty = (before if after is None else after).uncertainty
    if len(uncertainty.estimates) > 1:
        found.append(correlations(uncertainty))
    return found


def _residual_plots(
    before: ResidualDiagnostics, after: ResidualDiagnostics | None, *, noise: float, omega_0: float, unit: str
) -> list[Plot]:
    found = [spectrum(before, after, noise=noise, omega_0=omega_0, unit=unit)]
    if before.order.size:
        found.append(orders(before, after, unit=unit))
    return [*found, autocorrelation(before, after), dependences(before, after, unit=unit)]


def predictions(runs: tuple[FreeRun, FreeRun | None], *, omega_0: float, unit: str, key: str) -> Plot:
    """Measured and predicted dynamic error on held-out data, and the error of each prediction.

    Args:
        runs: the same stretch by the base model and by the final one.
        omega_0: natural frequency [rad/s], for the first view.
        unit: of the dynamic error.
        key: of the plot.
    """
    first = runs[0]
    window = _first_view(first, omega_0)
    shown = (first.time >= window[0]) & (first.time <= window[1])
    factor, label = scaled_unit(float(np.max(np.abs(first.measured))), unit)
    errors = [r.measured - r.predicted for r in runs if r is not None]
    error_factor, error_label = scaled_unit(_rms(errors[0]), unit)
    traces = [_trace(first.time, factor * first.measured, window, name="measured", color=MEASURED, width=4.0)]
    for (name, color), run, error in zip(_names(runs[1] is not None), runs, errors, strict=False):
        assert run is not None
        traces.append(_trace(run.time, factor * run.predicted, window, name=name, color=color))
        lower = _trace(run.time, error_factor * error, window, name=f"error {name}", color=color)
        traces.append(lower | {"yaxis": "y2", "showlegend": False})
    visible = [factor * r.predicted[shown] for r in runs if r is not None]
    layout = {
        "xaxis": _axis("time [s]", range=list(window), anchor="y2"),
        "yaxis": _axis(
            axis_label("dynamic error", label), domain=[0.42, 1], range=_span(factor * first.measured[shown], visible)
        ),
        "yaxis2": _axis(
            axis_label("error", error_label),
            domain=[0, 0.34],
            range=_span(np.zeros(1), [error_factor * e[shown] for e in errors]),
        ),
    }
    return Plot(
        key,
        "fit",
        f"Held-out data of {first.name}: measured and predicted",
        "Free run from the first samples on; the model sees the torque only. Below: measured minus predicted. "
        f"The view starts where the {'base ' if runs[1] else ''}model errs most; "
        "double-click for the whole stretch, drag to zoom.",
        _figure(traces, 460, **layout),
    )


def rmse_bars(before: Account, after: Account | None, *, noise: float, unit: str) -> Plot:
    """Rms error on training and held-out data against the measurement noise."""
    accounts = [before] if after is None else [before, after]
    values = [[a.training_rmse, a.validation_rmse] for a in accounts]
    finite = [v for pair in values for v in pair if np.isfinite(v)]
    factor, label = scaled_unit(max([noise, *finite]), unit)
    wide = max([noise, *finite]) > 20 * min([noise, *finite])
    bars = [
        {
            "type": "bar",
            "orientation": "h",
            "name": name,
            "y": ["training", "held out"],
            "x": _numbers(factor * np.array(pair)),
            "marker": {"color": color},
            "text": [f" {_text(factor * v)} " for v in pair],
            "textposition": "outside",
            "cliponaxis": False,
        }
        for (name, color), pair in zip(_names(after is not None), values, strict=False)
    ]
    layout: dict[str, Any] = {
        "barmode": "group",
        "bargap": 0.35,
        "xaxis": _axis(axis_label("rms error of the dynamic error", label), rangemode="tozero", exponentformat="power"),
        "yaxis": _axis("", autorange="reversed", showgrid=False),
        "shapes": [_line(x=factor * noise)],
        "annotations": [_note("noise", x=float(np.log10(factor * noise)) if wide else factor * noise)],
    }
    if wide:
        low, high = min([noise, *finite]), max([noise, *finite])
        layout["xaxis"] |= _scale(wide, factor * low, factor * high)
        layout["xaxis"]["range"] = [float(np.log10(factor * low / 2)), float(np.log10(factor * high * 2))]
    return Plot(
        "rmse",
        "fit",
        "Rms error of the free runs",
        "The dotted line is the measurement noise: no model can do better.",
        _figure(bars, 250, **layout),
    )


def spectrum(
    before: ResidualDiagnostics, after: ResidualDiagnostics | None, *, noise: float, omega_0: float, unit: str
) -> Plot:
    """Amplitude spectral density of the residual against that of white measurement noise."""
    nyquist = float(before.frequency[-1])
    white = noise / np.sqrt(nyquist)
    density = [np.sqrt(r.spectral_density[1:]) for r in (before, after) if r is not None]
    factor, label = scaled_unit(float(np.max(density[0])), unit)
    traces = [
        _line_trace(before.frequency[1:], factor * d, name=name, color=color)
        for (name, color), d in zip(_names(after is not None), density, strict=False)
    ]
    traces.append(_line_trace(np.array([before.frequency[1], nyquist]), factor * np.full(2, white), name="noise"))
    resonance = omega_0 / (2 * np.pi)
    layout: dict[str, Any] = {
        "xaxis": _axis("frequency [Hz]", **_scale(True, float(before.frequency[1]), nyquist)),
        "yaxis": _axis(
            f"residual [{label or '1'}/√Hz]", exponentformat="power", **_density_scale([factor * d for d in density])
        ),
    }
    if before.frequency[1] < resonance < nyquist:
        layout["shapes"] = [_line(x=resonance)]
        layout["annotations"] = [_note("natural frequency", x=float(np.log10(resonance)))]
    return Plot(
        "spectrum",
        "left_over",
        "Spectrum of the residual",
        "Lines and humps above the noise level are physics that the model lacks.",
        _figure(traces, 340, **layout),
    )


def orders(before: ResidualDiagnostics, after: ResidualDiagnostics | None, *, unit: str) -> Plot:
    """Amplitude of the residual locked to the motor angle."""
    amplitudes = [r.order_amplitude for r in (before, after) if r is not None and r.order.size]
    factor, label = scaled_unit(max(float(np.max(a)) for a in amplitudes), unit)
    traces = [
        _line_trace(before.order, factor * a, name=name, color=color)
        for (name, color), a in zip(_names(after is not None), amplitudes, strict=False)
    ]
    layout = {
        "xaxis": _axis("order [cycles per motor revolution]", dtick=1),
        "yaxis": _axis(axis_label("amplitude", label), rangemode="tozero"),
    }
    return Plot(
        "orders",
        "left_over",
        "Residual locked to the motor angle",
        "Peaks at whole orders speak for errors of the gear, the motor or an encoder.",
        _figure(traces, 320, **layout),
    )


def autocorrelation(before: ResidualDiagnostics, after: ResidualDiagnostics | None) -> Plot:
    """Memory of the residual."""
    step = 0.5 / float(before.frequency[-1])
    found = [r.autocorrelation for r in (before, after) if r is not None]
    factor, label = scaled_unit(step * found[0].size, "s")
    traces = [
        _line_trace(factor * step * np.arange(a.size), a, name=name, color=color)
        for (name, color), a in zip(_names(after is not None), found, strict=False)
    ]
    limit = float(before.white_limit)
    # At lag zero it is 1 by definition, which is not worth the height.
    reach = min(1.05, max(4 * limit, 1.1 * max(float(np.max(np.abs(a[1:]), initial=0.0)) for a in found)))
    band = {
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
    layout = {
        "xaxis": _axis(axis_label("lag", label)),
        "yaxis": _axis("autocorrelation", range=[-reach, reach]),
        "shapes": [band],
    }
    return Plot(
        "autocorrelation",
        "left_over",
        "Memory of the residual",
        "At lag zero it is 1. The grey band holds 95 % of the lags of white noise. "
        "A residual that stays outside it is not noise.",
        _figure(traces, 300, **layout),
    )


def dependences(before: ResidualDiagnostics, after: ResidualDiagnostics | None, *, unit: str) -> Plot:
    """Mean residual against twist, twist rate, motor angle and motor speed."""
    residuals = [r for r in (before, after) if r is not None]
    largest = max(float(np.max(np.abs(d.mean), initial=0.0)) for d in before.dependence.values())
    factor, label = scaled_unit(largest, unit)
    traces: list[Figure] = []
    rows = -(-len(before.dependence) // 2)
    layout: dict[str, Any] = {"grid": {"rows": rows, "columns": 2, "pattern": "independent", "ygap": 0.32}}
    for i, quantity in enumerate(before.dependence):
        suffix = "" if i == 0 else str(i + 1)
        scale, x_label = _quantity_scale(quantity, before, unit)
        for (name, color), residual in zip(_names(after is not None), residuals, strict=False):
            part = residual.dependence[quantity]
            traces.append(
                {
                    "type": "scatter",
                    "mode": "lines+markers",
                    "name": name,
                    "legendgroup": name,
                    "showlegend": i == 0,
                    "x": _numbers(scale * part.centre),
                    "y": _numbers(factor * part.mean),
                    "error_y": {
                        "type": "data",
                        "array": _numbers(factor * part.standard_error),
                        "thickness": 1,
                        "width": 0,
                    },
                    "line": {"color": color, "width": 1},
                    "marker": {"size": 4},
                    "xaxis": f"x{suffix}",
                    "yaxis": f"y{suffix}",
                }
            )
        layout[f"xaxis{suffix}"] = _axis(x_label)
        layout[f"yaxis{suffix}"] = _axis(axis_label("mean residual", label) if i % 2 == 0 else "")
    return Plot(
        "dependence",
        "left_over",
        "What the residual depends on",
        "Mean residual in bins of equally many samples, with its standard error. A curve that leaves zero is a "
        "force that the model lacks, drawn against the quantity that it depends on.",
        _figure(traces, 270 * rows, **layout),
    )


def competition(this: Round, turn: int) -> Plot:
    """What each form of the catalogue gains on held-out data, against chance."""
    verdicts = sorted(this.verdicts, key=lambda v: v.gain)
    chance = float(np.quantile(this.screen.null_gains, 0.99))
    gains = np.array([v.gain for v in verdicts])
    largest = max(float(np.max(gains[np.isfinite(gains)], initial=0.0)), chance, 1e-9)
    wide = chance > 0 and largest > 30 * chance
    low = chance / 30 if wide else min(0.0, float(np.min(gains[np.isfinite(gains)], initial=0.0)))
    low = max(low, -0.5 * largest)
    drawn = np.clip(np.nan_to_num(gains, nan=low), low, None)
    names = [_form_name(v) for v in verdicts]
    bars = {
        "type": "bar",
        "orientation": "h",
        "y": names,
        "x": _numbers(drawn),
        "marker": {
            "color": [_bar_color(v, this) for v in verdicts],
            "line": {"color": [AFTER if _is_accepted(v, this) else MEASURED for v in verdicts], "width": 1},
        },
        "hoverinfo": "skip",
        "showlegend": False,
    }
    labels = {
        "type": "scatter",
        "mode": "text",
        "y": names,
        "x": _numbers(drawn),
        "text": [f" {_text(v.gain)} " for v in verdicts],
        "textposition": ["middle right" if wide or d >= 0 else "middle left" for d in drawn],
        "hoverinfo": "skip",
        "showlegend": False,
    }
    top = largest * (8 if wide else 1.25)
    view = [float(np.log10(v)) for v in (low, top)] if wide else [low - 0.25 * (top - low) if low < 0 else 0.0, top]
    layout = {
        "xaxis": _axis("gain on held-out data", range=view, exponentformat="power", **_scale(wide, low, top)),
        "yaxis": _axis("", showgrid=False, automargin=True),
        "shapes": [_line(x=chance)],
        "annotations": [_note("chance (99 %)", x=float(np.log10(chance)) if wide else chance)],
        "bargap": 0.3,
    }
    outcome = f"{_plain(this.winner.name)} is accepted" if this.accepted else "none is accepted"
    return Plot(
        f"competition-{turn}",
        "found",
        f"Round {turn}: {outcome}",
        "Gain is the decrease of the logarithm of the held-out error. Filled bars were refitted inside the equations; "
        "hollow ones are the first-order estimate of the screening; below zero an effect does harm. The dotted line is "
        "what the best of the whole catalogue reaches by chance in 99 of 100 cases.",
        _figure([bars, labels], 120 + 24 * len(verdicts), **layout),
    )


def correlations(uncertainty: Uncertainty) -> Plot:
    """How the errors of the fitted parameters go together."""
    names = list(uncertainty.estimates)
    matrix = np.asarray(uncertainty.correlation)
    few = len(names) <= 14
    heat = {
        "type": "heatmap",
        "x": names,
        "y": names,
        "z": [_numbers(row, 3) for row in matrix],
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
        "xaxis": _axis("", showgrid=False, tickangle=-40, automargin=True),
        "yaxis": _axis("", showgrid=False, autorange="reversed", automargin=True),
    }
    return Plot(
        "correlations",
        "left_over",
        "Correlation of the fitted parameters",
        "Near +1 or -1 the data determine a combination of the two rather than each.",
        _figure([heat], 170 + 34 * len(names), **layout),
    )


def decimated(time: np.ndarray, values: np.ndarray, most: int = _MOST_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most so many points of a curve that keep every peak: the lowest and highest of each of equal bins."""
    if time.size <= most:
        return time, values
    bins = most // 2
    edges = np.linspace(0, time.size, bins + 1).astype(int)
    kept = np.empty(2 * bins, dtype=int)
    for i, (start, stop) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        part = np.nan_to_num(values[start:stop])
        kept[2 * i : 2 * i + 2] = start + np.sort([np.argmin(part), np.argmax(part)])
    return time[kept], values[kept]


def _pairs(before: Account, after: Account | None) -> list[tuple[FreeRun, FreeRun | None]]:
    """The same held-out stretch before and after, of the first few logs."""
    later: Sequence[FreeRun | None] = [None] * len(before.validation) if after is None else after.validation
    return list(zip(before.validation, later, strict=True))[:_MOST_LOGS]


def _names(two: bool) -> list[tuple[str, str]]:
    return [("before", BEFORE), ("after", AFTER)] if two else [("model", AFTER)]


def _first_view(run: FreeRun, omega_0: float) -> tuple[float, float]:
    """A few natural periods around the largest error."""
    length = _PERIODS * 2 * np.pi / omega_0
    start, stop = float(run.time[0]), float(run.time[-1])
    error = np.nan_to_num(np.abs(run.measured - run.predicted), posinf=0.0)
    centre = float(run.time[int(np.argmax(error))])
    left = min(max(centre - length / 2, start), max(stop - length, start))
    return left, min(left + length, stop)


def _trace(
    time: np.ndarray, values: np.ndarray, window: tuple[float, float], *, name: str, color: str, width: float = 1.5
) -> Figure:
    """A long curve: complete where it is seen first, with its peaks kept elsewhere."""
    first, last = np.searchsorted(time, window)
    inside = decimated(time[first:last], values[first:last], _MOST_POINTS // 2)
    left = decimated(time[:first], values[:first], _MOST_POINTS // 4)
    right = decimated(time[last:], values[last:], _MOST_POINTS // 4)
    x, y = (np.concatenate(part) for part in zip(left, inside, right, strict=True))
    return _line_trace(x, y, name=name, color=color, width=width)


def _line_trace(
    x: np.ndarray, y: np.ndarray, *, name: str, color: str = MEASURED, width: float | None = None
) -> Figure:
    line: Figure = {"color": color, "width": width or 1.5}
    if name == "noise":
        line |= {"dash": "dot", "color": INK}
    # Times need more digits than values: a long log's samples would fall on top of each other.
    return {"type": "scatter", "mode": "lines", "name": name, "x": _numbers(x, 9), "y": _numbers(y), "line": line}


def _quantity_scale(name: str, residual: ResidualDiagnostics, unit: str) -> tuple[float, str]:
    base = {"x": unit, "v": f"{unit}/s", "motor angle": "rad", "motor speed": "rad/s"}[name]
    shown = {"x": "dynamic error x", "v": "its rate v"}.get(name, name)
    factor, label = scaled_unit(float(np.max(np.abs(residual.dependence[name].centre))), base)
    return factor, axis_label(shown, label)


def _form_name(verdict: Verdict) -> str:
    return html.escape(_plain(verdict.name)) + " "


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _is_accepted(verdict: Verdict, this: Round) -> bool:
    return this.accepted and verdict.name == this.winner.name


def _bar_color(verdict: Verdict, this: Round) -> str:
    if _is_accepted(verdict, this):
        return AFTER
    return FAINT if verdict.trial is not None else "#ffffff"


def _figure(traces: Sequence[Figure], height: int, **layout: Any) -> Figure:
    """A figure in the house's look."""
    # Labels of vertical lines stand right above the plot, the legend above them.
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
        "showlegend": any(t.get("showlegend", True) and "name" in t for t in traces),
    }
    return {"data": list(traces), "layout": look | layout}


def _axis(title: str, **more: Any) -> Figure:
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


def _line(*, x: float) -> Figure:
    return {
        "type": "line",
        "x0": x,
        "x1": x,
        "yref": "paper",
        "y0": 0,
        "y1": 1,
        "line": {"color": INK, "width": 1.2, "dash": "dot"},
    }


def _note(text: str, *, x: float) -> Figure:
    """A label above a vertical line. On a logarithmic axis plotly wants the logarithm here, but not in the line."""
    return {
        "text": text,
        "x": x,
        "yref": "paper",
        "y": 1,
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 11, "color": INK},
    }


def _scale(logarithmic: bool, low: float, high: float) -> Figure:
    """A linear axis, or a logarithmic one with a label at each decade (more where there are few)."""
    if not logarithmic:
        return {"type": "linear"}
    if high > 100 * low or not 0 < low < high:
        return {"type": "log", "dtick": 1}
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
    ticks = [float(f"{digit}e{decade}") for decade in decades for digit in (1, 2, 5)]
    return {"type": "log", "tickvals": ticks, "ticktext": [number(t, 1) for t in ticks]}


def _density_scale(densities: Sequence[np.ndarray]) -> Figure:
    together = np.concatenate(densities)
    return _scale(True, float(np.min(together[together > 0], initial=np.inf)), float(np.max(together)))


def _span(measured: np.ndarray, others: Sequence[np.ndarray]) -> list[float] | None:
    """Range that shows all curves with some air, but a runaway prediction only in part."""
    own = float(np.ptp(measured))
    values = np.concatenate([measured, *others])
    values = values[np.isfinite(values)]
    if values.size == 0:
        return None
    low, high = float(np.min(values)), float(np.max(values))
    if own > 0:
        low = max(low, float(np.min(measured)) - 2 * own)
        high = min(high, float(np.max(measured)) + 2 * own)
    air = 0.08 * (high - low) or 1.0
    return [low - air, high + air]


def _rms(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else 0.0


def _numbers(values: np.ndarray, digits: int = _DIGITS) -> list[float | None]:
    """For JSON: as many digits as a screen can show, null for what is no number."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=float)]


def _two_decimals(value: float) -> str:
    # Adding zero turns a rounded -0.0 into 0.0.
    return f"{np.round(value, 2) + 0.0:.2f}".replace("-", "\N{MINUS SIGN}")


def _text(value: float) -> str:
    return number(float(value), 3) if np.isfinite(value) else "diverged"
