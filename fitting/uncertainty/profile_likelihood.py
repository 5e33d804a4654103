"""Intervals from the profile likelihood, where a quadratic approximation at the optimum is inaccurate.

Each point of a profile is a fit of all other parameters with one fixed (Venzon and Moolgavkar 1988). All points are
computed in parallel by one program. The increase of the sum of squares for 95 % is scaled by the ratio of robust and
classical variance (Kent 1982), with Student's t in place of a normal distribution; by one at least.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from scipy.special import stdtrit

from fitting.estimation.engines import residual_and_products, residual_with_blocks
from fitting.estimation.estimate import Fit
from fitting.estimation.levenberg_marquardt import ArrowLevenbergMarquardt
from fitting.estimation.residual import Problem, Unknowns
from fitting.uncertainty.normal_law import NORMAL_95
from fitting.uncertainty.standard_errors import Uncertainty, is_identifiable
from hdjax.where import where

# Points on each side, in units of the interval of the quadratic approximation; further rounds extend by this factor.
_GRID = np.array([0.5, 0.9, 1.1, 2.0])
_FURTHER = 5.0
_ROUNDS = 6
# Rounds that subdivide between the last point inside the interval and the first one outside.
_REFINEMENTS = 2
_INNER = np.array([0.2, 0.4, 0.6, 0.8])
# Roots beyond this are too far out for linear interpolation.
_FAR = 2.0
# Most steps of each point from its neighbour's solution, and initial damping.
_STEPS = 20
_DAMPING = 1e-6
# Largest distance of the first points from the optimum; a logarithm of 1 is a factor of e.
_FARTHEST_FIRST = 1.0
# An interval that extends further than this share of the way to zero may be far from that of the quadratic
# approximation.
_DOUBTFUL = 0.5
# Relative difference of an interval's sides above which the quadratic approximation is inaccurate.
_ASYMMETRIC = 0.1


class Profile(eqx.Module):
    """The profile likelihood of one parameter.

    Attributes:
        path: dotted path.
        value: at the optimum, in SI units.
        values: at which it was fixed, in rising order.
        rise: increase of the sum of squares there, over the increase for 95 %: below one inside the interval. Large
            where simulations diverge.
        ci95: interval; infinite where no value in the search range is excluded.
    """

    path: str = eqx.field(static=True)
    value: float
    values: Float[np.ndarray, " points"]
    rise: Float[np.ndarray, " points"]
    ci95: tuple[float, float]


def profile(fit: Fit, path: str, found: Uncertainty) -> Profile:
    """The profile likelihood of one free parameter.

    Args:
        fit: the fit.
        path: of the parameter.
        found: its uncertainty.

    Raises:
        ValueError: the parameter is not free.
    """
    if path not in fit.free.paths:
        raise ValueError(f"`path` must be one of {fit.free.paths}, but is {path!r}")
    index = fit.free.paths.index(path)
    estimate = found.estimates[path]
    # Half the interval of the quadratic approximation, which is no shorter than for a white residual.
    robust, unit = np.sqrt([found.covariance[index, index], found.unit_covariance[index, index]])
    classical = estimate.std_classical / abs(float(fit.free.slopes(fit.model)[index]))
    reach = max(stdtrit(estimate.degrees_of_freedom, 0.975) * robust, NORMAL_95 * classical)
    allowed = (reach / unit) ** 2
    reach = min(float(reach), _FARTHEST_FIRST)
    problem = eqx.tree_at(
        lambda p: (p.model, p.active), fit.problem, (fit.model, fit.problem.active.at[index].set(0.0))
    )
    walk = _Walk.start(fit.unknowns, index, float(_cost(problem, fit.unknowns)), float(allowed))
    for turn in range(_ROUNDS):
        steps = reach * _FURTHER**turn * _GRID
        # Both sides are always extended, so that all rounds share one program.
        walk = walk.extended(problem, np.concatenate([-steps, steps]))
        if all(np.isfinite(walk.bracket(side)).all() for side in (-1.0, 1.0)):
            break
    for _ in range(_REFINEMENTS):
        brackets = [walk.bracket(side) for side in (-1.0, 1.0)]
        # A side without a limit has nothing to subdivide: its points are placeholders.
        inner = [a + _INNER * (b - a) if np.isfinite([a, b]).all() else reach * _INNER for a, b in brackets]
        walk = walk.extended(problem, np.concatenate(inner))
    offsets, roots = walk.offsets, walk.roots
    low, high = (walk.crossing(side) for side in (-1.0, 1.0))
    centre = float(fit.unknowns.parameters[index])
    values = np.array([_physical(fit, index, centre + o) for o in offsets])
    return Profile(
        path=path,
        value=estimate.value,
        values=values,
        rise=np.minimum(roots, 1e6) ** 2,
        ci95=(_physical(fit, index, centre + low), _physical(fit, index, centre + high)),
    )


def with_profiles(fit: Fit, found: Uncertainty) -> Uncertainty:
    """The same uncertainty, with profile likelihood intervals where the quadratic approximation may be inaccurate.

    Profiles are computed for parameters that are not or hardly identifiable. An interval is replaced where the sides of
    the profile's differ by more than a tenth, or from the quadratic approximation.
    """
    estimates = dict(found.estimates)
    for path, estimate in found.estimates.items():
        logarithmic = fit.free.logarithmic[fit.free.paths.index(path)]
        half = 0.5 * (estimate.ci95[1] - estimate.ci95[0])
        if not half > _DOUBTFUL * abs(estimate.value):
            continue
        low, high = profile(fit, path, found).ci95
        old = estimate.ci95
        moved = max(abs(low - old[0]), abs(high - old[1])) if np.isfinite([low, high]).all() else np.inf
        if moved > _ASYMMETRIC * half:
            known = is_identifiable(path, (low, high), logarithmic=bool(logarithmic))
            estimates[path] = dataclasses.replace(estimate, ci95=(low, high), identifiable=known, interval="profile")
    # `tree_at` would sort the dictionary, and the covariance is in its order.
    return dataclasses.replace(found, estimates=estimates)


class _Walk(eqx.Module):
    """Points of a profile so far, by rising offset of the fixed entry, and the fits there.

    Attributes:
        index: of the fixed entry.
        floor: sum of squares at the optimum.
        allowed: its increase for 95 %.
        offsets: from the optimum.
        roots: square roots of the increase over the allowed one; linear for a quadratic.
        vectors: free vectors.
        states: initial states.
    """

    index: int = eqx.field(static=True)
    floor: float
    allowed: float
    offsets: np.ndarray
    roots: np.ndarray
    vectors: np.ndarray
    states: np.ndarray

    @staticmethod
    def start(optimum: Unknowns, index: int, floor: float, allowed: float) -> "_Walk":
        vectors, states = (np.asarray(a)[None] for a in (optimum.parameters, optimum.states))
        return _Walk(index, floor, allowed, np.zeros(1), np.zeros(1), vectors, states)

    def extended(self, problem: Problem, steps: np.ndarray) -> "_Walk":
        """The profile with further points, each fitted from its nearest neighbour's solution."""
        settled = np.flatnonzero(np.isfinite(self.roots))
        nearest = settled[np.argmin(np.abs(self.offsets[settled][None, :] - steps[:, None]), axis=1)]
        start = self.vectors[nearest]
        start[:, self.index] += steps - self.offsets[nearest]
        *solved, cost = _solve_lanes(problem, jnp.asarray(start), jnp.asarray(self.states[nearest]))
        rise = np.maximum(np.asarray(cost) - self.floor, 0.0) / self.allowed
        new = (steps, np.sqrt(rise), *(np.asarray(a) for a in solved))
        old = (self.offsets, self.roots, self.vectors, self.states)
        joined = [np.concatenate(pair) for pair in zip(old, new, strict=True)]
        order = np.argsort(joined[0])
        return _Walk(self.index, self.floor, self.allowed, *(a[order] for a in joined))

    def _side(self, side: float) -> tuple[np.ndarray, np.ndarray]:
        """Offsets on one side, from the optimum outwards, and their roots."""
        mine = side * self.offsets >= 0
        offsets, roots = self.offsets[mine], self.roots[mine]
        return (offsets, roots) if side > 0 else (offsets[::-1], roots[::-1])

    def bracket(self, side: float) -> tuple[float, float]:
        """The last offset inside the interval and the first one outside; infinite without one."""
        offsets, roots = self._side(side)
        outside = np.flatnonzero(roots > 1.0)
        if not outside.size:
            return float(offsets[-1]), side * np.inf
        return float(offsets[outside[0] - 1]), float(offsets[outside[0]])

    def crossing(self, side: float) -> float:
        """The limit of the interval."""
        a, b = self.bracket(side)
        if not np.isfinite(b):
            return b
        offsets, roots = self._side(side)
        low, high = (min(float(roots[offsets == o][0]), _FAR) for o in (a, b))
        return a + (b - a) * (1.0 - low) / (high - low)


