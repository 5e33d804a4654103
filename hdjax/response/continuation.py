"""Branches of steady motions through folds: pseudo-arclength continuation of harmonic balance.

The predictor-corrector is JaxCont's (Keller 1977); it follows the branch in a few steps. Its points are interpolated,
and all requested points are corrected in parallel by one program.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, ArrayLike, Bool, Float

from hdjax.dynamics import Model
from hdjax.fourier import FourierSeries
from hdjax.parameters import as_scalar
from hdjax.response.floquet import is_stable, multipliers, resolving_steps
from hdjax.response.harmonic_balance import BalancedMotion, SteadyState, balance, find_root
from hdjax.where import where

_TOLERANCE = 1e-9
_SOLVED = 1e-11
_CORRECTIONS = 2
_CHORDS = 5
_ITERATIONS = 8
_MARGIN = 1e-6


class Branch(eqx.Module):
    """Steady motions along a branch, by rows; folds are where the parameter reverses.

    Attributes:
        system: of harmonic balance.
        parameter: `"omega"`, `"amplitude"` or a parameter's dotted path.
        scale: of the parameter in the scaled problem.
        value: the parameter's value.
        omega: the forcing frequency [rad/s].
        unknowns: the system's unknowns.
        tangents: unit direction of the branch in (unknowns, scaled parameter); the last entry changes sign at a fold.
        valid: which rows are motions; the others are beyond the end of the branch, or not converged.
        complete: whether the branch reached the end of the parameter's range or closed upon itself.
    """

    system: BalancedMotion
    parameter: str = eqx.field(static=True)
    scale: Float[Array, ""]
    value: Float[Array, " points"]
    omega: Float[Array, " points"]
    unknowns: Float[Array, "points unknowns"]
    tangents: Float[Array, "points directions"]
    valid: Bool[Array, " points"]
    complete: Bool[Array, ""]

    @property
    def steady_states(self) -> SteadyState:
        """The motions, by row."""
        return _branch_motions(self)

    @property
    def amplitude(self) -> Float[Array, " points"]:
        """Largest |x| over a period [rad]."""
        return self.steady_states.x.largest()

    @property
    def multipliers(self) -> Array:
        """Floquet multipliers by row."""
        return _branch_multipliers(self, _floquet_steps(self))

    @property
    def stable(self) -> Bool[Array, " points"]:
        """Whether no Floquet multiplier lies outside the unit circle."""
        return is_stable(self.multipliers)

    def within(self, slow: ArrayLike, fast: ArrayLike) -> "Branch":
        """The branch up to where it leaves a range of forcing frequencies [rad/s]; further rows are not valid."""
        low, high = as_scalar(slow) * (1.0 - _MARGIN), as_scalar(fast) * (1.0 + _MARGIN)
        inside = jnp.cumsum(where((self.omega < low) | (self.omega > high), 1, 0)) == 0
        return eqx.tree_at(lambda b: b.valid, self, self.valid & inside)

    def at(self, value: Array) -> BalancedMotion:
        """The system at a value of the parameter."""
        return self.system if self.parameter == "omega" else self.system.with_parameter(self.parameter, value)

    def residual(self, unknowns: Array, scaled: Array, omega: Array) -> Array:
        """The system's residual at a scaled value of the parameter; `omega` holds where it is not the parameter."""
        value = scaled * self.scale
        return self.at(value).residual(unknowns, value if self.parameter == "omega" else omega)


def frequency_response(
    model: Model,
    forcing: FourierSeries | None,
    omega_start: ArrayLike,
    omega_end: ArrayLike,
    *,
    load_torque: FourierSeries | None = None,
    points: int = 1000,
    harmonics: int = 9,
    samples: int | None = None,
    subharmonic: int = 1,
    rotating: bool = False,
    guess: FourierSeries | None = None,
    steps: int = 1000,
) -> Branch:
    """All steady motions on the branch that starts at `omega_start`, through its folds to `omega_end`.

    Args:
        model: see [`hdjax.response.balance`][], as for the other arguments of that name.
        forcing: its omega is not used.
        omega_start: forcing frequency to start from [rad/s]; away from a resonance the start needs no guess.
        omega_end: where to stop [rad/s].
        load_torque: torque on the load.
        points: number of motions to return, evenly along the branch's length, so that peaks are resolved.
        harmonics: highest multiple of the fundamental to keep.
        samples: points of one period.
        subharmonic: look for motions of this many forcing periods; needs a guess.
        rotating: the motor turns at the forcing frequency.
        guess: dynamic error to start from (reduced drives); the linearised response where not given.
        steps: of the continuation, at most.
    """
    system = balance(
        model,
        forcing,
        load_torque=load_torque,
        harmonics=harmonics,
        samples=samples,
        subharmonic=subharmonic,
        rotating=rotating,
    )
    return follow(system, "omega", omega_start, omega_end, guess=guess, points=points, steps=steps)


