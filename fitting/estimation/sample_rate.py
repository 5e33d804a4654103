"""Sample rates that are uncertain because stamps are rounded: their estimate, and their influence on parameters.

Where the sample interval of a log is known to a relative standard deviation, it is one more parameter with that prior.
With known inertias, a wrong rate has the same effect as a wrong torque gain, and would be taken for an error of the
torque sensor.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fitting.estimation.engines import residual_at
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Experiment
from fitting.estimation.log_constants import LogColumns, log_columns, step_to_constants
from fitting.estimation.residual import Problem
from hdjax import Hold, PiecewisePolynomial

# Shift of parameters or intervals, in standard errors, below which the fit is not repeated (assumed).
_SEEN = 0.1
# Relative change of intervals for a difference quotient: rounding and curvature are then negligible.
_CHANGE = 1e-5


def rate_columns(found: Fit) -> LogColumns | None:
    """Sensitivities of a fit to the logarithms of its logs' uncertain sample intervals; None where all are known."""
    open_logs = _open_logs([s.experiment for s in found.stretches])
    if not open_logs:
        return None
    problem = found.at_solution
    longer, shorter = (
        residual_at(_with_intervals(problem, factor), found.unknowns) for factor in (1.0 + _CHANGE, 1.0 - _CHANGE)
    )
    change, gap = ((np.asarray(a) - np.asarray(b)) / (2.0 * _CHANGE) for a, b in zip(longer, shorter, strict=True))
    return log_columns(found, open_logs, change, gap)


def refined_intervals(found: Fit) -> dict[str, float]:
    """Correction factors of uncertain sample intervals, estimated from fit and stamps; none where the shift would be
    negligible.

    One Gauss-Newton step suffices, as corrections are small.
    """
    seen = rate_columns(found)
    if seen is None:
        return {}
    step, covariance = step_to_constants(found, seen)
    if not np.any(np.abs(step) > _SEEN * np.sqrt(np.diag(covariance))):
        return {}
    return {log: float(np.exp(s)) for log, s in zip(seen.logs, step[-len(seen.logs) :], strict=True)}


def with_intervals(
    experiments: Mapping[Hold, Sequence[Experiment]], factors: Mapping[str, float]
) -> dict[Hold, tuple[Experiment, ...]]:
    """Experiments with the sample intervals of their logs scaled by factors, about the start of each log."""
    return {h: tuple(_scaled(e, factors.get(e.log, 1.0)) for e in some) for h, some in experiments.items()}


def _open_logs(experiments: Sequence[Experiment]) -> dict[str, float]:
    """The logs of uncertain rate, with its relative standard deviation."""
    return {e.log: e.rate_std for e in experiments if e.rate_std > 0.0}


def _scaled(experiment: Experiment, factor: float) -> Experiment:
    if factor == 1.0:
        return experiment
    origin = experiment.origin

    def signal(found: PiecewisePolynomial | None) -> PiecewisePolynomial | None:
        return None if found is None else _stretched(found, factor, origin)

    return replace(
        experiment,
        time=origin + factor * (experiment.time - origin),
        torque=_stretched(experiment.torque, factor, origin),
        load_torque=signal(experiment.load_torque),
        temperature=signal(experiment.temperature),
    )


def _stretched(signal: PiecewisePolynomial, factor: float, origin: float = 0.0) -> PiecewisePolynomial:
    """The signal on knots stretched about an origin."""
    knots, coefficients = np.asarray(signal.knots), np.asarray(signal.coefficients)
    powers = factor ** -np.arange(coefficients.shape[-1], dtype=float)
    return PiecewisePolynomial(jnp.asarray(origin + factor * (knots - origin)), jnp.asarray(coefficients * powers))


def _with_intervals(problem: Problem, factor: float) -> Problem:
    """The problem with the sample intervals of all segments scaled by a factor."""
    segments = problem.segments
    load, warmth = (
        None if signal is None else _stretched(signal, factor)
        for signal in (segments.load_torque, segments.temperature)
    )
    stretched = replace(segments, torque=_stretched(segments.torque, factor), load_torque=load, temperature=warmth)
    return eqx.tree_at(lambda p: p.segments, problem, stretched)