def _physical(fit: Fit, index: int, entry: float) -> float:
    """The physical value of an entry of the free vector."""
    if fit.free.logarithmic[index]:
        with np.errstate(over="ignore"):
            return float(np.exp(entry))
    return entry * float(fit.free.scale[index])


@eqx.filter_jit
def _cost(problem: Problem, unknowns: Unknowns) -> Array:
    off = problem.free.off_prior(unknowns.parameters)
    return jnp.sum(residual_with_blocks(unknowns, problem).rows ** 2) + jnp.sum(off**2)


@eqx.filter_jit
def _solve_lanes(
    problem: Problem, parameters: Float[Array, "lanes parameters"], states: Float[Array, "lanes segments states"]
) -> tuple[Float[Array, "lanes parameters"], Float[Array, "lanes segments states"], Float[Array, " lanes"]]:
    """Fit the active parameters from each start; returns parameters, states and sums of squares."""

    def one(parameters: Array, states: Array) -> tuple[Array, Array, Array]:
        solver = ArrowLevenbergMarquardt(
            joined=problem.segments.joined,
            gap_weight=problem.gap_weight,
            damping=jnp.asarray(_DAMPING),
            most_steps=jnp.asarray(_STEPS),
            rows=jnp.asarray(float(problem.segments.measured.size)),
        )
        solution = optx.least_squares(
            residual_and_products,
            solver,
            Unknowns(parameters, states),
            args=problem,
            has_aux=True,
            max_steps=None,
            throw=False,
        )
        square = 2.0 * solution.state.costs[0]
        found = jnp.asarray(solution.value.parameters), jnp.asarray(solution.value.states)
        return *found, where(jnp.isfinite(square), square, jnp.inf)

    return jax.vmap(one)(parameters, states)
