"""Stability in the large of the unforced dynamic error, by its energy.

`V = v^2/2 + omega_0^2 x^2/2 + alpha omega_0^2 x^4/4` falls along every motion, `V' = -mu v^2 <= 0`, but not strictly:
V' vanishes wherever v = 0. So Lyapunov's theorem alone gives stability, not asymptotic stability as the seed document
has it. LaSalle's invariance principle gives the rest for mu > 0: a bounded motion tends to the largest invariant set
inside v = 0, where x' = 0 and v' = -omega_0^2 x (1 + alpha x^2) = 0, so to an equilibrium. For alpha >= 0 that is the
origin alone and V grows without bound: the origin attracts every motion. For alpha < 0 there are saddles at
x^2 = -1/alpha too; the set `|x| < 1/sqrt(-alpha), V < V_c` below their energy `V_c = omega_0^2/(4 |alpha|)` is bounded,
is never left and holds no equilibrium but the origin, so it lies inside the origin's basin. It is the largest such set
that V can show, and smaller than the basin.

References:
    LaSalle, J. P. (1960). Some extensions of Liapunov's second method. IRE Trans. Circuit Theory 7, 520-527.
    Khalil, H. K. (2002). Nonlinear Systems, 3rd ed., section 4.2 and theorem 4.4.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hdjax.drive import Drive, ReducedDrive, restoring
from hdjax.dynamics import ReducedModel
from hdjax.fourier import harmonic_series
from hdjax.simulate import simulate
from hdjax.where import where

FAR = 10.0
"""Times the saddles' twist beyond which an unforced motion has escaped: nothing out there turns it back."""


def energy(drive: Drive | ReducedDrive, x: Float[Array, "*n"], v: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The energy V of the dynamic error per unit of reduced inertia [rad^2/s^2]; times `1/c` it is in joule."""
    return 0.5 * v**2 + drive.omega_0**2 * (0.5 * x**2 + 0.25 * drive.alpha * x**4)


def energy_rate(drive: Drive | ReducedDrive, v: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Its rate along an unforced motion, `V' = -mu v^2` [rad^2/s^3]."""
    return -drive.mu * v**2


def saddle(drive: Drive | ReducedDrive) -> Float[Array, ""]:
    """Twist `1/sqrt(-alpha)` of the saddles on either side [rad]; infinite where alpha >= 0, which has none."""
    softening = drive.alpha < 0.0
    return where(softening, 1.0 / jnp.sqrt(where(softening, -drive.alpha, 1.0)), jnp.inf)


def critical_energy(drive: Drive | ReducedDrive) -> Float[Array, ""]:
    """Energy of the saddles, `V_c = omega_0^2/(4 |alpha|)` [rad^2/s^2]; infinite where alpha >= 0."""
    return 0.25 * drive.omega_0**2 * saddle(drive) ** 2


def in_basin_estimate(drive: Drive | ReducedDrive, x: Float[Array, "*n"], v: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    """Whether V proves that the unforced motion from (x, v) tends to the origin; needs mu > 0.

    True everywhere for alpha >= 0. For alpha < 0 true inside `|x| < 1/sqrt(-alpha), V < V_c`; a motion outside may
    come to rest as well.
    """
    return (drive.mu > 0.0) & (jnp.abs(x) < saddle(drive)) & (energy(drive, x, v) < critical_energy(drive))


class PhasePortrait(eqx.Module):
    """Unforced motions in the (x, v) plane, with the curves that order them.

    Attributes:
        time: of every motion [s].
        x: twist [rad], a motion a row; held where the motion escapes, beyond ten times the saddles' twist.
        v: its rate [rad/s], likewise.
        energy: V along each motion [rad^2/s^2].
        escaped: which motions do so.
        grid: twists at which the curves are given [rad].
        nullcline: rate v at which v' = 0 [rad/s], over `grid`; the other nullcline is v = 0. Infinite where mu = 0.
        level: rate v > 0 at which V = V_c [rad/s], over `grid`; its mirror image `-level` belongs to it. Without
            damping it is the separatrix. Zero outside the saddles and where alpha >= 0.
    """

    time: Float[Array, " n"]
    x: Float[Array, "lanes n"]
    v: Float[Array, "lanes n"]
    energy: Float[Array, "lanes n"]
    escaped: Bool[Array, " lanes"]
    grid: Float[Array, " points"]
    nullcline: Float[Array, " points"]
    level: Float[Array, " points"]


def phase_portrait(
    drive: Drive | ReducedDrive,
    initial_states: Float[Array, "lanes 2"],
    times: Float[Array, " n"],
    *,
    points: int = 201,
    rtol: float = 1e-8,
    atol: float = 1e-12,
    max_steps: int = 4096,
) -> PhasePortrait:
    """Motions of the unforced dynamic error, for plotting.

    Args:
        drive: the drive, or its reduced equation.
        initial_states: (x, v) [rad, rad/s] at the first time, by row.
        times: where to give the motions [s], rising.
        points: number of twists at which the curves are given.
        rtol: relative tolerance of the steps.
        atol: absolute tolerance of the steps.
        max_steps: steps until a motion counts as escaped.
    """
    reduced = drive if isinstance(drive, ReducedDrive) else drive.reduced()
    return _phase_portrait(reduced, initial_states, times, points, rtol, atol, max_steps)


@eqx.filter_jit
def _phase_portrait(drive, initial_states, times, points, rtol, atol, max_steps) -> PhasePortrait:
    model, unforced = ReducedModel(drive), harmonic_series(1.0, 0.0)

    edge = saddle(drive)

    def motion(state):
        found = simulate(model, unforced, times, state, rtol=rtol, atol=atol, max_steps=max_steps, throw=False)
        x, v = found.states[:, 0], found.states[:, 1]
        near = jnp.isfinite(energy(drive, x, v)) & (jnp.abs(x) <= FAR * edge)
        last = jnp.maximum(jnp.sum(jnp.cumprod(near)) - 1, 0)
        return found.states[jnp.minimum(jnp.arange(times.size), last)], ~jnp.all(near)

    states, escaped = jax.vmap(motion)(initial_states)
    x, v = states[..., 0], states[..., 1]
    furthest = jnp.max(jnp.abs(x))
    grid = jnp.linspace(-1.0, 1.0, points) * where(jnp.isfinite(edge), 1.25 * edge, furthest)
    damped = drive.mu != 0.0
    pull = drive.stiffness * restoring(grid, drive.alpha)
    nullcline = where(damped, -pull / where(damped, drive.mu, 1.0), jnp.inf)
    # V_c - V(x, 0) is the square (omega_0^2 |alpha| / 4) (1/|alpha| - x^2)^2.
    inside = jnp.abs(grid) < edge
    softening = jnp.maximum(-drive.alpha, 0.0)
    room = where(inside & (softening > 0.0), edge**2 - grid**2, 0.0)
    level = drive.omega_0 * jnp.sqrt(softening / 2.0) * where(jnp.isfinite(room), room, 0.0)
    return PhasePortrait(times, x, v, energy(drive, x, v), escaped, grid, nullcline, level)
