"""The base fit reaches the right minimum from the log alone, also in hard cases."""

import dataclasses

import numpy as np
import pytest

import rig
from fitting.estimation.base_fit import _refined, base_fit, is_held, leaves_white_noise
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Experiment, Stretch, experiment_from_log
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.outliers import left_out
from fitting.estimation.problem import Segmentation
from fitting.estimation.starting_values import starting_models
from fitting.uncertainty.standard_errors import uncertainty

PLACEHOLDER = rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0)
COUNT = 1000
NOISE = 1e-3
PERIOD = 2 * np.pi / rig.OMEGA_0


def whole(experiment: Experiment) -> list[Stretch]:
    return [Stretch(experiment, 0, len(experiment))]


def assert_recovered(found: Fit, truth: dict[str, float], *, within: float = 4.0):
    for path, estimate in uncertainty(found).estimates.items():
        assert abs(estimate.value - truth[path]) < within * estimate.std, (path, estimate)


@pytest.fixture(scope="module")
def clean() -> Experiment:
    return rig.reduced_experiment(COUNT, noise=NOISE)


@pytest.fixture(scope="module")
def found(clean) -> Fit:
    return base_fit(PLACEHOLDER, whole(clean)).fit


TRUTH = {"mu": rig.MU, "omega_0": rig.OMEGA_0, "alpha": rig.REDUCED_ALPHA, "gain": rig.GAIN}


def test_base_fit_recovers_all_parameters_of_a_log_with_white_noise(found: Fit):
    assert found.converged
    assert_recovered(found, TRUTH)
    assert found.principal_std == pytest.approx(NOISE, rel=0.1)
    # Gaussian noise has no outliers, so that the data are unchanged.
    assert left_out(found.stretches) == 0
    assert found.stretches[0].experiment.weight is None


def test_residual_is_white_at_the_minimum_and_not_at_a_wrong_frequency(found: Fit, clean):
    assert leaves_white_noise(found)
    off = fit(
        rig.reduced_model(omega_0=1.01 * rig.OMEGA_0),
        whole(clean),
        base_paths(PLACEHOLDER),
        Segmentation(found.horizon, substeps=found.substeps),
        strategy=Strategy(hold_parameters=True),
    )
    assert not leaves_white_noise(off)


def test_whiteness_check_passes_with_many_initial_states(found: Fit, clean):
    """An initial state every 32 samples follows some of the noise, which does not mean a wrong minimum."""
    short = fit(found.model, whole(clean), base_paths(PLACEHOLDER), Segmentation(32, substeps=found.substeps))
    assert leaves_white_noise(short)


def test_growing_horizons_reach_the_minimum_from_a_far_frequency(clean):
    far = rig.reduced_model(omega_0=0.5 * rig.OMEGA_0, gain=0.25 * rig.GAIN, alpha=0.0)
    paths = base_paths(far)
    # A fit over six periods at once ends in a wrong minimum if the frequency is 50 % off; growing windows avoid it.
    direct = fit(
        far,
        whole(clean),
        paths,
        Segmentation(128, substeps=3),
        strategy=Strategy(begin_anew_above=np.inf, retry_states=False),
    )
    assert abs(float(direct.model.get("omega_0")) / rig.OMEGA_0 - 1) > 0.1
    grown = fit(far, whole(clean), paths, Segmentation(128, substeps=3))
    assert float(grown.model.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=1e-3)
    coarse = fit(far, whole(clean), paths, Segmentation(32, substeps=3), strategy=Strategy(hold_parameters=True))
    refined = _refined(coarse, whole(clean), 0)
    assert refined.horizon == 128
    assert_recovered(refined, TRUTH)


