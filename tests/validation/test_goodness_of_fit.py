"""Figures of merit, compared with independent computations."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import rig
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import experiment_from_log, split
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.free_run import FreeRun
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.identifiability import Identifiability
from fitting.uncertainty.standard_errors import Uncertainty
from fitting.validation.account import Account
from fitting.validation.goodness_of_fit import Goodness, fit_percent, goodness
from fitting.validation.residual_diagnostics import diagnose
from fitting.validation.residual_tests import residual_tests

NOISE = np.array([[4e-10, 1e-10], [1e-10, 9e-10]])


@pytest.fixture(scope="module")
def fitted() -> Fit:
    torque = rig.drive_torque(3000)
    log = rig.drive_log(rig.drive_motion(torque), torque, noise=1.0)
    # So small that it does not change the motion.
    log = dataclasses.replace(log, load_torque=1e-9 * np.random.default_rng(0).normal(size=3000))
    training, _ = split([experiment_from_log(log, hold="zero-order", N=rig.N)])
    model = rig.drive_model()
    return fit(model, training, base_paths(model), Segmentation(256))


@pytest.fixture(scope="module")
def found(fitted: Fit) -> Goodness:
    runs = (run(np.arange(5.0), np.arange(5.0)),)
    nothing = np.zeros((0, 0))
    unknown = Identifiability({}, (), (), {})
    result = Account(fitted.model, Uncertainty({}, nothing, nothing, nothing), runs, (), runs, unknown)
    return goodness(fitted, result, jnp.asarray(NOISE))


@pytest.fixture(scope="module")
def error(fitted: Fit) -> np.ndarray:
    """Measured minus simulated, by sample; 2400 samples fill nine segments of 256 and a part of a tenth."""
    return np.asarray(fitted.error).reshape(-1, 2)[:2400]


def test_counts_of_data_parameters_and_states(found: Goodness):
    assert (found.data, found.parameters, found.states) == (2 * 2400, 3, 10 * 4)


def test_likelihood_and_information_criteria_equal_those_by_scipy(found: Goodness, error: np.ndarray):
    """The reference is scipy's density at the covariance that maximises it."""
    covariance = error.T @ error / 2400
    expected = np.sum(stats.multivariate_normal([0, 0], covariance).logpdf(error))
    assert found.log_likelihood == pytest.approx(expected)
    # Three entries of a covariance of two outputs.
    count = 3 + 40 + 3
    assert found.aic == pytest.approx(2 * count - 2 * expected)
    assert found.bic == pytest.approx(count * np.log(4800) - 2 * expected)


def test_reduced_chi_square_equals_its_definition(found: Goodness, error: np.ndarray):
    white = np.linalg.solve(np.linalg.cholesky(NOISE), error.T)
    assert found.reduced_chi_square == pytest.approx(np.sum(white**2) / (4800 - 43))


def test_error_over_noise_is_given_by_output(found: Goodness, error: np.ndarray):
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert list(found.error_over_noise) == ["motor angle", "dynamic error"]
    # The covariance of the fit has a floor of a billionth of the range.
    assert list(found.error_over_noise.values()) == pytest.approx(list(rms / np.sqrt(np.diag(NOISE))), rel=1e-5)


def test_residual_is_tested_for_independence_of_each_input(fitted: Fit):
    found = residual_tests(fitted, diagnose(fitted))
    assert [c.name for c in found.inputs] == ["motor torque", "load torque"]
    assert {t.verdict for t in found.tests} == {"passed"}
    (load,) = [t for t in found.tests if t.name == "independence of load torque"]
    # The input is white, so that each lag is a degree of freedom.
    assert load.degrees == 26


def run(measured: np.ndarray, predicted: np.ndarray) -> FreeRun:
    return FreeRun("log", np.arange(measured.size) * 1.0, predicted, measured, None)


def test_fit_percent_equals_its_definition():
    random = np.random.default_rng(0)
    y = 3.0 + random.normal(size=400)
    yhat = y + 0.1 * random.normal(size=400)
    expected = 100 * (1 - np.linalg.norm(y - yhat) / np.linalg.norm(y - np.mean(y)))
    assert fit_percent([run(y, yhat)]) == pytest.approx(expected)
    assert fit_percent([run(y, y)]) == 100.0
    assert fit_percent([run(y, np.full(400, y.mean()))]) == pytest.approx(0.0)
    assert fit_percent([run(y, np.full(400, np.inf))]) == -np.inf


def test_fit_percent_subtracts_the_mean_of_each_run():
    """Two logs that differ by a constant have together the fit percent of each."""
    random = np.random.default_rng(1)
    y, error = random.normal(size=100), 0.1 * random.normal(size=100)
    assert fit_percent([run(y, y + error), run(y + 50, y + 50 + error)]) == pytest.approx(
        fit_percent([run(y, y + error)])
    )
