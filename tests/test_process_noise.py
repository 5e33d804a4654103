"""Noise of the torque channel, from innovations: against what the rig was given."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.attribution.decisions import NoiseEvidence, noisy_torque
from fitting.close_loop import close_loop
from fitting.engines import with_engine
from fitting.estimate import Fit, fit
from fitting.experiment import Experiment, experiment_from_log, whole
from fitting.free import base_paths
from fitting.posing import Segmentation
from fitting.prediction_band import prediction_bands
from fitting.process_noise import spread_by_torque, torque_noise
from fitting.residual import Unknowns
from fitting.uncertainty import uncertainty
from hdjax import Hold

COUNT, STD = 3000, 0.01
OUTPUTS = np.array([[1.0, 1.0], [1.0, 1.0]]) * (rig.MOTOR_NOISE / rig.N) ** 2 + np.diag([0.0, rig.LOAD_NOISE**2])


def noisy_experiment(*, seed: int = 0, count: int = COUNT, std: float = STD, **physics) -> Experiment:
    """A log whose torque was logged with noise."""
    acting = rig.drive_torque(count, seed=seed)
    log = rig.drive_log(rig.drive_motion(acting, **physics), acting, seed=seed)
    logged = acting + std * np.random.default_rng(seed + 7).normal(size=count)
    return experiment_from_log(replace(log, motor_torque=logged), hold="zero-order", N=rig.N)


def fitted(experiment: Experiment) -> Fit:
    model = rig.drive_model()
    return fit(model, whole([experiment]), base_paths(model), Segmentation(128))


@pytest.fixture(scope="module")
def noisy() -> Fit:
    return fitted(noisy_experiment())


def test_the_noise_is_that_of_the_log(noisy: Fit):
    found = torque_noise(noisy, OUTPUTS)
    assert found.std == pytest.approx(STD, rel=0.05)
    assert found.innovations == pytest.approx(1.0, abs=0.05)
    assert found.predictable < 0.02


def test_what_is_missing_is_not_taken_for_it():
    found = torque_noise(fitted(noisy_experiment(motor_friction=(0.03, 0.05))), OUTPUTS)
    checks = noisy_torque(NoiseEvidence(found.share, found.predictable, found.innovations))
    assert not all(check.holds for check in checks)


def test_the_spread_is_that_of_simulations(noisy: Fit):
    """By the rig: the same motion under fresh noise of the torque."""
    count, draws = 300, 60
    torque = rig.drive_torque(count)
    silent = rig.drive_motion(torque)
    random = np.random.default_rng(0)
    moved = [rig.drive_motion(torque + STD * random.normal(size=count)) for _ in range(draws)]
    scatter = np.std([(m - silent)[:, 0] / rig.N - (m - silent)[:, 1] for m in moved], axis=0)
    experiment = rig.drive_experiment(count)
    model = rig.drive_model()
    problem = fit(model, whole([experiment]), (), Segmentation(count, length=count, substeps=4)).problem
    states = jnp.asarray(silent[:1, :4])
    found = spread_by_torque(with_engine(problem), Unknowns(jnp.zeros(0), states), STD)[0]
    # 60 draws know a standard deviation to 9 %; over all samples the ratio's median is known better.
    assert np.median(scatter[20:] / found[20:count]) == pytest.approx(1.0, abs=0.1)


def test_bands_hold_what_noise_of_the_torque_drives(noisy: Fit):
    unseen = whole([noisy_experiment(seed=seed, count=600) for seed in (3, 4, 5, 6)])
    options = {"noise": jnp.asarray(OUTPUTS), "halo": noisy.problem.segments.halo}
    blind, wide = (
        prediction_bands(noisy, uncertainty(noisy), unseen, torque_noise=std, **options) for std in (0.0, STD)
    )
    assert np.mean([band.inside[50:] for band in blind]) < 0.8
    # What the drive answers is a line at the resonance: four runs know the share to some per cent.
    assert np.mean([band.inside[50:] for band in wide]) == pytest.approx(0.95, abs=0.05)


def test_the_loop_says_that_the_model_suffices_and_the_torque_is_noisy():
    data: dict[Hold, tuple[Experiment, ...]] = {"zero-order": (noisy_experiment(count=4000),)}
    loop = close_loop(rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0), data, hold="zero-order")
    assert loop.decision == "model_sufficient" and loop.unknown is None
    assert loop.torque_noise == pytest.approx(STD, rel=0.1)
    for path, truth in {"K": rig.K, "alpha": rig.ALPHA, "B_sp": rig.B_SP}.items():
        low, high = loop.after.uncertainty.estimates[path].ci95
        assert low < truth < high, path