@pytest.mark.parametrize("size", [15 * NOISE, 20.0])
def test_outliers_get_weight_zero_and_do_not_bias_estimates(found: Fit, clean, size: float):
    random = np.random.default_rng(3)
    # One sample in a hundred, never two adjacent ones; the twist itself is of order 1.
    rows = 7 + 100 * np.arange(COUNT // 100) + random.integers(0, 80, COUNT // 100)
    measured = clean.measured.copy()
    measured[rows] += size * random.choice([-1.0, 1.0], rows.size)[:, None]
    spoiled = base_fit(PLACEHOLDER, whole(dataclasses.replace(clean, measured=measured))).fit
    weight = spoiled.stretches[0].experiment.weight
    assert weight is not None
    np.testing.assert_array_equal(np.flatnonzero(weight == 0), rows)
    estimates = uncertainty(found).estimates
    for path, estimate in estimates.items():
        # A hundredth of the information moves an estimate by about a tenth of its standard error.
        assert abs(float(spoiled.model.get(path)) - estimate.value) < 0.5 * estimate.std, path
    assert spoiled.principal_std == pytest.approx(found.principal_std, rel=0.05)


@pytest.mark.slow
def test_torque_frequency_is_not_taken_for_the_natural_frequency():
    """An undriven oscillator at the torque's frequency fits the log better than the drive with a wrong damping."""
    zeta, step = 0.018, PERIOD / 8.6
    forcing = 3 * rig.GAIN * np.cos(0.46 * rig.OMEGA_0 * np.arange(1500) * step)
    x = rig.reduced_motion(forcing, mu=2 * zeta * rig.OMEGA_0, alpha=0.0, step=step)[:, 0]
    random = np.random.default_rng(0)
    logged = forcing + 0.015 * np.std(forcing) * random.normal(size=forcing.size)
    log = rig.reduced_log(x, logged, noise=0.013 * np.std(x), step=step)
    stretches = whole(experiment_from_log(log, hold="zero-order"))
    starts = starting_models(PLACEHOLDER, stretches)
    assert any(abs(float(s.get("omega_0")) / (0.46 * rig.OMEGA_0) - 1) < 0.1 for s in starts)
    result = base_fit(PLACEHOLDER, stretches).fit
    assert float(result.model.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=0.02)
    assert float(result.model.get("gain")) == pytest.approx(rig.GAIN, rel=0.05)


@pytest.mark.slow
def test_base_fit_recovers_a_noisy_oversampled_softening_drive():
    """Initial speeds from a few noisy samples would make the simulation pass the saddle and diverge."""
    step, count = PERIOD / 150, 1500
    forcing = 10.0 * np.sign(np.sin(0.37 * rig.OMEGA_0 * np.arange(count) * step))
    motion = rig.reduced_motion(forcing, alpha=0.0, mu=10.0, step=step)[:, 0]
    alpha = -0.3 / np.max(np.abs(motion)) ** 2
    x = rig.reduced_motion(forcing, alpha=alpha, mu=10.0, step=step)[:, 0]
    assert -0.7 < alpha * np.max(np.abs(x)) ** 2 < -0.2
    log = rig.reduced_log(x, forcing, noise=0.1 * np.std(x), step=step)
    result = base_fit(PLACEHOLDER, whole(experiment_from_log(log, hold="zero-order"))).fit
    assert result.converged
    assert_recovered(result, {"mu": 10.0, "omega_0": rig.OMEGA_0, "alpha": alpha, "gain": rig.GAIN})
    assert float(result.model.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=0.1)


@pytest.mark.slow
def test_base_fit_fixes_parameters_under_a_large_unlogged_load():
    """Gravity exceeds the motor torque, and no minimum of the base model is near the true parameters."""
    torque = np.repeat(0.1 * np.random.default_rng(0).normal(size=20), 300)
    log = rig.drive_log(rig.drive_motion(torque, gravity=20.0), torque, noise=0.1)
    stretches = whole(experiment_from_log(log, hold="zero-order", N=rig.N))
    placeholder = rig.drive_model(K=1.0, alpha=0.0, B_sp=1.0)
    found = base_fit(placeholder, stretches, halo=4).fit
    assert is_held(found)
    assert float(found.model.get("K")) == pytest.approx(rig.K, rel=0.02)
    assert float(found.model.get("alpha")) == pytest.approx(rig.ALPHA, rel=0.2)
    assert found.model.effects == ()
    # Free parameters diverge.
    loose = fit(found.model, stretches, base_paths(found.model), Segmentation(found.horizon, halo=4))
    assert abs(np.log(float(loose.model.get("K")) / rig.K)) > 1.0
