"""The measured motion, smoothed by simulations short enough to follow the log.

A model without a dominant effect (friction that takes most of the torque) deviates from the log within a few samples.
Regressors along its motion then say nothing about the drive. Simulations over a few samples, with a free constant
torque on either side, follow the log. Their states are the measured motion, smoothed by the equations.
"""

from dataclasses import replace

import numpy as np

from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.linear_response import Followed, follow
from fitting.estimation.scales import largest_torque
from fitting.estimation.steady_torque import SteadyLoad, SteadyMotorTorque
from hdjax import TwoInertiaModel

# Samples of the shortest simulations, which still separate each state from noise.
_SHORTEST = 8


def followed_closely(found: Fit) -> Followed:
    """The motion along a fit's data from simulations of the best length, in the fit's segments.

    Shorter simulations have more initial states, which also fit noise; Akaike's criterion (1974) selects the length.

    Args:
        found: a fit whose motion does not follow the log.
    """
    best = _held(found, _SHORTEST)
    while 2 * best.horizon <= found.error.shape[1]:
        longer = _held(found, 2 * best.horizon)
        if _criterion(longer) > _criterion(best):
            break
        best = longer
    return _in_segments_of(found, best)


def _held(found: Fit, horizon: int) -> Fit:
    """The same parameters over simulations of `horizon` samples, with constant torques."""
    segmentation = replace(found.segmentation, horizon=horizon, length=horizon, count=None)
    model = found.model
    if isinstance(model, TwoInertiaModel):
        reach = largest_torque(found.stretches)
        model = model.with_effects(SteadyMotorTorque(reach=reach), SteadyLoad(reach=float(model.drive.N) * reach))
    strategy = Strategy(hold_parameters=True, retry_states=False)
    return fit(model, found.stretches, found.free.paths, segmentation, start=Start(found.covariance), strategy=strategy)


def _criterion(found: Fit) -> float:
    """Akaike's criterion, for Gaussian output errors and the initial states."""
    segments = found.problem.segments
    anew = int(np.sum(~np.asarray(segments.joined)[: found.pieces.sum()]))
    return float(np.sum(np.asarray(segments.weight))) * found.objective + anew * len(found.model.state_names)


def _in_segments_of(found: Fit, shorter: Fit) -> Followed:
    """States of the shorter simulations, cut into the fit's segments."""
    followed = follow(shorter.at_solution, shorter.unknowns)
    length, own = found.error.shape[1], len(found.model.state_names)

    def cut(values: np.ndarray) -> np.ndarray:
        """Cut values per sample, each stretch padded to whole segments with its last sample."""
        flat = values.reshape(-1, *values.shape[2:])
        samples = shorter.pieces * shorter.error.shape[1]
        ends = np.cumsum(samples)
        rows = [
            np.minimum(np.arange(pieces * length), count - 1) + end - count
            for pieces, count, end in zip(found.pieces, samples, ends, strict=True)
        ]
        return flat[np.concatenate(rows)].reshape(-1, length, *flat.shape[1:])

    starts, ends = cut(followed.states[:, :-1]), cut(followed.states[:, 1:])
    return Followed(
        states=np.concatenate([starts, ends[:, -1:]], axis=1)[..., :own],
        between=cut(followed.between)[..., :own],
        transition=cut(followed.transition)[..., :own, :own],
        from_start=cut(followed.from_start)[..., :own, :own],
        from_end=cut(followed.from_end)[..., :own, :own],
        readout=cut(followed.readout)[..., :own],
    )
