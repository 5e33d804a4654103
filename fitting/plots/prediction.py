"""Measured and predicted dynamic error."""

from collections.abc import Sequence

import numpy as np

from fitting.formatting import axis_label, scaled_unit
from fitting.free_run import FreeRun
from fitting.plots.long_trace import long_trace
from fitting.plots.look import MEASURED, axis, figure, names_and_colors
from fitting.plots.plot import Plot

# Natural periods that a trace shows at first sight.
_PERIODS = 15


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
    traces = [long_trace(first.time, factor * first.measured, window, name="measured", color=MEASURED, width=4.0)]
    for (name, color), run, error in zip(names_and_colors(runs[1] is not None), runs, errors, strict=False):
        assert run is not None
        traces.append(long_trace(run.time, factor * run.predicted, window, name=name, color=color))
        lower = long_trace(run.time, error_factor * error, window, name=f"error {name}", color=color)
        traces.append(lower | {"yaxis": "y2", "showlegend": False})
    visible = [factor * r.predicted[shown] for r in runs if r is not None]
    layout = {
        "xaxis": axis("time [s]", range=list(window), anchor="y2"),
        "yaxis": axis(
            axis_label("dynamic error", label), domain=[0.42, 1], range=_span(factor * first.measured[shown], visible)
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
        f"Held-out data of {first.name}: measured and predicted",
        "Free run from the first samples on; the model sees the torque only. Below: measured minus predicted. "
        f"The view starts where the {'base ' if runs[1] else ''}model errs most; "
        "double-click for the whole stretch, drag to zoom.",
        figure(traces, 460, **layout),
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