def follow(
    system: BalancedMotion,
    parameter: str,
    start: ArrayLike,
    end: ArrayLike,
    *,
    omega: ArrayLike = 1.0,
    guess: FourierSeries | None = None,
    points: int = 1000,
    steps: int = 1000,
) -> Branch:
    """Follow steady motions in any parameter.

    Args:
        system: from [`hdjax.response.balance`][].
        parameter: `"omega"`, `"amplitude"` (a factor on the forcing) or a parameter's dotted path such as `"K"`.
        start: its first value.
        end: its last value.
        omega: forcing frequency [rad/s] where another parameter is followed.
        guess: dynamic error to start from (reduced drives); the linearised response where not given.
        points: motions to return.
        steps: of the continuation, at most.
    """
    start, end, omega = as_scalar(start), as_scalar(end), as_scalar(omega)
    if guess is not None and system.subharmonic > 1:
        # The linear resonance's amplitude can be far from that of a sub-harmonic motion.
        system = eqx.tree_at(lambda s: s.length, system, guess.largest())
    return _follow(system, parameter, start, end, omega, guess, points, steps)


@eqx.filter_jit
def _follow(system, parameter, start, end, omega, guess, points, steps) -> Branch:
    scale = system.model.drive.omega_0 if parameter == "omega" else jnp.maximum(jnp.abs(start), jnp.abs(end))
    row, rows, no = jnp.zeros(0), jnp.zeros((0, 0)), jnp.zeros(0, dtype=bool)
    branch = Branch(system, parameter, scale, row, row, rows, rows, no, jnp.asarray(False))

    def residual(u: Array, p: Array) -> Array:
        return branch.residual(u, p, omega)

    # Only the correction of its points is differentiated, not the search.
    still, still_omega = lax.stop_gradient((branch, omega))

    first = start if parameter == "omega" else omega
    u_0, _ = find_root(branch.at(start), first, guess)
    p_0, p_1 = start / scale, end / scale
    start_and_end = lax.stop_gradient((u_0, p_0, p_1))
    found = continued(lambda u, p: still.residual(u, p, still_omega), *start_and_end, steps)
    count, complete = _end(found, p_0, p_1, _longest_step(p_0, p_1, steps), positive=parameter == "omega")
    path = jnp.concatenate([found.states, found.params[:, None]], axis=1)
    predicted, tangents = _interpolated(path, found.tangents, count, p_1, points)
    corrected, tangents, left = jax.vmap(_correct, in_axes=(None, 0, 0))(residual, predicted, tangents)
    value = corrected[:, -1] * scale
    return Branch(
        system,
        parameter,
        scale,
        value,
        value if parameter == "omega" else jnp.full(points, 1.0) * omega,
        corrected[:, :-1],
        tangents,
        found.converged[0] & (left < _SOLVED),
        # A step that jumped to another branch leaves points between that can't be corrected.
        found.converged[0] & complete & jnp.all(left < _SOLVED),
    )


def _end(found, p_0: Array, p_1: Array, step: Array, *, positive: bool) -> tuple[Array, Array]:
    """Number of points of a continuation on the branch, and whether it reached its end or its start.

    A positive parameter, the frequency, must not pass zero, beyond which motions repeat mirrored.
    """
    index = jnp.arange(found.params.size)
    used = index < found.n_valid
    distance = jnp.linalg.norm(found.states - found.states[:1], axis=1) + jnp.abs(found.params - found.params[0])
    away = jnp.cumsum(where(distance > step, 1, 0)) > 0
    back = used & away & (distance < 0.75 * step) & (found.tangents @ found.tangents[0] > 0.5)
    closed = jnp.any(back)
    last = found.params[found.n_valid - 1]
    reached = (last - p_1) * jnp.sign(p_1 - p_0) >= 0.0
    count, complete = where(closed, jnp.argmax(back) + 1, found.n_valid), reached | closed
    if positive:
        passed = used & (found.params <= 0.0)
        first = jnp.maximum(jnp.argmax(passed), 2)
        count, complete = where(jnp.any(passed), jnp.minimum(first, count), count), complete & ~jnp.any(passed)
    return count, complete


