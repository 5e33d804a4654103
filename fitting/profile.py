"""Intervals from the likelihood itself, where a parabola at the optimum does not tell its shape.

Each point of a profile is a fit of everything else with one parameter held (Venzon and Moolgavkar 1988). All points
are lanes of one program. The rise of the sum of squares that belongs to 95 % is scaled by what the residual's colour
does to the parameter's variance (Kent 1982), and Student's t stands where a normal law would.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from scipy.interpolate import PchipInterpolator
from scipy.stats import t as student

from fitting.arrow import ArrowDescent, ArrowLevenbergMarquardt
from fitting.estimate import Fit
from fitting.residual import Problem, Unknowns, residual_with_blocks
from fitting.uncertainty import Uncertainty
from hdjax.where import where

# Points on each side, in units of the interval that the parabola gives; further rounds reach this much further.
_GRID = (0.5, 1.0, 1.5, 2.0)
_FURTHER = 4.0
_ROUNDS = 6
# Lanes take at most this many steps from where their neighbours are, with this damping at first.
_STEPS = 20
_DAMPING = 1e-6
# The first points lie at most this far from the optimum; a logarithm of 1 is a factor of e.
_FARTHEST_FIRST = 1.0
# An interval that reaches further than this share of the way to zero may be anything but a parabola's.
_DOUBTFUL = 0.5
# Nor is a parabola one whose sides differ by more than this share.
_ASYMMETRIC = 0.1


class Profile(eqx.Module):
    """What the best fit costs where one parameter is held.

    Attributes:
        path: dotted path.
        value: at the optimum, in SI units.
        values: where it was held, rising.
        rise: of the sum of squares there, in units of what 95 % allows: the interval is where it is below one.
        ci95: interval; infinite where nothing within reach is excluded.
    """

    path: str = eqx.field(static=True)
    value: float
    values: Float[np.ndarray, " points"]
    rise: Float[np.ndarray, " points"]
    ci95: tuple[float, float]


def profile(fit: Fit, path: str, found: Uncertainty) -> Profile:
    """The likelihood's profile of one free parameter.

    Args:
        fit: the fit.
        path: of the parameter.
        found: its uncertainty.

    Raises:
        ValueError: where the parameter is not free.
    """
    if path not in fit.free.paths:
        raise ValueError(f"`path` must be one of {fit.free.paths}, but is {path!r}")
    index = fit.free.paths.index(path)
    estimate = found.estimates[path]
    # How much the parameter's variance exceeds that of a white residual of unit variance, times t squared.
    allowed = student.ppf(0.975, estimate.degrees_of_freedom) ** 2 * _inflation(fit, found, index)
    reach = np.sqrt(allowed * found.unit_covariance[index, index])
    reach = min(float(reach), _FARTHEST_FIRST)
    problem = eqx.tree_at(
        lambda p: (p.model, p.active), fit.problem, (fit.model, fit.problem.active.at[index].set(0.0))
    )
    floor = _cost(problem, fit.unknowns)
    offsets, roots = _walk(problem, fit.unknowns, index, reach, floor, allowed)
    low, high = (_crossing(offsets, roots, sign) for sign in (-1.0, 1.0))
    centre = float(fit.unknowns.parameters[index])
    values = np.array([_physical(fit, index, centre + o) for o in offsets])
    return Profile(
        path=path,
        value=estimate.value,
        values=values,
        rise=roots**2,
        ci95=(_physical(fit, index, centre + low), _physical(fit, index, centre + high)),
    )


def with_profiles(fit: Fit, found: Uncertainty) -> Uncertainty:
    """The same uncertainty, with intervals from profiles where those of the parabola are in doubt.

    A parameter is looked at where it is not identifiable or nearly so. Its interval is replaced where the sides of the
    profile's differ by more than a tenth, or from the parabola's.
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
            known = high / low < np.exp(2.0) if logarithmic and low > 0 else not low <= 0.0 <= high
            estimates[path] = dataclasses.replace(estimate, ci95=(low, high), identifiable=bool(known))
    return eqx.tree_at(lambda u: u.estimates, found, estimates, is_leaf=lambda x: isinstance(x, dict))


