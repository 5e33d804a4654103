"""Confirmation of an optimum by a sweep around it, and of its gradient by difference quotients."""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import qmc

from hdjax.design.optimise import KEPT, Optimum
from hdjax.design.study import LANES, Study, appraise
from hdjax.design.variables import values

_STEP = 2e-4
_GRIDDED = 3
_SAMPLE = 256


class Confirmation(eqx.Module):
    """A sweep around an optimum.

    Attributes:
        shares: the evaluated designs, as shares of the ranges; the grid's last axis varies fastest.
        objective: of each; infinite where a measure does not exist.
        feasible: which meet all limits.
        shape: points along each variable for a grid, empty for a sample.
        best: the best feasible design, by path; empty without one.
        best_objective: its objective; infinite without one.
        gain: its improvement over the optimum, relative to the objective's size; negative where it is worse.
        gradient_error: largest difference between gradients and differences, of the objective and of each limit,
            relative to the row's largest slope, at the optimum and at a design beside it.
    """

    shares: Float[np.ndarray, "designs variables"]
    objective: Float[np.ndarray, " designs"]
    feasible: Bool[np.ndarray, " designs"]
    shape: tuple[int, ...]
    best: dict[str, float]
    best_objective: float
    gain: float
    gradient_error: float

    def confirmed(self, tolerance: float = 1e-4, gradient_tolerance: float = 1e-3) -> bool:
        """Whether no design of the sweep is better, and the gradients agree.

        Args:
            tolerance: of the gain: limits are met to a relative 1e-6, which a multiplier amplifies.
            gradient_tolerance: of the gradient's error.
        """
        return self.gain <= tolerance and self.gradient_error <= gradient_tolerance


def confirm(
    study: Study, optimum: Optimum, *, width: float = 0.1, points: int = 9, seed: int = 0, lanes: int = LANES
) -> Confirmation:
    """Sweep the designs around an optimum.

    Up to three variables are swept on a full grid, more on a sample that fills the box.

    Args:
        study: whose optimum it is.
        optimum: from `hdjax.design.optimise`.
        width: half the width of the swept box, as a share of each range; bounds cut it.
        points: along each variable; of an odd number the middle is the optimum.
        seed: of the sample.
        lanes: designs that are evaluated in parallel.
    """
    low, high = np.clip(optimum.shares - width, 0.0, 1.0), np.clip(optimum.shares + width, 0.0, 1.0)
    count = len(study.variables)
    if count <= _GRIDDED:
        axes = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
        designs, shape = np.array(list(itertools.product(*axes))), (points,) * count
    else:
        sample = qmc.Sobol(count, rng=seed).random(_SAMPLE)
        designs, shape = low + sample * (high - low), ()
    rows = appraise(study, designs, lanes=lanes).rows
    objective = np.where(np.isfinite(rows).all(axis=1), rows[:, 0], np.inf)
    feasible = np.isfinite(objective) & (rows[:, 1:] <= KEPT).all(axis=1)
    allowed = np.where(feasible, objective, np.inf)
    best = int(np.argmin(allowed))
    found = bool(feasible.any())
    size = abs(optimum.objective) or 1.0
    return Confirmation(
        shares=designs,
        objective=objective,
        feasible=feasible,
        shape=shape,
        best={p: float(v) for p, v in values(study.variables, jnp.asarray(designs[best])).items()} if found else {},
        best_objective=float(allowed[best]),
        gain=(optimum.objective - float(allowed[best])) / size if found else -np.inf,
        gradient_error=gradient_error(study, optimum.shares, lanes=lanes),
    )


def gradient_error(study: Study, shares: Float[np.ndarray, " variables"], *, lanes: int = LANES) -> float:
    """Largest difference between gradients and differences of fourth order, relative to the row's largest slope.

    At a design and a neighbouring one, since at an optimum a gradient may be zero and agree for that reason.

    Args:
        study: gives the rows: objective and limits.
        shares: of the variables' ranges.
        lanes: designs that are evaluated in parallel.
    """
    inside = np.clip(shares, 3 * _STEP, 1.0 - 3 * _STEP)
    beside = np.clip(np.where(shares < 0.5, inside + 0.05, inside - 0.05), 3 * _STEP, 1.0 - 3 * _STEP)
    steps = _STEP * np.array([-2.0, -1.0, 1.0, 2.0])
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * _STEP)
    around = steps[:, None, None] * np.eye(shares.size)
    centres = np.stack([inside, beside])
    asked = np.concatenate([centres, (centres[:, None, None] + around[None]).reshape(-1, shares.size)])
    found = appraise(study, asked, lanes=lanes)
    moved = found.rows[2:].reshape(2, steps.size, shares.size, -1)
    differences = np.einsum("s,csvr->crv", weights, moved)
    slopes = found.slopes[:2]
    largest = np.abs(slopes).max(axis=(0, 2))
    errors = np.abs(differences - slopes).max(axis=(0, 2)) / np.where(largest > 0.0, largest, 1.0)
    return float(np.max(errors))
