"""Figures of merit of a fit, as system identification toolboxes report them."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.estimate import Fit
from fitting.estimation.free_run import FreeRun, as_logged
from fitting.estimation.outliers import left_out
from fitting.uncertainty.measurement_noise import excess
from fitting.validation.account import Account


class Goodness(eqx.Module):
    """Figures of merit.

    Attributes:
        fit_percent: `100 (1 - |y - yhat| / |y - mean(y)|)` of the free runs on each part of the data.
        data: measured numbers that were fitted (samples times outputs).
        left_out: samples with weight zero: inserted, found invalid by the health check, or outliers.
        parameters: free parameters.
        states: fitted entries of initial states.
        error_over_noise: rms residual of short simulations of each output, over its measurement noise.
        reduced_chi_square: mean square of the error over that of the measurement noise, per degree of freedom; of all
            outputs.
        log_likelihood: of Gaussian white errors with the residual's covariance.
        aic: information criterion of Akaike; parameters, initial states and covariance are counted.
        bic: likewise, of Schwarz.
        iterations: of the last fit.
        converged: whether they met their tolerance.
        substeps: solver steps in a sample interval.
    """

    fit_percent: dict[str, float]
    data: int = eqx.field(static=True)
    left_out: int = eqx.field(static=True)
    parameters: int = eqx.field(static=True)
    states: int = eqx.field(static=True)
    error_over_noise: dict[str, float]
    reduced_chi_square: float
    log_likelihood: float
    aic: float
    bic: float
    iterations: int = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    substeps: int = eqx.field(static=True)


def goodness(fit: Fit, account: Account, noise: Float[Array, "outputs outputs"]) -> Goodness:
    """Figures of merit of a fit.

    Args:
        fit: the fit.
        account: its free runs.
        noise: covariance of the measurement noise of the outputs.
    """
    segments = fit.problem.segments
    weight = np.asarray(segments.weight) > 0
    error = np.asarray(fit.error)[weight]
    samples, outputs = error.shape
    own_states = weight.any(axis=1) & ~np.asarray(segments.joined)
    states = int(own_states.sum()) * fit.unknowns.states.shape[1]
    parameters = len(fit.free.paths)
    chi_square = float(np.einsum("ni,ij,nj->", error, np.linalg.inv(np.asarray(noise)), error))
    _, log_determinant = np.linalg.slogdet(error.T @ error / samples)
    log_likelihood = -0.5 * samples * (outputs * (math.log(2 * math.pi) + 1) + float(log_determinant))
    count = parameters + states + outputs * (outputs + 1) // 2
    freedom = samples * outputs - parameters - states
    names = [name.replace("_", " ") for name in as_logged(fit.model)[0]]
    return Goodness(
        fit_percent={name: fit_percent(runs) for name, runs in account.parts().items()},
        data=samples * outputs,
        left_out=left_out(fit.stretches),
        parameters=parameters,
        states=states,
        error_over_noise=dict(zip(names, excess(fit, noise).tolist(), strict=True)),
        reduced_chi_square=chi_square / freedom if freedom > 0 else math.nan,
        log_likelihood=log_likelihood,
        aic=2 * count - 2 * log_likelihood,
        bic=count * math.log(samples * outputs) - 2 * log_likelihood,
        iterations=fit.steps,
        converged=fit.converged,
        substeps=fit.substeps,
    )


def fit_percent(runs: Sequence[FreeRun]) -> float:
    """`100 (1 - |y - yhat| / |y - mean(y)|)`, each run with its own mean; minus infinity where a run diverged.

    100 is perfect, 0 is no better than a constant.
    """
    error = sum(float(np.sum(r.squared_error)) for r in runs)
    seen = [r.measured[r.counts] for r in runs if r.counts.any()]
    swing = sum(float(np.sum((y - y.mean()) ** 2)) for y in seen)
    if not math.isfinite(error) or swing <= 0:
        return -math.inf
    return 100.0 * (1.0 - math.sqrt(error / swing))
