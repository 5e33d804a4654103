"""The residual tests keep their level on noise of any colour and detect model errors."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

import rig
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.estimation.whiteness import autocorrelation, autocovariance, left_over
from fitting.validation.residual_diagnostics import diagnose
from fitting.validation.residual_tests import LAGS, independence, normality, residual_tests, whiteness, zero_mean

REPETITIONS = 300
SAMPLES = 2000


def direct_autocorrelation(values: np.ndarray, lags: int) -> np.ndarray:
    """Autocorrelation by its definition."""
    v = values - values.mean()
    return np.array([np.sum(v[: v.size - k] * v[k:]) for k in range(lags + 1)]) / np.sum(v**2)


def coloured(random: np.random.Generator, memory: float) -> np.ndarray:
    """First-order autoregressive noise."""
    return lfilter([1.0], [1.0, -memory], random.normal(size=SAMPLES + 500))[500:]


def assert_uniform(p_values: list[float]) -> None:
    """Check that p-values are uniform (Kolmogorov-Smirnov test at 1e-4, with a fixed seed)."""
    assert stats.kstest(p_values, "uniform").pvalue > 1e-4


def test_uniformity_check_detects_nonuniform_p_values():
    with pytest.raises(AssertionError):
        assert_uniform(list(np.random.default_rng(0).uniform(size=REPETITIONS) ** 2))


def test_autocovariance_equals_its_definition():
    values = np.random.default_rng(0).normal(size=300)
    found = autocovariance(values, 40)
    np.testing.assert_allclose(found, [np.sum(values[: 300 - k] * values[k:]) for k in range(41)], atol=1e-10)


def test_whiteness_statistic_equals_that_of_ljung_and_box():
    values = coloured(np.random.default_rng(1), 0.1)
    r = direct_autocorrelation(values, LAGS)
    test = whiteness(r, SAMPLES)
    Q = SAMPLES * (SAMPLES + 2) * sum(r[k] ** 2 / (SAMPLES - k) for k in range(1, LAGS + 1))
    assert test.statistic == pytest.approx(Q)
    assert test.p_value == pytest.approx(1 - stats.chi2.cdf(Q, LAGS), abs=1e-12)


def test_residual_tests_keep_their_level_on_white_noise():
    random = np.random.default_rng(2)
    p_values = {"mean": [], "white": [], "normal": []}
    for _ in range(REPETITIONS):
        noise = random.normal(size=SAMPLES)
        r = direct_autocorrelation(noise, 100)
        p_values["mean"].append(zero_mean(noise, r).p_value)
        p_values["white"].append(whiteness(r, SAMPLES).p_value)
        p_values["normal"].append(normality(noise - noise.mean(), r).p_value)
    # The allowance for correlation responds to chance in white noise, so that the test of the mean is conservative.
    assert np.mean(np.array(p_values["mean"]) < 0.05) < 0.08
    assert_uniform(p_values["white"])
    assert_uniform(p_values["normal"])


@pytest.mark.parametrize(("memory", "input_memory"), [(0.0, 0.0), (0.0, 0.95), (0.9, 0.0), (0.9, 0.95)])
def test_independence_test_keeps_its_level_on_coloured_noise(memory: float, input_memory: float):
    random = np.random.default_rng(3)
    p_values, outside = [], []
    for _ in range(REPETITIONS):
        residual, signal = coloured(random, memory), coloured(random, input_memory)
        found, test = independence(residual - residual.mean(), signal - signal.mean(), name="torque", step=1e-3)
        p_values.append(test.p_value)
        outside.append(np.mean(np.abs(found.correlation) > found.limit))
    # A level of 1 % for all colours, within three standard deviations of 300 draws.
    assert np.mean(np.array(p_values) < 0.01) < 0.01 + 3 * np.sqrt(0.01 * 0.99 / REPETITIONS)
    assert np.mean(outside) == pytest.approx(0.05, abs=0.025)
    assert np.median(p_values) == pytest.approx(0.5, abs=0.15)


def test_cross_correlation_equals_its_definition():
    random = np.random.default_rng(4)
    residual, signal = random.normal(size=500), random.normal(size=500)
    residual, signal = residual - residual.mean(), signal - signal.mean()
    found, _ = independence(residual, signal, name="torque", step=1e-3)
    for lag in (-3, 0, 7):
        later, earlier = (residual[lag:], signal[: 500 - lag]) if lag >= 0 else (residual[:lag], signal[-lag:])
        expected = np.sum(later * earlier) / np.sqrt(np.sum(residual**2) * np.sum(signal**2))
        assert found.correlation[found.lag == lag][0] == pytest.approx(expected, abs=1e-12)


def test_independence_test_detects_a_missing_delay():
    """The residual contains the input of four samples earlier, with 4 % of the noise power."""
    random = np.random.default_rng(5)
    signal = coloured(random, 0.5)
    residual = random.normal(size=SAMPLES) + 0.2 * np.roll(signal, 4) / np.std(signal)
    found, test = independence(residual - residual.mean(), signal - signal.mean(), name="torque", step=1e-3)
    assert test.verdict == "failed" and "4 ms later" in test.says
    assert found.lag[np.argmax(np.abs(found.correlation))] == 4


def test_verdict_depends_on_the_size_of_the_correlation():
    """With a million samples, a correlation of 0.02 is significant but too small to matter."""
    r = np.zeros(50)
    r[0], r[1] = 1.0, 0.02
    assert whiteness(r, 100).verdict == "passed"
    assert whiteness(r, 1_000_000).verdict == "slight"
    r[1] = 0.3
    assert whiteness(r, 1_000_000).verdict == "failed"


def test_normality_test_detects_heavy_tails_and_skewness():
    random = np.random.default_rng(6)
    white = np.eye(1, 50)[0]
    outliers = random.normal(size=SAMPLES)
    outliers[::100] *= 8
    assert "rare large values" in normality(outliers - outliers.mean(), white).says
    lopsided = random.gamma(20.0, size=SAMPLES)
    assert normality(lopsided - lopsided.mean(), white).verdict == "failed"
    skewness, kurtosis = stats.skew(outliers), stats.kurtosis(outliers)
    expected = SAMPLES * (skewness**2 / 6 + kurtosis**2 / 24)
    assert normality(outliers - outliers.mean(), white).statistic == pytest.approx(expected)


def test_zero_mean_test_detects_an_offset():
    noise = 0.5 + np.random.default_rng(7).normal(size=SAMPLES)
    test = zero_mean(noise, np.eye(1, 50)[0])
    assert test.verdict == "failed" and "offset" in test.says
    share = noise.mean() / np.sqrt(np.mean(noise**2))
    assert f"{100 * share:+.2g} %" in test.says
    # A slow drift has a nonzero mean by chance.
    drift = lfilter([1.0], [1.0, -0.98], np.random.default_rng(8).normal(size=SAMPLES))
    assert zero_mean(drift, direct_autocorrelation(drift, 400)).p_value > 0.01


def short_fit(seed: int, **physics) -> Fit:
    """A fit with segments of 32 samples."""
    experiment = rig.reduced_experiment(1600, noise=1e-3, seed=seed, **physics)
    model = rig.reduced_model()
    return fit(model, [Stretch(experiment, 0, 1600)], base_paths(model), Segmentation(32))


def test_autocorrelation_allows_for_fitted_initial_states():
    """Two initial states for 32 samples colour white noise; the autocorrelation is corrected for them."""
    fits = [short_fit(seed) for seed in range(12)]
    root = np.sqrt(len(fits) * 1600)
    plain = root * np.mean([direct_autocorrelation(left_over(f), 10)[1:] for f in fits], axis=0)
    freed = root * np.mean([autocorrelation(f, 10)[1:] for f in fits], axis=0)
    # Standard normal except for the small share that the parameters take.
    assert np.max(np.abs(plain)) > 6.0
    assert np.max(np.abs(freed)) < 4.0


def test_true_model_passes_the_residual_tests_and_a_wrong_one_fails():
    good = short_fit(0)
    verdicts = {t.name: t.verdict for t in residual_tests(good, diagnose(good)).tests}
    assert verdicts == dict.fromkeys(("zero mean", "whiteness", "independence of forcing", "normality"), "passed")
    poor = short_fit(0, friction=(30.0, 0.1))
    failed = {t.name for t in residual_tests(poor, diagnose(poor)).tests if t.verdict == "failed"}
    assert "whiteness" in failed


def test_rate_of_the_motion_does_not_depend_on_which_samples_are_valid():
    """Differences between the valid samples of a slow channel would be several times too large."""
    experiment = rig.reduced_experiment(1000, noise=1e-3)
    slow = replace(experiment, weight=(np.arange(1000) % 5 == 0).astype(float))
    model, segmentation = rig.reduced_model(), Segmentation(128, substeps=2, count=8)
    held = Strategy(hold_parameters=True)
    every, some = (
        diagnose(fit(model, [Stretch(own, 0, 1000)], base_paths(model), segmentation, strategy=held)).dependence["v"]
        for own in (experiment, slow)
    )
    assert np.ptp(some.centre) == pytest.approx(np.ptp(every.centre), rel=0.2)


def test_spectrum_of_logs_with_two_sample_rates_is_that_of_the_first_rate():
    """A line of 4 Hz in both logs is one line."""
    model, segmentation = rig.reduced_model(), Segmentation(128, substeps=2, count=16)
    steps = (rig.REDUCED_STEP, 3.0 * rig.REDUCED_STEP)
    logs = [Stretch(rig.reduced_experiment(1000, step=step), 0, 1000) for step in steps]
    held = Strategy(hold_parameters=True)
    one, both = (fit(model, some, base_paths(model), segmentation, strategy=held) for some in (logs[:1], logs))
    one, both = (replace(found, error=_line(found)) for found in (one, both))
    np.testing.assert_allclose(diagnose(both).spectral_density, diagnose(one).spectral_density)
    random = np.random.default_rng(9)
    signal = coloured(random, 0.5)
    late = random.normal(size=SAMPLES) + 0.2 * np.roll(signal, 4) / np.std(signal)
    _, test = independence(late - late.mean(), signal - signal.mean(), name="torque", step=None)
    assert "4 samples later" in test.says


def _line(found: Fit) -> jax.Array:
    """An error of 4 Hz by each log's own clock."""
    error, length = np.zeros(found.error.shape), found.error.shape[1]
    ends = np.cumsum(found.pieces)
    for stretch, end, count in zip(found.stretches, ends, found.pieces, strict=True):
        time = stretch.experiment.time_step * np.arange(count * length)
        error[end - count : end, :, 0] = np.sin(8.0 * np.pi * time).reshape(count, length)
    return jnp.asarray(error)
