"""Check of free runs along whole stretches against their prediction bands: slow errors do not show on short
segments."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.estimate import Fit
from fitting.estimation.free_run import FreeRun, rms_error
from fitting.uncertainty.prediction_band import PredictionBand, prediction_bands
from fitting.uncertainty.standard_errors import Uncertainty


def share_explained(
    before: Sequence[FreeRun], after: Sequence[FreeRun], held_out: Fit, noise: Float[Array, "outputs outputs"]
) -> float | None:
    """Share of the variance beyond noise, of the base model's free runs, that the effects remove; -1 where they at
    least double it. None where both models diverge.

    Args:
        before: free runs of the base model along the held-out stretches.
        after: likewise of the final model.
        held_out: the final model on short segments of the held-out stretches.
        noise: covariance of the measurement noise, estimated from shorter pieces.
    """
    variance = float(_short_error(held_out, noise)[-1, -1])
    at_first = max(rms_error(before) ** 2 - variance, np.finfo(float).tiny)
    share = 1.0 - (rms_error(after) ** 2 - variance) / at_first
    return None if np.isnan(share) else float(np.clip(share, -1.0, 1.0))


def surprise(
    final: Fit,
    runs: Sequence[FreeRun] | None,
    short: Fit,
    *,
    of_parameters: Uncertainty,
    noise: Float[Array, "outputs outputs"],
    halo: int,
    torque_noise: float = 0.0,
) -> float | None:
    """Rms error of free runs along whole stretches, over the rms of their prediction bands. Bands contain the residual
    of short segments, and the uncertainty of parameters and initial state.

    Near one for a right model, also a chaotic one, whose bands grow like its errors. None where bands say nothing.

    Args:
        final: the model with its effects.
        runs: its free runs along the stretches; simulated if None.
        short: the model on short segments of the stretches, whose residual contains all coloured noise.
        of_parameters: uncertainty of the final fit's parameters.
        noise: covariance of the measurement noise, estimated from shorter pieces.
        halo: intervals of torque before a stretch.
        torque_noise: standard deviation of the noise of a torque sample [N m].
    """
    known = {"noise": _short_error(short, noise), "halo": halo, "runs": runs, "torque_noise": torque_noise}
    return over_bands(prediction_bands(final, of_parameters, short.stretches, **known))


def _short_error(short: Fit, noise: Float[Array, "outputs outputs"]) -> Float[Array, "outputs outputs"]:
    """Covariance of the error over short segments; at least the measurement noise."""
    return max(noise, short.covariance, key=lambda covariance: float(covariance[-1, -1]))


def over_bands(bands: Sequence[PredictionBand]) -> float | None:
    """Rms error of several runs over the rms of their prediction bands; None where these are wider than the measured
    motion about its mean, so that they say nothing."""
    allowed = np.concatenate([band.std_measured[band.run.counts] ** 2 for band in bands])
    seen = np.concatenate([band.run.squared_error for band in bands])
    measured = [band.run.measured[band.run.counts] for band in bands]
    moves = np.concatenate([own - np.mean(own) for own in measured if own.size])
    # Also where a band is not finite.
    return float(np.sqrt(np.sum(seen) / np.sum(allowed))) if np.sum(allowed) <= np.sum(moves**2) else None
