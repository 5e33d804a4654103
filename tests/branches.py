"""Properties of a branch of steady motions: its motions, its folds, and the residual of its equations."""

import equinox as eqx
import jax
import numpy as np

from hdjax.fourier import FourierSeries
from hdjax.response.continuation import Branch


def row(branch: Branch, i: int) -> FourierSeries:
    """The dynamic error of one motion."""
    return jax.tree.map(lambda leaf: leaf[i], branch.steady_states.x)


def path(branch: Branch) -> np.ndarray:
    """Unknowns and scaled parameter by row: the space of the continuation."""
    return np.concatenate([branch.unknowns, np.asarray(branch.value / branch.scale)[:, None]], axis=1)


def turns(branch: Branch) -> np.ndarray:
    """Rows before a fold."""
    slope = np.asarray(branch.tangents[:, -1])
    return np.flatnonzero(slope[1:] * slope[:-1] < 0)


def left_over(branch: Branch) -> np.ndarray:
    """Largest residual of the harmonic balance, by row."""
    return np.abs(np.asarray(_residuals(branch))).max(axis=1)


@eqx.filter_jit
def _residuals(branch: Branch) -> jax.Array:
    each = jax.vmap(lambda u, v, w: branch.at(v).residual(u, w))
    return each(branch.unknowns, branch.value, branch.omega)


def assert_whole(branch: Branch, start: float, end: float):
    """Assert that a branch has the given ends, is solved everywhere and has even chords, hence no jumps."""
    assert bool(branch.complete) and np.asarray(branch.valid).all()
    value = np.asarray(branch.value)
    # The end is interpolated within the last step: the error is a fraction of a step of 0.3 % of the range.
    assert abs(value[0] - start) < 1e-9 * start and abs(value[-1] - end) < 1e-4 * end
    if len(turns(branch)) == 0:
        assert value.min() >= min(start, end) * (1 - 1e-9) and value.max() <= max(start, end) * (1 + 1e-4)
    chords = np.linalg.norm(np.diff(path(branch), axis=0), axis=1)
    assert chords.max() < 1.15 * np.median(chords) and chords.min() > 0.85 * np.median(chords)
