"""What chance might have left over: residuals of the same colour, with random phases."""

import numpy as np
from jaxtyping import Float
from scipy.fft import prev_fast_len

from fitting.estimate import Fit
from fitting.spectral_lines import STANDS_OUT, surroundings

DRAWS = 199
"""Surrogate residuals; the smallest p-value that they can show is 1/200."""


def surrogates(fit: Fit, seed: int) -> Float[np.ndarray, "draws segments rows"]:
    """[`same_colour`][] of a fit's whitened residual."""
    weight = np.asarray(fit.problem.segments.weight) > 0
    error = np.asarray(fit.error) @ np.asarray(fit.problem.whitening).T
    found = np.zeros((DRAWS, *error.shape))
    found[:, weight] = same_colour(error[weight], np.random.default_rng(seed))
    return found.reshape(DRAWS, error.shape[0], -1)


def same_colour(
    series: Float[np.ndarray, "samples outputs"], random: np.random.Generator
) -> Float[np.ndarray, "draws samples outputs"]:
    """Series with the same spectra and cross-spectra and random phases: noise of the residual's own colour.

    A line that stands out of its surroundings is no colour of noise, but what a periodic effect would leave: with a
    phase of its own it would still be explained by that effect.
    """
    samples, outputs = series.shape
    length = prev_fast_len(samples, real=True)
    spectrum = np.fft.rfft(series.T[:, :length])
    power = np.sum(np.abs(spectrum) ** 2, axis=0)
    spectrum = spectrum / np.sqrt(np.maximum(power / (STANDS_OUT * surroundings(power)), 1.0))
    found = np.empty((DRAWS, samples, outputs))
    for draw in range(DRAWS):
        turn = np.exp(1j * random.uniform(0.0, 2 * np.pi, spectrum.shape[1]))
        # Noise has no mean; what mean there is may be the very thing that is looked for.
        turn[0] = 0.0
        found[draw] = np.resize(np.fft.irfft(spectrum * turn[None, :], n=length).T, (samples, outputs))
    return found
