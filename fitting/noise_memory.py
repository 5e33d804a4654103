"""Noise with a memory: whether what is left over is that, and how large it is.

Short segments, whose initial states are fitted, leave less of it than there is; pieces of half a period leave little of
what is slow. Whole stretches leave it all, and there it differs from what is missing in two ways. It does not add up,
as a torque does that moves the drive ever farther. And it is made of relaxations, whose autocovariance is convex in its
logarithm: motion, which is smooth and swings, bends the other way.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.attribution.decisions import RULES
from fitting.autocorrelation import autocovariance, basis_of_states
from fitting.estimate import Fit, half_log_determinant
from fitting.long_fit import follows, over_whole_stretches, with_gaps_closed

# Draws of such noise: what bends less than all of so many does hardly so by chance. Samples until a draw has forgotten
# its start.
_DRAWS = 99
_START = 2000
# The longest memory that is told from a drift [samples].
_LONGEST = 1000.0
# Lags over which the autocovariance is looked at, where it is still this share of its slow part's variance.
_LAGS, _SHARE = 1024, 0.5


class NoiseWithMemory(eqx.Module):
    """Noise of the outputs, each the sum of a white part and of one whose correlation decays by a constant share from
    sample to sample.

    Attributes:
        covariance: of the outputs.
        white: share of each output's variance that is white.
        correlation: of neighbouring samples of the other part.
    """

    covariance: Float[Array, "outputs outputs"]
    white: Float[np.ndarray, " outputs"]
    correlation: Float[np.ndarray, " outputs"]

    def memory(self, time_step: float) -> float:
        """Time [s] after which the slow part of the noise has forgotten all but 1/e; of the slowest output."""
        slowest = float(self.correlation.max())
        return time_step / -float(np.log(slowest)) if slowest > 0 else 0.0


def noise_with_memory(found: Fit) -> NoiseWithMemory | None:
    """What a model leaves over as such noise; None where it is something else: the model does not follow whole
    stretches, leaves more there than such noise would beyond what the initial states of short segments take off, or
    leaves what swings.

    What relaxes as the noise does and hardly moves the drive (creep, say) can't be told from it; ask what can be
    learned first.

    Args:
        found: a fit over short horizons.
    """
    whole = over_whole_stretches(found)
    if not follows(whole):
        return None
    error = np.asarray(whole.error)[np.asarray(whole.problem.segments.weight) > 0]
    noise = _described(error)
    segments, samples = found.problem.segments.weight.shape
    drawn = _drawn(noise, segments * samples)
    if _swings(error, drawn[:, : len(error)]):
        return None
    if with_gaps_closed(whole) > found.objective + _taken_by_states(found, drawn) + RULES.whole_stretches:
        return None
    return noise


def _described(error: Float[np.ndarray, "samples outputs"]) -> NoiseWithMemory:
    """An error as such noise, from its autocovariance at the first two lags."""
    none, one, two = _autocovariance(error, 2).T
    positive = (one > 0) & (two > 0)
    correlation = np.divide(two, one, out=np.zeros_like(one), where=positive)
    correlation = np.clip(correlation, 0.0, np.exp(-1.0 / _LONGEST))
    slow = np.divide(one, correlation * none, out=np.zeros_like(one), where=correlation > 0)
    return NoiseWithMemory(jnp.asarray(error.T @ error / len(error)), 1.0 - np.minimum(slow, 1.0), correlation)


def _swings(error: Float[np.ndarray, "samples outputs"], drawn: Float[np.ndarray, "draws samples outputs"]) -> bool:
    """Whether the autocovariance of an error bends as that of relaxations does not, and less than that of any draw."""
    by_chance = np.min([_convexity(draw) for draw in drawn], axis=0)
    return bool(np.any(_convexity(error) < np.minimum(by_chance, RULES.convexity)))


def _convexity(error: Float[np.ndarray, "samples outputs"]) -> Float[np.ndarray, " outputs"]:
    """Least ratio of the product of the autocovariances at lags 1 and 2m - 1 to the square of that at m, which lies
    half-way: 1 for one relaxation, more for several, less for what swings. 1 where there is nothing slow."""
    lags = min(_LAGS, len(error) // 4)
    found = _autocovariance(error, lags)
    least = np.ones(len(found))
    for i, values in enumerate(found):
        m = 2
        while 2 * m - 1 <= lags and values[m] > _SHARE * values[1] > 0:
            least[i] = min(least[i], values[1] * values[2 * m - 1] / values[m] ** 2)
            m *= 2
    return least


def _autocovariance(error: Float[np.ndarray, "samples outputs"], lags: int) -> Float[np.ndarray, "outputs lags"]:
    return autocovariance((error - error.mean(axis=0)).T, lags)


def _taken_by_states(found: Fit, drawn: Float[np.ndarray, "draws samples outputs"]) -> float:
    """By how much fitting the initial states of short segments lowers the objective over nothing but noise."""
    weight = np.asarray(found.problem.segments.weight) > 0
    basis, chain = basis_of_states(found)
    white = drawn @ np.asarray(found.problem.whitening).T
    white = white.reshape(len(white), *weight.shape, -1) * weight[..., None]
    rows = white.reshape(*white.shape[:2], -1)
    fitted = np.zeros((int(chain[-1]) + 1, len(rows), basis.shape[-1]))
    np.add.at(fitted, chain, np.einsum("srk,dsr->sdk", basis, rows))
    left = (rows - np.einsum("srk,sdk->dsr", basis, fitted[chain])).reshape(white.shape)
    before, after = (half_log_determinant(jnp.einsum("dsni,dsnj->ij", e, e)) for e in (white, left))
    return before - after


def _drawn(noise: NoiseWithMemory, count: int) -> Float[np.ndarray, "draws samples outputs"]:
    # Loaded here: it takes as long as jax, and only noise with a memory needs it.
    from scipy.signal import lfilter

    random = np.random.default_rng(0)
    together = np.linalg.cholesky(np.asarray(noise.covariance)).T
    white = random.normal(size=(_DRAWS, count, len(together))) @ together
    pushed = random.normal(size=(_DRAWS, count + _START, len(together))) @ together
    slow = np.empty_like(white)
    for i, r in enumerate(noise.correlation):
        slow[..., i] = np.asarray(lfilter([np.sqrt(1.0 - r**2)], [1.0, -r], pushed[..., i], axis=1))[:, _START:]
    return np.sqrt(noise.white) * white + np.sqrt(1.0 - noise.white) * slow
