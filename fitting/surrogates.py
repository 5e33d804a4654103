"""What chance might have left over: residuals of the same colour, with random phases."""

from typing import Any

import numpy as np
from jaxtyping import Float

from fitting.estimate import Fit
from fitting.spectral_lines import without_lines

DRAWS = 199
"""Surrogate residuals; the smallest p-value that they can show is 1/200."""


def surrogates(fit: Fit, seed: int) -> Float[np.ndarray, "draws segments rows"]:
    """Residuals with the same spectra and cross-spectra and random phases: noise of the residual's own colour.

    A line that stands out of its surroundings is no colour of noise, but what a periodic effect would leave: with a
    phase of its own it would still be explained by that effect.
    """
    from scipy.fft import irfft, prev_fast_len

    random = np.random.default_rng(seed)
    weight = np.asarray(fit.problem.segments.weight) > 0
    error = np.asarray(fit.error) @ np.asarray(fit.problem.whitening).T
    series = error[weight].T
    samples = series.shape[1]
    length = prev_fast_len(samples, real=True)
    spectrum = without_lines(np.fft.rfft(series[:, :length]))
    found = np.zeros((DRAWS, *error.shape))
    for draw in range(DRAWS):
        turn = np.exp(1j * random.uniform(0.0, 2 * np.pi, spectrum.shape[1]))
        # Noise has no mean; what mean there is may be the very thing that is looked for.
        turn[0] = 0.0
        surrogate: Any = irfft(spectrum * turn[None, :], n=length, overwrite_x=True, workers=-1)
        found[draw][weight] = np.pad(surrogate, ((0, 0), (0, samples - length)), mode="wrap").T
    return found.reshape(DRAWS, error.shape[0], -1)
