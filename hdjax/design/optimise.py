"""The best design of a study, from several starts.

Sequential quadratic programming (Kraft 1988, SciPy's SLSQP): it meets bounds and smooth constraints exactly, needs some
ten gradients where an augmented Lagrangian needs ten minimisations, and optimistix has no solver with constraints.
Values and gradients of all starts are evaluated as lanes of one program. Results are checked afterwards by the
conditions of Karush, Kuhn and Tucker.
"""

import enum
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize, nnls
from scipy.stats import qmc

from hdjax.design.lockstep import in_lockstep
from hdjax.design.study import LANES, Study, appraise
from hdjax.design.variables import values

KEPT = 1e-6
"""Relative excess over a limit that still counts as met."""

_AT_BOUND = 1e-6
_ACTIVE = 1e-4
_STATIONARY = 1e-3
_TOLERANCE = 1e-10
_STEPS = 100
# Objective and constraint of a design without one, in units of typical values.
_BAD = 1e3


class Outcome(enum.StrEnum):
    """How the search from one start ended."""

    optimum = "an optimum: feasible, and no direction leads on"
    stalled = "feasible, but not stationary: a kink, where two motions or two measures are equally bad, or a flat floor"
    infeasible = "no design near it keeps all limits"
    lost = "a measure does not exist at the start: no steady motion was found, or no equilibrium"


class Optimum(eqx.Module):
    """A design where a search ended.

    Attributes:
        outcome: how it ended.
        shares: of the variables' ranges.
        values: of the variables, by path.
        objective: its value; infinite if a measure does not exist.
        excess: over each limit, by label, relative to it; positive where it is not met.
        measures: value of each measure by label; the mean over draws, if any.
        draws: value of each measure in each draw, by label; one value without draws.
        at_bound: the variables that lie at a bound, by path: `"low"` or `"high"`.
        bound_multipliers: of those, decrease of the objective per unit of the variable beyond the bound.
        multipliers: by label of the active limits, decrease of the objective per unit of relaxation.
        gradient: size of the projected gradient of the objective, by shares of the ranges, relative to the gradient or,
            where that is larger, the objective.
        asked: number of evaluated designs.
    """

    outcome: Outcome
    shares: Float[np.ndarray, " variables"]
    values: dict[str, float]
    objective: float
    excess: dict[str, float]
    measures: dict[str, float]
    draws: dict[str, np.ndarray]
    at_bound: dict[str, str]
    bound_multipliers: dict[str, float]
    multipliers: dict[str, float]
    gradient: float
    asked: int

    @property
    def feasible(self) -> bool:
        """Whether all limits are met."""
        return self.outcome in (Outcome.optimum, Outcome.stalled)


class Optimised(eqx.Module):
    """What a search found.

    Attributes:
        best: the best feasible result; without one, that of the smallest violation.
        ends: result of each start.
        starts: as shares of the ranges.
    """

    best: Optimum
    ends: tuple[Optimum, ...]
    starts: Float[np.ndarray, "starts variables"]


def _silent(asked: int) -> None:
    pass


def drawn_starts(variables: int, starts: int, seed: int = 0) -> Float[np.ndarray, "starts variables"]:
    """Starts that fill the box: its middle, and points of a Latin hypercube."""
    others = qmc.LatinHypercube(variables, rng=seed).random(starts - 1) if starts > 1 else np.zeros((0, variables))
    return np.concatenate([np.full((1, variables), 0.5), others])


