"""Isolated outliers: they get weight zero, as if they were missing, and the fit is repeated.

An isolated wrong sample has no information about the drive, so it is removed rather than down-weighted. Large errors of
many neighbouring samples stay: they may be an effect that the model lacks. Where no sample exceeds what Gaussian noise
explains, nothing changes.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri

from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Stretch
from fitting.logs.masks import glitches

# Chance that pure noise of a whole log loses a sample.
_FALSE_ALARM = 1e-3
# Largest error of an isolated outlier's neighbours, in standard deviations.
_ORDINARY = 3.0
# Longest run of outliers that counts as a glitch, and number of ordinary samples required on either side.
_LONGEST = 3
_BESIDE = 2
# A larger share than this is a property of the noise, not a fault.
_MOST = 0.05


def without_glitches(stretches: Sequence[Stretch]) -> tuple[Stretch, ...]:
    """The stretches without gross spikes, which would spoil starting values and scales. The log reader has already
    removed those of files."""
    found = []
    for stretch in stretches:
        part = slice(stretch.start, stretch.stop)
        wrong = np.zeros(len(stretch), dtype=bool)
        for column in stretch.experiment.measured[part].T:
            wrong[glitches(column, stretch.experiment.time[part])] = True
        found.append(_left_out(stretch, wrong))
    return tuple(found)


def without_lone_errors(found: Fit) -> tuple[Stretch, ...] | None:
    """The stretches of a fit without isolated outliers; None where there are none."""
    white = found.white_error
    weight = np.asarray(found.problem.segments.weight) > 0
    spread = np.array([_spread(output[weight]) for output in np.moveaxis(white, -1, 0)])
    if not (spread > 0).all():
        return None
    size = np.max(np.abs(white) / spread, axis=-1)
    limit = -float(ndtri(0.5 * _FALSE_ALARM / (weight.sum() * spread.size)))
    masks = [_alone(part, limit) for part in found.by_stretch(size)]
    count = sum(mask.sum() for mask in masks)
    if not 0 < count <= _MOST * weight.sum():
        return None
    return tuple(_left_out(s, mask) for s, mask in zip(found.stretches, masks, strict=True))


def with_weights(stretches: Sequence[Stretch], believed: Sequence[Stretch]) -> tuple[Stretch, ...]:
    """The same stretches with another hold of the torque, and the outputs and weights of `believed`."""

    def one(stretch: Stretch, known: Stretch) -> Stretch:
        fields = {name: getattr(known.experiment, name) for name in ("measured", "motor_angle", "weight")}
        return dataclasses.replace(stretch, experiment=dataclasses.replace(stretch.experiment, **fields))

    return tuple(one(s, b) for s, b in zip(stretches, believed, strict=True))


def left_out(stretches: Sequence[Stretch]) -> int:
    """Number of samples with weight zero."""
    weights = [s.experiment.weight[s.start : s.stop] for s in stretches if s.experiment.weight is not None]
    return int(sum(np.sum(w == 0) for w in weights))


def _left_out(stretch: Stretch, wrong: np.ndarray) -> Stretch:
    """The stretch with further samples of weight zero, whose outputs are interpolated."""
    if not wrong.any():
        return stretch
    experiment = stretch.experiment
    weight = np.ones(len(experiment)) if experiment.weight is None else experiment.weight.copy()
    weight[stretch.start + np.flatnonzero(wrong)] = 0.0
    known = weight > 0

    def bridged(values: np.ndarray) -> np.ndarray:
        return np.interp(experiment.time, experiment.time[known], values[known])

    mended = dataclasses.replace(
        experiment,
        measured=np.stack([bridged(column) for column in experiment.measured.T], axis=1),
        motor_angle=None if experiment.motor_angle is None else bridged(experiment.motor_angle),
        weight=weight,
    )
    return dataclasses.replace(stretch, experiment=mended)


def _alone(size: np.ndarray, limit: float) -> np.ndarray:
    """Which errors exceed the limit, in short runs, with ordinary ones on either side."""
    found = np.zeros(size.size, dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (size > limit).astype(np.int8), [0]])))
    for start, stop in edges.reshape(-1, 2):
        beside = np.concatenate([size[max(0, start - _BESIDE) : start], size[stop : stop + _BESIDE]])
        if stop - start <= _LONGEST and (beside < _ORDINARY).all():
            found[start:stop] = True
    return found


def _spread(values: np.ndarray) -> float:
    """Robust standard deviation: from the 95 % quantile, as if normal."""
    return float(np.quantile(np.abs(values), 0.95)) / 1.96
