"""Constants of the logs that a fit refines: sample intervals, and zeros of the dynamic error."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.estimation.base_fit import leaves_white_noise
from fitting.estimation.estimate import Fit, Start, fit, log_of, segments_by
from fitting.estimation.experiment import Experiment
from fitting.estimation.log_constants import log_columns, step_to_constants
from fitting.estimation.residual import slopes_by_zero
from fitting.estimation.sample_rate import refined_intervals, with_intervals
from hdjax import Hold

# Mean of the residual, in standard errors, below which a zero is not refined (assumed).
_SEEN = 2.0
# Least difference of two logs' zeros, in standard errors: equal ones, which may be a load's, differ as much once in two
# million pairs. Most fits until they are found (assumed).
_APART, _PASSES = 5.0, 4

Data = Mapping[Hold, Sequence[Experiment]]


def recalibrated(found: Fit, *data: Data) -> list[dict[Hold, tuple[Experiment, ...]]] | None:
    """Experiments with refined constants of their logs; None where these are hardly different.

    Args:
        found: the fit of the base model.
        data: experiments under each hold: those of the fit, and others of the same logs.
    """
    factors, means = refined_intervals(found), remaining_offsets(found)
    apart = {} if means else zeros_apart(found)
    if not factors and not means and not apart:
        return None
    return [with_own_zeros(with_zeros(with_intervals(experiments, factors), means), apart) for experiments in data]


def remaining_offsets(found: Fit) -> dict[float, float]:
    """Mean residual of the dynamic error in the logs with each estimated zero; none where it is insignificant, or more
    is left than constants and white noise: then `encoder_offset` is one of several candidates."""
    error, weight = np.asarray(found.error).copy(), np.asarray(found.problem.segments.weight) > 0
    means = {}
    for zero, own in segments_by(found, lambda stretch: stretch.experiment.zero).items():
        known = own[:, None] & weight
        left = error[known, -1]
        error[known, -1] -= left.mean()
        if zero != 0.0 and abs(left.mean()) > _SEEN * left.std() / np.sqrt(left.size):
            means[zero] = float(left.mean())
    return means if means and leaves_white_noise(replace(found, error=jnp.asarray(error))) else {}


def zeros_apart(found: Fit) -> dict[str, float]:
    """What is left to subtract from the dynamic error of each log where the logs' zeros differ, and where white noise
    remains then; else none: what all logs have in common, or what remains, is for the search."""
    logs = dict.fromkeys(map(log_of, found.stretches), np.inf)
    if len(logs) < 2 or found.model.measured[-1] != "dynamic_error" or leaves_white_noise(found):
        return {}
    total, error = np.zeros(len(logs)), np.inf
    for _ in range(_PASSES):
        no_gap = np.zeros(found.unknowns.states.shape)
        seen = log_columns(found, logs, slopes_by_zero(found.problem), no_gap)
        step, covariance = step_to_constants(found, seen)
        own = slice(-len(logs), None)
        total = total + step[own]
        if leaves_white_noise(found):
            return dict(zip(logs, total.tolist(), strict=True))
        if not (_differ(total, covariance[own, own]) and found.principal_std < 0.5 * error):
            return {}
        error = found.principal_std
        by = dict(zip(logs, step[own].tolist(), strict=True))
        parts = [replace(s, experiment=s.experiment.less(by[log_of(s)])) for s in found.stretches]
        start = Start(found.covariance, found.unknowns.states)
        found = fit(found.model, parts, found.free.paths, found.segmentation, start=start)
    return {}


def _differ(zeros: Float[np.ndarray, " logs"], covariance: Float[np.ndarray, "logs logs"]) -> bool:
    """Whether a log's zero differs significantly from that of the first one."""
    variance = np.diag(covariance) + covariance[0, 0] - 2.0 * covariance[0]
    return bool(np.any(np.abs(zeros - zeros[0]) > _APART * np.sqrt(np.maximum(variance, 0.0))))


def with_own_zeros(data: Data, offsets: Mapping[str, float]) -> dict[Hold, tuple[Experiment, ...]]:
    """Experiments with their logs' own zeros. Where these differ, those of other logs are not known.

    Args:
        data: experiments under each hold.
        offsets: what is left to subtract from the dynamic error, by log; none where logs do not differ.
    """

    def own(one: Experiment) -> Experiment:
        return one.less(offsets[one.log]) if one.log in offsets else replace(one, has_own_zero=True)

    return {h: tuple(map(own, some)) if offsets else tuple(some) for h, some in data.items()}


def with_zeros(data: Data, offsets: Mapping[float, float]) -> dict[Hold, tuple[Experiment, ...]]:
    """Experiments without what their zeros left of an offset.

    Args:
        data: experiments under each hold.
        offsets: remaining offset of the dynamic error, by zero.
    """
    return {h: tuple(e.less(offsets.get(e.zero, 0.0)) for e in some) for h, some in data.items()}
