"""What each form of the catalogue would gain on stretches that the fit has not seen, and what chance would gain.

Everything is linear in the strengths, so that inner products of columns, residual and surrogates, one set for each
fold, hold all that cross-validation needs: the whole catalogue is looked at under a thousand surrogates in a second.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fitting.quasi_static.form import Form
from fitting.quasi_static.noise_colour import noise_of_the_same_colour
from fitting.quasi_static.points import Points
from fitting.quasi_static.stretches import FOLDS
from fitting.quasi_static.twist_model import TwistModel

# Columns of which so little is beside those that the model has already can't be seen.
_BLIND = 1e-3
_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class Lead:
    """One form, or two that may hide each other, at the grid point that suits best.

    Attributes:
        forms: The form or forms.
        shapes: Shape parameters of each.
        gain: Half the logarithm of the held-out mean square without over that with it.
    """

    forms: tuple[Form, ...]
    shapes: tuple[np.ndarray, ...]
    gain: float

    @property
    def families(self) -> tuple[str, ...]:
        """Of the forms."""
        return tuple(form.family for form in self.forms)

    @property
    def name(self) -> str:
        """Of the forms."""
        return " and ".join(form.name for form in self.forms)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(form.size for form in self.forms)


@dataclass(frozen=True, eq=False)
class Screen:
    """A look at the whole catalogue.

    Attributes:
        leads: Each choice at its best, best first.
        null_gains: The best gain over all choices and shapes in each surrogate, (draws,).
    """

    leads: tuple[Lead, ...]
    null_gains: np.ndarray

    def p_value(self, gain: float) -> float:
        """How often chance alone makes the best of the catalogue at least this good."""
        return (1 + int(np.sum(self.null_gains >= gain))) / (1 + len(self.null_gains))


def screen(
    points: Points, model: TwistModel, choices: Sequence[tuple[Form, ...]], fold: np.ndarray, seed: int
) -> Screen:
    """Look at forms beside a fitted model.

    Args:
        points: That were fitted.
        model: Of these points; its shape parameters move along to first order.
        choices: Forms, or several together, to look at.
        fold: Number of the fold of each point, (n,).
        seed: Of the surrogates.
    """
    random = np.random.default_rng(seed)
    chance = [noise_of_the_same_colour(model.misfit[own], random) for own in points.logs]
    series = np.column_stack([model.misfit, np.concatenate(chance, axis=1).T])
    known = _orthonormal(model.jacobian)
    forms = dict.fromkeys(form for choice in choices for form in choice)
    columns = {form: [_beside(known, form.columns(points, shape)) for shape in form.shapes] for form in forms}
    products = _Products.of(np.column_stack([known, *(c for own in columns.values() for c in own)]), series, fold)
    seats, first = {}, known.shape[1]
    for form, own in columns.items():
        seats[form] = [np.arange(first + i * c.shape[1], first + (i + 1) * c.shape[1]) for i, c in enumerate(own)]
        first += sum(c.shape[1] for c in own)
    tried = [
        (choice, grid) for choice in choices for grid in itertools.product(*(range(len(f.shapes)) for f in choice))
    ]
    chosen = [np.concatenate([seats[f][i] for f, i in zip(*one, strict=True)]) for one in tried]
    nuisance = np.arange(known.shape[1])
    before = products.held_out_loss(nuisance[None, :])[0][0]
    gains = np.zeros((len(tried), series.shape[1]))
    sizes = np.array([len(own) for own in chosen], dtype=int)
    for size in np.unique(sizes):
        these = np.flatnonzero(sizes == size)
        loss, strengths = products.held_out_loss(np.array([[*nuisance, *chosen[i]] for i in these]))
        # Only forms that stand alone ask for a sign.
        signs = np.array([tried[i][0][0].sign if len(tried[i][0]) == 1 else 0 for i in these])
        wrong = (signs[:, None] != 0) & (np.sign(strengths[:, len(nuisance)]) == -signs[:, None])
        gains[these] = np.where(wrong, 0.0, 0.5 * np.log(before / np.maximum(loss, 1e-300)))
    leads: dict[tuple[Form, ...], Lead] = {}
    for (choice, grid), gain in zip(tried, gains[:, 0].tolist(), strict=True):
        if choice not in leads or gain > leads[choice].gain:
            leads[choice] = Lead(choice, tuple(f.shapes[i] for f, i in zip(choice, grid, strict=True)), gain)
    null_gains = np.max(gains[:, 1:], axis=0, initial=0.0)
    return Screen(tuple(sorted(leads.values(), key=lambda lead: -lead.gain)), null_gains)


@dataclass(frozen=True, eq=False)
class _Products:
    """Inner products in each fold: of columns with each other, with the series, and of the series with themselves."""

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

    def held_out_loss(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sum of squares on held-out folds of each choice of columns and each series, (choices, series), and the
        strengths that all folds together give, (choices, columns, series)."""
        rows, columns = chosen[:, :, None], chosen[:, None, :]
        whole_gram, whole_against = self.gram.sum(axis=0), self.against.sum(axis=0)
        loss = np.zeros((len(chosen), self.squares.shape[1]))
        for gram, against, squares in zip(self.gram, self.against, self.squares, strict=True):
            solution = _solve((whole_gram - gram)[rows, columns], (whole_against - against)[chosen])
            quadratic = np.sum(solution * (gram[rows, columns] @ solution), axis=1)
            loss += squares - 2.0 * np.sum(solution * against[chosen], axis=1) + quadratic
        return loss, _solve(whole_gram[rows, columns], whole_against[chosen])


def _solve(gram: np.ndarray, against: np.ndarray) -> np.ndarray:
    return np.linalg.pinv(gram, rcond=_RANK, hermitian=True) @ against


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns / np.where(norms > 0, norms, 1.0), full_matrices=False)
    return u[:, s > 1e-6 * s[0]]


def _beside(known: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Columns less what is known already, of length one; those that are known nearly wholly are zero."""
    rest = columns - known @ (known.T @ columns)
    before, after = np.linalg.norm(columns, axis=0), np.linalg.norm(rest, axis=0)
    return rest * np.where(after > _BLIND * before, 1.0 / np.where(after > 0, after, 1.0), 0.0)
