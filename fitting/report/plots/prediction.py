"""Measured and predicted dynamic error."""

from collections.abc import Sequence

import numpy as np

from fitting.estimation.free_run import FreeRun
from fitting.formatting import axis_label, percent, scaled_unit
from fitting.report.outputs import in_words
from fitting.report.plots.axes import MEASURED, axis, figure, names_and_colors
from fitting.report.plots.long_trace import long_trace
from fitting.report.plots.plot import Figure, Plot
from fitting.uncertainty.prediction_band import PredictionBand, coverage

# Natural periods in the first view of a trace.
_PERIODS = 15
_BAND = "rgba(0,114,178,0.25)"


def predictions(
    runs: tuple[FreeRun, FreeRun | None],
    *,
    part: str,
    omega_0: float,
    unit: str,
    key: str,
    band: PredictionBand | None = None,
) -> Plot:
    """Measured and predicted dynamic error, and the error of each prediction.

    Args:
        runs: the same stretch by the base model and by the final one.
        part: of the data.
        omega_0: natural frequency [rad/s], for the first view.
        unit: of the principal output.
        key: of the plot.
        band: of the first run.
    """
    first = runs[0]
    window = _first_view(first, omega_0)
    shown = (first.time >= window[0]) & (first.time <= window[1])
    factor, label = scaled_unit(float(np.max(np.abs(first.measured))), unit)
    errors = [r.measured - r.predicted for r in runs if r is not None]
    error_factor, error_label = scaled_unit(_rms(errors[0]), unit)
    traces = [] if band is None else _band(band, window, factor, error_factor)
    traces.append(long_trace(first.time, factor * first.measured, window, name="measured", color=MEASURED, width=4.0))
    for (name, color), run, error in zip(names_and_colors(runs[1] is not None), runs, errors, strict=False):
        assert run is not None
        traces.append(long_trace(run.time, factor * run.predicted, window, name=name, color=color))
        lower = long_trace(run.time, error_factor * error, window, name=f"error {name}", color=color)
        traces.append(lower | {"yaxis": "y2", "showlegend": False})
    visible = [factor * r.predicted[shown] for r in runs if r is not None]
    layout = {
        "xaxis": axis("time [s]", range=list(window), anchor="y2"),
        "yaxis": axis(
            axis_label(in_words(first.output), label),
            domain=[0.42, 1],
            range=_span(factor * first.measured[shown], visible),
        ),
        "yaxis2": axis(
            axis_label("error", error_label),
            domain=[0, 0.34],
            range=_span(np.zeros(1), [error_factor * e[shown] for e in errors]),
        ),
    }
    return Plot(
        key,
        "fit",
        f"{part.capitalize()} data of {first.name}: measured and predicted",
        "Free run from the first samples on; the model uses the torque only. Below: measured minus predicted. "
        f"The view starts where the {'base ' if runs[1] else ''}model errs most; "
        f"double-click for the whole stretch, drag to zoom.{_coverage(band)}",
        figure(traces, 460, **layout),
    )


def _band(band: PredictionBand, window: tuple[float, float], factor: float, error_factor: float) -> list[Figure]:
    """The band of measured samples and of their errors; empty where it is unknown."""
    low, high = band.band95
    if not np.isfinite([low, high]).all():
        return []
    predicted, time = band.run.predicted, band.run.time
    made = []
    for curve, scale, place in ((low, factor, {}), (low - predicted, error_factor, {"yaxis": "y2"})):
        # The band is symmetric about the prediction.
        other = curve + (high - low)
        edges = [long_trace(time, scale * c, window, name="95 % band", color=_BAND, width=0.0) for c in (curve, other)]
        edges[1] |= {"fill": "tonexty", "fillcolor": _BAND}
        # One legend entry for all.
        made += [e | place | {"hoverinfo": "skip", "showlegend": bool(not place and "fill" in e)} for e in edges]
    return made


def _coverage(band: PredictionBand | None) -> str:
    """A sentence on the coverage of the band."""
    share = np.nan if band is None else coverage([band])
    if not np.isfinite(share):
        return ""
    return (
        " The blue band is where 95 % of the samples are expected, from the uncertainty of parameters and initial "
        f"state, and noise; it contains {percent(share)} of them. Model discrepancy is not included."
    )


def _first_view(run: FreeRun, omega_0: float) -> tuple[float, float]:
    """A few natural periods around the largest error."""
    length = _PERIODS * 2 * np.pi / omega_0
    start, stop = float(run.time[0]), float(run.time[-1])
    error = np.nan_to_num(np.abs(run.measured - run.predicted), posinf=0.0)
    centre = float(run.time[int(np.argmax(error))])
    left = min(max(centre - length / 2, start), max(stop - length, start))
    return left, min(left + length, stop)


def _span(measured: np.ndarray, others: Sequence[np.ndarray]) -> list[float] | None:
    """Range of all curves with a margin, limited for a diverging prediction."""
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
