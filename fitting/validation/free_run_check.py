"""Check of free runs along whole stretches against their prediction bands: slow errors do not show on short
segments."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.estimate import Fit
from fitting.estimation.free_run import FreeRun, rms_error
from fitting.uncertainty.prediction_band import PredictionBand, prediction_bands
from fitting.uncertainty.standard_errors import uncertainty


def surprise(
    final: Fit,
    before: Sequence[FreeRun],
    after: Sequence[FreeRun],
    held_out: Fit,
    *,
    explained: float,
    noise: Float[Array, "outputs outputs"],
    halo: int,
    torque_noise: float = 0.0,
) -> float | None:
    """Rms error of free runs along held-out stretches, over the rms of their prediction bands. Bands contain the
    residual of short segments, and the uncertainty of parameters and initial state.

    Near one for a right model, also a chaotic one, whose bands grow like its errors. None where the effects explain
    enough of the free runs' error (bands do not contain inexact laws), or where its bands diverge.

    Args:
        final: the model with its effects.
        before: free runs of the base model along the held-out stretches.
        after: likewise of the final model.
        held_out: the final model on short segments of the held-out stretches, whose residual contains all coloured
            noise.
        explained: share of the base model's variance beyond the noise that is enough.
        noise: covariance of the measurement noise, estimated from shorter pieces.
        halo: intervals of torque before a stretch.
        torque_noise: standard deviation of the noise of a torque sample [N m].
    """
    short = max(noise, held_out.covariance, key=lambda covariance: float(covariance[-1, -1]))
    variance = float(short[-1, -1])
    at_first = rms_error(before) ** 2 - variance
    if rms_error(after) ** 2 - variance <= (1.0 - explained) * at_first:
        return None
    bands = prediction_bands(
        final,
        uncertainty(final),
        held_out.stretches,
        noise=short,
        halo=halo,
        runs=after,
        torque_noise=torque_noise,
    )
    return over_bands(bands)


def over_bands(bands: Sequence[PredictionBand]) -> float | None:
    """Rms error of several runs over the rms of their prediction bands; None where these diverge."""
    allowed = np.concatenate([band.std_measured[band.run.counts] ** 2 for band in bands])
    seen = np.concatenate([band.run.squared_error for band in bands])
    ratio = np.sqrt(np.sum(seen) / np.sum(allowed))
    return float(ratio) if np.isfinite(allowed).all() else None
