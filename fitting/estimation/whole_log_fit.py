"""The final fit, over simulations as long as the logs, where small parameter errors accumulate."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from fitting.estimation.engines import residual_at, simulate
from fitting.estimation.estimate import Fit, Start, Strategy, fit, half_log_determinant
from fitting.estimation.free_parameters import as_they_are
from fitting.estimation.free_run import whole_simulations
from fitting.estimation.problem import Segmentation
from fitting.estimation.residual import Unknowns
from fitting.estimation.solver_steps import needed_substeps

_STEPS = 20
# Settings for a start near the solution.
_CONTINUED = Strategy(_STEPS, begin_anew_above=np.inf, retry_states=False)
# Largest parameter shift by solver error, in standard errors; largest number of solver steps per sample during and at
# the end of the fit. Dry friction that determines K to 1e-7 needs 128 (`docs/uncertainty.md`).
_SHIFT = 0.1
_MOST_SUBSTEPS, _MOST_IN_THE_END = 32, 256
# Largest increase of the objective by the long fit: 2 % of the error.
_LOSS = 0.02


def long_fit(start: Fit, *, must_explain: bool = False) -> Fit:
    """Fit the same parameters to the same data, over horizons as long as the stretches and with sufficiently small
    solver steps.

    The short horizons are kept where a long simulation diverges. They are also kept where the long fit does not
    converge and has a larger residual or open gaps. Unstable motions (with backlash, for example) would give long fits
    whose standard errors are far too small.

    Args:
        start: a fit over shorter horizons.
        must_explain: whether the short horizons are also kept where long simulations converge with a larger residual.
            Then unmodelled inputs (torque noise, missing physics) accumulate over a long simulation and bias the
            parameters beyond their standard errors.
    """
    substeps = _fine_enough(start)
    if substeps > start.substeps:
        # A sharp nonlinearity that the steps did not resolve may have changed by then.
        start = _again(start, replace(start.segmentation, substeps=substeps))
    long = _again(start, replace(start.segmentation, horizon=_longest(start)))
    # Long horizons determine the parameters better, and so need smaller solver steps.
    substeps = _fine_enough(long)
    if substeps > long.substeps:
        long = _again(long, replace(long.segmentation, substeps=substeps))
    motion = len(start.model.motion_states)
    explains = with_gaps_closed(long) <= start.objective + _freedom_of_states(start, motion) + _LOSS
    if not (follows(long) and (explains or (long.converged and not must_explain))):
        return start
    check = fit(
        long.model,
        start.stretches,
        start.free.paths,
        replace(start.segmentation, substeps=substeps),
        start=Start(start.covariance),
        strategy=Strategy(_STEPS, hold_parameters=True),
    )
    return long if check.objective < start.objective + _LOSS else start


def refitted_on_all(found: Fit, selection: Fit) -> Fit:
    """The same parameters fitted to training and selection data, with solver steps that suit their standard errors.

    Args:
        found: the fit to training data, over horizons of any length.
        selection: the same model on the selection data, over short horizons.

    Returns:
        The fit to both; over short horizons where longer ones no longer follow the logs.
    """
    horizons = dict.fromkeys((found.horizon, selection.horizon))
    substeps = needed_substeps(found, shift=_SHIFT, most=_MOST_IN_THE_END)
    for fitted in (_on_both(found, selection, horizon, substeps) for horizon in horizons):
        if np.isfinite(fitted.objective) and (follows(fitted) or not follows(found)):
            return fitted
    return found


def _on_both(found: Fit, selection: Fit, horizon: int, substeps: int) -> Fit:
    states = np.concatenate([np.asarray(f.unknowns.states)[: f.pieces.sum()] for f in (found, selection)])
    both = fit(
        found.model,
        (*found.stretches, *selection.stretches),
        found.free.paths,
        replace(found.segmentation, horizon=horizon, substeps=substeps, count=len(states)),
        start=Start(found.covariance, jnp.asarray(states)),
        strategy=replace(_CONTINUED, hold_parameters=found.was_held or found.held),
    )
    return both.with_all_free()


def over_whole_stretches(found: Fit, *, hold_parameters: bool = True, least_progress: float = 0.0) -> Fit:
    """The same model over horizons as long as the stretches, with the output weights of the short ones.

    Args:
        found: a fit over short horizons.
        hold_parameters: whether only initial states are fitted.
        least_progress: see [`fitting.estimation.solve.solve`][].
    """
    strategy = replace(_CONTINUED, hold_parameters=hold_parameters, least_progress=least_progress, reweigh=False)
    return _again(found, replace(found.segmentation, horizon=_longest(found)), strategy)


def with_memory_carried(found: Fit, *, hold_parameters: bool = False, least_progress: float = 0.0) -> Fit:
    """A fit over short horizons, started from one over whole stretches where that reduces its residual.

    Hidden states are not measured. On a short segment, a wrong hidden initial state hardly changes the error and is not
    corrected. Over a whole stretch, hidden states follow from the motion.

    Args:
        found: a fit over short horizons.
        hold_parameters: whether only initial states are fitted.
        least_progress: see [`fitting.estimation.solve.solve`][].
    """
    carried = over_whole_stretches(found, hold_parameters=hold_parameters, least_progress=least_progress)
    if not follows(carried):
        return found
    strategy = replace(_CONTINUED, hold_parameters=hold_parameters, least_progress=least_progress)
    back = _again(carried, found.segmentation, strategy)
    return min(found, back, key=lambda fit: fit.objective)


def follows(found: Fit, *, share: float = 0.5) -> bool:
    """Whether each output's rms residual is less than a share of its variation."""
    segments = found.problem.segments
    measured = np.asarray(segments.measured)[np.asarray(segments.weight) > 0]
    return bool(np.all(np.diag(np.asarray(found.covariance)) < share**2 * measured.var(axis=0)))


