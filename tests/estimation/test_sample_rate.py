"""Sample rates that rounded time stamps leave uncertain: refined by the fit, and part of its standard errors."""

from dataclasses import replace

import numpy as np
import pytest

import rig
from fitting.estimation.base_fit import base_fit
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Experiment, experiments_from_log, whole
from fitting.estimation.sample_rate import rate_columns, refined_intervals, with_intervals
from fitting.logs.gaps import SHORTEST
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, TwoInertiaModel

COUNT = 3000
MODEL = TwoInertiaModel(Drive(N=rig.N, J_m=rig.J_M, J_l=rig.J_L, K=1.0))
WRONG, STD = 1.0003, 2e-4


def experiments(seed: int, *, rate_std: float, factor: float = 1.0, pieces=None) -> tuple[Experiment, ...]:
    """The rig's log with a time base that is wrong by a factor."""
    torque = rig.drive_torque(COUNT, seed=seed)
    log = rig.drive_log(rig.drive_motion(torque), torque, noise=4.0, seed=seed, name=f"log {seed}")
    log = replace(log, time=10.0 + factor * log.time, rate_std=rate_std, pieces=pieces)
    return experiments_from_log(log, hold="zero-order", N=rig.N)


def fitted(*several: Experiment) -> Fit:
    return base_fit(MODEL, whole(several)).fit


@pytest.fixture(scope="module")
def wrong() -> Fit:
    return fitted(*experiments(0, rate_std=STD, factor=WRONG))


def test_sample_rate_is_fixed_with_exact_time_stamps():
    found = fitted(*experiments(0, rate_std=0.0))
    assert rate_columns(found) is None and refined_intervals(found) == {}


def test_fit_refines_a_wrong_sample_rate(wrong: Fit):
    (factor,) = refined_intervals(wrong).values()
    # The data determine the rate far better than the stamps; the prior biases it by the squared ratio of both errors.
    assert abs(factor * WRONG - 1.0) < 0.2 * (WRONG - 1.0)
    experiment = wrong.stretches[0].experiment
    (mended,) = with_intervals({"zero-order": [experiment]}, {experiment.log: factor})["zero-order"]
    np.testing.assert_allclose(np.diff(mended.time), factor * np.diff(experiment.time), rtol=1e-9)
    assert mended.time[0] == experiment.time[0]
    again = fitted(mended)
    assert again.objective < wrong.objective
    assert abs(float(again.model.drive.K) / rig.K - 1.0) < abs(float(wrong.model.drive.K) / rig.K - 1.0) + 1e-5


def test_standard_errors_allow_for_the_uncertain_sample_rate(wrong: Fit):
    known = replace(wrong.stretches[0].experiment, rate_std=0.0)
    without = uncertainty(fitted(known), torque_noise=False).estimates["K"].std
    beside = uncertainty(wrong, torque_noise=False).estimates["K"].std
    assert beside > 1.05 * without


def test_pieces_of_one_log_share_one_sample_rate():
    pieces = ((0, 5 * SHORTEST), (6 * SHORTEST, COUNT))
    parts = experiments(1, rate_std=STD, factor=1.0 / WRONG, pieces=pieces)
    found = fitted(*parts, *experiments(2, rate_std=0.0))
    seen = rate_columns(found)
    assert seen is not None and seen.logs == ("log 1",)
    others = np.any(seen.columns != 0.0, axis=(1, 2))
    assert 0 < others.sum() < len(others)
    assert abs(refined_intervals(found)["log 1"] / WRONG - 1.0) < 0.3 * (WRONG - 1.0)
