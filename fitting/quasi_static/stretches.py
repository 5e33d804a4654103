"""Nearly uncorrelated stretches of a log, the units of cross-validation and tests."""

import math

import numpy as np

from fitting.attribution.decisions import tie
from fitting.estimation.whiteness import autocovariance

FOLDS = 5


def correlation_length(residual: np.ndarray) -> float:
    """Correlation length of residuals in blocks: one plus twice the sum of their autocorrelation."""
    size = len(residual)
    covariance = autocovariance(residual - np.mean(residual), size // 2 - 1)
    if covariance[0] <= 0:
        return 1.0
    rho = covariance / covariance[0]
    # Up to where it vanishes; the sum over all lags of a series only depends on its mean.
    until = np.argmax(np.append(rho, -1.0) < 2.0 / math.sqrt(size))
    return max(1.0, 1.0 + 2.0 * float(np.sum(rho[1:until])))


def stretches(residual: np.ndarray, log: np.ndarray, *, each: int = 1) -> np.ndarray:
    """Runs of blocks so long that residuals of different runs are nearly uncorrelated.

    Args:
        residual: Of a fit, (n,).
        log: Number of the log of each block, (n,); no run crosses into another log.
        each: Least number of runs in a log.

    Returns:
        Number of the run of each block, (n,); at least `FOLDS` runs.
    """
    length = math.ceil(max(4.0, 6.0 * correlation_length(residual)))
    numbers, count = np.zeros(len(residual), dtype=int), 0
    logs = int(log[-1]) + 1
    for i in range(logs):
        own = np.flatnonzero(log == i)
        runs = max(each, math.ceil(FOLDS / logs), len(own) // length)
        numbers[own] = count + np.arange(len(own)) * runs // len(own)
        count += runs
    return numbers


def folds(stretch: np.ndarray) -> np.ndarray:
    """Number of the fold of each block, (n,), from the numbers of their stretches."""
    count = int(stretch[-1]) + 1
    # Random, since regular folds could omit the same torque in every cycle.
    return np.random.default_rng(0).permutation(np.arange(count) % FOLDS)[stretch]


def worse(one: np.ndarray, other: np.ndarray, stretch: np.ndarray, noise: float) -> bool:
    """Whether the first held-out misfit is significantly above the second, paired over stretches.

    A difference of less than a hundredth of the noise variance does not count: rounding would decide between exact
    fits.
    """
    excess = np.bincount(stretch, one**2 - other**2)
    return not tie("", excess).holds and float(np.sum(excess)) > 0.01 * noise**2 * len(one)
