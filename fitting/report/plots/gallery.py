"""Plots of a report, in order."""

from collections.abc import Mapping, Sequence
from typing import Any

from fitting.estimation.free_run import FreeRun
from fitting.outcome import FitOnly, Loop
from fitting.report.outputs import noise_of_outputs
from fitting.report.plots.competition import competition
from fitting.report.plots.correlations import correlations
from fitting.report.plots.frequency_response import bode
from fitting.report.plots.plot import Plot
from fitting.report.plots.prediction import predictions
from fitting.report.plots.residual import autocorrelation, dependences, input_correlation, orders, spectrum
from fitting.report.plots.rmse import rmse_bars
from fitting.uncertainty.prediction_band import PredictionBand
from fitting.validation.account import Account
from fitting.validation.residual_diagnostics import ResidualDiagnostics

_MOST_LOGS = 4


def plots(loop: Loop, *, units: Mapping[str, str]) -> list[Plot]:
    """All plots of a closed loop.

    Args:
        loop: the outcome.
        units: of the outputs.
    """
    unit, twist_unit = units.get(loop.before.judged[0].output, "rad"), units.get("dynamic_error", "rad")
    after = None if loop.after is loop.before else loop.after
    left = None if after is None else loop.residual_after
    noise = _noise(loop)
    found = _predictions(loop.before, after, unit)
    found.append(rmse_bars(loop.before, after, noise=noise, unit=unit))
    found += _residual_plots(loop.before, loop.residual_before, left, noise=noise, unit=unit, twist_unit=twist_unit)
    if len(loop.after.uncertainty.estimates) > 1:
        found.append(correlations(loop.after.uncertainty))
    return found + [competition(this, turn + 1) for turn, this in enumerate(loop.rounds)]


def fit_plots(fitted: FitOnly, *, units: Mapping[str, str]) -> list[Plot]:
    """All plots of a fit; arguments as in [`plots`][]."""
    unit, twist_unit = units.get(fitted.account.judged[0].output, "rad"), units.get("dynamic_error", "rad")
    step = 0.5 / float(fitted.residual.frequency[-1])
    found = _predictions(fitted.account, None, unit, fitted.bands)
    memory, *others = _residual_plots(
        fitted.account, fitted.residual, None, noise=_noise(fitted), unit=unit, twist_unit=twist_unit
    )
    found += [memory, *(input_correlation(c, step=step) for c in fitted.tests.inputs), *others]
    if fitted.frequency_response is not None:
        found.append(bode(fitted.frequency_response, units=units))
    return found


def _noise(outcome: Loop | FitOnly) -> float:
    """Rms measurement noise of the principal output."""
    return list(noise_of_outputs(outcome.stored).values())[-1]


def _predictions(before: Account, after: Account | None, unit: str, bands: Sequence[PredictionBand] = ()) -> list[Plot]:
    """The same stretch before and after, of the first few logs; with the bands of the model before."""
    later: Sequence[FreeRun | None] = [None] * len(before.judged) if after is None else after.judged
    omega_0 = float(before.model.drive.omega_0)
    common: dict[str, Any] = {"part": list(before.parts())[-1], "omega_0": omega_0, "unit": unit}
    pairs = list(zip(before.judged, later, strict=True))[:_MOST_LOGS]
    return [
        predictions(runs, key=f"prediction-{i}", band=bands[i] if bands else None, **common)
        for i, runs in enumerate(pairs)
    ]


def _residual_plots(
    account: Account,
    before: ResidualDiagnostics,
    after: ResidualDiagnostics | None,
    *,
    noise: float,
    unit: str,
    twist_unit: str,
) -> list[Plot]:
    omega_0 = float(account.model.drive.omega_0)
    found = [autocorrelation(before, after), spectrum(before, after, noise=noise, omega_0=omega_0, unit=unit)]
    if before.order.size:
        found.append(orders(before, after, unit=unit))
    return [*found, dependences(before, after, unit=unit, twist_unit=twist_unit)]
