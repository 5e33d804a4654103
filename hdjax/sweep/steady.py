"""Steady motions of very many drives and frequencies: harmonic balance whose lanes are points.

Every motion starts from a root of the Duffing oscillator's amplitude equation,

    ((omega_0^2 - w^2 + 3/4 omega_0^2 alpha z)^2 + (mu w)^2) z = A^2,    z = a^2,

of which there are one or three, and Newton's method takes it to as many harmonics as are asked for (alternating
frequency-time, Cameron and Griffin 1989). Motions that have no such relative, sub-harmonic ones for instance, are not
found; [`hdjax.response`][] finds those of a single drive.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hdjax.dynamics import Model
from hdjax.effects import Effect
from hdjax.effects.stiffness import QuadraticStiffness
from hdjax.sweep.twist import TwistEquation
from hdjax.sweep.windows import largest_between
from hdjax.where import where

MOTIONS = 3
"""At most, by rising amplitude: on the low branch, between the folds, and on the high branch."""
_LOPSIDED: tuple[type[Effect], ...] = (QuadraticStiffness,)
_BISECTIONS = 50
_SOLVED = 1e-10
_LONGEST_STEP = 0.5
_PEAK_SAMPLES = 64


class Waves(NamedTuple):
    """The harmonics that are kept, and their values at samples of a period (of half of it where all are odd).

    Attributes:
        orders: of each unknown; unknowns are cosine and sine of each order in turn.
        basis: values by unknown and sample.
        slope: their derivatives by the phase.
        projection: from samples to coefficients.
        push: the forcing's cosine at the samples.
        above: from samples to the size of the first harmonics left out.
        next_order: the order of these.
    """

    orders: Float[np.ndarray, " unknowns"]
    basis: Float[np.ndarray, "unknowns samples"]
    slope: Float[np.ndarray, "unknowns samples"]
    projection: Float[np.ndarray, "unknowns samples"]
    push: Float[np.ndarray, " samples"]
    above: Float[np.ndarray, "2 samples"]
    next_order: int


def symmetric(model: Model) -> bool:
    """Whether the mesh is the same both ways, so that a motion about zero has odd harmonics only."""
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
    period = np.pi if odd else 2 * np.pi
    samples = (4 if smooth else 12) * harmonics // step + 4
    angles = np.arange(samples) * (period / samples)

    def pairs(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.stack([first, second], axis=1).reshape(-1, samples)

    k = orders[:, None]
    cosine, sine = np.cos(k * angles), np.sin(k * angles)
    basis = pairs(cosine, sine)
    weights = np.where(np.repeat(orders, 2) == 0, 1.0, 2.0)[:, None] / samples
    following = int(orders[-1]) + step
    above = np.stack([np.cos(following * angles), np.sin(following * angles)]) * (2.0 / samples)
    arrays = (np.repeat(orders, 2).astype(float), basis, pairs(-k * sine, k * cosine), weights * basis)
    return Waves(*arrays, np.cos(angles), above, following)


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
    square = equation.drive.omega_0**2
    c = 0.75 * equation.drive.alpha
    d = 1.0 - omega**2 / square
    m = equation.drive.mu * omega / square
    force = (push / square) ** 2
    # In units of the largest possible z, the bound of the search.
    top = force / m**2
    c, force = c * top, m**2

    def left(z: Array) -> Array:
        return ((d + c * z) ** 2 + m**2) * z - force

    inside = d**2 - 3.0 * m**2
    turns = (inside > 0.0) & (c * d < 0.0)
    root = jnp.sqrt(where(turns, inside, 0.0))
    safe = where(turns, c, 1.0)
    ends = [where(turns, (-2.0 * d + sign * root) / (3.0 * safe), 1.0) for sign in (-1.0, 1.0)]
    first, second = jnp.minimum(jnp.minimum(*ends), 1.0), jnp.minimum(jnp.maximum(*ends), 1.0)
    three = turns & (left(first) > 0.0) & (left(second) < 0.0)
    low_only = three | ~turns | (left(first) > 0.0)
    brackets = (
        (jnp.zeros_like(first), where(low_only & turns, first, 1.0), three | (turns & (left(first) > 0.0)) | ~turns),
        (first, second, three),
        (second, jnp.ones_like(first), three | (turns & (left(first) <= 0.0))),
    )

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        same = jnp.sign(left(middle)) == jnp.sign(left(low))
        return where(same, middle, low), where(same, high, middle)

    found = [jax.lax.fori_loop(0, _BISECTIONS, halve, (low, high)) for low, high, _ in brackets]
    z = jnp.stack([0.5 * (low + high) for low, high in found], axis=-1) * top[:, None]
    return jnp.sqrt(z), jnp.stack([exists for *_, exists in brackets], axis=-1)


class Balanced(eqx.Module):
    """Steady motions by lane.

    Attributes:
        unknowns: cosine and sine of each order in turn [rad], about the forcing's own phase.
        peak: largest |x| [rad].
        saddle: whether the motion is unstable by a real multiplier above 1, as between two folds.
        truncation: size of the first harmonic left out over the largest kept, estimated.
        converged: whether the balance was solved.
    """

    unknowns: Float[Array, "unknowns lanes"]
    peak: Float[Array, " lanes"]
    saddle: Bool[Array, " lanes"]
    truncation: Float[Array, " lanes"]
    converged: Bool[Array, " lanes"]


def balance_lanes(
    equation: TwistEquation,
    push: Float[Array, " lanes"],
    still: Float[Array, " lanes"],
    omega: Float[Array, " lanes"],
    amplitude: Float[Array, " lanes"],
    kept: Waves,
    *,
    iterations: int,
) -> Balanced:
    """Newton's method from one-harmonic motions.

    Args:
        equation: its leaves carry one lane an entry.
        push: amplitude of the forcing acceleration [rad/s^2].
        still: its constant part.
        omega: forcing frequency [rad/s].
        amplitude: of the motion to start from [rad].
        kept: the harmonics.
        iterations: at most.
    """
    square = equation.drive.omega_0**2
    n = kept.orders.size
    first = int(np.argmax(kept.orders == 1.0))
    inertia = kept.orders[:, None] ** 2 * (omega**2 / square)[None, :]
    by_twist = (kept.projection[:, None, :] * kept.basis[None, :, :]).reshape(n * n, -1)
    by_rate = (kept.projection[:, None, :] * kept.slope[None, :, :]).reshape(n * n, -1)
    # The sine of order 0 is nothing: its place is held by an equation of its own.
    nothing = np.diag(np.where(np.arange(n) % 2 == 1, kept.orders == 0.0, False).astype(float))

    def forces(u: Array) -> tuple[Array, Array, Array]:
        """Accelerations at the samples, in units of omega_0^2, and their derivatives by twist and phase rate."""
        x, v = jnp.asarray(kept.basis.T) @ u, omega[None, :] * (jnp.asarray(kept.slope.T) @ u)
        outside = jnp.asarray(kept.push)[:, None] * push[None, :] + still[None, :]

        def of_one(eq: TwistEquation, x: Array, v: Array, outside: Array) -> tuple[Array, Array, Array]:
            one, none = jnp.ones_like(x), jnp.zeros_like(x)
            a, by_x = jax.jvp(lambda x: eq.acceleration(x, v, outside), (x,), (one,))
            _, by_v = jax.jvp(lambda x, v: eq.acceleration(x, v, outside), (x, v), (none, one))
            return a, by_x, by_v

        found = jax.vmap(of_one, in_axes=(0, 1, 1, 1), out_axes=1)(equation, x, v, outside)
        a, by_x, by_v = (f / square[None, :] for f in found)
        return a, by_x, by_v * omega[None, :]

    def system(u: Array) -> tuple[Array, Array]:
        a, by_x, by_v = forces(u)
        left = -inertia * u - kept.projection @ a
        matrix = -(by_twist @ by_x + by_rate @ by_v).reshape(n, n, -1)
        diagonal = jnp.eye(n)[:, :, None] * -inertia[:, None, :] + nothing[:, :, None]
        return left, matrix + diagonal

    def improve(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        u, _, count = carry
        change = _eliminated(*reversed(system(u)))[0]
        size = jnp.max(jnp.abs(u), axis=0) + 1e-300
        length = jnp.max(jnp.abs(change), axis=0) / size
        moved = u - change * jnp.minimum(1.0, _LONGEST_STEP / (length + 1e-300))[None, :]
        return where(jnp.isfinite(moved), moved, u), where(jnp.isfinite(length), length, jnp.inf), count + 1

    def unfinished(carry: tuple[Array, Array, Array]) -> Array:
        return jnp.any(carry[1] > _SOLVED) & (carry[2] < iterations)

    phase = jnp.arctan2(
        equation.drive.mu * omega, square * (1.0 + 0.75 * equation.drive.alpha * amplitude**2) - omega**2
    )
    start = jnp.zeros((n, amplitude.size)).at[first].set(amplitude * jnp.cos(phase))
    start = start.at[first + 1].set(amplitude * jnp.sin(phase))
    u, length, _ = jax.lax.while_loop(unfinished, improve, (start, jnp.full_like(amplitude, jnp.inf), jnp.asarray(0)))
    left, matrix = system(u)
    _, sign = _eliminated(matrix, left)
    size = jnp.max(jnp.abs(u), axis=0) + 1e-300
    above = jnp.linalg.norm(kept.above @ forces(u)[0], axis=0)
    above = above / jnp.maximum(jnp.abs(1.0 - (kept.next_order * omega) ** 2 / square), 1e-3) / size
    return Balanced(u, _peak(u, kept, omega), sign < 0.0, above, length < 1e3 * _SOLVED)


def _peak(u: Array, kept: Waves, omega: Array) -> Array:
    """Largest |x| over a period, between samples too."""
    angles = np.arange(_PEAK_SAMPLES + 1) * (2 * np.pi / _PEAK_SAMPLES)
    k = kept.orders[:, None]
    even = (np.arange(kept.orders.size) % 2 == 0)[:, None]
    cosine, sine = np.cos(k * angles), np.sin(k * angles)
    basis, slope = np.where(even, cosine, sine), np.where(even, -k * sine, k * cosine)
    x, v, a = (jnp.asarray(w.T) @ u for w in (basis, slope, -k * k * basis))
    starts, ends = ((x[part], v[part], a[part]) for part in (slice(None, -1), slice(1, None)))
    h = jnp.full_like(x[:-1], 2 * np.pi / _PEAK_SAMPLES)
    return jnp.max(largest_between(starts, ends, h), axis=0)


def _eliminated(matrix: Float[Array, "n n lanes"], right: Float[Array, "n lanes"]) -> tuple[Array, Array]:
    """Solution of a linear system in each lane, and the sign of its determinant.

    By 2 x 2 blocks without exchanges: a harmonic's own block, `[[d, m], [-m, d]]` and what the motion adds, is regular
    wherever there is damping; what rounding leaves, the next Newton step sees.
    """
    n = matrix.shape[0]

    def block(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rows, sign = carry
        pair = jax.lax.dynamic_slice_in_dim(rows, 2 * j, 2, axis=0)
        columns = jax.lax.dynamic_slice_in_dim(rows, 2 * j, 2, axis=1)
        own = jax.lax.dynamic_slice_in_dim(columns, 2 * j, 2, axis=0)
        a, b, c, d = own[0, 0], own[0, 1], own[1, 0], own[1, 1]
        determinant = a * d - b * c
        first, second = pair / determinant[None, None]
        solved = jnp.stack([d[None] * first - b[None] * second, a[None] * second - c[None] * first])
        rows = rows - columns[:, 0, None] * solved[None, 0] - columns[:, 1, None] * solved[None, 1]
        return jax.lax.dynamic_update_slice_in_dim(rows, solved, 2 * j, axis=0), sign * jnp.sign(determinant)

    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    # A loop, not its steps written out: that program takes a quarter of a minute to compile.
    rows, sign = jax.lax.fori_loop(0, n // 2, block, (rows, jnp.ones_like(right[0])))
    return rows[:, -1], sign
