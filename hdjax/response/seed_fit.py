"""The model that comes nearest to a table of amplitudes over frequency, by least squares over every kind of motion.

`x'' + mu x' + omega_0^2 (x + alpha x^3) = A cos(omega t)`: what (A, omega_0, mu, alpha) give these largest |x|? At each
frequency the nearest stable steady motion stands for the table's (see [`hdjax.response.nearest_motion`][]). The choice
is thus the most charitable one, and what remains of misfit belongs to the table.
"""

import dataclasses
import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import differential_evolution

from hdjax.drive import ReducedDrive
from hdjax.fourier import FourierSeries
from hdjax.response.nearest_motion import nearest_motions
from hdjax.response.seed_data import TABLE_2

PUSH, OMEGA_0, DAMPING, BEND = (1e-3, 1e3), (20.0, 1500.0), (1e-7, 1.0), 1e3
"""Range of the search: A/(omega_0^2 a), omega_0 [rad/s], mu/omega_0 and |alpha| a^2, where a is the mean amplitude."""
_STRAIGHT = 1e-4
"""The search runs in asinh(alpha a^2 / this): in the logarithm beyond it, and through zero."""
_HARMONICS = 15
_FAR = 5.0


@dataclasses.dataclass(frozen=True)
class AmplitudeFit:
    """The parameters nearest to a table of amplitudes, and how near they come.

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
        return tuple(float(a) for a in jax.vmap(FourierSeries.largest)(self.motions))

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
        bands: of omega_0, each searched by itself for either sign of alpha: the best of one would draw the others away.
        generations: of the search, at most.
        seed: of the random numbers.
    """
    if not omega or len(omega) != len(amplitude) or min(amplitude) <= 0.0:
        raise ValueError("`omega` and `amplitude` must be of one length, with amplitudes above zero")
    table = jnp.asarray(omega), jnp.asarray(amplitude)
    edges = np.log(np.geomspace(*OMEGA_0, bands + 1))
    bend = np.arcsinh(BEND / _STRAIGHT)
    found = [
        differential_evolution(
            lambda points: np.asarray(_misfits(jnp.asarray(points.T), *table)),
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
        drive, A = _drive(jnp.asarray(points[k]), table[1])
        nearest = nearest_motions(drive, A, *table)
        if bool(jnp.all(nearest.exists)):
            A, omega_0, mu, alpha = (float(v) for v in (A, drive.omega_0, drive.mu, drive.alpha))
            return AmplitudeFit(A, omega_0, mu, alpha, tuple(omega), tuple(amplitude), nearest.motion)
    raise ValueError("no parameters give stable motions at every frequency: raise `generations`")


@functools.cache
def best_fit_of_table_2() -> AmplitudeFit:
    """What comes nearest to the analytical column of the seed's Table 2, see [`fit_amplitudes`][]."""
    return fit_amplitudes(tuple(r.omega for r in TABLE_2), tuple(r.analytical for r in TABLE_2))


def _drive(point: Float[Array, "4"], amplitude: Float[Array, " rows"]) -> tuple[ReducedDrive, Float[Array, ""]]:
    """The drive and the amplitude of its forcing that a point of the search means."""
    a = jnp.exp(jnp.mean(jnp.log(amplitude)))
    push, omega_0, damping = jnp.exp(point[:3])
    alpha = _STRAIGHT * jnp.sinh(point[3]) / a**2
    return ReducedDrive(mu=damping * omega_0, omega_0=omega_0, alpha=alpha), push * omega_0**2 * a


@eqx.filter_jit
def _misfits(points: Float[Array, "points 4"], omega: Array, amplitude: Array) -> Float[Array, " points"]:
    """Sums of squared log ratios; a missing motion counts as one far off."""

    def misfit(point: Array) -> Array:
        found = nearest_motions(*_drive(point, amplitude), omega, amplitude, harmonics=_HARMONICS)
        return jnp.sum(jnp.where(found.exists, jnp.log(found.size / amplitude) ** 2, _FAR**2))

    return jax.vmap(misfit)(points)
