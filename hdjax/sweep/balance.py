"""Steady motions of many drives and frequencies: vectorised harmonic balance.

Every motion starts from a root of the Duffing oscillator's amplitude equation,

    ((omega_0^2 - w^2 + 3/4 omega_0^2 alpha z)^2 + (mu w)^2) z = A^2,    z = a^2,

of which there are one or three, and Newton's method extends it to the requested harmonics (alternating frequency-time,
Cameron and Griffin 1989). Motions unrelated to these, such as sub-harmonic ones, are not found; [`hdjax.response`][]
finds those of a single drive.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hdjax.dynamics import Model
from hdjax.effects import Effect
from hdjax.effects.learned import Learned
from hdjax.effects.stiffness import QuadraticStiffness
from hdjax.sweep.twist_equation import TwistEquation
from hdjax.sweep.windows import largest_between
from hdjax.where import where

MOTIONS = 3
"""Largest number of motions, by rising amplitude: low branch, between the folds, high branch."""
_LOPSIDED: tuple[type[Effect], ...] = (QuadraticStiffness, Learned)
_SEARCHES = 60
_FOUND = 1e-9
# Newton's error after a step is of the order of its square.
_SOLVED = 1e-7
_LONGEST_STEP = 0.5
_LEAST_STIFFNESS = 1e-3  # of an omitted harmonic, at its resonance
_PEAK_SAMPLES = 32  # of half a period


class Waves(NamedTuple):
    """The kept harmonics, and their values at samples of a period (half a period if all are odd).

    Attributes:
        orders: of the harmonics.
        step: from one order to the next.
        values: cosine and sine of each order at the samples.
        slopes: their derivatives by the phase.
        means: cosines, then sines, of 0, 1, 2, ... steps, over the number of samples.
        push: the forcing's cosine at the samples.
        beyond: omitted orders that the samples resolve.
        above: from samples to their coefficients.
    """

    orders: Float[np.ndarray, " harmonics"]
    step: int
    values: Float[np.ndarray, "2 harmonics samples"]
    slopes: Float[np.ndarray, "2 harmonics samples"]
    means: Float[np.ndarray, "2 steps samples"]
    push: Float[np.ndarray, " samples"]
    beyond: Float[np.ndarray, " others"]
    above: Float[np.ndarray, "2 others samples"]

    @property
    def weights(self) -> Float[np.ndarray, "harmonics 1"]:
        """Factor from means over the samples to coefficients."""
        return np.where(self.orders == 0.0, 1.0, 2.0)[:, None]

    def coefficients(self, a: Float[Array, "samples lanes"]) -> Float[Array, "2 harmonics lanes"]:
        """Cosine and sine coefficients of sampled values."""
        rows = jnp.asarray((self.weights * self.values / self.push.size).reshape(-1, self.push.size))
        return (rows @ a).reshape(2, self.orders.size, -1)

    def at_samples(self, u: Float[Array, "2 harmonics lanes"]) -> tuple[Array, Array]:
        """A series and its derivative by the phase at the samples."""
        flat = u.reshape(-1, u.shape[-1])
        values, slopes = (jnp.asarray(t.reshape(-1, self.push.size).T) for t in (self.values, self.slopes))
        return values @ flat, slopes @ flat

    def product(self, factor: Float[Array, "samples lanes"]) -> Float[Array, "2 harmonics 2 harmonics lanes"]:
        """The matrix from a series to the coefficients of its product with a factor.

        Its entries are sums and differences of the factor's own coefficients: 2 cos j cos k = cos (j - k) + cos (j + k)
        and so on. That takes fewer operations than to project the product of each pair.
        """
        count, first = self.orders.size, int(self.orders[0])
        c, s = (m @ factor for m in self.means)
        c_both, s_both = jnp.concatenate([c[count - 1 : 0 : -1], c]), jnp.concatenate([-s[count - 1 : 0 : -1], s])
        rows = range(count)
        c_less, s_less = (jnp.stack([b[count - 1 - j : 2 * count - 1 - j] for j in rows]) for b in (c_both, s_both))
        c_more, s_more = (jnp.stack([m[j + first : j + first + count] for j in rows]) for m in (c, s))
        cosines = jnp.stack([c_less + c_more, s_more + s_less], axis=1)
        sines = jnp.stack([s_more - s_less, c_less - c_more], axis=1)
        return jnp.stack([cosines, sines]) * (0.5 * self.weights)[None, :, None, :, None]


def symmetric(model: Model) -> bool:
    """Whether the mesh is symmetric, so that a motion about zero has odd harmonics only."""
    return not any(isinstance(e, _LOPSIDED) for e in model.effects)


def waves(harmonics: int, *, odd: bool, smooth: bool) -> Waves:
    """Set up the harmonics.

    Args:
        harmonics: the highest order.
        odd: whether the even ones vanish.
        smooth: whether the forces are polynomials of the third degree, for which few samples are exact.
    """
    step = 2 if odd else 1
    orders = np.arange(1 if odd else 0, harmonics + 1, step)
    # Products of three reach up to 3 H and, with what they are projected on, up to 4 H and the order behind.
    samples = (4 if smooth else 12) * harmonics // step + 4
    angles = np.arange(samples) * (np.pi if odd else 2 * np.pi) / samples

    def both(k: np.ndarray) -> np.ndarray:
        return np.stack([np.cos(k[:, None] * angles), np.sin(k[:, None] * angles)])

    values = both(orders)
    slopes = orders[:, None] * np.stack([-values[1], values[0]])
    means = both(step * np.arange(2 * orders.size)) / samples
    beyond = np.arange(orders[-1] + step, samples * step // 2, step)
    above = both(beyond) * (2.0 / samples)
    return Waves(orders.astype(float), step, values, slopes, means, np.cos(angles), beyond.astype(float), above)


@eqx.filter_jit
def amplitude_roots(
    equation: TwistEquation, push: Float[Array, " points"], omega: Float[Array, " points"]
) -> tuple[Float[Array, "points motions"], Bool[Array, "points motions"]]:
    """Amplitudes of the one-harmonic motions, rising, and which of the three exist.

    Args:
        equation: its leaves carry one point an entry.
        push: amplitude of the forcing acceleration [rad/s^2].
        omega: forcing frequency [rad/s].
    """
    square = equation.drive.omega_0[None] ** 2
    d = 1.0 - omega[None] ** 2 / square
    m = equation.drive.mu[None] * omega[None] / square
    # In units of the largest possible z, the bound of the search.
    top = (push[None] / square / m) ** 2
    c = 0.75 * equation.drive.alpha[None] * top

    def left(z: Array) -> Array:
        return ((d + c * z) ** 2 + m**2) * z - m**2

    inside = d**2 - 3.0 * m**2
    turns = (inside > 0.0) & (c * d < 0.0)
    root, safe = jnp.sqrt(where(turns, inside, 0.0)), where(turns, c, 1.0)
    ends = [where(turns, (-2.0 * d + sign * root) / (3.0 * safe), 1.0) for sign in (-1.0, 1.0)]
    first, second = jnp.minimum(jnp.minimum(*ends), 1.0), jnp.minimum(jnp.maximum(*ends), 1.0)
    # It rises up to `first`, falls to `second` and rises again; all of it is the first rise where it does not turn.
    over, under = left(first) > 0.0, left(second) < 0.0
    exists = jnp.concatenate([over | ~turns, over & under & turns, (under | ~over) & turns])
    edges = jnp.concatenate([jnp.zeros_like(first), first, second, jnp.ones_like(first)])
    rising = np.array([[True], [False], [True]])

    def search(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        """A step of Newton's method, or half of the bracket where that would leave it."""
        low, high, z, _, count = carry
        value, slope = left(z), (d + c * z) ** 2 + m**2 + 2.0 * c * z * (d + c * z)
        short = (value < 0.0) == rising
        low, high = where(short, z, low), where(short, high, z)
        leap = z - value / where(slope == 0.0, 1.0, slope)
        settled = jnp.abs(leap - z) <= _FOUND * z
        moved = where(settled | ((leap > low) & (leap < high)), leap, 0.5 * (low + high))
        return low, high, moved, settled | ~exists, count + 1

    def searching(carry: tuple[Array, ...]) -> Array:
        return ~jnp.all(carry[3]) & (carry[4] < _SEARCHES)

    begin = (edges[:-1], edges[1:], 0.5 * (edges[:-1] + edges[1:]), ~exists, jnp.asarray(0))
    z = jax.lax.while_loop(searching, search, begin)[2]
    return jnp.sqrt(z * top).T, exists.T


