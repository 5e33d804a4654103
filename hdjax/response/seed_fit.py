"""The model that comes nearest to a table of amplitudes over frequency, by least squares over every kind of motion.

`x'' + mu x' + omega_0^2 (x + alpha x^3) = A cos(omega t)`: what (A, omega_0, mu, alpha) give these largest |x|? At each
frequency any steady motion with the symmetry of the equation may stand for the table's: any branch, with its
super-harmonics, and sub-harmonics of order 1/3. The choice is thus the most charitable one, and what remains of misfit
belongs to the table. Motions that break the symmetry (even harmonics) and longer sub-harmonics are not tried.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from hdjax.drive import ReducedDrive, restoring
from hdjax.dynamics import ReducedModel
from hdjax.fourier import FourierSeries, harmonic_series
from hdjax.response.floquet import monodromy
from hdjax.response.harmonic_balance import balance, solve
from hdjax.response.modulation import AdditiveModulation, SubharmonicModulation
from hdjax.response.seed_data import TABLE_2
from hdjax.response.shooting import shoot, steady_series

ORDERS = np.arange(1, 16, 2)
"""Multiples of a third of the forcing frequency that a motion holds during the fit."""
SAMPLES = 96
HARMONICS = 21
"""Of a third of the forcing frequency when the optimum is confirmed."""
NEWTON_STEPS = 10
REFINED = 3
"""Rough motions at a frequency that are corrected: the nearest ones."""
ROUNDS, CHILDREN, STEP = 3, 20, 0.4
"""Of the random local search around each start: rounds, tries in each, and how far they reach at first (logarithms)."""
_FAR = 5.0
LOWEST = np.array([1e-3, 20.0, 1e-4, 1e-4])
HIGHEST = np.array([1e3, 1500.0, 1.0, 1e2])
"""Range of the starts: A/(omega_0^2 a), omega_0 [rad/s], mu/omega_0, |alpha| a^2, where a is the mean amplitude."""

_ANGLES = np.arange(SAMPLES) * (2 * np.pi / SAMPLES)
_BASIS = np.concatenate([np.cos(ORDERS[:, None] * _ANGLES), np.sin(ORDERS[:, None] * _ANGLES)])
_PROJECTION = _BASIS.T * (2.0 / SAMPLES)


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
        fitted: largest |x| of the nearest stable motion, by harmonic balance [rad].
        time: the same by time integration over a closed orbit (shooting); None where there is none.
        subharmonic: whether that motion is a sub-harmonic of order 1/3.
    """

    A: float
    omega_0: float
    mu: float
    alpha: float
    omega: tuple[float, ...]
    given: tuple[float, ...]
    fitted: tuple[float, ...]
    time: tuple[float | None, ...]
    subharmonic: tuple[bool, ...]

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
    omega: tuple[float, ...], amplitude: tuple[float, ...], *, screened: int = 20_000, starts: int = 48, seed: int = 0
) -> AmplitudeFit:
    """The (A, omega_0, mu, alpha) whose stable steady motions come nearest to the amplitudes, and how near.

    Random parameters are screened with two-term approximations of all their motions. The best are searched around and
    polished (Levenberg-Marquardt on the log amplitudes) with motions that obey the equation in harmonic balance. Of
    the results, those whose Floquet multipliers show all motions stable are confirmed, and the best is returned.

    Args:
        omega: forcing frequencies [rad/s].
        amplitude: largest |x| at each [rad].
        screened: random parameter sets, of either sign of alpha.
        starts: how many of them are refined.
        seed: of the random numbers.
    """
    if not omega or len(omega) != len(amplitude) or min(amplitude) <= 0.0:
        raise ValueError("`omega` and `amplitude` must be of one length, with amplitudes above zero")
    given, frequencies = jnp.asarray(amplitude), jnp.asarray(omega)
    length = jnp.exp(jnp.mean(jnp.log(given)))
    sizes = given / length
    found, balanced = _search(frequencies, sizes, jax.random.key(seed), screened, starts)
    ratio, lane = _nearest(found, balanced, sizes)
    if not np.isfinite(ratio):
        raise ValueError("no start led to stable motions at every frequency: raise `screened` or `starts`")
    best = jax.tree.map(lambda v: v[lane], (found, balanced))
    time = _shot(best[0], frequencies, best[1].start)
    A, omega_0, mu, alpha = (float(v) for v in best[0])
    a = float(length)
    return AmplitudeFit(
        A * a,
        omega_0,
        mu,
        alpha / a**2,
        tuple(omega),
        tuple(amplitude),
        tuple(a * float(v) for v in best[1].size),
        tuple(a * float(v) if ok else None for v, ok in zip(*time, strict=True)),
        tuple(bool(v) for v in best[1].subharmonic),
    )


