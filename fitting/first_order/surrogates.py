"""What chance might have left over: residuals of the same colour, with random phases."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.estimation.estimate import Fit
from fitting.estimation.projection import solved
from fitting.first_order.spectral_lines import without_lines

DRAWS = 199
"""Surrogate residuals; the smallest p-value that they can show is 1/200."""


def surrogates(fit: Fit, seed: int) -> Float[np.ndarray, "draws segments rows"]:
    """Residuals with the same spectra and cross-spectra and random phases: noise of the residual's own colour.

    A line that stands out of its surroundings is no colour of noise, but what a periodic effect would leave: with a
    phase of its own it would still be explained by that effect.
    """
    from scipy.fft import irfft, prev_fast_len

    random = np.random.default_rng(seed)
    weight = np.asarray(fit.problem.segments.weight) > 0
    error = fit.white_error
    series = error[weight].T
    length = int(prev_fast_len(series.shape[1], real=True) or 1)
    spectrum = without_lines(np.fft.rfft(series[:, :length]))
    place = (np.cumsum(weight).reshape(weight.shape) - 1) % length
    found = np.empty((DRAWS, *error.shape))
    for draw in range(DRAWS):
        turn = np.exp(1j * random.uniform(0.0, 2 * np.pi, spectrum.shape[1]))
        # Noise has no mean; what mean there is may be the very thing that is looked for.
        turn[0] = 0.0
        surrogate: Any = irfft(spectrum * turn[None, :], n=length, overwrite_x=True, workers=-1)
        found[draw] = surrogate.T[place]
    found *= weight[..., None]
    return found.reshape(DRAWS, error.shape[0], -1)


class Scores(eqx.Module):
    """Inner products of sensitivities with each other, with the residual, and with its surrogates.

    Attributes:
        gram: of the columns: of what was free already, then of strengths.
        gradient: columns against the residual.
        surrogate_gradients: columns against each surrogate.
        rows: number of measured values, at least one.
    """

    gram: Float[np.ndarray, "columns columns"]
    gradient: Float[np.ndarray, " columns"]
    surrogate_gradients: Float[np.ndarray, "columns draws"]
    rows: float

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
        rows = max(float(np.sum(weight)) * residual.shape[-1], 1.0)
        against = (surrogates.reshape(len(surrogates), -1) @ flat).T
        return cls(flat.T @ flat, flat.T @ residual.reshape(-1), against, rows)

    def columns(self, which: list[int]) -> "Scores":
        """Those of some columns alone."""
        own = self.gram[np.ix_(which, which)], self.gradient[which], self.surrogate_gradients[which]
        return Scores(*own, self.rows)

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
        """Change of the objective by a step, for each column of it."""
        return (np.sum(step * (self.gram @ step), axis=0) - 2 * np.sum(step * gradient, axis=0)) / (2 * self.rows)


def null_gains(fitted: Scores, unseen: Scores, known: int) -> Float[np.ndarray, " draws"]:
    """What a least-squares step gains on unseen surrogates beyond refitting what was free already, the first columns.

    Args:
        fitted: scores of the data that are fitted.
        unseen: likewise of unseen data.
        known: how many columns were free already.
    """
    before, after = (
        unseen.loss(fitted.steps(fitted.surrogate_gradients, list(range(count))), unseen.surrogate_gradients)
        for count in (known, len(fitted.gram))
    )
    return before - after
