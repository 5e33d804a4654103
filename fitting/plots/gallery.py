"""Which pictures a report has, in the order of the story."""

from collections.abc import Mapping, Sequence

import numpy as np

from fitting.close_loop import Loop
from fitting.compare import Account
from fitting.diagnostics import ResidualDiagnostics
from fitting.free_run import FreeRun
from fitting.plots.competition import competition
from fitting.plots.correlations import correlations
from fitting.plots.plot import Plot
from fitting.plots.prediction import predictions
from fitting.plots.residual import autocorrelation, dependences, orders, spectrum
from fitting.plots.rmse import rmse_bars

_MOST_LOGS = 4


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


def _pairs(before: Account, after: Account | None) -> list[tuple[FreeRun, FreeRun | None]]:
    """The same held-out stretch before and after, of the first few logs."""
    later: Sequence[FreeRun | None] = [None] * len(before.validation) if after is None else after.validation
    return list(zip(before.validation, later, strict=True))[:_MOST_LOGS]
