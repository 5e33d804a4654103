"""Least-squares fit of a model to a table of amplitudes over frequency, over all kinds of motion.

`x'' + mu x' + omega_0^2 (x + alpha x^3) = A cos(omega t)`: what (A, omega_0, mu, alpha) give these largest |x|? At each
frequency the nearest stable steady motion is used (see [`hdjax.response.nearest_motion`][]). This is the best possible
choice, so that the remaining misfit is due to the table.
"""

import dataclasses
import functools
import itertools

import numpy as np
from jaxtyping import Float
from scipy.optimize import differential_evolution

from hdjax.drive import ReducedDrive
from hdjax.fourier import FourierSeries
from hdjax.response.nearest_motion import Oscillators, largest, nearest_motions, nearest_waves
from hdjax.response.seed_data import TABLE_2

PUSH, OMEGA_0, DAMPING, BEND = (1e-3, 1e3), (20.0, 1500.0), (1e-7, 1.0), 1e3
"""Range of the search: A/(omega_0^2 a), omega_0 [rad/s], mu/omega_0 and |alpha| a^2, where a is the mean amplitude."""
_STRAIGHT = 1e-4
"""The search runs in asinh(alpha a^2 / this): in the logarithm beyond it, and through zero."""
_HARMONICS = 15
_FAR = 5.0


@dataclasses.dataclass(frozen=True)
class AmplitudeFit:
    """The parameters fitted to a table of amplitudes, and the misfit.

    Attributes:
        A: amplitude of the forcing [rad/s^2].
        omega_0: natural frequency [rad/s].
        mu: damping [1/s].
        alpha: cubic stiffness coefficient [rad^-2].
        omega: forcing frequencies [rad/s].
        given: amplitudes of the table [rad].
        motions: the nearest stable motions, by row.
    """

    A: float
    omega_0: float
    mu: float
    alpha: float
    omega: tuple[float, ...]
    given: tuple[float, ...]
    motions: FourierSeries

    @functools.cached_property
    def fitted(self) -> tuple[float, ...]:
        """Largest |x| of the nearest stable motions [rad]."""
        return tuple(float(a) for a in largest(self.motions))

    @property
    def subharmonic(self) -> tuple[bool, ...]:
        """Which of them repeat after three forcing periods only."""
        return tuple(bool(a[0] > 1e-6 * a.max()) for a in np.asarray(self.motions.amplitudes))

    @property
    def ratios(self) -> tuple[float, ...]:
        """Fitted over given amplitude."""
        return tuple(f / g for f, g in zip(self.fitted, self.given, strict=True))

    @property
    def rms(self) -> float:
        """Root mean square of the log ratios."""
        return float(np.sqrt(np.mean(np.log(self.ratios) ** 2)))

    @property
    def worst(self) -> float:
        """The largest ratio between fitted and given amplitude, whichever is larger, at least 1."""
        return float(np.exp(np.max(np.abs(np.log(self.ratios)))))


def fit_amplitudes(
    omega: tuple[float, ...], amplitude: tuple[float, ...], *, bands: int = 4, generations: int = 60, seed: int = 0
) -> AmplitudeFit:
    """The (A, omega_0, mu, alpha) whose stable steady motions come nearest to the amplitudes, and how near.

    Differential evolution on the squared log ratios, which jump where a branch ends. The best of all sets whose motions
    exist with more harmonics too is returned.

    Args:
        omega: forcing frequencies [rad/s].
        amplitude: largest |x| at each [rad].
        bands: of omega_0, each searched separately for either sign of alpha, to keep several minima.
        generations: of the search, at most.
        seed: of the random numbers.
    """
    if not omega or len(omega) != len(amplitude) or min(amplitude) <= 0.0:
        raise ValueError("`omega` and `amplitude` must be of one length, with amplitudes above zero")
    table = np.asarray(omega), np.asarray(amplitude)
    edges = np.log(np.geomspace(*OMEGA_0, bands + 1))
    bend = np.arcsinh(BEND / _STRAIGHT)
    found = [
        differential_evolution(
            lambda points: _misfits(points.T, *table),
            [np.log(PUSH), band, np.log(DAMPING), side],
            maxiter=generations,
            popsize=12,
            updating="deferred",
            vectorized=True,
            polish=False,
            rng=seed,
        )
        for band, side in itertools.product(itertools.pairwise(edges), ((0.0, bend), (-bend, 0.0)))
    ]
    points, misfits = (
        np.concatenate(parts) for parts in zip(*((f.population, f.population_energies) for f in found), strict=True)
    )
    for k in np.argsort(misfits):
        A, omega_0, mu, alpha = (float(v[0]) for v in _parameters(points[k : k + 1], table[1]))
        nearest = nearest_motions(ReducedDrive(mu=mu, omega_0=omega_0, alpha=alpha), A, *table)
        if nearest.exists.all():
            return AmplitudeFit(A, omega_0, mu, alpha, tuple(omega), tuple(amplitude), nearest.motion)
    raise ValueError("no parameters give stable motions at every frequency: raise `generations`")


@functools.cache
def best_fit_of_table_2() -> AmplitudeFit:
    """Best fit to the analytical column of the seed's Table 2, see [`fit_amplitudes`][]."""
    return fit_amplitudes(tuple(r.omega for r in TABLE_2), tuple(r.analytical for r in TABLE_2))


def _parameters(
    points: Float[np.ndarray, "*points 4"], amplitude: Float[np.ndarray, " rows"]
) -> tuple[np.ndarray, ...]:
    """A, omega_0, mu and alpha of points of the search."""
    a = np.exp(np.mean(np.log(amplitude)))
    push, omega_0, damping = np.exp(points[:, :3].T)
    return push * omega_0**2 * a, omega_0, damping * omega_0, _STRAIGHT * np.sinh(points[:, 3]) / a**2


def _misfits(
    points: Float[np.ndarray, "points 4"], omega: np.ndarray, amplitude: np.ndarray
) -> Float[np.ndarray, " points"]:
    """Sums of squared log ratios; a missing motion counts as a large misfit."""
    A, omega_0, mu, alpha = (v[:, None] for v in _parameters(points, amplitude))
    _, size, exists = nearest_waves(Oscillators(mu, omega_0, alpha, A, omega), amplitude, _HARMONICS)
    return np.sum(np.where(exists, np.log(np.where(exists, size, 1.0) / amplitude) ** 2, _FAR**2), axis=1)
