"""Zeros of the twist that a log's motion determines roughly, refined by the fit."""

from dataclasses import replace

import numpy as np
import pytest

import rig
from fitting.estimation.base_fit import base_fit
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Experiment, experiment_from_log, whole
from fitting.estimation.recalibration import recalibrated, remaining_offsets, with_zeros, zeros_apart
from fitting.logs.zeroing import counted_from
from hdjax import Drive, TwoInertiaModel

COUNT, LEFT = 4000, 2e-7
MODEL = TwoInertiaModel(Drive(N=rig.N, J_m=rig.J_M, J_l=rig.J_L, K=1.0))


def experiment(seed: int, *, zero: float, left: float, **physics) -> Experiment:
    """The rig's log after the subtraction of a zero that is wrong by a fifth of the noise of one sample."""
    torque = rig.drive_torque(COUNT, seed=seed)
    log = rig.drive_log(rig.drive_motion(torque, **physics), torque, seed=seed, name=f"log {seed}")
    log = replace(log, dynamic_error=log.dynamic_error + zero + left)
    return experiment_from_log(counted_from(log, zero), hold="zero-order", N=rig.N)


def fitted(*several: Experiment) -> Fit:
    return base_fit(MODEL, whole(several)).fit


def test_fit_refines_the_zero_of_each_group_of_logs():
    logs = experiment(0, zero=0.3, left=LEFT), experiment(1, zero=-0.1, left=-LEFT), experiment(2, zero=0.0, left=LEFT)
    found = fitted(*logs)
    means = remaining_offsets(found)
    # Without a zero nothing was subtracted: what is constant there is for the search.
    assert means.keys() == {0.3, -0.1}
    noise = np.hypot(rig.LOAD_NOISE, rig.MOTOR_NOISE / rig.N) / np.sqrt(COUNT)
    assert means[0.3] == pytest.approx(LEFT, abs=4 * noise)
    assert means[-0.1] == pytest.approx(-LEFT, abs=4 * noise)
    again = recalibrated(found, {"zero-order": logs}, {})
    assert again is not None and again[1] == {}
    np.testing.assert_array_equal(again[0]["zero-order"][2].measured, logs[2].measured)
    left = remaining_offsets(fitted(*again[0]["zero-order"]))
    assert all(abs(mean) < 0.1 * LEFT for mean in left.values())


def test_zero_is_not_refined_beside_a_missing_effect():
    found = fitted(experiment(0, zero=0.3, left=LEFT, motor_friction=(0.03, 0.05)))
    assert remaining_offsets(found) == {} and recalibrated(found, {}) is None


def test_zeros_that_differ_between_logs_are_found_where_nothing_else_is_missing():
    offsets = {"log 0": 5e-5, "log 1": 2e-4}
    logs = [experiment(i, zero=0.0, left=left) for i, left in enumerate(offsets.values())]
    other = experiment(2, zero=0.0, left=-1e-4)
    again = recalibrated(fitted(*logs), {"zero-order": logs}, {"zero-order": [logs[0], other]})
    assert again is not None
    noise = np.hypot(rig.LOAD_NOISE, rig.MOTOR_NOISE / rig.N) / np.sqrt(COUNT)
    for one, offset in zip(again[0]["zero-order"], offsets.values(), strict=True):
        assert one.zero == pytest.approx(offset, abs=5 * noise)
    end, unknown = again[1]["zero-order"]
    assert end.zero == again[0]["zero-order"][0].zero and not end.has_own_zero
    assert unknown.zero == 0.0 and unknown.has_own_zero


@pytest.mark.parametrize(
    ("offsets", "friction"), [((1e-4, 1e-4), 0.0), pytest.param((5e-5, 2e-4), 0.03, marks=pytest.mark.slow)]
)
def test_zeros_are_left_where_they_are_equal_or_an_effect_is_missing(offsets: tuple[float, float], friction: float):
    logs = [experiment(i, zero=0.0, left=one, motor_friction=(friction, 0.05)) for i, one in enumerate(offsets)]
    assert zeros_apart(fitted(*logs)) == {}


def test_only_the_dynamic_error_is_shifted():
    log = experiment(0, zero=0.3, left=0.0)
    (shifted,) = with_zeros({"zero-order": [log]}, {0.3: 1e-3})["zero-order"]
    np.testing.assert_allclose(shifted.measured, log.measured - [0.0, 1e-3], rtol=0, atol=1e-15)
    (same,) = with_zeros({"zero-order": [log]}, {0.2: 1e-3})["zero-order"]
    assert same is log
