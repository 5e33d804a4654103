"""Fits of torque-twist curves against the true parameters of simulated logs."""

from dataclasses import replace

import numpy as np
import pytest
import torque_cycles
from scipy.stats import binom
from torque_cycles import FRICTION, K1, K2, K3, T1, T2, cycles

from fitting.quasi_static.blocks import average, noise, turns
from fitting.quasi_static.curve_figures import figures
from fitting.quasi_static.curve_fit import CurveFit, fit_curve, starts
from fitting.quasi_static.fit import QuasiStaticFit, fit_quasi_static
from fitting.quasi_static.intervals import Known
from fitting.quasi_static.stretches import correlation_length, stretches
from fitting.quasi_static.torque_twist import Blocks, Curve

TRUTH = {"K1": K1, "K2": K2, "K3": K3, "T1": T1, "T2": T2, "hysteresis_torque": FRICTION}
WIDTH = 2 * FRICTION / K1


def covers(known: Known, truth: float) -> bool:
    return known.ci95 is not None and known.ci95[0] <= truth <= known.ci95[1]


@pytest.fixture(scope="module")
def three_slopes_fit() -> QuasiStaticFit:
    """A fit of all shapes to cycles through both knees, with a biased torque sensor."""
    return fit_quasi_static([cycles(bias=2.5, drift=1e-7)], rated_torque=54.0)


def test_fit_recovers_slopes_knees_bias_and_hysteresis(three_slopes_fit: QuasiStaticFit) -> None:
    assert three_slopes_fit.chosen == "three slopes"
    known = three_slopes_fit.known["three slopes"]
    for name, truth in TRUTH.items():
        assert known[name].identifiable, name
        # Four standard errors, since eight figures are compared.
        assert abs(known[name].value - truth) < 4 * known[name].std, name
    assert abs(known["torque_bias"].value - 2.5) < 4 * known["torque_bias"].std
    assert covers(known["hysteresis_width"], WIDTH)
    assert covers(known["drift"], 1e-7)
    assert known["K1"].std < 0.01 * K1


def test_lost_motion_agrees_with_the_true_curve(three_slopes_fit: QuasiStaticFit) -> None:
    known = three_slopes_fit.known["three slopes"]
    # 4 % of 54 N m is on the first slope: twist along the mean curve, and with the full width of the loop.
    small = 0.04 * 54.0
    assert known["lost_motion"].value == pytest.approx(2 * small / K1, rel=0.02)
    assert known["lost_motion_outer"].value == pytest.approx(2 * small / K1 + WIDTH, rel=0.02)
    # The cycles exceed rated torque; the width at zero is equal for all cycles in which the sliders reverse.
    assert known["hysteresis_loss"].value == pytest.approx(WIDTH, rel=0.02)


def test_hysteresis_width_of_a_bouc_wen_loop_is_recovered() -> None:
    fit = fit_quasi_static([cycles(torque_cycles.line, torque_cycles.bouc_wen, rows=3000)])
    assert fit.chosen == "linear"
    # Bouc and Wen's law evolves along x; along the torque it is Dahl's only approximately, hence the tolerance.
    assert fit.known["linear"]["hysteresis_width"].value == pytest.approx(WIDTH, rel=0.03)
    assert fit.known["linear"]["K"].value == pytest.approx(K1, rel=0.01)


def test_cubic_curve_is_chosen_when_true() -> None:
    fit = fit_quasi_static([cycles(torque_cycles.cubic)])
    assert fit.chosen == "cubic"
    known = fit.known["cubic"]
    assert covers(known["K"], K1) and covers(known["alpha"], 2e5)
    assert known["alpha"].identifiable


def test_three_slopes_are_not_chosen_below_the_second_knee() -> None:
    fit = fit_quasi_static([cycles(largest=1.1e-3)])
    assert fit.chosen in ("cubic", "two slopes")
    assert covers(fit.known["two slopes"]["K2"], K2)


def test_linear_curve_is_chosen_below_the_first_knee() -> None:
    fit = fit_quasi_static([cycles(largest=4.5e-4)])
    assert fit.chosen == "linear"
    assert covers(fit.known["linear"]["K"], K1)
    assert not fit.known["cubic"]["alpha"].identifiable


def test_hysteresis_width_interval_covers_zero_without_hysteresis() -> None:
    fit = fit_quasi_static([cycles(friction=torque_cycles.no_friction)])
    width = fit.best.curve.memory and fit.known[fit.chosen]["hysteresis_width"]
    assert isinstance(width, Known) and covers(width, 0.0) and not width.identifiable


def test_noise_free_linear_curve_is_recovered() -> None:
    fit = fit_quasi_static([cycles(torque_cycles.line, torque_cycles.no_friction, twist_noise=0.0, torque_noise=0.0)])
    assert fit.chosen == "linear"
    assert fit.known["linear"]["K"].value == pytest.approx(K1, rel=1e-9)


def test_hysteresis_is_not_fitted_without_torque_reversals() -> None:
    fit = fit_quasi_static([cycles(torque_cycles.line, count=0.24)])
    assert fit.best.curve.memory is None
    assert "hysteresis_width" not in fit.known["linear"]


def test_logs_of_one_drive_share_the_curve_but_not_the_offset() -> None:
    logs = [cycles(seed=1), cycles(seed=2, count=2.0, rows=900)]
    logs[1] = replace(logs[1], dynamic_error=logs[1].dynamic_error - 3e-3, name="other")
    fit = fit_quasi_static(logs)
    best = fit.best
    zeros = [best.parameters[best.curve.places[f"offset {i}"]] for i in range(2)]
    assert zeros[0] - zeros[1] == pytest.approx(3e-3, abs=3e-6)
    assert covers(fit.known["three slopes"]["K2"], K2)