def _inflation(fit: Fit, found: Uncertainty, index: int) -> float:
    return float(found.covariance[index, index] / found.unit_covariance[index, index])


def _walk(
    problem: Problem, optimum: Unknowns, index: int, reach: float, floor: float, allowed: float
) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of the held entry, rising, and the signed roots of the rises; outwards until both sides are excluded."""
    offsets, roots = np.zeros(1), np.zeros(1)
    states = np.asarray(optimum.states)[None]
    vectors = np.asarray(optimum.parameters)[None]
    sides = [-1.0, 1.0]
    scale = reach
    for _ in range(_ROUNDS):
        # Both sides are always walked, so that all rounds share one program.
        steps = np.concatenate([-scale * np.array(_GRID), scale * np.array(_GRID)])
        nearest = np.argmin(np.abs(offsets[None, :] - steps[:, None]), axis=1)
        start = vectors[nearest].copy()
        start[:, index] = float(optimum.parameters[index]) + steps
        solved, cost = _solve_lanes(problem, Unknowns(jnp.asarray(start), jnp.asarray(states[nearest])))
        rise = np.maximum(np.nan_to_num(np.asarray(cost) - floor, nan=np.inf), 0.0)
        root = np.sign(steps) * np.sqrt(np.minimum(rise / allowed, 1e12))
        offsets, roots = np.concatenate([offsets, steps]), np.concatenate([roots, root])
        vectors = np.concatenate([vectors, np.asarray(solved.parameters)])
        states = np.concatenate([states, np.asarray(solved.states)])
        order = np.argsort(offsets)
        offsets, roots, vectors, states = offsets[order], roots[order], vectors[order], states[order]
        if all(np.any(s * roots > 1.0) for s in sides):
            break
        scale *= _FURTHER
    return offsets, roots


def _crossing(offsets: np.ndarray, roots: np.ndarray, sign: float) -> float:
    """Where a side's signed root, which a parabola makes a straight line, first reaches one."""
    side = sign * offsets >= 0
    distance, height = np.abs(offsets[side]), np.abs(roots[side])
    order = np.argsort(distance)
    distance, height = distance[order], height[order]
    above = np.flatnonzero(height > 1.0)
    if not above.size:
        return sign * np.inf
    distance, height = distance[: above[0] + 1], height[: above[0] + 1]
    rising = np.concatenate([[True], height[1:] > np.maximum.accumulate(height)[:-1]])
    distance, height = distance[rising], height[rising]
    return sign * float(PchipInterpolator(height, distance)(1.0))


def _physical(fit: Fit, index: int, entry: float) -> float:
    """The value that an entry of the free vector stands for."""
    if fit.free.logarithmic[index]:
        return float(np.exp(np.clip(entry, -700.0, 700.0)))
    return entry * float(fit.free.scale[index])


def _cost(problem: Problem, unknowns: Unknowns) -> float:
    return float(_evaluate(problem, unknowns))


@eqx.filter_jit
def _evaluate(problem: Problem, unknowns: Unknowns) -> Array:
    return jnp.sum(residual_with_blocks(unknowns, problem).rows ** 2)


@eqx.filter_jit
def _solve_lanes(problem: Problem, starts: Unknowns) -> tuple[Unknowns, Float[Array, " lanes"]]:
    """Fit what is active from each start; and the sums of squares."""

    def one(start: Unknowns) -> tuple[Unknowns, Array]:
        descent = ArrowDescent(problem.segments.joined, problem.gap_weight, jnp.asarray(_DAMPING))
        solution = optx.least_squares(
            residual_with_blocks,
            ArrowLevenbergMarquardt(descent=descent, most_steps=jnp.asarray(_STEPS)),
            start,
            args=problem,
            max_steps=None,
            throw=False,
        )
        end = solution.state.f_info.residual
        square = jnp.sum(end.rows**2) + jnp.sum(end.gap**2)
        return solution.value, where(jnp.isfinite(square), square, jnp.inf)

    return jax.vmap(one)(starts)
