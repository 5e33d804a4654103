"""Gain of each form of missing physics."""

import html

import numpy as np

from fitting.attribution.selection_round import Round, Verdict
from fitting.report.outputs import in_words
from fitting.report.plots.axes import (
    AFTER,
    FAINT,
    MEASURED,
    axis,
    axis_scale,
    figure,
    note,
    numbers,
    text,
    vertical_line,
)
from fitting.report.plots.plot import Plot


def competition(this: Round, turn: int) -> Plot:
    """Gain of each form of the catalogue on selection data, with its null distribution."""
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
        "x": numbers(drawn),
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
        "x": numbers(drawn),
        "text": [f" {text(v.gain)} " for v in verdicts],
        "textposition": ["middle right" if wide or d >= 0 else "middle left" for d in drawn],
        "hoverinfo": "skip",
        "showlegend": False,
    }
    top = largest * (8 if wide else 1.25)
    view = [float(np.log10(v)) for v in (low, top)] if wide else [low - 0.25 * (top - low) if low < 0 else 0.0, top]
    layout = {
        "xaxis": axis("gain on selection data", range=view, exponentformat="power", **axis_scale(wide, low, top)),
        "yaxis": axis("", showgrid=False, automargin=True),
        "shapes": [vertical_line(x=chance)],
        "annotations": [note("chance (99 %)", x=float(np.log10(chance)) if wide else chance)],
        "bargap": 0.3,
    }
    outcome = f"{in_words(this.winner.name)} is accepted" if this.accepted else "none is accepted"
    return Plot(
        f"competition-{turn}",
        "found",
        f"Round {turn}: {outcome}",
        "Gain is the decrease of the logarithm of the error on selection data. Filled bars were refitted inside the "
        "equations; hollow ones are the first-order estimate of the screening; below zero an effect increases the "
        "error. The dotted line is the 99 % quantile of the best gain of the whole catalogue by chance.",
        figure([bars, labels], 120 + 24 * len(verdicts), **layout),
    )


def _form_name(verdict: Verdict) -> str:
    return html.escape(in_words(verdict.name)) + " "


def _is_accepted(verdict: Verdict, this: Round) -> bool:
    return this.accepted and verdict.name == this.winner.name


def _bar_color(verdict: Verdict, this: Round) -> str:
    if _is_accepted(verdict, this):
        return AFTER
    return FAINT if verdict.trial is not None else "#ffffff"
