"""The stable steady motion whose largest |x| comes nearest to a given one, of all that coexist under one sine.

`x'' + mu x' + omega_0^2 (x + alpha x^3) = A cos(omega t)`: any motion with the symmetry of the equation,
`x(t + T/2) = -x(t)` over its period T, may be it, on any branch, with its super-harmonics, and sub-harmonics of order
1/3. Motions that break the symmetry (even harmonics) and longer sub-harmonics are not looked for.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from hdjax.drive import ReducedDrive
from hdjax.dynamics import ReducedModel
from hdjax.fourier import FourierSeries, harmonic_series
from hdjax.parameters import as_scalar
from hdjax.response.harmonic_balance import BalancedMotion, balance
from hdjax.response.modulation import AdditiveModulation, SubharmonicModulation

_SAMPLES = 96
_CORRECTED = 2
_NEWTON_STEPS = 6
_SOLVED = 1e-6
_DEFECT = 0.03


class NearestMotions(eqx.Module):
    """Stable steady motions, by row.

    Attributes:
        motion: the dynamic error over three forcing periods [rad].
        size: its largest |x| among some instants [rad].
        exists: whether there is any; where not, the others mean nothing.
    """

    motion: FourierSeries
    size: Float[Array, "*rows"]
    exists: Bool[Array, "*rows"]


@eqx.filter_jit
def nearest_motions(
    drive: ReducedDrive, A: ArrayLike, omega: Float[Array, " rows"], size: Float[Array, " rows"], *, harmonics: int = 27
) -> NearestMotions:
    """At each frequency the stable steady motion of a forced drive whose largest |x| comes nearest in ratio.

    Balances of two harmonics give all motions roughly; the nearest are corrected and their stability decided.

    Args:
        drive: gives mu, omega_0 and alpha.
        A: amplitude of the forcing `A cos(omega t)` as an acceleration [rad/s^2].
        omega: forcing frequencies [rad/s].
        size: the largest |x| to come near to at each [rad].
        harmonics: of a motion's own frequency. One that needs more does not count as existing.
    """
    return jax.vmap(lambda w, a: _nearest(drive, as_scalar(A), w, a, harmonics))(omega, size)


def _nearest(drive: ReducedDrive, A: Array, omega: Array, size: Array, harmonics: int) -> NearestMotions:
    def of_period(periods: int, rough: FourierSeries, there: Array) -> tuple[FourierSeries, Array, Array]:
        forcing = harmonic_series(1.0, A)
        system = balance(ReducedModel(drive), forcing, harmonics=harmonics, subharmonic=periods)
        nearest = jnp.argsort(_distance(_largest(rough), there, size))[:_CORRECTED]
        starts = jax.tree.map(lambda leaf: leaf[nearest], rough)
        motions, stable = jax.vmap(lambda start: _corrected(system, start, omega))(starts)
        return _over_three_periods(motions, 3 // periods), _largest(motions), there[nearest] & stable

    found = of_period(1, *_rough_motions(drive, A, omega)), of_period(3, *_rough_subharmonics(drive, A, omega))
    motions, largest, exists = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
    distance = _distance(largest, exists, size)
    best = jnp.argmin(distance)
    motion, largest = jax.tree.map(lambda leaf: leaf[best], (motions, largest))
    return NearestMotions(motion, largest, jnp.isfinite(distance[best]))


def _distance(largest: Array, there: Bool[Array, " motions"], size: Array) -> Float[Array, " motions"]:
    """Logarithm of the ratio between each motion's size and the given one; infinite where it is not there."""
    there = there & (largest > 0.0) & jnp.isfinite(largest)
    return jnp.where(there, jnp.abs(jnp.log(jnp.where(there, largest, 1.0) / size)), jnp.inf)


def _largest(motion: FourierSeries) -> Float[Array, "*motions"]:
    return jnp.max(jnp.abs(motion.values(_SAMPLES)), axis=-1)


