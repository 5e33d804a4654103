"""Standard errors, compared with the scatter of estimates over repeated experiments."""

import equinox as eqx
import numpy as np
import pytest
from scipy.stats import binom, chi2, t

import rig
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.free_parameters import base_paths, free_parameters
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.standard_errors import Uncertainty, uncertainty

COUNT, HORIZON, NOISE = 1000, 128, 2e-3
TRUTH = {"mu": rig.MU, "omega_0": rig.OMEGA_0, "alpha": rig.REDUCED_ALPHA, "gain": rig.GAIN}
PATHS = tuple(TRUTH)


@pytest.fixture(scope="module")
def clean() -> Experiment:
    return rig.reduced_experiment(COUNT)


def noisy(clean: Experiment, noise: np.ndarray) -> list[Stretch]:
    measured = clean.measured + noise[:, None]
    return [Stretch(eqx.tree_at(lambda e: e.measured, clean, measured), 0, COUNT)]


def reduced_fit(stretches: list[Stretch], **start) -> Fit:
    model = rig.reduced_model(**start)
    return fit(model, stretches, base_paths(model), Segmentation(HORIZON, substeps=2, count=8))


def white(seed: int) -> np.ndarray:
    return NOISE * np.random.default_rng(seed).normal(size=COUNT)


def coloured(seed: int) -> np.ndarray:
    """First-order noise with the same rms, correlated over some six samples."""
    pole = 0.85
    draws = np.random.default_rng(seed).normal(size=COUNT) * NOISE * np.sqrt(1 - pole**2)
    noise = np.empty(COUNT)
    level = draws[0] / np.sqrt(1 - pole**2)
    for i, d in enumerate(draws):
        noise[i] = level = pole * level + d
    return noise


def repeated(clean: Experiment, noise, draws: int) -> list[Uncertainty]:
    return [uncertainty(reduced_fit(noisy(clean, noise(seed)))) for seed in range(draws)]


def z_scores(found: list[Uncertainty], error: str) -> np.ndarray:
    """(draws, parameters) deviations from the truth in standard errors."""
    return np.array(
        [[(u.estimates[p].value - TRUTH[p]) / getattr(u.estimates[p], error) for p in PATHS] for u in found]
    )


def assert_chi_squared(z: np.ndarray, slack: float = 1.0):
    """Check second moments about the truth against their joint 99.9 % band (Bonferroni).

    Args:
        z: deviations in standard errors.
        slack: factor that allows for the scatter of the standard errors themselves.
    """
    draws = z.shape[0]
    low, high = chi2.ppf([0.0005 / len(PATHS), 1 - 0.0005 / len(PATHS)], draws) / draws
    moment = np.mean(z**2, axis=0)
    assert (moment > low / slack).all() and (moment < high * slack).all(), (low, moment, high)


def coverage(found: list[Uncertainty]) -> np.ndarray:
    return np.array(
        [np.sum([u.estimates[p].ci95[0] < TRUTH[p] < u.estimates[p].ci95[1] for u in found]) for p in PATHS]
    )


DRAWS = 60


@pytest.fixture(scope="module")
def white_draws(clean: Experiment) -> list[Uncertainty]:
    return repeated(clean, white, DRAWS)


def assert_covered(found: list[Uncertainty]):
    """Check a coverage between 93 % and 97 %, within the 99.9 % band of so many draws."""
    draws, covered = len(found), coverage(found)
    assert (covered >= binom.ppf(0.0005, draws, 0.93)).all(), covered
    assert covered.mean() <= binom.ppf(0.9995, draws, 0.97), covered


def test_standard_errors_under_white_noise_equal_the_scatter_of_estimates(white_draws: list[Uncertainty]):
    for error in ("std_classical", "std"):
        assert_chi_squared(z_scores(white_draws, error), slack=1.0 if error == "std_classical" else 1.15)
    # No bias: the mean of n standard normal values has the standard deviation 1/sqrt(n).
    z = z_scores(white_draws, "std_classical")
    assert np.max(np.abs(z.mean(axis=0))) * np.sqrt(DRAWS) < 4.0
    assert_covered(white_draws)


def test_chi_squared_check_detects_errors_wrong_by_a_factor_of_two(white_draws: list[Uncertainty]):
    z = z_scores(white_draws, "std_classical")
    for factor in (0.5, 2.0):
        with pytest.raises(AssertionError):
            assert_chi_squared(factor * z)


def test_robust_errors_hold_under_coloured_noise_and_classical_ones_do_not(clean: Experiment):
    draws = 40
    found = repeated(clean, coloured, draws)
    classical = np.mean(z_scores(found, "std_classical") ** 2, axis=0)
    # With more noise power below the resonance than white noise, classical errors of all parameters are too small.
    high = chi2.ppf(0.9995, draws) / draws
    assert (classical > high).all(), (classical, high)
    assert_chi_squared(z_scores(found, "std"), slack=1.15)
    assert_covered(found)


def test_correlation_matrix_equals_that_of_the_scatter_of_estimates(white_draws: list[Uncertainty]):
    correlation = white_draws[0].correlation
    np.testing.assert_allclose(np.diag(correlation), 1.0, rtol=1e-12)
    np.testing.assert_allclose(correlation, correlation.T, atol=1e-12)
    assert (np.linalg.eigvalsh(correlation) > 0).all()
    # The scatter has the same correlations: 60 draws determine a correlation to 0.13 or better.
    values = np.array([[u.estimates[p].value for p in PATHS] for u in white_draws])
    np.testing.assert_allclose(np.corrcoef(values.T), correlation, atol=0.5)
    assert tuple(white_draws[0].estimates) == PATHS


def test_intervals_are_those_of_student_and_estimates_have_units(white_draws: list[Uncertainty]):
    estimates = white_draws[0].estimates
    for path, estimate in estimates.items():
        assert estimate.path == path
        assert estimate.identifiable
        assert 0.3 < estimate.std / estimate.std_classical < 3.0
        assert estimate.ci95[0] < estimate.value < estimate.ci95[1]
        width = estimate.ci95[1] - estimate.ci95[0]
        # The interval lies between that of the normal distribution and Student's; positive parameters have one of the
        # logarithm, which is slightly longer above.
        student = t.ppf(0.975, estimate.degrees_of_freedom)
        assert 0.99 * 1.959964 < 0.5 * width / estimate.std < 1.01 * student < 3.0
    assert estimates["mu"].unit == "1/s"
    assert estimates["omega_0"].ci95[0] > 0


def test_alpha_of_a_nearly_linear_log_is_not_identifiable():
    small = [Stretch(rig.reduced_experiment(COUNT, noise=NOISE, rms=0.5), 0, COUNT)]
    found = uncertainty(reduced_fit(small, alpha=0.0)).estimates
    assert not found["alpha"].identifiable
    assert found["alpha"].ci95[0] < 0.0 < found["alpha"].ci95[1]
    for path in ("mu", "omega_0", "gain"):
        assert found[path].identifiable, path


def test_uncertainty_without_free_parameters_is_empty(clean: Experiment):
    result = reduced_fit(noisy(clean, white(0)))
    found = uncertainty(eqx.tree_at(lambda f: f.problem.free, result, free_parameters(result.model, (), {})))
    assert found.estimates == {}
    assert found.correlation.shape == (0, 0)
