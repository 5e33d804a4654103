"""Surrogates: residuals of the same spectrum with random phases."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float

from fitting.estimation.estimate import Fit, followed_error, lost
from fitting.estimation.projection import solved
from fitting.first_order.spectral_lines import without_lines
from fitting.record import Record

DRAWS = 200
"""Number of surrogates of the residual of each part of the data."""

PARTNERS = 5
"""Number of held-out surrogates paired with each training surrogate, which are independent. In total there are 1,000
draws, and the smallest possible p-value is 1/1001."""


class Surrogates(eqx.Module):
    """Residuals with the same spectra and cross-spectra and random phases.

    Attributes:
        spectrum: of each output's residual.
        turns: random phases of each surrogate.
        length: number of samples after which they repeat.
        counts: valid samples.
    """

    spectrum: Complex[np.ndarray, "outputs frequencies"]
    turns: Complex[np.ndarray, "draws frequencies"]
    length: int = eqx.field(static=True)
    counts: Bool[np.ndarray, "segments samples"]

    @classmethod
    def of(cls, fit: Fit, seed: int) -> "Surrogates":
        """Surrogates of a fit's whitened residual, in its segments with data that do not diverge."""
        random = np.random.default_rng(seed)
        weight = _used(fit)
        spectrum, length = _noise_spectrum(followed_error(fit)[weight].T)
        turns = np.stack([_turn(random, spectrum) for _ in range(DRAWS)])
        return cls(spectrum, turns, length, weight[: fit.pieces.sum()])

    def against(
        self, columns: Float[np.ndarray, "segments samples outputs columns"]
    ) -> Float[np.ndarray, "columns draws"]:
        """Inner product of each column with each surrogate, by Parseval's theorem: no surrogate is made."""
        from scipy.fft import rfft

        series = columns[self.counts]
        series, further = series[: self.length], series[self.length :]
        series[: len(further)] += further
        found: Any = rfft(series, axis=0, overwrite_x=True)
        across = _represented(self.length)[:, None] / self.length * np.einsum("of,foc->fc", self.spectrum, found.conj())
        return np.real(self.turns @ across).T


def chance_of_gain(before: Fit, after: Fit, seed: int) -> float:
    """p-value of a learned model's gain on held-out data, under noise of the residual's spectrum.

    Held-out data were not used for learning, however many candidates were searched. So the change of the error is
    fixed, and only the noise is random.

    Args:
        before: fit of the preceding model to held-out data, with fixed parameters.
        after: likewise, of the model with the learned term.
        seed: of the draws.
    """
    random = np.random.default_rng(seed)
    weight = _used(before) & _used(after)
    if not weight.any():
        return 1.0
    changed = (np.asarray(before.error) - np.asarray(after.error)) @ np.asarray(before.problem.whitening).T
    spectrum, length = _noise_spectrum(followed_error(before)[weight].T)
    series = changed[weight].T
    against = _represented(length) / length * np.sum(np.fft.rfft(series[:, :length]).conj() * spectrum, axis=0)
    draws = DRAWS * PARTNERS
    explained = np.array([float(np.real(against @ _turn(random, spectrum))) for _ in range(draws)])
    null = (explained - 0.5 * np.sum(series**2)) / weight.sum()
    return (1 + int(np.sum(null >= before.objective - after.objective))) / (1 + draws)


def _used(fit: Fit) -> Bool[np.ndarray, "segments samples"]:
    """Valid samples of the segments in which the simulation does not diverge; of all where it always does."""
    valid = np.asarray(fit.problem.segments.weight) > 0
    followed = valid & ~lost(fit)[:, None]
    return followed if followed.any() else valid