def _interpolated(path: Array, tangents: Array, count: Array, p_1: Array, points: int) -> tuple[Array, Array]:
    """Points evenly along a branch, by cubic Hermite interpolation over its chord length, and their tangents."""
    used = jnp.arange(path.shape[0]) < count
    chords = where(used[1:], jnp.linalg.norm(jnp.diff(path, axis=0), axis=1), 0.0)
    length = jnp.concatenate([jnp.zeros(1), jnp.cumsum(chords)])
    # The last step runs past the end of the range: stop at the end itself.
    before, after = path[count - 2, -1], path[count - 1, -1]
    fraction = where(after == before, 1.0, jnp.clip((p_1 - before) / (after - before), 0.0, 1.0))
    overshoot = (after - p_1) * jnp.sign(after - before) > 0.0
    end = length[-1] - where(overshoot, (1.0 - fraction) * chords[count - 2], 0.0)
    at = jnp.linspace(0.0, 1.0, points) * end
    left = jnp.clip(jnp.astype(jnp.searchsorted(length, at, side="right"), int) - 1, 0, count - 2)
    h = chords[left][:, None]
    s = ((at - length[left]) / chords[left])[:, None]
    y_0, y_1, d_0, d_1 = path[left], path[left + 1], h * tangents[left], h * tangents[left + 1]
    value = (1 + 2 * s) * (1 - s) ** 2 * y_0 + s**2 * (3 - 2 * s) * y_1 + s * (1 - s) ** 2 * d_0 - s**2 * (1 - s) * d_1
    slope = 6 * s * (1 - s) * (y_1 - y_0) + (1 - s) * (1 - 3 * s) * d_0 - s * (2 - 3 * s) * d_1
    return value, slope / jnp.linalg.norm(slope, axis=1, keepdims=True)


def _correct(residual, point: Array, tangent: Array) -> tuple[Array, Array, Array]:
    """Newton steps at right angles to the branch: the point, the branch's direction there, and the residual."""

    def left_over(point: Array) -> Array:
        return residual(point[:-1], point[-1])

    # Loops: unrolling would multiply the residual's code, which dominates the program.
    def corrected(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        point, tangent = carry
        factors = lu_factor(jnp.concatenate([jax.jacfwd(left_over)(point), tangent[None]]))

        def chord(point: Array, _: None) -> tuple[Array, None]:
            return point - lu_solve(factors, jnp.append(left_over(point), 0.0)), None

        point, _ = lax.scan(chord, point, length=_CHORDS)
        direction = lu_solve(factors, jnp.zeros_like(point).at[-1].set(1.0))
        return (point, direction / jnp.linalg.norm(direction)), None

    (point, tangent), _ = lax.scan(corrected, (point, tangent), length=_CORRECTIONS)
    left = jnp.max(jnp.abs(left_over(point)))
    finite = jnp.isfinite(left) & jnp.all(jnp.isfinite(point))
    return where(finite, point, 0.0), where(finite, tangent, 0.0), where(finite, left, jnp.inf)


@eqx.filter_jit
def _branch_motions(branch: Branch) -> SteadyState:
    motions = jax.vmap(lambda value, omega, unknowns, valid: branch.at(value).steady_state(unknowns, omega, valid))
    return motions(branch.value, branch.omega, branch.unknowns, branch.valid)


@eqx.filter_jit
def _branch_multipliers(branch: Branch, steps: int) -> Array:
    each = jax.vmap(lambda v, w, u: multipliers(branch.at(v), u, w, steps=steps))
    return each(branch.value, branch.omega, branch.unknowns)


def _floquet_steps(branch: Branch) -> int:
    """Steps of a period that resolve the natural oscillations within the longest."""
    if isinstance(branch.omega, Tracer):
        return 64
    slowest = np.min(np.asarray(branch.omega), where=np.asarray(branch.valid), initial=np.inf)
    drive = branch.system.model.drive
    hardening = 1.0 + 3.0 * np.maximum(drive.alpha, 0.0) * np.max(np.asarray(branch.amplitude)) ** 2
    turns = float(branch.system.subharmonic * drive.omega_0 * np.sqrt(hardening) / slowest)
    return min(resolving_steps(turns), 4096)


def continued(residual, u_0: Array, p_0: Array, p_1: Array, steps: int):
    """JaxCont's pseudo-arclength continuation, with steps that suit unknowns and a parameter of order one."""
    # Imported here: JaxCont imports matplotlib, which takes as long as JAX. Its constants must not belong to this
    # program.
    with jax.ensure_compile_time_eval():
        from jaxcont.core.scan_continuation import pseudo_arclength_scan

    largest = _longest_step(p_0, p_1, steps)
    # JaxCont mixes integer and floating types.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        found = pseudo_arclength_scan(
            residual, u_0, p_0, p_1, 0.1 * largest, 1e-6 * largest, largest, jnp.asarray(_TOLERANCE), steps, _ITERATIONS
        )
    return found._replace(n_valid=jnp.astype(found.n_valid, int))


def _longest_step(p_0: Array, p_1: Array, steps: int) -> Array:
    return 3.0 * (jnp.abs(p_1 - p_0) + 2.0) / steps
