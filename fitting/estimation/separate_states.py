"""Levenberg-Marquardt for initial states alone: segments that share nothing are problems of their own."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.arrow_system import solve_scaled
from fitting.estimation.levenberg_marquardt import (
    KEPT,
    LATEST,
    LEAST_DAMPING,
    LONGER,
    SHORTER,
    SLIGHT,
    WELL,
    bolder_after,
)
from fitting.estimation.residual import Products, Unknowns

Look = Callable[[Unknowns], tuple[Products, Array | np.ndarray]]
"""The normal equations at some unknowns, and the rows of the residual."""

Damping = float | Float[np.ndarray, " segments"]
"""Damping of a step, relative to the diagonals of J^T J; of each segment where these are problems of their own."""


class Ended(NamedTuple):
    """Where an iteration ended.

    Attributes:
        unknowns: the best ones.
        rows: of their residual.
        success: whether the next step promised next to nothing.
        steps: how many were taken.
        damping: of the next step.
    """

    unknowns: Unknowns
    rows: Float[Array | np.ndarray, "segments rows"]
    success: bool
    steps: int
    damping: Damping


def solve_states(
    look: Look, start: Unknowns, max_steps: int, damping: Damping, *, rtol: float, least_progress: float
) -> Ended:
    """Fit the initial state of each segment with fixed parameters.

    Every segment has a damping of its own and takes or rejects its own steps. One damping for all would let a few
    segments at a corner of a nonsmooth model hold up the others.

    Args:
        look: see [`Look`][].
        start: where the iteration begins; the parameters stay as they are.
        max_steps: where it ends at the latest.
        damping: of the first step, relative to the diagonals of J^T J.
        rtol: a segment is done where its next step promises less than this share of what one more degree of freedom
            explains of noise.
        least_progress: share of the sum of squares that a few steps must take off it.
    """
    states, dampings = np.array(start.states), np.full(len(start.states), damping)
    bolder = np.full(len(states), LONGER)
    seen, rows = look(start)
    products, rows = np.array(seen.products), np.array(rows)
    costs, done, steps = [np.inf] * LATEST, np.zeros(len(states), bool), 0
    while steps < max_steps:
        steps += 1
        step, promised = _step(products, states.shape[1], dampings)
        squares = products[:, -1, -1]
        costs = [0.5 * float(np.sum(squares[np.isfinite(squares)])), *costs[:-1]]
        done = np.abs(promised) < rtol * costs[0] / rows.size
        if done.all() or (least_progress > 0 and costs[-1] < (1.0 + least_progress) * costs[0]):
            break
        ahead = states + np.where(done[:, None], 0.0, step)
        seen, rows_ahead = look(Unknowns(start.parameters, ahead))
        changed = 0.5 * (seen.products[:, -1, -1] - squares)
        taken = (changed <= KEPT * promised) | (np.abs(changed) < 0.5 * SLIGHT * squares)
        well = changed < WELL * promised
        dampings = dampings / np.where(taken, np.where(well, bolder, 1.0), SHORTER)
        bolder = bolder_after(taken, well, bolder)
        dampings = np.maximum(dampings, LEAST_DAMPING)
        states[taken], products[taken], rows[taken] = ahead[taken], seen.products[taken], np.asarray(rows_ahead)[taken]
    return Ended(Unknowns(start.parameters, states), rows, bool(done.all()), steps, dampings)


def _step(
    products: Float[np.ndarray, "segments columns columns"], states: int, dampings: Float[np.ndarray, " segments"]
) -> tuple[Float[np.ndarray, "segments states"], Float[np.ndarray, " segments"]]:
    """Damped Gauss-Newton steps of the states, and by how much they are to change half the sums of squares. A step
    that can't be computed to working precision is zero and promises everything, so that the next one is more damped;
    a simulation that diverges promises nothing."""
    own = slice(-1 - states, -1)
    matrix, gradient = products[:, own, own], products[:, own, -1]
    diagonal = np.einsum("sii->si", matrix)
    damped = matrix + (dampings[:, None] * diagonal)[:, :, None] * np.eye(states)
    step = -solve_scaled(damped, gradient[:, :, None])[:, :, 0]
    promised = np.sum(step * (gradient + 0.5 * np.einsum("sij,sj->si", matrix, step)), axis=1)
    solved = np.isfinite(promised)
    diverged = ~np.isfinite(products).all(axis=(1, 2))
    return np.where(solved[:, None], step, 0.0), np.where(solved, promised, np.where(diverged, 0.0, -np.inf))
