"""Stretches of a log that hardly know of each other: the unit in which evidence is counted."""

import math

import numpy as np

FOLDS = 5


def correlation_length(residual: np.ndarray) -> float:
    """Blocks over which residuals resemble each other: one and twice the sum of their autocorrelation."""
    centred = residual - np.mean(residual)
    size = len(centred)
    spectrum = np.abs(np.fft.rfft(centred, 2 * size)) ** 2
    covariance = np.fft.irfft(spectrum)[: size // 2]
    if covariance[0] <= 0:
        return 1.0
    rho = covariance / covariance[0]
    faded = np.flatnonzero(rho < 2.0 / math.sqrt(size))
    until = int(faded[0]) if len(faded) else len(rho)
    return max(1.0, 1.0 + 2.0 * float(np.sum(rho[1:until])))


def stretches(residual: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Runs of blocks so long that residuals of different runs hardly know of each other.

    Args:
        residual: Of a fit, (n,).
        log: Number of the log of each block, (n,); no run crosses into another log.

    Returns:
        Number of the run of each block, (n,); at least `FOLDS` runs.
    """
    length = math.ceil(max(4.0, 6.0 * correlation_length(residual)))
    numbers, count = np.zeros(len(residual), dtype=int), 0
    logs = int(log[-1]) + 1
    for i in range(logs):
        own = np.flatnonzero(log == i)
        runs = max(math.ceil(FOLDS / logs), len(own) // length)
        numbers[own] = count + np.arange(len(own)) * runs // len(own)
        count += runs
    return numbers
