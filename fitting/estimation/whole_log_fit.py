"""The last fit, over simulations as long as the logs, where small errors of a parameter add up and show."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.problem import Segmentation
from fitting.estimation.solver_steps import needed_substeps

_STEPS = 20
# From a solution near by, which has not lost its way.
_CONTINUED = Strategy(_STEPS, begin_anew_above=np.inf, retry_states=False)
# By how many standard errors the solver's steps may move the parameters, and how many steps a sample may take on the
# way and in the end: dry friction that tells K to 1e-7 asks for 128 (`docs/uncertainty.md`).
_SHIFT = 0.1
_MOST_SUBSTEPS, _MOST_IN_THE_END = 32, 256
# What the long fit may cost in the objective: 2 % of the error.
_LOSS = 0.02


def long_fit(start: Fit, *, must_explain: bool = False) -> Fit:
    """Fit the same parameters to the same data, over horizons as long as the stretches and with steps fine enough.

    Where a long simulation has lost its way, the short horizons stay. So they do where the long one leaves more over,
    or gaps between its segments, and does not converge: a motion whose errors grow without end (backlash, say) has long
    simulations that promise far more than they can tell.

    Args:
        start: a fit over shorter horizons.
        must_explain: whether the short horizons stay as well where long simulations converge but leave more over. Then
            something drives the motion that the model does not know (noise of the torque, missing physics); what piles
            up over a long simulation imitates parameters, and their standard errors would not tell.
    """
    substeps = _fine_enough(start)
    if substeps > start.substeps:
        # A corner that is sharper than its steps resolved has moved by then.
        start = _again(start, replace(start.segmentation, substeps=substeps))
    long = _again(start, replace(start.segmentation, horizon=_longest(start)))
    # Long horizons know the parameters better, and so ask for finer steps.
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
    """The same parameters fitted to the data that selected the model as well, with steps as fine as their standard
    errors ask for.

    Args:
        found: the fit to training data, over horizons of any length.
        selection: the same model on the data that selected it, over short horizons.

    Returns:
        The fit to both; over short horizons where longer ones do not follow the logs any more.
    """
    horizons = dict.fromkeys((found.horizon, selection.horizon))
    substeps = needed_substeps(found, shift=_SHIFT, most=_MOST_IN_THE_END)
    for fitted in (_on_both(found, selection, horizon, substeps) for horizon in horizons):
        if np.isfinite(fitted.objective) and (follows(fitted) or not follows(found)):
            return fitted
    return found


def _on_both(found: Fit, selection: Fit, horizon: int, substeps: int) -> Fit:
    states = np.concatenate([np.asarray(f.unknowns.states)[: f.pieces.sum()] for f in (found, selection)])
    # Parameters that a fit has not moved were held.
    held = all(float(found.model.get(p)) == float(found.problem.model.get(p)) for p in found.free.paths)
    both = fit(
        found.model,
        (*found.stretches, *selection.stretches),
        found.free.paths,
        replace(found.segmentation, horizon=horizon, substeps=substeps, count=len(states)),
        start=Start(found.covariance, jnp.asarray(states)),
        strategy=replace(_CONTINUED, hold_parameters=held),
    )
    return both.with_all_free()


def over_whole_stretches(found: Fit, *, hold_parameters: bool = True, least_progress: float = 0.0) -> Fit:
    """The same model over horizons as long as the stretches, its outputs weighed as over short ones.

    Args:
        found: a fit over short horizons.
        hold_parameters: whether only initial states are fitted.
        least_progress: see [`fitting.estimation.solve.solve`][].
    """
    strategy = replace(_CONTINUED, hold_parameters=hold_parameters, least_progress=least_progress, reweigh=False)
    return _again(found, replace(found.segmentation, horizon=_longest(found)), strategy)


def with_memory_carried(found: Fit, *, hold_parameters: bool = False, least_progress: float = 0.0) -> Fit:
    """A fit over short horizons that has gone by way of horizons as long as the stretches, where that leaves less.

    What an effect remembers is not seen, and where it slips it forgets its start: on a short segment a start that is
    far off hardly changes the error, and finds no way back. Over a whole stretch it follows from the motion.

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
    """Whether the simulation errs by less than a share (half) of how much each output moves."""
    segments = found.problem.segments
    measured = np.asarray(segments.measured)[np.asarray(segments.weight) > 0]
    return bool(np.all(np.diag(np.asarray(found.covariance)) < share**2 * measured.var(axis=0)))


def with_gaps_closed(found: Fit) -> float:
    """The objective, about, if what gaps are left between joined segments were closed: a fit that came no closer does
    not follow the log for so long."""
    gap = np.asarray(linearise(found.problem, found.unknowns).gap) * np.asarray(found.problem.gap_weight)
    return found.objective + 0.5 * float(np.sum(gap**2) / np.sum(np.asarray(found.problem.segments.weight)))


def _longest(found: Fit) -> int:
    """Samples of the longest stretch."""
    return max(len(s) for s in found.stretches)


def _freedom_of_states(found: Fit, states: int) -> float:
    """By how much fitting so many initial states of each short segment lowers the objective over nothing but noise.

    Args:
        found: a fit over short horizons.
        states: of each segment.
    """
    segments = found.problem.segments
    kept = np.asarray(segments.weight).sum(axis=1)
    outputs = segments.measured.shape[-1]
    own = int(np.sum((kept > 0) & ~np.asarray(segments.joined))) * states
    return -0.5 * outputs * float(np.log1p(-min(0.5, own / (kept.sum() * outputs))))


def _fine_enough(found: Fit) -> int:
    return needed_substeps(found, shift=_SHIFT, most=_MOST_SUBSTEPS)


def _again(found: Fit, segmentation: Segmentation, strategy: Strategy = _CONTINUED) -> Fit:
    """A fit of the same data on segments of the same length, which share its compiled program, from its states."""
    start = Start(found.covariance, found.unknowns.states)
    return fit(found.model, found.stretches, found.free.paths, segmentation, start=start, strategy=strategy)
