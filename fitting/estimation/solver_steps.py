"""Number of solver steps for a negligible solver error in a fit's residual and parameters."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from fitting.estimation.engines import linearise, residual_at
from fitting.estimation.estimate import Fit
from fitting.estimation.free_parameters import named
from fitting.estimation.projection import FirstStates
from fitting.estimation.residual import Blocks


def needed_substeps(found: Fit, *, tolerance: float = 0.05, shift: float = np.inf, most: int = 16) -> int:
    """Solver steps in a sample interval that keep the step error below a fraction of the residual.

    Args:
        found: a fit; its solution is simulated with twice the steps, until the difference is negligible.
        tolerance: largest rms difference in units of the residual's standard deviation.
        shift: largest change of a parameter, in standard errors. An error that is small per sample accumulates over all
            samples.
        most: largest number of steps.
    """
    problem, substeps = found.at_solution, found.substeps
    slopes = linearise(problem, found.unknowns) if np.isfinite(shift) else None
    count = np.sum(np.asarray(problem.segments.weight))
    rows, gap = residual_at(problem, found.unknowns) if slopes is None else (slopes.residual, slopes.gap)
    while substeps < most:
        finer, finer_gap = residual_at(replace(problem, substeps=2 * substeps), found.unknowns)
        change, gap_change = np.asarray(finer) - np.asarray(rows), np.asarray(finer_gap) - np.asarray(gap)
        moved = 0.0 if slopes is None else _moved(found, slopes, change, gap_change)
        if np.sqrt(_most_of_an_output(found, change) / count) < tolerance and moved < shift:
            break
        substeps, rows, gap = 2 * substeps, finer, finer_gap
    return substeps


def _most_of_an_output(found: Fit, rows: Float[np.ndarray, "segments rows"]) -> float:
    """The largest sum of squares of a whitened output."""
    segments, samples, outputs = found.problem.segments.measured.shape
    return float(np.max(np.sum(rows[:, : samples * outputs].reshape(-1, outputs) ** 2, axis=0)))


def _moved(
    found: Fit,
    slopes: Blocks,
    change: Float[np.ndarray, "segments rows"],
    gap: Float[np.ndarray, "segments states"],
) -> float:
    """Largest change of any parameter, in standard errors, due to a change of a fit's residual.

    Coefficients of learned functions do not count, nor parameters that the data do not determine.

    Args:
        found: the fit.
        slopes: derivatives of its residual.
        change: change of its rows.
        gap: change of the gaps between joined segments, which propagates to all following segments.
    """
    columns = np.concatenate([np.asarray(slopes.by_parameter), change[:, :, None]], axis=2)
    before = np.concatenate([np.asarray(slopes.before_by_parameter), -gap[:, :, None]], axis=2)
    states = FirstStates.of(slopes, found.problem.segments.joined)
    flat = states.without(columns, before).reshape(change.size, -1)
    with np.errstate(all="ignore"):
        products = flat.T @ flat
    if not np.all(np.isfinite(products)):
        # No number of steps mends a simulation that diverges.
        return 0.0
    information, gradient = products[:-1, :-1], products[:-1, -1]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-10, hermitian=True)
    moved, error = scale * (inverse @ (scale * gradient)), scale * np.sqrt(np.diag(inverse))
    # Entries of the free vector are of order one.
    told = named(found.model, found.free.paths) & (error > 0.0) & (error < 1.0)
    return float(np.max(np.abs(moved[told]) / error[told], initial=0.0))
