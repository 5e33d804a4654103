"""What chance might have left over: residuals of the same colour, with random phases."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from fitting.estimation.estimate import Fit
from fitting.estimation.projection import solved
from fitting.first_order.spectral_lines import without_lines

DRAWS = 200
"""Surrogates of the residual of each part of the data."""

PARTNERS = 5
"""With how many of the unseen data each of the fitted data goes, which are independent of each other: in all they are
1,000 draws, and the smallest p-value that they can show is 1/1001."""


def surrogates(fit: Fit, seed: int) -> Float[np.ndarray, "draws segments rows"]:
    """Residuals with the same spectra and cross-spectra and random phases: noise of the residual's own colour."""
    from scipy.fft import irfft

    random = np.random.default_rng(seed)
    weight = np.asarray(fit.problem.segments.weight) > 0
    error = fit.white_error
    spectrum, length = _noise_spectrum(error[weight].T)
    place = (np.cumsum(weight).reshape(weight.shape) - 1) % length
    found = np.empty((DRAWS, *error.shape))
    for draw in range(DRAWS):
        surrogate: Any = irfft(spectrum * _turn(random, spectrum), n=length, overwrite_x=True, workers=-1)
        found[draw] = surrogate.T[place]
    found *= weight[..., None]
    return found.reshape(DRAWS, error.shape[0], -1)


def chance_of_gain(before: Fit, after: Fit, seed: int) -> float:
    """How often noise of the residual's own colour makes a learned model gain as much on unseen data.

    These had no part in what was learned, however many candidates were searched. So what it changes of the error is
    fixed, and only the noise is drawn anew.

    Args:
        before: fit of the model before to unseen data, its parameters held.
        after: likewise, of the model with what was learned.
        seed: of the draws.
    """
    random = np.random.default_rng(seed)
    weight = np.asarray(before.problem.segments.weight) > 0
    changed = (np.asarray(before.error) - np.asarray(after.error)) @ np.asarray(before.problem.whitening).T
    spectrum, length = _noise_spectrum(before.white_error[weight].T)
    series = changed[weight].T
    # Frequencies stand for their mirror images as well.
    against = 2.0 / length * np.sum(np.fft.rfft(series[:, :length]).conj() * spectrum, axis=0)
    draws = DRAWS * PARTNERS
    explained = np.array([float(np.real(against @ _turn(random, spectrum))) for _ in range(draws)])
    null = (explained - 0.5 * np.sum(series**2)) / weight.sum()
    return (1 + int(np.sum(null >= before.objective - after.objective))) / (1 + draws)


def _noise_spectrum(series: Float[np.ndarray, "outputs n"]) -> tuple[Complex[np.ndarray, "outputs frequencies"], int]:
    """The spectrum of residuals, and of how many samples.

    A line that stands out of its surroundings is no colour of noise, but what a periodic effect would leave: with a
    phase of its own it would still be explained by that effect.
    """
    from scipy.fft import prev_fast_len

    length = int(prev_fast_len(series.shape[1], real=True) or 1)
    return without_lines(np.fft.rfft(series[:, :length])), length


def _turn(random: np.random.Generator, spectrum: np.ndarray) -> Complex[np.ndarray, " frequencies"]:
    """Random phases."""
    turn = np.exp(1j * random.uniform(0.0, 2 * np.pi, spectrum.shape[1]))
    # Noise has no mean; what mean there is may be the very thing that is looked for.
    turn[0] = 0.0
    return turn


class Scores(eqx.Module):
    """Inner products of sensitivities with each other, with the residual, and with its surrogates.

    Attributes:
        gram: of the columns: of what was free already, then of strengths.
        gradient: columns against the residual.
        surrogate_gradients: columns against each surrogate.
        samples: with weight, at least one.
    """

    gram: Float[np.ndarray, "columns columns"]
    gradient: Float[np.ndarray, " columns"]
    surrogate_gradients: Float[np.ndarray, "columns draws"]
    samples: float

    @classmethod
    def of(
        cls,
        columns: Float[np.ndarray, "segments samples outputs columns"],
        weight: Float[np.ndarray, "segments samples"],
        residual: Float[np.ndarray, "segments samples outputs"],
        surrogates: Float[np.ndarray, "draws segments rows"],
    ) -> "Scores":
        """Of the whitened outputs' derivatives, the weight of each sample, and what is to be explained."""
        flat = columns.reshape(-1, columns.shape[-1])
        # Where the model runs away in every segment, nothing is told.
        samples = max(float(np.sum(weight)), 1.0)
        against = (surrogates.reshape(len(surrogates), -1) @ flat).T
        return cls(flat.T @ flat, flat.T @ residual.reshape(-1), against, samples)

    def columns(self, which: list[int]) -> "Scores":
        """Those of some columns alone."""
        own = self.gram[np.ix_(which, which)], self.gradient[which], self.surrogate_gradients[which]
        return Scores(*own, self.samples)

    def steps(
        self, gradient: Float[np.ndarray, "columns draws"], chosen: list[int]
    ) -> Float[np.ndarray, "columns draws"]:
        """Least squares over the chosen columns, for each column of gradients; zero for the other ones."""
        found = np.zeros_like(gradient)
        found[chosen] = solved(self.gram[np.ix_(chosen, chosen)], gradient[chosen])
        return found

    def loss(
        self, step: Float[np.ndarray, "columns draws"], gradient: Float[np.ndarray, "columns draws"]
    ) -> Float[np.ndarray, " draws"]:
        """Change of the objective by a step, for each column of it: half the log-determinant of the covariance of the
        outputs' errors, whose whitened squares add up to the number of samples for each output."""
        return (np.sum(step * (self.gram @ step), axis=0) - 2 * np.sum(step * gradient, axis=0)) / (2 * self.samples)


def null_gains(fitted: Scores, unseen: Scores, known: int) -> Float[np.ndarray, " draws"]:
    """What a least-squares step gains on unseen surrogates beyond refitting what was free already, the first columns.

    Args:
        fitted: scores of the data that are fitted.
        unseen: likewise of unseen data.
        known: how many columns were free already.
    """
    steps = [fitted.steps(fitted.surrogate_gradients, list(range(count))) for count in (known, len(fitted.gram))]
    partners = [np.roll(unseen.surrogate_gradients, shift, axis=1) for shift in range(PARTNERS)]
    before, after = (np.concatenate([unseen.loss(step, partner) for partner in partners]) for step in steps)
    return before - after
