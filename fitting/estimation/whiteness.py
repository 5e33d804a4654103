"""Autocorrelation of the residual dynamic error, corrected for the fitted initial states."""

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtrc

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit
from fitting.estimation.projection import FirstStates

# Singular values below this share: weakly observable directions of a chain's initial state.
_BLIND = 1e-12
# Derivatives beyond this overflow when squared.
_NO_SLOPE = 1e150


def left_over(fit: Fit) -> Float[np.ndarray, " samples"]:
    """Residual of the dynamic error at all valid samples, in order."""
    return np.asarray(fit.error)[..., -1][np.asarray(fit.problem.segments.weight) > 0]


def autocovariance(values: Float[np.ndarray, "*rows n"], lags: int) -> Float[np.ndarray, "*rows lags"]:
    """Sum over samples of `values[t] * values[t + k]`, for k from 0 to `lags`."""
    length = values.shape[-1] + lags
    transform = np.fft.rfft(values, length)
    return np.fft.irfft(np.abs(transform) ** 2, length)[..., : lags + 1]


def autocorrelation(fit: Fit, lags: int) -> Float[np.ndarray, " lags"]:
    """Autocorrelation of a fit's residual dynamic error, at lags from 0 to `lags` samples.

    Fitted initial states change the autocorrelation of white noise e: with P the projection on their sensitivities, it
    becomes (1 - P) e, whose autocovariance is known. It is subtracted, so that white noise appears white also on short
    segments.
    """
    residual = left_over(fit)
    found = autocovariance(residual - residual.mean(), lags)
    if found[0] <= 0:
        return found
    taken = _taken_by_states(fit, lags)
    # The residual variance is smaller than the noise variance by the removed part.
    share = min(taken[0] / found[0], 0.9)
    corrected = found + taken / (1.0 - share)
    return corrected / corrected[0]


def ljung_box(autocorrelation: Float[np.ndarray, " lags"], samples: int) -> tuple[float, float]:
    """The statistic of Ljung and Box (1978), and its p-value under white noise.

    Args:
        autocorrelation: at lags 1, 2, ...
        samples: number of samples that it was estimated from.
    """
    lags = np.arange(1, autocorrelation.size + 1)
    statistic = float(samples * (samples + 2) * np.sum(autocorrelation**2 / (samples - lags)))
    return statistic, float(chdtrc(lags.size, statistic))


def _taken_by_states(fit: Fit, lags: int) -> np.ndarray:
    """Autocovariance removed by the fitted initial states from white noise of the residual's size."""
    first = np.linalg.inv(np.asarray(fit.problem.whitening))[-1]
    weight = np.asarray(fit.problem.segments.weight) > 0
    segments, samples = weight.shape
    basis, chain = basis_of_states(fit)
    # From whitened outputs back to the dynamic error.
    error = np.einsum("o,snok->snk", first, basis.reshape(segments, samples, first.shape[0], -1))[weight]
    owner = np.repeat(chain, samples).reshape(segments, samples)[weight]
    place = np.arange(owner.size) - np.searchsorted(owner, owner)
    apart = np.zeros((int(owner[-1]) + 1, error.shape[1], int(place.max()) + 1))
    apart[owner, :, place] = error
    return autocovariance(apart, lags).sum(axis=(0, 1))


def basis_of_states(fit: Fit) -> tuple[Float[np.ndarray, "segments rows directions"], Int[np.ndarray, " segments"]]:
    """Orthonormal basis of the fitted initial states' effect on whitened outputs, and the simulation (chain of joined
    segments) of each segment.

    Each chain's columns are orthonormal over its rows and those of its hidden states' prior.
    """
    problem = fit.at_solution
    slopes = FirstStates.of(linearise(problem, fit.unknowns), problem.segments.joined).by_first
    chain = np.cumsum(~np.asarray(problem.segments.joined)) - 1
    return _orthonormal(slopes, chain)[:, : np.asarray(problem.segments.measured)[0].size], chain


def _orthonormal(slopes: np.ndarray, chain: np.ndarray) -> np.ndarray:
    """Columns that span the same as those of each chain, orthonormal over its rows."""
    # A diverged simulation has no usable derivatives.
    slopes = np.where(np.abs(slopes) < _NO_SLOPE, slopes, 0.0)
    count = int(chain[-1]) + 1
    square = np.zeros((count, *slopes.shape[2:] * 2))
    np.add.at(square, chain, np.einsum("srp,srq->spq", slopes, slopes))
    size = np.sqrt(np.einsum("cpp->cp", square))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    values, vectors = np.linalg.eigh(square * scale[:, :, None] * scale[:, None, :])
    root = np.divide(1.0, np.sqrt(np.maximum(values, _BLIND)), out=np.zeros_like(values), where=values > _BLIND)
    return np.einsum("srp,spq->srq", slopes, (scale[:, :, None] * vectors * root[:, None, :])[chain])