def _represented(length: int) -> Float[np.ndarray, " frequencies"]:
    """Number of frequencies that each one of a real series stands for: also its negative, except for zero, which is
    left out of noise, and the last one of an even number of samples."""
    twice = np.full(length // 2 + 1, 2.0)
    twice[-1] -= length % 2 == 0
    return twice


def _noise_spectrum(series: Float[np.ndarray, "outputs n"]) -> tuple[Complex[np.ndarray, "outputs frequencies"], int]:
    """The spectrum of residuals, and the number of samples.

    Lines are reduced: a significant line is not coloured noise, but may be caused by a periodic effect, which would
    explain it with any phase.
    """
    from scipy.fft import prev_fast_len

    length = int(prev_fast_len(series.shape[1], real=True) or 1)
    return without_lines(np.fft.rfft(series[:, :length])), length


def _turn(random: np.random.Generator, spectrum: np.ndarray) -> Complex[np.ndarray, " frequencies"]:
    """Random phases."""
    angle = random.uniform(0.0, 2 * np.pi, spectrum.shape[1])
    # Faster than a complex exponential.
    turn = np.cos(angle) + 1j * np.sin(angle)
    # Noise has zero mean; a nonzero mean may be caused by the missing effect.
    turn[0] = 0.0
    return turn


class Scores(Record):
    """Inner products of sensitivities, of residual and of surrogates.

    Attributes:
        gram: of the columns: first of free parameters, then of strengths.
        gradient: columns against the residual.
        surrogate_gradients: columns against each surrogate.
        square: of the residual.
        samples: number of valid ones, at least one.
    """

    gram: Float[np.ndarray, "columns columns"]
    gradient: Float[np.ndarray, " columns"]
    surrogate_gradients: Float[np.ndarray, "columns draws"]
    square: float
    samples: float

    @classmethod
    def of(
        cls,
        columns: Float[np.ndarray, "segments samples outputs columns"],
        weight: Float[np.ndarray, "segments samples"],
        residual: Float[np.ndarray, "segments samples outputs"],
        surrogates: Surrogates,
    ) -> "Scores":
        """From the whitened outputs' derivatives, the weight of each sample, residual and surrogates."""
        flat = columns.reshape(-1, columns.shape[-1])
        with np.errstate(over="ignore", invalid="ignore"):
            gram = flat.T @ flat
        # Where the model diverges in every segment, there are no valid samples.
        samples = max(float(np.sum(weight)), 1.0)
        error = residual.reshape(-1)
        return cls(gram, flat.T @ error, surrogates.against(columns), float(error @ error), samples)

    def joined(self, further: "Scores", across: Float[np.ndarray, "columns further"]) -> "Scores":
        """The scores of these columns and of further ones, on the same residual.

        Args:
            further: those of the further columns.
            across: inner products of the two.
        """
        return Scores(
            np.block([[self.gram, across], [across.T, further.gram]]),
            np.concatenate([self.gradient, further.gradient]),
            np.concatenate([self.surrogate_gradients, further.surrogate_gradients]),
            self.square,
            self.samples,
        )

    def columns(self, which: list[int]) -> "Scores":
        """The scores of some columns."""
        own = self.gram[np.ix_(which, which)], self.gradient[which], self.surrogate_gradients[which]
        return Scores(*own, self.square, self.samples)

    def beside_prior(self, off: Float[np.ndarray, " free"], slope: Float[np.ndarray, " free"]) -> "Scores":
        """With the priors of the first columns' parameters; surrogates are of the data alone.

        Args:
            off: deviation of each parameter from its prior mean, in standard deviations.
            slope: its derivative by the parameter; zero without a prior.
        """
        gram, gradient, own = self.gram.copy(), self.gradient.copy(), range(slope.size)
        gram[own, own] += slope**2
        gradient[: slope.size] -= slope * off
        return replace(self, gram=gram, gradient=gradient)

    def steps(
        self, gradient: Float[np.ndarray, "columns draws"], chosen: list[int]
    ) -> Float[np.ndarray, "columns draws"]:
        """Least-squares steps of the chosen columns, for each column of gradients; zero for the others."""
        found = np.zeros_like(gradient)
        found[chosen] = solved(self.gram[np.ix_(chosen, chosen)], gradient[chosen])
        return found

    def loss(
        self, step: Float[np.ndarray, "columns draws"], gradient: Float[np.ndarray, "columns draws"]
    ) -> Float[np.ndarray, " draws"]:
        """Change of the objective (half the log-determinant of the outputs' error covariance) by each column of a step.
        Whitened squares of each output sum to the number of samples."""
        return (np.sum(step * (self.gram @ step), axis=0) - 2 * np.sum(step * gradient, axis=0)) / (2 * self.samples)


def null_gains(fitted: Scores, unseen: Scores, known: int) -> Float[np.ndarray, " draws"]:
    """Gain of a least-squares step on held-out surrogates, relative to refitting the free parameters (the first
    columns): at most the whole residual, which the extrapolation of a curved law would exceed.

    Args:
        fitted: scores of the training data.
        unseen: scores of the held-out data.
        known: number of columns of free parameters.
    """
    steps = [fitted.steps(fitted.surrogate_gradients, list(range(count))) for count in (known, len(fitted.gram))]
    partners = np.subtract.outer(np.arange(DRAWS), np.arange(PARTNERS)).T.ravel() % DRAWS
    against = unseen.surrogate_gradients[:, partners]
    before, after = (unseen.loss(np.tile(step, PARTNERS), against) for step in steps)
    return np.minimum(before - after, unseen.square / (2 * unseen.samples))
