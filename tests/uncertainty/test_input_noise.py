"""Effect of noise of the logged torque on estimates, compared with simulations of the rig."""

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.stats import kstest

import rig
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import experiment_from_log, split
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.input_noise import nonnegative, torque_noise_covariance, uniformity
from fitting.uncertainty.sandwich import covariance, linearised

COUNT, DRAWS = 700, 48
# With little damping, the response to noise is nearly a line at the resonance with few correlation times.
PHYSICS = {"mu": 1.0, "alpha": 0.0}


def fitted(*, torque: float = 0.0, output: float = 0.0, seed: int = 0, count: int = COUNT) -> Fit:
    """A fit of a log with noise of the torque, relative to its rms of 10, and of the output."""
    logged = rig.reduced_forcing(count)
    acting = logged + 10.0 * torque * np.random.default_rng(seed).normal(size=count)
    motion = rig.reduced_motion(acting, **PHYSICS)
    log = rig.reduced_log(motion[:, 0], logged, noise=output, seed=seed)
    model = rig.reduced_model(**PHYSICS)
    training, _ = split([experiment_from_log(log, hold="zero-order")], held_out=0.01)
    return fit(model, training, base_paths(model), Segmentation(1 << 20, substeps=3))


def standard_errors(found: Fit) -> np.ndarray | None:
    regression = linearised(found)
    described = torque_noise_covariance(found, regression, covariance(regression).unit)
    return None if described is None else np.sqrt(np.diag(described))


@pytest.fixture(scope="module")
def fit_with_torque_noise() -> Fit:
    return fitted(torque=0.05, output=1e-4)


def test_standard_errors_under_torque_noise_equal_the_scatter_of_estimates(fit_with_torque_noise: Fit):
    described = standard_errors(fit_with_torque_noise)
    assert described is not None
    # The residual of new torque noise, by the rig; least squares gives the change of estimates.
    regression = linearised(fit_with_torque_noise)
    (record,), inverse = regression.records, covariance(regression).unit
    logged = rig.reduced_forcing(COUNT)
    silent = rig.reduced_motion(logged, **PHYSICS)[:, 0]
    white = float(fit_with_torque_noise.problem.whitening[0, 0])
    random = np.random.default_rng(5)
    moved = []
    for _ in range(DRAWS):
        motion = rig.reduced_motion(logged + 0.5 * random.normal(size=COUNT), substeps=4, **PHYSICS)[:, 0]
        disturbance = white * (motion - silent)[: record.residual.shape[0], None]
        moved.append(inverse @ np.einsum("nop,no->p", record.slopes, disturbance))
    scatter = np.std(moved, axis=0)
    # 48 draws determine a standard deviation to 10 %; the noise level follows from some 30 periods.
    np.testing.assert_allclose(described, scatter, rtol=0.4)
    # Under the assumption of white noise, the error of the damping is far too small.
    classical = np.sqrt(np.diag(covariance(regression).classical))
    assert described[0] > 2.0 * classical[0]


def test_standard_errors_under_white_encoder_noise_equal_classical_ones():
    found = fitted(output=2e-3)
    described = standard_errors(found)
    if described is not None:
        classical = np.sqrt(np.diag(covariance(linearised(found)).classical))
        np.testing.assert_allclose(described, classical, rtol=0.3)


@pytest.mark.slow
def test_random_walk_is_not_described_as_torque_noise():
    found = fitted(output=2e-3, count=2000)
    drift = np.cumsum(np.random.default_rng(1).normal(size=found.error.shape[:2]).ravel())
    walk = 1e-3 * drift.reshape(found.error.shape[:2])[..., None]
    regression = linearised(found)
    record = regression.records[0]
    disturbed = record.residual + walk.reshape(-1, 1)[: record.residual.shape[0]] * float(found.problem.whitening[0, 0])
    changed = type(regression)(
        (type(record)(disturbed, record.slopes, record.states, record.present),),
        regression.information,
        regression.prior,
        regression.chunk,
    )
    assert torque_noise_covariance(found, changed, covariance(regression).unit) is None


@pytest.mark.parametrize("sources", [1, 2, 3])
def test_nonnegative_coefficients_equal_those_of_scipy_nnls(sources: int):
    random = np.random.default_rng(sources)
    bound = 0
    for _ in range(100):
        shapes = np.abs(random.normal(size=(60, sources))) * 10.0 ** random.uniform(-6.0, 6.0, sources)
        power = shapes @ (random.normal(size=sources) / shapes.mean(axis=0)) + random.normal(size=60)
        expected, _ = nnls(shapes, power)
        bound += int((expected == 0.0).any())
        # Both work with products of the columns, whose condition number is squared.
        np.testing.assert_allclose(nonnegative(shapes, power), expected, rtol=1e-6, atol=1e-9 * expected.max())
    # Some but not all of the hundred draws have a coefficient at its bound.
    assert 10 < bound < 100


@pytest.mark.parametrize(("count", "power"), [(100, 0.7), (1000, 1.0), (9000, 0.97), (20000, 1.01)])
def test_uniformity_p_value_equals_that_of_the_kolmogorov_smirnov_test(count: int, power: float):
    values = np.random.default_rng(count).uniform(size=count) ** power
    expected = kstest(values, "uniform").pvalue
    # The correction for few values errs by some per cent of the p-value where that is below 0.1 (Stephens 1970).
    assert uniformity(values) == pytest.approx(expected, rel=0.1)