def optimise(
    study: Study,
    starts: int | Float[np.ndarray, "starts variables"] = 4,
    *,
    seed: int = 0,
    lanes: int = LANES,
    progress: Callable[[int], None] = _silent,
) -> Optimised:
    """Find the design with the smallest objective that meets all limits.

    Args:
        study: the design study.
        starts: their number, or shares of the ranges to start from.
        seed: of the starts.
        lanes: designs that are worked out side by side.
        progress: receives the number of evaluated designs.

    Raises:
        ValueError: the study is not valid, or no start has an objective.
    """
    study.refuse()
    begin = drawn_starts(len(study.variables), starts, seed) if isinstance(starts, int) else starts
    first = appraise(study, begin, lanes=lanes)
    exist = np.all(np.isfinite(first.rows), axis=1) & np.all(np.isfinite(first.slopes), axis=(1, 2))
    if not exist.any():
        raise ValueError("at no start do all measures exist: no steady motion is found there, or no equilibrium")
    # Not the median, which bad starts would make too large.
    scale = float(np.quantile(np.abs(first.rows[exist, 0]), 0.25)) or 1.0
    asked = [len(begin)]

    def answers(points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        found = appraise(study, points, lanes=lanes)
        asked.append(len(points))
        progress(sum(asked))
        return list(zip(found.rows, found.slopes, strict=True))

    def search(i: int, ask: Callable) -> tuple[np.ndarray, int]:
        return _search(begin[i], ask, scale) if bool(exist[i]) else (begin[i], 1)

    ends = in_lockstep(len(begin), search, answers)
    shares, counts = np.stack([e[0] for e in ends]), [e[1] for e in ends]
    last = appraise(study, shares, lanes=lanes)
    found = tuple(
        _judged(study, shares[i], last.rows[i], last.slopes[i], last.parts[i], counts[i], scale)
        for i in range(len(begin))
    )
    feasible = [end for end in found if end.feasible]
    best = (
        min(feasible, key=lambda end: end.objective)
        if feasible
        else min(found, key=lambda end: (end.outcome is Outcome.lost, max(end.excess.values(), default=0.0)))
    )
    return Optimised(best, found, begin)


class _Lost(Exception):
    """A search has reached a point where a measure has no gradient."""


def _search(start: np.ndarray, ask: Callable, scale: float) -> tuple[np.ndarray, int]:
    """The result of one search, and its number of evaluated points."""
    known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    kept: list[tuple[float, float, np.ndarray]] = []

    def at(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = np.clip(u, 0.0, 1.0)
        key = u.tobytes()
        if key not in known:
            rows, slopes = ask(u)
            if np.isfinite(rows).all():
                kept.append((max(float(np.max(rows[1:], initial=0.0)), KEPT), float(rows[0]), u))
            known[key] = (rows, slopes)
        return known[key]

    def value(u: np.ndarray) -> float:
        rows, _ = at(u)
        return float(rows[0]) / scale if np.isfinite(rows).all() else _BAD

    def slope(u: np.ndarray) -> np.ndarray:
        return _existing(at(u)[1])[0] / scale

    def room(u: np.ndarray) -> np.ndarray:
        rows, _ = at(u)
        return -rows[1:] if np.isfinite(rows).all() else np.full(rows.size - 1, -_BAD)

    def room_slope(u: np.ndarray) -> np.ndarray:
        return -_existing(at(u)[1])[1:]

    rows, _ = at(start)
    limits = [{"type": "ineq", "fun": room, "jac": room_slope}] if rows.size > 1 else []
    try:
        minimize(
            value,
            start,
            jac=slope,
            bounds=[(0.0, 1.0)] * start.size,
            constraints=limits,
            method="SLSQP",
            options={"ftol": _TOLERANCE, "maxiter": _STEPS},
        )
    except _Lost:
        pass
    # The best of all evaluated points: at a kink the last one is not the best.
    return min(kept, key=lambda k: k[:2])[2], len(known)


def _existing(slopes: np.ndarray) -> np.ndarray:
    if not np.isfinite(slopes).all():
        raise _Lost
    return slopes


def _judged(
    study: Study, shares: np.ndarray, rows: np.ndarray, slopes: np.ndarray, parts: np.ndarray, asked: int, scale: float
) -> Optimum:
    """A result with all its diagnostics."""
    chosen = {path: float(v) for path, v in values(study.variables, jnp.asarray(shares)).items()}
    labels = [part.label for part in (*study.terms, *study.limits)]
    if not (np.isfinite(rows).all() and np.isfinite(slopes).all()):
        return Optimum(Outcome.lost, shares, chosen, np.inf, {}, {}, {}, {}, {}, {}, np.inf, asked)
    excess = {limit.label: float(rows[1 + i]) for i, limit in enumerate(study.limits)}
    low, high = shares <= _AT_BOUND, shares >= 1.0 - _AT_BOUND
    active = rows[1:] > -_ACTIVE
    # A step must not violate bounds or active limits: the gradient must be a sum of their gradients, with nonnegative
    # multipliers.
    box = np.eye(shares.size)
    out = np.concatenate([-box[low], box[high], slopes[1:][active]])
    multipliers, _ = nnls(out.T, -slopes[0]) if len(out) else (np.zeros(0), 0.0)
    left = slopes[0] + multipliers @ out if len(out) else slopes[0]
    # An objective may be zero at its minimum; its values elsewhere supply the scale of slopes.
    size = max(float(np.linalg.norm(slopes[0])) if len(out) else 0.0, abs(float(rows[0])), 1e-2 * scale)
    gradient = float(np.linalg.norm(left)) / size
    if max(excess.values(), default=0.0) > KEPT:
        outcome = Outcome.infeasible
    else:
        outcome = Outcome.optimum if gradient < _STATIONARY else Outcome.stalled
    paths = [v.path for v in study.variables]
    at_low, at_high = ([p for p, there in zip(paths, side, strict=True) if there] for side in (low, high))
    ends = [*at_low, *at_high]
    by_share = {path: float(m) for path, m in zip(ends, multipliers, strict=False)}
    held = [limit for i, limit in enumerate(study.limits) if active[i]]
    return Optimum(
        outcome=outcome,
        shares=shares,
        values=chosen,
        objective=float(rows[0]),
        excess=excess,
        measures=dict(zip(labels, parts.mean(axis=0).tolist(), strict=True)),
        draws={label: parts[:, i] for i, label in enumerate(labels)},
        at_bound=dict.fromkeys(at_low, "low") | dict.fromkeys(at_high, "high"),
        bound_multipliers={path: m / _unit(study, path, shares) for path, m in by_share.items()},
        multipliers={
            limit.label: float(m) / float(limit.scale)
            for limit, m in zip(held, multipliers[len(ends) :], strict=True)
            if m > 0.0
        },
        gradient=gradient,
        asked=asked,
    )


def _unit(study: Study, path: str, shares: np.ndarray) -> float:
    """Derivative of a variable by its share at a design."""
    return next(float(v.rate(jnp.asarray(shares[i]))) for i, v in enumerate(study.variables) if v.path == path)