def one_fit(blocks: Blocks, curve: Curve) -> CurveFit:
    return fit_curve(blocks, curve, starts(blocks, curve)[0])


@pytest.mark.parametrize("side", ["twist", "torque"])
def test_stiffness_is_unbiased_under_noise_on_either_axis(side: str) -> None:
    loud = {"torque_noise": 20.0} if side == "torque" else {"twist_noise": 4e-4}
    curve = Curve("linear", None, biased=False, drifting=False, logs=1)
    found, naive = [], []
    for seed in range(30):
        log = cycles(torque_cycles.line, torque_cycles.no_friction, count=2, rows=400, seed=seed, **loud)
        blocks = average([log])
        found.append(np.exp(one_fit(blocks, curve).parameters[0]))
        naive.append(1 / np.polyfit(blocks.torque, blocks.twist, 1)[0])
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found) - K1) < 3 * error
    if side == "torque":
        # Regression of twist on torque is biased.
        assert np.mean(naive) - K1 > 3 * error


def coverage(draws: int, **options) -> dict[str, int]:
    """Number of 95 % intervals that cover the true value, by parameter."""
    curve = Curve("three slopes", "abrupt", biased=True, drifting=False, logs=1)
    hits = dict.fromkeys(TRUTH, 0)
    for seed in range(draws):
        blocks = average([cycles(count=2, rows=800, seed=seed, **options)])
        known = figures(one_fit(blocks, curve), blocks, None)
        for name, truth in TRUTH.items():
            hits[name] += covers(known[name], truth)
    return hits


NOISES = [{"torque_noise": 1.0}, {"colour": 0.95, "twist_noise": 1e-5}]


def assert_nominal_coverage(draws: int, options: dict[str, float]) -> None:
    # Binomial at the required coverage of 0.93: chance falls below this once in 500 for each of 12 figures.
    least = binom.ppf(0.002, draws, 0.93)
    for name, hits in coverage(draws, **options).items():
        assert hits >= least, (name, hits)


@pytest.mark.parametrize("options", NOISES)
def test_intervals_have_nominal_coverage(options: dict[str, float]) -> None:
    assert_nominal_coverage(10, options)


@pytest.mark.slow
@pytest.mark.parametrize("options", NOISES)
def test_intervals_have_nominal_coverage_over_many_draws(options: dict[str, float]) -> None:
    assert_nominal_coverage(300, options)


@pytest.mark.parametrize("colour", [0.0, 0.97])
def test_jackknife_interval_has_nominal_coverage_under_coloured_noise(colour: float) -> None:
    curve, draws = Curve("linear", None, biased=False, drifting=False, logs=1), 100
    hits = naive = 0
    for seed in range(draws):
        options = {"rows": 800, "colour": colour, "twist_noise": 5e-5, "seed": seed}
        log = cycles(torque_cycles.line, torque_cycles.no_friction, **options)
        blocks = average([log])
        fit = one_fit(blocks, curve)
        known = figures(fit, blocks, None)["K"]
        hits += covers(known, K1)
        white = np.sqrt(np.linalg.inv(fit.jacobian.T @ fit.jacobian)[0, 0])
        naive += abs(fit.parameters[0] - np.log(K1)) < 1.96 * white
    # Two binomial standard deviations below 0.95.
    assert hits / draws >= 0.90
    if colour:
        assert naive / draws < 0.85


def test_intervals_do_not_cover_a_wrong_value() -> None:
    blocks = average([cycles()])
    known = figures(one_fit(blocks, Curve("three slopes", "abrupt", True, False, 1)), blocks, None)
    assert not covers(known["K1"], 1.05 * K1)
    assert not covers(known["T2"], 1.1 * T2)


def test_blocks_end_at_reversals_and_keep_the_extremes() -> None:
    log = cycles(torque_cycles.line, torque_cycles.no_friction, count=2.0, rows=1000, torque_noise=0.0)
    blocks = average([log])
    assert blocks.reversals == (4,)
    # Two blocks and the extreme are between the last point before a reversal and the first after it.
    extremes = blocks.seat[:-1][np.diff(blocks.seat) == 4] + 2
    assert len(extremes) == 4
    np.testing.assert_allclose(np.abs(blocks.paths[0][extremes]), 2.2e-3 * K1, rtol=0.005)
    np.testing.assert_array_equal(blocks.paths[0][blocks.seat], blocks.torque)


def test_noise_is_estimated_beside_a_smooth_signal() -> None:
    random = np.random.default_rng(3)
    values = 10 * np.sin(np.linspace(0, 6, 5000)) + 0.2 * random.normal(size=5000)
    # The median of 5000 correlated differences has a standard deviation of 3 %.
    assert noise(values) == pytest.approx(0.2, rel=0.1)
    assert len(turns(values, 25)) == 2


def test_stretches_are_longer_than_the_correlation_length() -> None:
    random = np.random.default_rng(4)
    coloured = np.convolve(random.normal(size=4009), np.ones(10), mode="valid")
    # A running mean of ten has triangular autocorrelation, whose sum is ten.
    assert correlation_length(coloured) == pytest.approx(10.0, rel=0.35)
    numbers = stretches(coloured, np.zeros(4000, dtype=int))
    assert np.min(np.bincount(numbers)) >= 30