def _over_three_periods(motion: FourierSeries, times: int) -> FourierSeries:
    """The same function with a fundamental so many times slower."""
    H = motion.harmonics
    zeros = jnp.zeros((*motion.mean.shape, 3 * H))
    cosine, sine = (zeros.at[..., times - 1 : times * H : times].set(c) for c in (motion.cosine, motion.sine))
    return FourierSeries(motion.omega / times, motion.mean, cosine, sine)


def _corrected(system: BalancedMotion, start: FourierSeries, omega: Array) -> tuple[FourierSeries, Bool[Array, ""]]:
    """Newton steps to the symmetric motion near `start`, and whether they settled on a stable one."""
    H = system.harmonics
    odd = np.concatenate([np.arange(1, H + 1, 2), H + np.arange(1, H + 1, 2)])

    def whole(kept: Array) -> Array:
        return jnp.zeros(2 * H + 1).at[odd].set(kept)

    def left_over(kept: Array) -> Array:
        return system.residual(whole(kept), omega)[odd]

    def step(_: Array, kept: Array) -> Array:
        return kept - jnp.linalg.solve(jax.jacfwd(left_over)(kept), left_over(kept))

    kept = jax.lax.fori_loop(0, _NEWTON_STEPS, step, system.unknowns(start)[odd])
    settled = jnp.max(jnp.abs(left_over(kept))) < _SOLVED * jnp.max(jnp.abs(kept))
    settled &= system.defect(whole(kept), omega) < _DEFECT
    # The determinant has the sign of (1 - m_1)(1 - m_2), m the Floquet multipliers (Hill). A symmetric motion's
    # monodromy is a square, so that no multiplier leaves through -1 (Swift and Wiesenfeld 1984), and damping keeps
    # their product below one: where the sign is positive, both lie inside the unit circle.
    slope = jax.jacfwd(system.residual)(whole(kept), omega)
    return system.steady_state(whole(kept), omega, settled).x, settled & (jnp.linalg.slogdet(slope)[0] > 0.0)


def _rough_motions(drive: ReducedDrive, A: Array, omega: Array) -> tuple[FourierSeries, Bool[Array, "9"]]:
    """The three branches, each with the three of its third harmonic, and which exist and seem stable.

    The modulation equations with squared frequencies in place of detunings are the balance of one harmonic.
    """
    square, zero = drive.omega_0**2, jnp.zeros(())
    k = 0.75 * square * drive.alpha
    first = AdditiveModulation(2 * drive.mu * omega, k, zero, -A).branches(omega**2 - square)

    def with_third(a: Array, phase: Array) -> tuple[FourierSeries, Array]:
        mode = AdditiveModulation(6 * drive.mu * omega, k, 2 * k * a**2, k * a**3 / 3)
        third = mode.branches(9 * omega**2 - square)

        def wave(b: Array, psi: Array) -> FourierSeries:
            return harmonic_series(omega, jnp.stack([a, zero, b]), jnp.stack([phase, zero, psi + 3 * phase]))

        return jax.vmap(wave)(third.amplitude, third.phase), third.stable

    waves, stable = jax.vmap(with_third)(first.amplitude, first.phase)
    waves = jax.tree.map(lambda leaf: leaf.reshape(9, *leaf.shape[2:]), waves)
    return waves, (first.stable[:, None] & stable).reshape(9)


def _rough_subharmonics(drive: ReducedDrive, A: Array, omega: Array) -> tuple[FourierSeries, Bool[Array, "2"]]:
    """The two sub-harmonics of order 1/3 beside the linear forced motion, and which exist and seem stable."""
    square, zero = drive.omega_0**2, jnp.zeros(())
    k, C = 0.75 * square * drive.alpha, A / (square - omega**2)
    mode = SubharmonicModulation(2 * drive.mu * omega / 3, k, 2 * k * C**2, k * C)
    found = mode.branches((omega / 3) ** 2 - square)

    def wave(a: Array, psi: Array) -> FourierSeries:
        return harmonic_series(omega / 3, jnp.stack([a, zero, C]), jnp.stack([psi, zero, zero]))

    return jax.vmap(wave)(found.amplitude[1:], found.phase[1:]), found.stable[1:]