def with_gaps_closed(found: Fit) -> float:
    """Approximate objective with all gaps between joined segments closed. Large gaps mean that the model does not
    follow the log over this horizon."""
    gap = np.asarray(residual_at(found.problem, found.unknowns)[1]) * np.asarray(found.problem.gap_weight)
    return found.objective + 0.5 * float(np.sum(gap**2) / np.sum(np.asarray(found.problem.segments.weight)))


def without_gaps(found: Fit) -> Fit:
    """The fit with the covariance of the errors of one simulation of each stretch, from its fitted initial state."""
    first = np.cumsum(found.pieces) - found.pieces
    states = jnp.asarray(np.asarray(found.unknowns.states)[first])
    free, values = as_they_are(found.model, found.free.paths)
    problem = whole_simulations(found.model, free, found.stretches, found.segmentation.halo, found.substeps)
    outputs = np.asarray(simulate(problem, Unknowns(values, states))[0])
    segments = problem.segments
    error = (np.asarray(segments.measured) - outputs)[np.asarray(segments.weight) > 0]
    with np.errstate(all="ignore"):  # the simulation may diverge
        covariance = error.T @ error / len(error)
    return replace(found, covariance=jnp.asarray(covariance), objective=half_log_determinant(covariance))


def _longest(found: Fit) -> int:
    """Samples of the longest stretch."""
    return max(len(s) for s in found.stretches)


def _freedom_of_states(found: Fit, states: int) -> float:
    """Decrease of the objective on pure noise by the fitted initial states of short segments.

    Args:
        found: a fit over short horizons.
        states: number per segment.
    """
    segments = found.problem.segments
    kept = np.asarray(segments.weight).sum(axis=1)
    outputs = segments.measured.shape[-1]
    own = int(np.sum((kept > 0) & ~np.asarray(segments.joined))) * states
    return -0.5 * outputs * float(np.log1p(-min(0.5, own / (kept.sum() * outputs))))


def _fine_enough(found: Fit) -> int:
    return needed_substeps(found, shift=_SHIFT, most=_MOST_SUBSTEPS)


def _again(found: Fit, segmentation: Segmentation, strategy: Strategy = _CONTINUED) -> Fit:
    """A fit of the same data on segments of the same length, with the same compiled program, started from its
    states; what was fixed stays fixed."""
    start = Start(found.covariance, found.unknowns.states)
    if not strategy.hold_parameters:
        strategy = replace(strategy, hold_parameters=found.held)
    return fit(found.model, found.stretches, found.free.paths, segmentation, start=start, strategy=strategy)
