"""Strongest spectral lines of a residual: starting values for frequencies that are not orders of a shaft."""

import numpy as np
from jaxtyping import Float

from fitting.estimation.estimate import Fit, followed_error

# Largest number of lines.
_MOST = 3
# Neighbouring frequencies of the median that a line must exceed.
_NEIGHBOURS = 41
# Least distance of two lines, in frequencies: the width of a line under the window.
_APART = 8
# Least power of a line over that median: among 10,000 frequencies of noise the largest is about 10 times the mean.
STANDS_OUT = 15.0
"""Least power of a line over the median of its surroundings."""


def spectral_lines(fit: Fit) -> tuple[float, ...]:
    """Frequencies [rad/s] of the strongest lines in the residual, strongest first.

    The periodogram of the longest stretch's whitened residual (Hann window), summed over the outputs and divided by the
    median of its surroundings, so that coloured noise and the drive's resonance are not taken for lines.

    Args:
        fit: a fit.
    """
    # Invalid samples of the longest stretch are zero, and segments in which the simulation diverges.
    pairs = zip(fit.stretches, fit.by_stretch(followed_error(fit)), strict=True)
    stretch, series = max(reversed([*pairs]), key=lambda pair: len(pair[1]))
    count = series.shape[0]
    if count < 4 * _NEIGHBOURS:
        return ()
    window = np.hanning(count)[:, None]
    # Zero padding to twice the length: the nearest grid frequency is then at most a quarter of a step away.
    power = np.sum(np.abs(np.fft.rfft(series * window, n=2 * count, axis=0)) ** 2, axis=1)
    around = surroundings(power, neighbours=_NEIGHBOURS)
    ratio = power / around
    # The lowest frequencies are drift, not lines: fewer than two periods in the log.
    ratio[:4] = 0.0
    peaks = _peaks(ratio)
    strongest = peaks[np.argsort(power[peaks] - around[peaks])[::-1][:_MOST]]
    step = stretch.experiment.time_step
    return tuple((2.0 * np.pi * ((strongest + off_the_grid(power, strongest)) / (2 * count * step))).tolist())


def _peaks(ratio: np.ndarray) -> np.ndarray:
    """Indices of significant maxima, the higher one of any two that are close; in rising order."""
    inner = ratio[1:-1]
    found = np.flatnonzero((inner > ratio[:-2]) & (inner > ratio[2:]) & (inner >= STANDS_OUT)) + 1
    kept: list[int] = []
    for place in found[np.argsort(-ratio[found])].tolist():
        if all(abs(place - other) >= _APART for other in kept):
            kept.append(place)
    return np.array(sorted(kept), dtype=int)


def surroundings(power: Float[np.ndarray, " n"], *, neighbours: int = _NEIGHBOURS // 2) -> Float[np.ndarray, " n"]:
    """The median of a periodogram around each frequency: the noise spectrum without lines.

    Args:
        power: of a series without padding.
        neighbours: on each side.
    """
    from scipy.ndimage import median_filter

    return np.maximum(median_filter(power, size=2 * neighbours, mode="nearest"), 1e-300)


def without_lines(spectrum: np.ndarray) -> np.ndarray:
    """A spectrum with lines reduced to the largest value plausible for the surrounding noise.

    A significant line is not coloured noise, but may be caused by a periodic effect.

    Args:
        spectrum: of one series or of several, (n,) or (series, n); lines are searched in the sum of powers.
    """
    power = np.sum(np.abs(np.atleast_2d(spectrum)) ** 2, axis=0)
    return spectrum / np.sqrt(np.maximum(power / (STANDS_OUT * surroundings(power)), 1.0))


def off_the_grid(power: Float[np.ndarray, " n"], peaks: np.ndarray) -> np.ndarray:
    """Distance of each line from its highest grid frequency: the vertex of the parabola through the logarithms.
    Held-out data come later in time, where a frequency error has become a phase error."""
    inner = np.clip(peaks, 1, power.size - 2)
    left, top, right = (np.log(np.maximum(power[inner + k], 1e-300)) for k in (-1, 0, 1))
    curvature = np.minimum(left - 2 * top + right, -1e-12)
    return np.clip(0.5 * (left - right) / curvature, -0.5, 0.5)
