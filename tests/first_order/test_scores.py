"""Least-squares steps from inner products: with priors, and their gains on surrogates."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fitting.first_order.surrogates import DRAWS, Scores, null_gains


def scores(random: np.random.Generator, columns: np.ndarray) -> Scores:
    """Of white residuals with unit variance."""
    rows = len(columns)
    residual, surrogates = random.normal(size=rows), random.normal(size=(rows, DRAWS))
    products = columns.T @ columns, columns.T @ residual, columns.T @ surrogates
    return Scores(*products, float(residual @ residual), float(rows))


@given(seed=st.integers(0, 999), slope=st.floats(0.0, 1e3))
def test_prior_is_one_more_row_of_the_least_squares(seed: int, slope: float):
    random = np.random.default_rng(seed)
    columns, residual, off = random.normal(size=(50, 3)), random.normal(size=50), random.normal(size=2)
    bare = Scores(columns.T @ columns, columns.T @ residual, np.zeros((3, DRAWS)), float(residual @ residual), 50.0)
    known = bare.beside_prior(off, np.array([slope, 0.0]))
    step = known.steps(known.gradient[:, None], [0, 1, 2])[:, 0]
    rows = np.vstack([columns, [slope, 0.0, 0.0]])
    expected = np.linalg.lstsq(rows, np.append(residual, -off[0]), rcond=None)[0]
    np.testing.assert_allclose(step, expected, rtol=1e-6, atol=1e-9)


def test_no_surrogate_gains_more_than_the_whole_residual():
    """A parameter that hardly moves the training data moves the held-out data far."""
    random = np.random.default_rng(0)
    columns = random.normal(size=(200, 2))
    fitted, unseen = scores(random, columns * [1e-4, 1.0]), scores(random, columns * [1e4, 1.0])
    gains = null_gains(fitted, unseen, 1)
    assert np.max(gains) <= unseen.square / (2 * unseen.samples)
    usual = null_gains(scores(random, columns), scores(random, columns), 1)
    assert np.abs(usual).max() < 0.1
