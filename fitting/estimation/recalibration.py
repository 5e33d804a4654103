"""Constants of the logs that a fit refines: sample intervals, and zeros of the twist."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from fitting.estimation.base_fit import leaves_white_noise
from fitting.estimation.estimate import Fit, segments_by
from fitting.estimation.experiment import Experiment
from fitting.estimation.sample_rate import refined_intervals, with_intervals
from hdjax import Hold

# Mean of the residual, in standard errors, below which a zero is not refined (assumed).
_SEEN = 2.0

Data = Mapping[Hold, Sequence[Experiment]]


def recalibrated(found: Fit, *data: Data) -> list[dict[Hold, tuple[Experiment, ...]]] | None:
    """Experiments with refined constants of their logs; None where these are hardly different.

    Args:
        found: the fit of the base model.
        data: experiments under each hold: those of the fit, and others of the same logs.
    """
    factors, means = refined_intervals(found), remaining_offsets(found)
    if not factors and not means:
        return None
    return [with_zeros(with_intervals(experiments, factors), means) for experiments in data]


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


def with_zeros(data: Data, offsets: Mapping[float, float]) -> dict[Hold, tuple[Experiment, ...]]:
    """Experiments without what their zeros left of an offset.

    Args:
        data: experiments under each hold.
        offsets: remaining offset of the dynamic error, by zero.
    """
    return {h: tuple(_less(e, offsets.get(e.zero, 0.0)) for e in some) for h, some in data.items()}


def _less(experiment: Experiment, offset: float) -> Experiment:
    if offset == 0.0:
        return experiment
    measured = experiment.measured.copy()
    measured[:, -1] -= offset
    return replace(experiment, measured=measured, zero=experiment.zero + offset)
