"""Isolated samples far from their neighbours are outliers; bursts and the motion itself are not."""

import dataclasses

import numpy as np
import pytest

import rig
from fitting.estimation.experiment import Stretch, experiment_from_log
from fitting.estimation.outliers import _alone, left_out, with_weights, without_glitches
from fitting.estimation.segments import cut

COUNT = 2000


def stretch_with_spikes(rows, size: float, **options) -> tuple[Stretch, np.ndarray]:
    experiment = rig.reduced_experiment(COUNT, **options)
    measured = experiment.measured.copy()
    measured[rows] += size
    return Stretch(dataclasses.replace(experiment, measured=measured), 0, COUNT), experiment.measured


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
def test_gross_spikes_get_weight_zero_and_are_interpolated(noise: float):
    rows = [40, 700, 1999 - 40]
    stretch, truth = stretch_with_spikes(rows, 20.0, noise=noise)
    (calm,) = without_glitches([stretch])
    weight = calm.experiment.weight
    assert weight is not None
    np.testing.assert_array_equal(np.flatnonzero(weight == 0), rows)
    assert left_out([calm]) == 3
    # A straight line over two of the seventeen samples of a period.
    assert np.max(np.abs(calm.experiment.measured - truth)) < 0.5
    kept = weight > 0
    np.testing.assert_array_equal(calm.experiment.measured[kept], truth[kept])
    np.testing.assert_array_equal(np.asarray(cut([calm], 250).weight).ravel(), weight)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_ordinary_motion_has_no_outliers(noise: float, seed: int):
    stretch = Stretch(rig.reduced_experiment(COUNT, noise=noise, seed=seed), 0, COUNT)
    (same,) = without_glitches([stretch])
    assert same is stretch


def test_torque_jump_is_no_outlier():
    forcing = np.repeat(np.random.default_rng(0).normal(size=20), 100) * 30.0
    log = rig.reduced_log(rig.reduced_motion(forcing)[:, 0], forcing)
    stretch = Stretch(experiment_from_log(log, hold="zero-order"), 0, COUNT)
    assert without_glitches([stretch]) == (stretch,)


def test_only_isolated_samples_are_outliers():
    size = np.full(60, 0.5)
    size[10] = 9.0
    size[20:23] = 7.0
    # A burst, a wave, and a sample whose neighbour is large too.
    size[30:34] = 8.0
    size[40:45] = [2.0, 4.0, 8.0, 4.0, 2.0]
    size[52:54] = [8.0, 3.5]
    np.testing.assert_array_equal(np.flatnonzero(_alone(size, 5.0)), [10, 20, 21, 22])


def test_weights_are_copied_to_an_experiment_with_another_hold():
    stretch, _ = stretch_with_spikes([500], 20.0)
    (calm,) = without_glitches([stretch])
    other = Stretch(rig.reduced_experiment(COUNT), 0, COUNT)
    (moved,) = with_weights([other], [calm])
    assert moved.experiment.torque is other.experiment.torque
    assert moved.experiment.weight is calm.experiment.weight
