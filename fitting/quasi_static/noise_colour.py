"""Surrogates of the residual: noise of the same spectrum from an autoregressive process.

Surrogates with random phases are periodic, which slow noise is not; p-values of slow effects would be too small.
"""

import numpy as np
from scipy.fft import prev_fast_len
from scipy.signal import lfilter

from fitting.first_order.spectral_lines import STANDS_OUT, off_the_grid, surroundings, without_lines

DRAWS = 999
"""Number of surrogates: enough to determine a p-value of 0.01 accurately."""

_HIGHEST_ORDER = 30
_MOST_LINES = 20
# Frequencies on each side with which a line is compared; below as many, slow noise may look like a line.
_NEIGHBOURS = 20
# Largest length of the discarded start-up of the process, and the share of its impulse response that may remain.
_WARM_UP, _REMAINS = 2000, 1e-3


def noise_of_the_same_colour(residual: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Draws of Gaussian noise with the spectrum of a residual, (draws, n).

    Significant spectral lines are reduced first: they are not noise, but may be caused by a periodic effect.

    Args:
        residual: In order of time, evenly spaced or nearly, (n,).
        random: Generator.
    """
    length = prev_fast_len(len(residual), real=True)
    series = _less_sinusoids((residual - np.mean(residual))[:length])
    series = np.fft.irfft(without_lines(np.fft.rfft(series)), n=length)
    coefficients, variance = autoregression(series)
    response = np.abs(lfilter([1.0], coefficients, np.eye(1, _WARM_UP)[0]))
    warm_up = 1 + int(np.flatnonzero(response > _REMAINS * np.max(response))[-1])
    innovations = random.normal(size=(DRAWS, warm_up + len(residual))) * np.sqrt(variance)
    return np.asarray(lfilter([1.0], coefficients, innovations, axis=1))[:, warm_up:]


def _less_sinusoids(series: np.ndarray) -> np.ndarray:
    """A series less the sinusoids of its significant lines, (n,).

    They are found under a window: without one, a line between grid frequencies leaks and would count as noise around
    it.
    """
    count, waves, left = len(series), [], series
    at, window = np.arange(count), np.hanning(count)
    for _ in range(_MOST_LINES if count > 4 * _NEIGHBOURS else 0):
        power = np.abs(np.fft.rfft(window * left, n=2 * count)) ** 2
        ratio = power / surroundings(power, neighbours=_NEIGHBOURS)
        peak = _NEIGHBOURS + int(np.argmax(ratio[_NEIGHBOURS:]))
        if ratio[peak] < STANDS_OUT:
            break
        (place,) = peak + off_the_grid(power, np.array([peak]))
        waves += [turn(np.pi * place / count * at) for turn in (np.cos, np.sin)]
        matrix = np.column_stack(waves)
        left = series - matrix @ np.linalg.lstsq(matrix, series, rcond=1e-9)[0]
    return left


def autoregression(series: np.ndarray) -> tuple[np.ndarray, float]:
    """The autoregressive process of a series, its order chosen by Akaike's criterion.

    Args:
        series: Of mean zero, (n,).

    Returns:
        Coefficients of the prediction error filter, the first of them 1, and the variance of its output.

    References:
        Burg 1975, Maximum entropy spectral analysis (thesis, Stanford); Akaike 1974, IEEE Trans. Autom. Control 19(6).
    """
    size = len(series)
    forwards, backwards = series[1:].copy(), series[:-1].copy()
    filter_, variance = np.ones(1), float(np.mean(series**2))
    best, least = (filter_, variance), size * np.log(max(variance, 1e-300))
    for order in range(1, min(_HIGHEST_ORDER, size // 10) + 1):
        power = float(forwards @ forwards + backwards @ backwards)
        if power <= 0.0:
            break
        reflection = -2.0 * float(forwards @ backwards) / power
        longer = np.append(filter_, 0.0)
        filter_ = longer + reflection * longer[::-1]
        variance *= 1.0 - reflection**2
        forwards, backwards = (forwards + reflection * backwards)[1:], (backwards + reflection * forwards)[:-1]
        criterion = size * np.log(max(variance, 1e-300)) + 2.0 * order
        if criterion < least:
            best, least = (filter_, variance), criterion
    return best
