"""The last fit, over simulations as long as the logs, where small errors of a parameter add up and show."""

from fitting.estimate import Fit, fit, needed_substeps

_STEPS = 20
# By how many standard errors the solver's steps may move the parameters, and how many steps a sample may take.
_SHIFT = 0.2
_MOST_SUBSTEPS = 32
# What the long fit may cost on short segments, in the objective: 2 % of the error.
_LOSS = 0.02


def long_fit(start: Fit) -> Fit:
    """Fit the same parameters to the same data, over horizons as long as the stretches and with steps fine enough.

    Where a long simulation has lost its way, short segments say so, and the fit that was given stays.

    Args:
        start: a fit over shorter horizons.
    """
    segments = start.problem.segments
    count, length = segments.weight.shape
    substeps = needed_substeps(start, shift=_SHIFT, most=_MOST_SUBSTEPS)
    long = fit(
        start.model,
        start.stretches,
        start.free.paths,
        horizon=max(len(s) for s in start.stretches),
        length=length,
        halo=segments.halo,
        substeps=substeps,
        covariance=start.covariance,
        count=count,
        states=start.unknowns.states,
        max_steps=_STEPS,
    )
    check = fit(
        long.model,
        start.stretches,
        start.free.paths,
        horizon=start.horizon,
        length=length,
        halo=segments.halo,
        substeps=substeps,
        count=count,
        covariance=start.covariance,
        hold_parameters=True,
    )
    return long if check.objective < start.objective + _LOSS else start
