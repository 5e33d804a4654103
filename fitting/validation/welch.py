"""Welch's spectral densities in numpy, since importing scipy.signal takes too long."""

import numpy as np
from jaxtyping import Complex, Float


def cross_density(
    one: Float[np.ndarray, " n"], other: Float[np.ndarray, " n"], *, step: float, window: int
) -> tuple[Float[np.ndarray, " lines"], Complex[np.ndarray, " lines"]]:
    """One-sided cross spectral density of two series (Welch 1967), with Hann windows that overlap by half and are
    detrended by their mean.

    Args:
        one: its spectrum is conjugated.
        other: sampled together with `one`; the density of a series with itself is real.
        step: sampling interval [s].
        window: samples in a window, at most `n`.

    Returns:
        Frequencies [Hz], and densities in the series' units by Hz.
    """
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(window) / window)
    hop = window - window // 2

    def spectra(series: np.ndarray) -> np.ndarray:
        parts = np.lib.stride_tricks.sliding_window_view(series, window)[::hop]
        return np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * hann, axis=1)

    density = np.mean(np.conj(spectra(one)) * spectra(other), axis=0) * (2.0 * step / np.sum(hann**2))
    # Lines without a negative counterpart.
    density[0] *= 0.5
    if window % 2 == 0:
        density[-1] *= 0.5
    return np.fft.rfftfreq(window, step), density


def density(
    series: Float[np.ndarray, " n"], *, step: float, window: int
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """One-sided power spectral density; arguments as in [`cross_density`][]."""
    frequency, found = cross_density(series, series, step=step, window=window)
    return frequency, np.real(found)