@functools.cache
def best_fit_of_table_2(*, screened: int = 20_000, starts: int = 48, seed: int = 0) -> AmplitudeFit:
    """What comes nearest to the analytical column of the seed's Table 2, see [`fit_amplitudes`][]."""
    omega, amplitude = tuple(r.omega for r in TABLE_2), tuple(r.analytical for r in TABLE_2)
    return fit_amplitudes(omega, amplitude, screened=screened, starts=starts, seed=seed)


class _Balanced(eqx.Module):
    size: Float[Array, "*cases"]
    start: Float[Array, "*cases 2"]
    usable: Bool[Array, "*cases"]
    subharmonic: Bool[Array, "*cases"]


def _nearest(found: Array, balanced: _Balanced, sizes: Array) -> tuple[float, int]:
    """Sum of squared log ratios of the best lane all of whose motions are stable, and which it is."""
    misfit = jnp.sum(jnp.log(balanced.size / sizes[None]) ** 2, axis=1)
    usable = jnp.all(balanced.usable, axis=1) & jnp.all(jnp.isfinite(found), axis=1) & jnp.isfinite(misfit)
    misfit = np.asarray(jnp.where(usable, misfit, jnp.inf))
    return float(misfit.min()), int(misfit.argmin())


@eqx.filter_jit
def _search(omega: Array, sizes: Array, key: Array, screened: int, starts: int) -> tuple[Array, _Balanced]:
    """The best parameters (A, omega_0, mu, alpha) in units of the mean amplitude, and their motions."""
    low, high = jnp.log(LOWEST), jnp.log(HIGHEST)
    keys = jax.random.split(key, ROUNDS + 1)
    logs = jax.random.uniform(keys[0], (screened, 4), minval=low[None], maxval=high[None])
    signs = jnp.where(jnp.arange(screened) % 2 == 0, 1.0, -1.0)

    def rough(lane: tuple[Array, Array]) -> Array:
        return _nearest_motions(_parameters(*lane), omega, sizes, refined=False)[0]

    def exact(lane: tuple[Array, Array]) -> Array:
        return _nearest_motions(_parameters(*lane), omega, sizes, refined=True)[0]

    def best(cost: Array, signs: Array, count: int) -> Array:
        """As many hardening as softening ones: next to a softening drive's saddles rough motions look too good."""
        return jnp.concatenate(
            [jax.lax.top_k(jnp.where(signs == s, -cost, -jnp.inf), count // 2)[1] for s in (1.0, -1.0)]
        )

    kept = best(jax.lax.map(rough, (logs, signs), batch_size=1000), signs, CHILDREN * starts)
    logs, signs = logs[kept], signs[kept]
    cost = jax.lax.map(exact, (logs, signs), batch_size=200)
    kept = best(cost, signs, starts)
    logs, signs, cost = logs[kept], signs[kept], cost[kept]
    # A random local search first: the nearest motions often lie at the end of their branch, where no slope leads.
    for r in range(ROUNDS):
        step = STEP * 0.5**r * jax.random.normal(keys[r + 1], (starts, CHILDREN, 4))
        tried = (logs[:, None] + step).reshape(-1, 4)
        found = jax.lax.map(exact, (tried, jnp.repeat(signs, CHILDREN)), batch_size=200).reshape(starts, CHILDREN)
        child = jnp.argmin(found, axis=1)
        better = jnp.min(found, axis=1) < cost
        logs = jnp.where(better[:, None], tried.reshape(starts, CHILDREN, 4)[jnp.arange(starts), child], logs)
        cost = jnp.minimum(cost, jnp.min(found, axis=1))

    def polish(log: Array, sign: Array) -> Array:
        _, motions = _nearest_motions(_parameters(log, sign), omega, sizes, refined=True)

        def miss(log: Array, motions: Array) -> Array:
            p = _parameters(log, sign)
            found, usable = jax.vmap(lambda c, w: _corrected(p, c, w))(motions, omega)
            size = jnp.max(jnp.abs(found @ jnp.asarray(_BASIS)), axis=1)
            return jnp.where(usable, jnp.log(jnp.where(usable, size, 1.0) / sizes), _FAR)

        solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
        return optx.least_squares(miss, solver, log, motions, max_steps=60, throw=False).value

    def confirm(lane: tuple[Array, Array]) -> tuple[Array, _Balanced]:
        p = _parameters(*lane)
        _, motions = _nearest_motions(p, omega, sizes, refined=True)
        return p, jax.vmap(lambda c, w: _balanced(p, c, w))(motions, omega)

    logs = jnp.concatenate([logs, jax.vmap(polish)(logs, signs)])
    return jax.lax.map(confirm, (logs, jnp.concatenate([signs, signs])), batch_size=starts)


def _nearest_motions(p: Array, omega: Array, sizes: Array, *, refined: bool) -> tuple[Array, Array]:
    """Sum of squared log ratios over the nearest motion at each frequency, and those motions' coefficients."""

    def at(w: Array, target: Array) -> tuple[Array, Array]:
        motions, size, exists = _two_term_motions(p, w)
        if refined:
            order = jnp.argsort(_miss(size, exists, target))[:REFINED]
            motions, usable = jax.vmap(lambda c: _corrected(p, c, w))(motions[order])
            exists = exists[order] & usable
            size = jnp.max(jnp.abs(motions @ jnp.asarray(_BASIS)), axis=1)
        miss = _miss(size, exists, target)
        slot = jnp.argmin(miss)
        return miss[slot] ** 2, motions[slot]

    squares, motions = jax.vmap(at)(omega, sizes)
    return jnp.sum(squares), motions


def _miss(size: Array, exists: Array, target: Array) -> Array:
    there = exists & (size > 0.0) & jnp.isfinite(size)
    return jnp.where(there, jnp.abs(jnp.log(jnp.where(there, size, 1.0) / target)), _FAR)


def _corrected(
    p: Array, c: Float[Array, " unknowns"], omega: Array
) -> tuple[Float[Array, " unknowns"], Bool[Array, ""]]:
    """Newton steps to the motion near `c`, and whether they settled on one that is no saddle; differentiable in `p`."""

    def step(p: Array, c: Array) -> tuple[Array, Array]:
        slope = jax.jacfwd(_left_over, 1)(p, c, omega)
        return jnp.linalg.solve(slope, _left_over(p, c, omega)), jnp.linalg.det(slope)

    fixed = jax.lax.stop_gradient((p, c))
    near = jax.lax.fori_loop(0, NEWTON_STEPS, lambda _, c: c - step(fixed[0], c)[0], fixed[1])
    near = jax.lax.stop_gradient(near)
    settled = jnp.all(jnp.isfinite(near))
    near = jnp.where(settled, near, fixed[1])
    change, determinant = step(p, near)
    # The slope of the balance changes sign where a branch turns back: below zero the motion is not stable.
    usable = settled & (jnp.max(jnp.abs(change)) < 1e-6 * jnp.max(jnp.abs(near))) & (determinant > 0.0)
    return near - jnp.where(usable, change, 0.0), usable


def _parameters(log: Array, sign: Array) -> Float[Array, "4"]:
    """(A, omega_0, mu, alpha) from the logarithms that are searched; amplitudes in units of the mean."""
    A, omega_0, mu, alpha = jnp.exp(log)
    return jnp.stack([A * omega_0**2, omega_0, mu * omega_0, sign * alpha])


def _left_over(p: Array, c: Float[Array, " unknowns"], omega: Array) -> Float[Array, " unknowns"]:
    """Harmonic balance at the multiples `ORDERS` of omega/3, over inertia and spring."""
    A, omega_0, mu, alpha = p
    rates = jnp.asarray(ORDERS / 3.0) * omega
    cosine, sine = jnp.split(c, 2)
    spring = omega_0**2 * (restoring(c @ jnp.asarray(_BASIS), alpha) @ jnp.asarray(_PROJECTION))
    push = jnp.zeros_like(c).at[int(np.flatnonzero(ORDERS == 3)[0])].set(A)
    inertia = jnp.concatenate([rates**2 * cosine, rates**2 * sine])
    damping = mu * jnp.concatenate([rates * sine, -rates * cosine])
    return (spring - inertia + damping - push) / (omega_0**2 + omega**2)


def _two_term_motions(p: Array, omega: Array) -> tuple[Array, Array, Array]:
    """Rough coefficients at `ORDERS`, largest |x| and existence of all stable motions: three branches, each with its
    third harmonic on three, and the two sub-harmonics."""
    A, omega_0, mu, alpha = p
    k, zero = 0.75 * omega_0**2 * alpha, jnp.zeros(())
    # The modulation equations with squared frequencies for detunings are the balance of one harmonic.
    first = AdditiveModulation(2 * mu * omega, k, zero, -A).branches(omega**2 - omega_0**2)

    def with_third(a: Array, phase: Array, exists: Array) -> tuple[Array, Array]:
        mode = AdditiveModulation(6 * mu * omega, k, 2 * k * a**2, k * a**3 / 3)
        third = mode.branches(9 * omega**2 - omega_0**2)
        rows = jax.vmap(lambda b, psi: _placed(zero, zero, a, phase, b, psi + 3 * phase))(third.amplitude, third.phase)
        return rows, exists & third.stable

    rows, stable = jax.vmap(with_third)(first.amplitude, first.phase, first.stable)
    C = A / (omega_0**2 - omega**2)
    sub = SubharmonicModulation(2 * mu * omega / 3, k, 2 * k * C**2, k * C).branches((omega / 3) ** 2 - omega_0**2)
    slow = jax.vmap(lambda a, psi: _placed(a, psi, C, zero, zero, zero))(sub.amplitude[1:], sub.phase[1:])
    motions = jnp.concatenate([rows.reshape(9, -1), slow])
    exists = jnp.concatenate([stable.reshape(9), sub.stable[1:]])
    return motions, jnp.max(jnp.abs(motions @ jnp.asarray(_BASIS)), axis=1), exists


def _placed(*waves: Array) -> Array:
    """Coefficients of amplitudes and phases at 1, 3 and 9 times omega/3."""
    c = jnp.zeros(2 * ORDERS.size)
    for order, a, phase in zip((1, 3, 9), waves[::2], waves[1::2], strict=True):
        i = int(np.flatnonzero(ORDERS == order)[0])
        c = c.at[i].set(a * jnp.cos(phase)).at[ORDERS.size + i].set(-a * jnp.sin(phase))
    return c


def _model(p: Array) -> ReducedModel:
    return ReducedModel(ReducedDrive(mu=p[2], omega_0=p[1], alpha=p[3]))


def _balanced(p: Array, c: Array, omega: Array) -> _Balanced:
    """The motion that the coefficients lead to, with the project's own harmonic balance."""
    system = balance(_model(p), harmonic_series(omega, p[0]), harmonics=HARMONICS, subharmonic=3)
    cosine, sine = (jnp.zeros(HARMONICS).at[ORDERS - 1].set(half) for half in jnp.split(c, 2))
    steady = solve(system, omega, FourierSeries(omega / 3.0, jnp.zeros(()), cosine, sine))
    x = steady.x
    matrix = monodromy(system, system.unknowns(x), omega)
    # Both Floquet multipliers inside the unit circle (Jury's conditions).
    determinant = jnp.linalg.det(matrix)
    stable = (jnp.abs(jnp.trace(matrix)) < 1.0 + determinant) & (determinant < 1.0)
    start = jnp.stack([x(jnp.zeros(())), x.derivative()(jnp.zeros(()))])
    slow = jnp.delete(x.amplitudes, np.arange(2, HARMONICS, 3), assume_unique_indices=True)
    largest = x.largest()
    usable = steady.converged & stable & (steady.defect < 1e-3)
    return _Balanced(largest, start, usable, jnp.max(slow) > 1e-6 * largest)


@eqx.filter_jit
def _shot(p: Array, omega: Array, start: Array) -> tuple[Array, Array]:
    def one(w: Array, state: Array) -> tuple[Array, Array]:
        forcing = harmonic_series(w, p[0])
        orbit = shoot(_model(p), forcing, state, periods=3)
        series = steady_series(_model(p), forcing, orbit, harmonics=HARMONICS, samples=192)
        return series.largest(), orbit.converged

    return jax.vmap(one)(omega, start)
