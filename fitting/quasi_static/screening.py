"""Screening of the catalogue: held-out gain of each form, and its null distribution.

The model is linear in the strengths. So cross-validation only needs inner products of regressors, residual and
surrogates for each fold, which takes a second for the whole catalogue and a thousand surrogates.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fitting.attribution.screening import Screen
from fitting.quasi_static.form import Form, Terms
from fitting.quasi_static.noise_colour import noise_of_the_same_colour
from fitting.quasi_static.points import Points
from fitting.quasi_static.stretches import FOLDS
from fitting.quasi_static.twist_model import TwistModel

# Columns with less than this share orthogonal to the model's are omitted.
_BLIND = 1e-3
_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class Lead:
    """One form, or two that may mask each other, at the best grid point.

    Attributes:
        terms: The form or forms, with their shape parameters.
        gain: Half the logarithm of the held-out mean square ratio without and with it.
    """

    terms: Terms
    gain: float

    @property
    def forms(self) -> tuple[Form, ...]:
        """The forms without their shape parameters."""
        return tuple(form for form, _ in self.terms)

    @property
    def families(self) -> tuple[str, ...]:
        """Families of the forms."""
        return tuple(form.family for form in self.forms)


def screen(
    points: Points, model: TwistModel, choices: Sequence[tuple[Form, ...]], fold: np.ndarray, seed: int
) -> Screen[Lead]:
    """Screen forms beside a fitted model.

    Args:
        points: The fitted points.
        model: Of these points; its shape parameters are free to first order.
        choices: Candidate forms, or combinations of several.
        fold: Number of the fold of each point, (n,).
        seed: Of the surrogates.
    """
    random = np.random.default_rng(seed)
    chance = [noise_of_the_same_colour(model.misfit[own], random) for own in points.logs]
    series = np.column_stack([model.misfit, np.concatenate(chance, axis=1).T])
    known = _orthonormal(model.jacobian)
    columns, places, count = [known], {}, known.shape[1]
    for form in dict.fromkeys(form for choice in choices for form in choice):
        for i, shape in enumerate(form.shapes):
            columns.append(_beside(known, form.columns(points, shape)))
            places[form, i] = range(count, count + columns[-1].shape[1])
            count += columns[-1].shape[1]
    products = _Products.of(np.column_stack(columns), series, fold)
    nuisance = range(known.shape[1])
    before, _ = products.held_out_loss([*nuisance])
    best, null_gains = {}, np.zeros(series.shape[1] - 1)
    for choice in choices:
        for grid in itertools.product(*(range(len(form.shapes)) for form in choice)):
            own = [place for form, i in zip(choice, grid, strict=True) for place in places[form, i]]
            loss, strengths = products.held_out_loss([*nuisance, *own])
            # Only the sign of single forms is constrained.
            wrong = choice[0].sign * strengths[len(nuisance)] < 0 if len(choice) == 1 else False
            gains = np.where(wrong, 0.0, 0.5 * np.log(before / np.maximum(loss, 1e-300)))
            null_gains = np.maximum(null_gains, gains[1:])
            if choice not in best or gains[0] > best[choice].gain:
                shapes = (form.shapes[i] for form, i in zip(choice, grid, strict=True))
                best[choice] = Lead(tuple(zip(choice, shapes, strict=True)), float(gains[0]))
    return Screen(tuple(sorted(best.values(), key=lambda lead: -lead.gain)), null_gains)


@dataclass(frozen=True, eq=False)
class _Products:
    """Inner products in each fold: of columns, of columns with series, and of series."""

    gram: np.ndarray
    against: np.ndarray
    squares: np.ndarray

    @classmethod
    def of(cls, columns: np.ndarray, series: np.ndarray, fold: np.ndarray) -> "_Products":
        parts = [(columns[fold == i], series[fold == i]) for i in range(FOLDS)]
        return cls(
            np.array([c.T @ c for c, _ in parts]),
            np.array([c.T @ s for c, s in parts]),
            np.array([np.sum(s**2, axis=0) for _, s in parts]),
        )

    def held_out_loss(self, own: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Sum of squares of each series on held-out folds with some columns, (series,), and the strengths from all
        folds, (columns, series)."""
        gram, against = self.gram[:, own][:, :, own], self.against[:, own]
        without = _solve(gram.sum(axis=0) - gram, against.sum(axis=0) - against)
        loss = self.squares + np.sum(without * (gram @ without - 2.0 * against), axis=1)
        return loss.sum(axis=0), _solve(gram.sum(axis=0), against.sum(axis=0))


def _solve(gram: np.ndarray, against: np.ndarray) -> np.ndarray:
    return np.linalg.pinv(gram, rcond=_RANK, hermitian=True) @ against


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns / np.where(norms > 0, norms, 1.0), full_matrices=False)
    return u[:, s > 1e-6 * s[0]]


def _beside(known: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Columns orthogonal to the known ones, of unit length; zero where hardly anything remains."""
    rest = columns - known @ (known.T @ columns)
    before, after = np.linalg.norm(columns, axis=0), np.linalg.norm(rest, axis=0)
    return rest * np.where(after > _BLIND * before, 1.0 / np.where(after > 0, after, 1.0), 0.0)
