"""Prediction bands, compared with free runs over draws of the parameters and of the noise in the window."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_run import free_run
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.prediction_band import PredictionBand, prediction_bands
from fitting.uncertainty.standard_errors import Uncertainty, uncertainty

COUNT, HORIZON, NOISE = 600, 128, 2e-3
# The stretch starts in motion, because the initial rate of a drive at rest is not uncertain.
START, STOPS = 80, (COUNT, 330)
COVARIANCE = jnp.asarray([[NOISE**2]])
PATHS = ("mu", "omega_0", "alpha", "gain")


@pytest.fixture(scope="module")
def fitted() -> tuple[Fit, Uncertainty]:
    experiment = rig.reduced_experiment(COUNT, noise=NOISE)
    found = fit(rig.reduced_model(), [Stretch(experiment, 0, COUNT)], PATHS, Segmentation(HORIZON, substeps=2, count=8))
    return found, uncertainty(found)


@pytest.fixture(scope="module")
def bands(fitted: tuple[Fit, Uncertainty]) -> tuple[PredictionBand, ...]:
    """Prediction bands of a whole stretch and of its first half."""
    unseen = rig.reduced_experiment(COUNT, noise=NOISE, seed=5)
    return prediction_bands(*fitted, [Stretch(unseen, START, n) for n in STOPS], noise=COVARIANCE)


@pytest.fixture(scope="module")
def band(bands: tuple[PredictionBand, ...]) -> PredictionBand:
    return bands[0]


def repeated(fitted: Fit, covariance: np.ndarray, noise: float, draws: int, **changes: Any) -> np.ndarray:
    """Standard deviation of free runs at each sample, over parameters of that covariance and noise in the window."""
    random = np.random.default_rng(3)
    clean = dataclasses.replace(rig.reduced_experiment(COUNT, seed=5), **changes)
    centre = np.asarray(fitted.free.pack(fitted.model))
    # Windows without noise are given a small one, since a fit of the state ends a hundredth of it from its minimum.
    given = COVARIANCE if noise else 1e-4 * COVARIANCE
    runs = []
    for _ in range(draws):
        model = fitted.free.unpack(fitted.model, jnp.asarray(random.multivariate_normal(centre, covariance)))
        measured = clean.measured + noise * random.normal(size=(COUNT, 1))
        noisy = dataclasses.replace(clean, measured=measured)
        run, _ = free_run(model, [Stretch(noisy, START, n) for n in STOPS], covariance=given, substeps=2)
        runs.append(run.predicted)
    return np.std(runs, axis=0)


def assert_same_spread(found: np.ndarray, expected: np.ndarray, draws: int):
    # Three standard errors of a standard deviation from so many draws; neighbouring samples share their draws.
    known = 3.0 / np.sqrt(2 * draws)
    assert np.sqrt(np.mean(found**2)) == pytest.approx(np.sqrt(np.mean(expected**2)), rel=known)
    large = expected > 0.3 * expected.max()
    np.testing.assert_allclose(found[large] / expected[large], 1.0, atol=2 * known)


def test_band_equals_the_scatter_of_repeated_free_runs(fitted: tuple[Fit, Uncertainty], band: PredictionBand):
    found, known = fitted
    assert_same_spread(band.std_predicted, repeated(found, known.covariance, NOISE, 50), 50)


@pytest.mark.slow
def test_parts_of_the_band_by_parameters_and_state_equal_repetition(
    fitted: tuple[Fit, Uncertainty], band: PredictionBand
):
    found, known = fitted
    assert_same_spread(band.std_parameters, repeated(found, known.covariance, 0.0, 150), 150)
    assert_same_spread(band.std_state, repeated(found, 1e-20 * known.covariance, NOISE, 150), 150)


def test_band_covers_the_measured_output(band: PredictionBand):
    assert band.std_noise == pytest.approx(NOISE, rel=1e-9)
    np.testing.assert_allclose(band.std_measured**2, band.std_predicted**2 + NOISE**2, rtol=1e-12)
    low, high = band.band95
    inside = np.mean((low < band.run.measured) & (band.run.measured < high))
    assert inside > 0.9
    # The influence of the initial state decays, that of the parameters does not.
    assert np.max(band.std_state[-100:]) < 0.2 * np.max(band.std_state)
    assert np.max(band.std_parameters[-100:]) > 0.2 * np.max(band.std_parameters)


def test_band_of_a_slow_channel_equals_the_scatter_of_repeated_free_runs(fitted: tuple[Fit, Uncertainty]):
    """The window reaches over enough valid samples, and the band over invalid ones."""
    found, known = fitted
    weight = (np.arange(COUNT) % 5 == 0).astype(float)
    unseen = dataclasses.replace(rig.reduced_experiment(COUNT, noise=NOISE, seed=5), weight=weight)
    band, _ = prediction_bands(found, known, [Stretch(unseen, START, n) for n in STOPS], noise=COVARIANCE)
    assert_same_spread(band.std_predicted, repeated(found, known.covariance, NOISE, 50, weight=weight), 50)


@pytest.mark.slow
def test_band_of_a_log_with_a_zero_of_its_own_equals_the_scatter_of_repeated_free_runs(
    fitted: tuple[Fit, Uncertainty], band: PredictionBand
):
    found, known = fitted
    unseen = dataclasses.replace(rig.reduced_experiment(COUNT, noise=NOISE, seed=5), has_own_zero=True)
    own, _ = prediction_bands(found, known, [Stretch(unseen, START, n) for n in STOPS], noise=COVARIANCE)
    assert np.all(own.std_state[-100:] > band.std_state[-100:])
    assert_same_spread(own.std_predicted, repeated(found, known.covariance, NOISE, 50, has_own_zero=True), 50)


def test_bands_of_several_stretches_are_independent(bands: tuple[PredictionBand, ...]):
    whole, half = bands
    assert half.std_state.shape == (STOPS[1] - START,)
    np.testing.assert_allclose(half.std_predicted, whole.std_predicted[: STOPS[1] - START], rtol=1e-6)


@pytest.mark.slow
def test_band_of_a_drive_log_with_two_outputs():
    experiment = rig.drive_experiment(512)
    found = fit(rig.drive_model(), [Stretch(experiment, 0, 512)], ("K", "B_sp"), Segmentation(256, substeps=1, count=2))
    known = uncertainty(found)
    (result,) = prediction_bands(found, known, [Stretch(experiment, 0, 512)], noise=found.covariance)
    assert result.std_noise == pytest.approx(found.principal_std, rel=1e-9)
    # With exact parameters, only the noise of the window remains.
    certain = eqx.tree_at(lambda u: u.covariance, known, 0.0 * known.covariance)
    (sure,) = prediction_bands(found, certain, [Stretch(experiment, 0, 512)], noise=found.covariance)
    np.testing.assert_array_equal(sure.std_parameters, 0.0)
    np.testing.assert_allclose(sure.std_state, result.std_state)
