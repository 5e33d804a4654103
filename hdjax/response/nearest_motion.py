"""The stable steady motion whose largest |x| comes nearest to a given one, of all that coexist under one sine.

`x'' + mu x' + omega_0^2 (x + alpha x^3) = A cos(omega t)`: any motion with the symmetry of the equation, `x(t + T/2) =
-x(t)` over its period T, is considered, on any branch, with its super-harmonics, and sub-harmonics of order 1/3.
Motions without the symmetry (even harmonics) and longer sub-harmonics are not searched.

All by numpy: many drives and frequencies are lanes of its arrays, and nothing is compiled.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from hdjax.drive import ReducedDrive
from hdjax.fourier import FourierSeries

_SAMPLES = 96
_CORRECTED = 2
_NEWTON_STEPS = 6
_SOLVED, _BALANCED = 1e-6, 1e-9
_EXACT = 1e-11
"""Below this relative size of the last Newton step the next one is rounding."""
_DEFECT = 0.03


class Oscillators(NamedTuple):
    """Forced cubic oscillators; the arrays broadcast.

    Attributes:
        mu: damping [1/s].
        omega_0: natural frequency [rad/s].
        alpha: cubic stiffness coefficient [rad^-2].
        A: amplitude of the forcing `A cos(omega t)` [rad/s^2].
        omega: its frequency [rad/s].
    """

    mu: np.ndarray
    omega_0: np.ndarray
    alpha: np.ndarray
    A: np.ndarray
    omega: np.ndarray


class NearestMotions(eqx.Module):
    """Stable steady motions, by row.

    Attributes:
        motion: the dynamic error over three forcing periods [rad].
        size: its largest |x| among some instants [rad].
        exists: whether there is any; if not, the other values have no meaning.
    """

    motion: FourierSeries
    size: Float[np.ndarray, "*rows"]
    exists: Bool[np.ndarray, "*rows"]


def nearest_motions(
    drive: ReducedDrive,
    A: ArrayLike,
    omega: Float[Array | np.ndarray, " rows"],
    size: Float[Array | np.ndarray, " rows"],
    *,
    harmonics: int = 27,
) -> NearestMotions:
    """At each frequency the stable steady motion of a forced drive whose largest |x| comes nearest in ratio.

    Balances of two harmonics give all motions approximately; the nearest are corrected and their stability is computed.

    Args:
        drive: gives mu, omega_0 and alpha.
        A: amplitude of the forcing `A cos(omega t)` as an acceleration [rad/s^2].
        omega: forcing frequencies [rad/s].
        size: the largest |x| to come near to at each [rad].
        harmonics: of a motion's own frequency. One that needs more does not count as existing.
    """
    numbers = (np.asarray(v, dtype=float) for v in (drive.mu, drive.omega_0, drive.alpha, A, omega))
    waves, largest, exists = nearest_waves(Oscillators(*numbers), np.asarray(size, dtype=float), harmonics)
    cosine, sine = np.zeros((2, omega.size, 3 * harmonics))
    cosine[:, ::2], sine[:, ::2] = np.real(waves), -np.imag(waves)
    motion = FourierSeries(omega / 3.0, *(jnp.asarray(a) for a in (np.zeros(omega.size), cosine, sine)))
    return NearestMotions(motion, largest, exists)


def nearest_waves(
    given: Oscillators, size: np.ndarray, harmonics: int
) -> tuple[np.ndarray, Float[np.ndarray, "*lanes"], Bool[np.ndarray, "*lanes"]]:
    """[`nearest_motions`][] of many oscillators.

    Args:
        given: the oscillators.
        size: the largest |x| to come near to, of each.
        harmonics: see [`nearest_motions`][].

    Returns:
        Odd multiples of a third of the forcing's frequency, as the complex numbers z of `Re(z exp(i k omega t / 3))`
        along a last axis; largest |x| among some instants; whether there is a motion at all.
    """
    shape = np.broadcast_shapes(*(np.shape(v) for v in given), np.shape(size))
    *flat, size = (np.broadcast_to(v, shape).reshape(-1) for v in (*given, size))
    given = Oscillators(*flat)
    with np.errstate(all="ignore"):
        found = [
            _of_period(given, size, harmonics, periods, *rough(given))
            for periods, rough in ((1, _rough_motions), (3, _rough_subharmonics))
        ]
    waves, largest, exists = (np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
    distance = _distance(largest, exists, size)
    best = np.argmin(distance, axis=1)
    lanes = np.arange(size.size)
    waves, largest, distance = waves[lanes, best], largest[lanes, best], distance[lanes, best]
    return waves.reshape(*shape, -1), largest.reshape(shape), np.isfinite(distance).reshape(shape)


def _of_period(
    given: Oscillators, size: np.ndarray, harmonics: int, periods: int, rough: np.ndarray, there: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The candidates that repeat after so many forcing periods, by lane: waves, size, and whether they exist."""
    kept = np.arange(1, harmonics + 1, 2).size
    rough = np.concatenate([rough, np.zeros((*rough.shape[:2], kept - rough.shape[2]))], axis=2)
    distance = _distance(_largest(rough, harmonics), there, size)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :_CORRECTED]
    distance, waves = np.take_along_axis(distance, nearest, 1), np.take_along_axis(rough, nearest[..., None], 1)
    exists = np.isfinite(distance)
    lane, place = np.nonzero(exists)
    # Missing motions are not corrected.
    own = Oscillators(*(v[lane] for v in given))
    waves[lane, place], exists[lane, place] = _corrected(own, waves[lane, place], harmonics, periods)
    largest = _largest(waves, harmonics)
    # Over three forcing periods.
    times = 3 // periods
    slow = np.zeros((*waves.shape[:2], np.arange(1, 3 * harmonics + 1, 2).size), dtype=complex)
    slow[..., (times - 1) // 2 :: times][..., :kept] = waves
    return slow, largest, exists


def _distance(largest: np.ndarray, there: np.ndarray, size: np.ndarray) -> Float[np.ndarray, "lanes motions"]:
    """Logarithm of the ratio between each motion's size and the given one; infinite where there is no motion."""
    there = there & (largest > 0.0) & np.isfinite(largest)
    return np.where(there, np.abs(np.log(np.where(there, largest, 1.0) / size[:, None])), np.inf)


class _Odd(NamedTuple):
    """Waves of odd harmonics at samples of half a period, which are all of it.

    Attributes:
        orders: of the harmonics.
        values: cosines, then sines, at the samples.
        means: from samples to their coefficients.
        above: likewise of omitted odd harmonics that the samples resolve.
        products: from samples of a factor to its product with each wave, by wave.
        even: likewise of the even waves.
        evens: orders of the even waves.
        looks: values at the instants among which the largest |x| is sought.
    """

    orders: np.ndarray
    values: np.ndarray
    means: np.ndarray
    above: np.ndarray
    products: np.ndarray
    even: np.ndarray
    evens: np.ndarray
    looks: np.ndarray


@functools.cache
def _odd(harmonics: int) -> _Odd:
    samples = 2 ** int(np.ceil(np.log2(4 * harmonics + 1))) // 2
    angles = np.arange(samples) * (np.pi / samples)

    def waves(orders: np.ndarray, angles: np.ndarray = angles) -> np.ndarray:
        return np.concatenate([np.cos(orders[:, None] * angles), np.sin(orders[:, None] * angles)])

    def products(values: np.ndarray) -> np.ndarray:
        weights = values * np.where(np.all(values == 1.0, axis=1), 0.5, 1.0)[:, None] * (2.0 / samples)
        return np.einsum("js,ks->sjk", weights, values).reshape(samples, -1)

    orders = np.arange(1, harmonics + 1, 2)
    above = np.arange(orders[-1] + 2, samples, 2)
    evens = np.arange(0, harmonics + 1, 2)
    # The mean has no sine.
    even = np.delete(waves(evens), evens.size, axis=0)
    values, means = waves(orders), waves(orders).T * (2.0 / samples)
    # Half of them: x(t + T/2) = -x(t).
    looks = waves(orders, np.arange(_SAMPLES // 2) * (2.0 * np.pi / _SAMPLES))
    return _Odd(orders, values, means, waves(above).T * (2.0 / samples), products(values), products(even), evens, looks)


def _parts(waves: np.ndarray) -> np.ndarray:
    """Cosines, then sines, of complex waves."""
    return np.concatenate([np.real(waves), -np.imag(waves)], axis=-1)


def _largest(waves: np.ndarray, harmonics: int) -> Float[np.ndarray, "lanes motions"]:
    """Largest |x| among some instants."""
    return np.max(np.abs(_parts(waves) @ _odd(harmonics).looks), axis=-1)


def largest(motion: FourierSeries) -> Float[np.ndarray, "*motions"]:
    """[`FourierSeries.largest`][hdjax.fourier.FourierSeries.largest] without compilation: the largest magnitudes over a
    period, between samples too."""
    z = np.asarray(motion.cosine) - 1j * np.asarray(motion.sine)
    return _largest_of(np.asarray(motion.mean), z, 1)


def largest_of(waves: np.ndarray) -> Float[np.ndarray, "*motions"]:
    """The same of odd harmonics alone, as complex numbers z of `Re(z exp(i k omega t))` along the last axis."""
    return _largest_of(np.zeros(waves.shape[:-1]), waves, 2)


def _largest_of(mean: np.ndarray, z: np.ndarray, between: int) -> np.ndarray:
    """The same of a mean and every order from one on, or every other."""
    orders = 1 + between * np.arange(z.shape[-1])
    count = 8 * (orders[-1] + 1)
    step = 2 * np.pi / count
    t = np.broadcast_to(np.arange(count) * step, (*z.shape[:-1], count))

    def wave(z: np.ndarray) -> np.ndarray:
        # By Horner's rule.
        turn, total = np.exp(1j * between * t), np.zeros_like(t, dtype=complex)
        for k in reversed(range(orders.size)):
            total = total * turn + z[..., k, None]
        return np.real(total * np.exp(1j * orders[0] * t))

    samples = mean[..., None] + wave(z)
    # As there, Newton steps from every sample to a top, none longer than from sample to sample.
    for _ in range(3):
        bend = wave(-(orders**2) * z)
        t = t - np.clip(wave(1j * orders * z) / np.where(bend == 0.0, np.inf, bend), -step, step)
    tops = mean[..., None] + wave(z)
    return np.asarray(np.max(np.abs(np.concatenate([samples, tops], axis=-1)), axis=-1))


def _linear(given: Oscillators, periods: int, orders: np.ndarray) -> Float[np.ndarray, "2 lanes orders"]:
    """Response of inertia and spring, and of the damper, to waves of some orders, over omega_0^2."""
    speeds = orders * (given.omega / (periods * given.omega_0))[:, None]
    return np.stack([1.0 - speeds**2, speeds * (given.mu / given.omega_0)[:, None]])


def _system(linear: np.ndarray, bend: np.ndarray, mean: bool = False) -> np.ndarray:
    """Derivative of the residual, by lane, from its linear and cubic parts."""
    spring, damper = linear
    n = spring.shape[1]
    wave = np.arange(n)
    whole = np.zeros((spring.shape[0], 2 * n, 2 * n))
    whole[:, wave, wave] = whole[:, n + wave, n + wave] = spring
    whole[:, wave, n + wave], whole[:, n + wave, wave] = damper, -damper
    if mean:
        whole = np.delete(np.delete(whole, n, axis=1), n, axis=2)
    return whole + bend.reshape(whole.shape)


def balanced_waves(
    given: Oscillators, guess: np.ndarray, harmonics: int, *, steps: int = 64
) -> tuple[np.ndarray, Bool[np.ndarray, " lanes"]]:
    """Symmetric motions by harmonic balance, as complex waves of the odd harmonics, and which were solved.

    Args:
        given: the oscillators, of one axis.
        guess: waves to start from.
        harmonics: to keep.
        steps: of Newton's method, at most.
    """
    start = np.zeros((guess.shape[0], _odd(harmonics).orders.size), dtype=complex)
    kept = min(guess.shape[1], start.shape[1])
    start[:, :kept] = guess[:, :kept]
    with np.errstate(all="ignore"):
        balance = _Balance(given, harmonics, 1)
        parts, x = balance.solved(_parts(start), steps)
        solved = balance.missed(parts, x) < _BALANCED
    return parts[:, : start.shape[1]] - 1j * parts[:, start.shape[1] :], solved


class _Balance:
    """Harmonic balance of motions with odd harmonics of their own frequency, one a lane; unknowns are cosines, then
    sines."""

    def __init__(self, given: Oscillators, harmonics: int, periods: int):
        self.odd = _odd(harmonics)
        self.cubic = given.alpha[:, None]
        self.linear = _linear(given, periods, self.odd.orders)
        self.push = np.zeros((given.A.size, 2 * self.odd.orders.size))
        self.push[:, (periods - 1) // 2] = given.A / given.omega_0**2

    def left_over(self, kept: np.ndarray, x: np.ndarray, of: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Residual of the equation, over omega_0^2."""
        spring, damper = self.linear[:, of]
        cosine, sine = np.split(kept, 2, axis=1)
        straight = np.concatenate([spring * cosine + damper * sine, spring * sine - damper * cosine], axis=1)
        return straight + _times(self.cubic[of] * x**3, self.odd.means) - self.push[of]

    def missed(self, kept: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Largest residual, relative to the motion."""
        return np.max(np.abs(self.left_over(kept, x)), axis=1) / np.max(np.abs(kept), axis=1)

    def solved(self, kept: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Newton steps from a start: the unknowns, and the motions at the samples."""
        kept, moving = kept.copy(), np.arange(kept.shape[0])
        for _ in range(steps):
            own = kept[moving]
            x = _times(own, self.odd.values)
            slope = _system(self.linear[:, moving], _times(3.0 * self.cubic[moving] * x**2, self.odd.products))
            change = _solved(slope, self.left_over(own, x, moving))
            kept[moving] = own - change
            moving = moving[np.max(np.abs(change), axis=1) > _EXACT * np.max(np.abs(own), axis=1)]
            if not moving.size:
                break
        return kept, _times(kept, self.odd.values)


def _corrected(
    given: Oscillators, start: np.ndarray, harmonics: int, periods: int
) -> tuple[np.ndarray, Bool[np.ndarray, " lanes"]]:
    """Newton steps to the symmetric motion near `start`, and whether they settled on a stable one."""
    balance, n = _Balance(given, harmonics, periods), start.shape[1]
    odd, cubic, linear = balance.odd, balance.cubic, balance.linear
    kept, x = balance.solved(_parts(start), _NEWTON_STEPS)
    settled = balance.missed(kept, x) < _SOLVED
    settled &= np.linalg.norm(_times(cubic * x**3, odd.above), axis=1) < _DEFECT * np.linalg.norm(kept, axis=1)
    # The determinant has the sign of (1 - m_1)(1 - m_2), m the Floquet multipliers (Hill). A symmetric motion's
    # monodromy is a square, so that no multiplier leaves through -1 (Swift and Wiesenfeld 1984), and damping keeps
    # their product below one: where the sign is positive, both lie inside the unit circle. Odd and even waves do not
    # mix.
    there = np.flatnonzero(settled)
    factor = 3.0 * cubic[there] * x[there] ** 2
    own = Oscillators(*(v[there] for v in given))
    sign = np.linalg.slogdet(_system(linear[:, there], _times(factor, odd.products)))[0]
    even = _linear(own, periods, odd.evens)
    sign *= np.linalg.slogdet(_system(even, _times(factor, odd.even), mean=True))[0]
    settled[there] = sign > 0.0
    return kept[:, :n] - 1j * kept[:, n:], settled


def _times(rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """`rows @ matrix`, row by row: threads cost more than such small products."""
    return (rows[:, None] @ matrix)[:, 0]


def _solved(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions of linear systems; infinite numbers where one has none."""
    try:
        return np.linalg.solve(matrices, right[..., None])[..., 0]
    except np.linalg.LinAlgError:
        singular = np.linalg.det(matrices) == 0.0
        matrices = np.where(singular[:, None, None], np.eye(right.shape[1]), matrices)
        return np.where(singular[:, None], np.inf, np.linalg.solve(matrices, right[..., None])[..., 0])


def _fed(m: np.ndarray, q: np.ndarray, e: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Amplitudes and phases of the up to three steady states of an additive modulation, along a first axis, and which
    are stable; see [`hdjax.response.modulation`][]: half the damping, bend, feed and detuning about the shift."""
    r, p = d * (2 / 27 * d * d + 2 / 3 * m * m) - q * e**2, m * m - d * d / 3
    discriminant = 0.25 * r * r + p**3 / 27
    three = discriminant < 0
    radius = 2 * np.sqrt(np.where(three, -p / 3, 1.0))
    angle = np.arccos(np.clip(3 * r / np.where(three, p * radius, 1.0), -1.0, 1.0))
    turns = 2 * np.pi * np.arange(3.0).reshape(3, *[1] * np.ndim(r))
    w = np.cbrt(0.5 * np.abs(r) + np.sqrt(np.where(three, 0.0, discriminant)))
    single = -np.sign(r) * (w - p / np.where(w > 0, 3 * w, 1.0))
    v = 2 / 3 * d + np.where(three, radius * np.cos((angle - turns) / 3), single)
    for _ in range(2):
        slope = (d - v) ** 2 + m * m - 2 * (d - v) * v
        v = v - (((d - v) ** 2 + m * m) * v - q * e**2) / np.where(slope == 0, 1.0, slope)
    exists = np.stack([np.ones_like(three), three, three])
    stable = exists & (m > 0) & (m * m + (d - v) * (d - 3 * v) > 0)
    amplitude = np.abs(e) / np.sqrt(m * m + (d - v) ** 2)
    return amplitude, np.where(e < 0, -0.5 * np.pi, 0.5 * np.pi) - np.arctan2(d - v, m), stable


def _rough_motions(given: Oscillators) -> tuple[np.ndarray, Bool[np.ndarray, "lanes 9"]]:
    """The three branches, each with the three of its third harmonic, and which exist and seem stable.

    The modulation equations with squared frequencies in place of detunings are the balance of one harmonic.
    """
    mu, omega_0, alpha, A, omega = given
    k = 0.75 * omega_0**2 * alpha
    a, phase, first = _fed(mu * omega, k, -A, omega**2 - omega_0**2)
    b, turned, second = _fed(3 * mu * omega, k, k * a**3 / 3, 9 * omega**2 - omega_0**2 - 2 * k * a**2)
    waves = np.stack(np.broadcast_arrays(a * np.exp(1j * phase), b * np.exp(1j * (turned + 3 * phase))), axis=-1)
    stable = first & second
    return np.moveaxis(waves.reshape(9, -1, 2), 0, 1), stable.reshape(9, -1).T


def _rough_subharmonics(given: Oscillators) -> tuple[np.ndarray, Bool[np.ndarray, "lanes 2"]]:
    """The two sub-harmonics of order 1/3 beside the linear forced motion, and which exist and seem stable."""
    mu, omega_0, alpha, A, omega = given
    k, C = 0.75 * omega_0**2 * alpha, A / (omega_0**2 - omega**2)
    q, e, m, d = k, k * C, mu * omega / 3, (omega / 3) ** 2 - omega_0**2 - 2 * k * C**2
    E = e**2 / q
    room = d * E + 0.25 * E**2 - m * m
    v = d + 0.5 * E + np.sqrt(room) * np.array([-1.0, 1.0])[:, None]
    stable = (e * q != 0) & (room >= 0) & (v / q > 0) & (m > 0) & (v**2 > d**2 + m**2)
    amplitude = np.sqrt(np.where(stable, v / q, 0.0))
    phase = (np.where(e < 0, -0.5 * np.pi, 0.5 * np.pi) - np.arctan2(d - v, m)) / 3
    waves = np.stack(np.broadcast_arrays(amplitude * np.exp(1j * phase), C), axis=-1)
    return np.moveaxis(waves, 0, 1), stable.T
