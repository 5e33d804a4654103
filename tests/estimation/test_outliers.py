"""What stands alone is left out; what comes in company, or belongs to the motion, stays."""

import dataclasses

import numpy as np
import pytest

import rig
from fitting.estimation.experiment import Stretch, experiment_from_log
from fitting.estimation.outliers import _alone, left_out, with_weights, without_glitches
from fitting.estimation.segments import cut

COUNT = 2000


def spoiled(rows, size: float, **options) -> tuple[Stretch, np.ndarray]:
    experiment = rig.reduced_experiment(COUNT, **options)
    measured = experiment.measured.copy()
    measured[rows] += size
    return Stretch(dataclasses.replace(experiment, measured=measured), 0, COUNT), experiment.measured


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
def test_a_gross_spike_is_found_and_bridged(noise: float):
    rows = [40, 700, 1999 - 40]
    stretch, truth = spoiled(rows, 20.0, noise=noise)
    (calm,) = without_glitches([stretch])
    weight = calm.experiment.weight
    assert weight is not None
    np.testing.assert_array_equal(np.flatnonzero(weight == 0), rows)
    assert left_out([calm]) == 3
    # A straight line across two samples of a swing that takes seventeen.
    assert np.max(np.abs(calm.experiment.measured - truth)) < 0.5
    kept = weight > 0
    np.testing.assert_array_equal(calm.experiment.measured[kept], truth[kept])
    np.testing.assert_array_equal(np.asarray(cut([calm], 250).weight).ravel(), weight)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_a_motion_is_no_glitch(noise: float, seed: int):
    stretch = Stretch(rig.reduced_experiment(COUNT, noise=noise, seed=seed), 0, COUNT)
    (same,) = without_glitches([stretch])
    assert same is stretch


def test_a_jump_of_the_torque_is_no_glitch():
    forcing = np.repeat(np.random.default_rng(0).normal(size=20), 100) * 30.0
    log = rig.reduced_log(rig.reduced_motion(forcing)[:, 0], forcing)
    stretch = Stretch(experiment_from_log(log, hold="zero-order"), 0, COUNT)
    assert without_glitches([stretch]) == (stretch,)


def test_only_what_stands_alone():
    size = np.full(60, 0.5)
    size[10] = 9.0
    size[20:23] = 7.0
    # A burst, a wave, and one whose neighbour is out of the ordinary too.
    size[30:34] = 8.0
    size[40:45] = [2.0, 4.0, 8.0, 4.0, 2.0]
    size[52:54] = [8.0, 3.5]
    np.testing.assert_array_equal(np.flatnonzero(_alone(size, 5.0)), [10, 20, 21, 22])


def test_the_same_samples_under_another_hold():
    stretch, _ = spoiled([500], 20.0)
    (calm,) = without_glitches([stretch])
    other = Stretch(rig.reduced_experiment(COUNT), 0, COUNT)
    (moved,) = with_weights([other], [calm])
    assert moved.experiment.torque is other.experiment.torque
    assert moved.experiment.weight is calm.experiment.weight
