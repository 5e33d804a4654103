"""The frequency response from torque to dynamic error."""

from collections.abc import Mapping

import numpy as np

from fitting.formatting import axis_label, pretty_unit, scaled_unit
from fitting.report.outputs import in_words
from fitting.report.plots.axes import AFTER, MEASURED, axis, axis_scale, figure, line_trace, note, vertical_line
from fitting.report.plots.plot import Plot
from fitting.validation.frequency_response import FrequencyResponse, strong_lines

# The first view extends beyond the excited lines by this factor.
_AROUND = 2.5
_MOST_LINES = 2000
_MEANINGLESS = 0.5


def bode(found: FrequencyResponse, *, units: Mapping[str, str]) -> Plot:
    """Magnitude, phase and coherence over frequency, measured and modelled.

    Args:
        found: the responses.
        units: of the output and of `forcing`.
    """
    kept = _shown(found)
    frequency = found.frequency[kept]
    measured = np.where(found.coherence > _MEANINGLESS, found.measured, np.nan)
    curves = (("measured (H1)", MEASURED, measured[kept]), ("model", AFTER, found.model[kept]))
    largest = float(np.max(np.abs(found.model)))
    factor, unit = scaled_unit(largest, units.get(found.output, "rad"))
    traces = []
    for name, color, response in curves:
        traces.append(line_trace(frequency, factor * np.abs(response), name=name, color=color))
        phase = line_trace(frequency, _degrees(response), name=name, color=color)
        traces.append(phase | {"yaxis": "y2", "showlegend": False})
    coherence = line_trace(frequency, found.coherence[kept], name="coherence", color=MEASURED)
    traces.append(coherence | {"yaxis": "y3", "showlegend": False})
    low, high = _view(found)
    magnitudes = factor * np.abs(found.model[(found.frequency >= low) & (found.frequency <= high)])
    forcing = pretty_unit(units.get("forcing", "N m"))
    per = f"({forcing})" if " " in forcing or "/" in forcing else forcing
    marks = [("natural frequency", found.resonance, "center")]
    if found.antiresonance is not None:
        # The two may lie close together.
        marks = [("antiresonance", found.antiresonance, "right"), (*marks[0][:2], "left")]
    layout = {
        "xaxis": axis("frequency [Hz]", anchor="y3", **axis_scale(True, low, high))
        | {"range": [float(np.log10(low)), float(np.log10(high))]},
        "yaxis": axis(axis_label("magnitude", f"{unit}/{per}"), domain=[0.6, 1], exponentformat="power")
        | axis_scale(True, float(np.min(magnitudes)) / 10, float(np.max(magnitudes)) * 10)
        | {"range": [float(np.log10(np.min(magnitudes) / 3)), float(np.log10(np.max(magnitudes) * 3))]},
        "yaxis2": axis("phase [°]", domain=[0.3, 0.54], range=[-285, 105], tickvals=[-270, -180, -90, 0, 90]),
        "yaxis3": axis("coherence", domain=[0, 0.24], range=[0, 1.05]),
        "shapes": [vertical_line(x=x) for _, x, _ in marks],
        "annotations": [note(name, x=float(np.log10(x))) | {"xanchor": side} for name, x, side in marks],
    }
    output = in_words(found.output)
    return Plot(
        "frequency-response",
        "look",
        f"Frequency response from {found.source} to {output}",
        "Measured: cross-spectrum over input spectrum (H1). Model: the fitted drive with its stiffness averaged over "
        f"the measured twist. Coherence is the share of the {output}'s power that follows linearly from the "
        f"{found.source}; where it is below {_MEANINGLESS}, the measured curve is meaningless and not shown.",
        figure(traces, 560, **layout),
    )


def _shown(found: FrequencyResponse) -> np.ndarray:
    """Lines to plot: all, or as many as a logarithmic axis resolves."""
    count = found.frequency.size
    if count <= _MOST_LINES:
        return np.arange(count)
    return np.unique(np.round(np.geomspace(1, count, _MOST_LINES)).astype(int) - 1)


def _view(found: FrequencyResponse) -> tuple[float, float]:
    """Frequencies of the first view: excited lines and resonance, with a margin."""
    excited = found.frequency[strong_lines(found)]
    low = min(float(excited[0]), found.antiresonance or found.resonance) / _AROUND
    high = max(float(excited[-1]), found.resonance) * _AROUND
    return max(low, float(found.frequency[0])), min(high, float(found.frequency[-1]))


def _degrees(response: np.ndarray) -> np.ndarray:
    """Phase from -270 to 90 degrees, so that an oscillator's does not jump."""
    phase = np.degrees(np.angle(response))
    return np.where(phase > 90.0, phase - 360.0, phase)