class Balanced(eqx.Module):
    """Steady motions by lane.

    Attributes:
        unknowns: cosine and sine of each order [rad], about the forcing's own phase.
        peak: largest |x| [rad].
        saddle: whether the motion is unstable by a real multiplier above 1, as between two folds.
        truncation: estimated size of the largest omitted harmonic over the largest kept.
        converged: whether the balance was solved.
    """

    unknowns: Float[Array, "2 harmonics lanes"]
    peak: Float[Array, " lanes"]
    saddle: Bool[Array, " lanes"]
    truncation: Float[Array, " lanes"]
    converged: Bool[Array, " lanes"]


def one_harmonic(
    equation: TwistEquation, omega: Float[Array, " lanes"], amplitude: Float[Array, " lanes"]
) -> tuple[Float[Array, " lanes"], Float[Array, " lanes"]]:
    """Cosine and sine of a one-harmonic motion [rad] of an amplitude from [`amplitude_roots`][]."""
    drive = equation.drive
    stiffness = drive.omega_0**2 * (1.0 + 0.75 * drive.alpha * amplitude**2)
    phase = jnp.arctan2(drive.mu * omega, stiffness - omega**2)
    return amplitude * jnp.cos(phase), amplitude * jnp.sin(phase)


def balance_lanes(
    equation: TwistEquation,
    push: Float[Array, " lanes"],
    still: Float[Array, " lanes"],
    omega: Float[Array, " lanes"],
    start: Float[Array, "2 harmonics lanes"],
    kept: Waves,
    *,
    iterations: Int[Array, ""],
) -> Balanced:
    """Newton's method from approximate motions.

    Args:
        equation: its leaves carry one lane an entry.
        push: amplitude of the forcing acceleration [rad/s^2].
        still: constant part of it.
        omega: forcing frequency [rad/s].
        start: cosine and sine of each order [rad].
        kept: the harmonics.
        iterations: at most.
    """
    square = equation.drive.omega_0**2
    count = kept.orders.size
    inertia = kept.orders[:, None] ** 2 * (omega**2 / square)[None, :]
    damping = kept.orders[:, None] * (equation.drive.mu * omega / square)[None, :]
    # The sine of order 0 vanishes: it has a trivial equation.
    own = jnp.stack([-inertia, -inertia + (kept.orders == 0.0).astype(float)[:, None]])
    outside = jnp.asarray(kept.push)[:, None] * push[None, :] + still[None, :]

    def accelerations(x: Array, v: Array) -> Array:
        """Accelerations at the samples, in units of omega_0^2."""
        found = jax.vmap(lambda eq, x, v, o: eq.acceleration(x, v, o), in_axes=(0, 1, 1, 1), out_axes=1)
        return found(equation, x, v, outside) / square[None, :]

    def motion(u: Array) -> tuple[Array, Array]:
        x, slope = kept.at_samples(u)
        return x, omega[None, :] * slope

    def system(u: Array) -> tuple[Array, Array]:
        x, v = motion(u)
        a, by_x = jax.jvp(lambda x: accelerations(x, v), (x,), (jnp.ones_like(x),))
        matrix = -kept.product(by_x)
        if equation.effects:
            _, by_v = jax.jvp(lambda v: accelerations(x, v), (v,), (jnp.ones_like(v),))
            by_rate = kept.product((by_v + (equation.drive.mu / square)[None, :]) * omega[None, :])
            k = jnp.asarray(kept.orders)[None, None, :, None]
            matrix = matrix - jnp.stack([-k * by_rate[:, :, 1], k * by_rate[:, :, 0]], axis=2)
        j = np.arange(count)
        for part, other, sign in ((0, 1, 1.0), (1, 0, -1.0)):
            matrix = matrix.at[part, j, part, j].add(own[part]).at[part, j, other, j].add(sign * damping)
        return matrix, -inertia[None] * u - kept.coefficients(a)

    def improve(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        u, _, _, done = carry
        change, sign = _eliminated(*system(u))
        size = jnp.max(jnp.abs(u), axis=(0, 1)) + 1e-300
        length = jnp.max(jnp.abs(change), axis=(0, 1)) / size
        moved = u - change * jnp.minimum(1.0, _LONGEST_STEP / (length + 1e-300))[None, None, :]
        return where(jnp.isfinite(moved), moved, u), where(jnp.isfinite(length), length, jnp.inf), sign, done + 1

    def unfinished(carry: tuple[Array, Array, Array, Array]) -> Array:
        return jnp.any(carry[1] > _SOLVED) & (carry[3] < iterations)

    begin = (start, jnp.full_like(omega, jnp.inf), jnp.ones_like(omega), jnp.asarray(0))
    u, length, sign, _ = jax.lax.while_loop(unfinished, improve, begin)
    size = jnp.max(jnp.abs(u), axis=(0, 1)) + 1e-300
    left_out = jnp.linalg.norm(kept.above @ accelerations(*motion(u)), axis=0)
    stiffness = jnp.abs(1.0 - kept.beyond[:, None] ** 2 * (omega**2 / square)[None, :])
    truncation = jnp.max(left_out / jnp.maximum(stiffness, _LEAST_STIFFNESS), axis=0) / size
    return Balanced(u, _peak(u, kept), sign < 0.0, truncation, length <= _SOLVED)


def _peak(u: Array, kept: Waves) -> Array:
    """Largest |x| over a period, also between samples; over half a period for symmetric motions."""
    samples = _PEAK_SAMPLES * 2 // kept.step
    angles = np.arange(samples + 1) * (2 * np.pi / kept.step / samples)
    k = kept.orders[:, None]
    cosine, sine = np.cos(k * angles), np.sin(k * angles)
    flat = u.reshape(-1, u.shape[-1])
    tables = ((cosine, sine), (-k * sine, k * cosine), (-k * k * cosine, -k * k * sine))
    x, v, a = (jnp.asarray(np.concatenate(table).T) @ flat for table in tables)
    starts, ends = ((x[part], v[part], a[part]) for part in (slice(None, -1), slice(1, None)))
    return jnp.max(largest_between(starts, ends, jnp.full_like(x[1:], angles[1])), axis=0)


def _eliminated(
    matrix: Float[Array, "2 n 2 n lanes"], right: Float[Array, "2 n lanes"]
) -> tuple[Float[Array, "2 n lanes"], Float[Array, " lanes"]]:
    """Solution of a linear system in each lane, and the sign of its determinant.

    By 2 x 2 blocks without pivoting: the diagonal block of a harmonic, `[[d, m], [-m, d]]` plus the motion's part, is
    regular with damping. Rounding errors are corrected by the next Newton step.
    """

    def block(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rows, sign = carry
        pair = jax.lax.dynamic_index_in_dim(rows, j, axis=1, keepdims=False)
        columns = jax.lax.dynamic_index_in_dim(rows, j, axis=3, keepdims=False)
        (a, b), (c, d) = jax.lax.dynamic_index_in_dim(pair, j, axis=2)
        determinant = a * d - b * c
        first, second = pair / determinant[None, None]
        solved = jnp.stack([d[None] * first - b[None] * second, a[None] * second - c[None] * first])
        rows = rows - columns[:, :, 0, None, None] * solved[None, None, 0]
        rows = rows - columns[:, :, 1, None, None] * solved[None, None, 1]
        return jax.lax.dynamic_update_index_in_dim(rows, solved, j, axis=1), sign * jnp.sign(determinant[0])

    n = matrix.shape[1]
    # The right-hand side is one more column pair, of which the second is empty.
    beside = jnp.stack([right, jnp.zeros_like(right)], axis=2)[:, :, :, None]
    rows = jnp.concatenate([matrix, beside], axis=3)
    # A loop: the unrolled program takes a quarter of a minute to compile.
    rows, sign = jax.lax.fori_loop(0, n, block, (rows, jnp.ones_like(right[0, 0])))
    return rows[:, :, 0, -1], sign
