"""The peak of a frequency response, and the backbone curve on which peaks lie."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float

from hdjax.dynamics import ReducedModel
from hdjax.fourier import FourierSeries
from hdjax.response.continuation import Branch
from hdjax.response.harmonic_balance import DEFAULT_HARMONICS, BalancedMotion, SteadyState, balance

_TOLERANCE = 1e-11
_SOLVED = 1e-8


class Peak(eqx.Module):
    """The largest response of a branch.

    Attributes:
        value: the branch's parameter there; the forcing frequency [rad/s] of a frequency response.
        amplitude: largest |x| over a period [rad].
        steady_state: the motion.
        converged: whether the peak was located within the branch; an end of the branch is not a peak.
    """

    value: Float[Array, ""]
    amplitude: Float[Array, ""]
    steady_state: SteadyState
    converged: Bool[Array, ""]


@eqx.filter_jit
def peak(branch: Branch, *, harmonic: int | None = None) -> Peak:
    """The largest motion of a branch about its mean; value and amplitude have gradients by drive and forcing.

    Args:
        branch: from [`hdjax.response.frequency_response`][] or [`hdjax.response.follow`][].
        harmonic: the harmonic of the motion that shall be largest (3 for a super-harmonic peak, for instance); the
            motion's mean square about its mean where not given.
    """
    H = branch.system.harmonics
    n = branch.unknowns.shape[1]

    def size(unknowns: Array) -> Array:
        cosine, sine = unknowns[1 : H + 1], unknowns[H + 1 : 2 * H + 1]
        square = cosine**2 + sine**2
        return jnp.sum(square) if harmonic is None else square[harmonic - 1]

    row = jnp.argmax(jnp.where(branch.valid, jax.vmap(size)(branch.unknowns), -1.0))
    start = jnp.concatenate([branch.unknowns[row], branch.value[row, None] / branch.scale])

    def residual(y: Array, given: tuple[BalancedMotion, Array]) -> Array:
        moved = eqx.tree_at(lambda b: b.system, branch, given[0])
        by_unknowns, by_parameter = jax.jacfwd(moved.residual, (0, 1))(y[:n], y[n], given[1])
        climb = jax.grad(size)(y[:n]) @ jnp.linalg.solve(by_unknowns, by_parameter)
        return jnp.concatenate([moved.residual(y[:n], y[n], given[1]), climb[None]])

    given = (branch.system, branch.omega[row])
    solver = optx.Newton(_TOLERANCE, _TOLERANCE)
    y = optx.root_find(residual, solver, jax.lax.stop_gradient(start), given, max_steps=30, throw=False).value
    left = jnp.max(jnp.abs(residual(y, given)))
    near = jnp.linalg.norm(y - start) < 0.2 * (1.0 + jnp.linalg.norm(start))
    converged = jnp.isfinite(left) & (left < _SOLVED) & near & branch.valid[row]
    y = jnp.where(converged, y, start)
    value = y[n] * branch.scale
    omega = value if branch.parameter == "omega" else branch.omega[row]
    motion = branch.at(value).steady_state(y[:n], omega, converged)
    return Peak(value, motion.x.largest(), motion, converged)


class Backbone(eqx.Module):
    """Free, undamped motions: the curve on which the peaks of the forced response lie.

    Attributes:
        amplitude: of the first harmonic [rad].
        omega: natural frequency at that amplitude [rad/s].
        motion: the motions, by row.
        converged: by row; a softening drive has none beyond its saddles.
    """

    amplitude: Float[Array, " amplitudes"]
    omega: Float[Array, " amplitudes"]
    motion: FourierSeries
    converged: Bool[Array, " amplitudes"]


@eqx.filter_jit
def backbone(model: ReducedModel, amplitudes: ArrayLike, *, harmonics: int = DEFAULT_HARMONICS) -> Backbone:
    """The natural frequency as a function of the amplitude.

    A free undamped motion that starts from its turning point is even in time, and damping does not act on its cosines.
    So the cosine part of harmonic balance is the whole condition.

    Args:
        model: its forcing and damping are not used.
        amplitudes: first harmonics [rad], rising; each motion is the start for the next.
        harmonics: highest multiple of the frequency to keep.
    """
    amplitudes = jnp.asarray(amplitudes, dtype=float)
    omega_0 = model.drive.omega_0
    system = eqx.tree_at(lambda s: s.length, balance(model, harmonics=harmonics), jnp.max(amplitudes))
    sines = jnp.zeros(harmonics)

    def unknowns(y: Array, a: Array) -> Array:
        return jnp.concatenate([y[:1], a[None] / system.length, y[2:], sines])

    def residual(y: Array, a: Array) -> Array:
        return system.residual(unknowns(y, a), y[1] * omega_0)[: harmonics + 1]

    def advance(guess: Array, a: Array) -> tuple[Array, tuple[Array, Array]]:
        solver = optx.Newton(_TOLERANCE, _TOLERANCE)
        y = optx.root_find(residual, solver, guess, a, max_steps=30, throw=False).value
        left = jnp.max(jnp.abs(residual(y, a)))
        converged = jnp.isfinite(left) & (left < _SOLVED) & (y[1] > 0.0)
        y = jnp.where(converged, y, guess)
        return y, (y, converged)

    # (mean, frequency, higher cosines), from the linear oscillation.
    start = jnp.zeros(harmonics + 1).at[1].set(1.0)
    _, (found, converged) = jax.lax.scan(advance, start, amplitudes)
    rows = system.length * jax.vmap(unknowns)(found, amplitudes)
    motion = FourierSeries(found[:, 1] * omega_0, rows[:, 0], rows[:, 1 : harmonics + 1], rows[:, harmonics + 1 :])
    return Backbone(amplitudes, found[:, 1] * omega_0, motion, converged)
