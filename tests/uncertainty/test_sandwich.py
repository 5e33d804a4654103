"""Sandwich intervals have nominal coverage for noise of any colour, over thousands of linear regressions."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, t

import rig
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import Stretch, experiment_from_log
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.sandwich import Linearised, Record, covariance, linearised
from fitting.uncertainty.standard_errors import uncertainty

COUNT, DRAWS = 2000, 200
PERIOD = 16.0
Noise = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]


def resonance(series: np.ndarray, damping: float = 0.02) -> np.ndarray:
    """Response of a lightly damped oscillator along the first axis, with a memory of some seventeen periods."""
    angle = 2 * np.pi / PERIOD
    decay = np.exp(-damping * angle)
    return lfilter([1.0], [1.0, -2 * decay * np.cos(angle), decay**2], series, axis=0)


def white(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return random.normal(size=shape)


def first_order(periods: float) -> Noise:
    pole = np.exp(-1.0 / (periods * PERIOD))

    def noise(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        burn = int(10 * periods * PERIOD)
        return lfilter([1.0], [1.0, -pole], random.normal(size=(burn + shape[0], *shape[1:])), axis=0)[burn:]

    return noise


def torque(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Response of the dynamic error to torque noise, lightly damped, and white encoder noise."""
    driven = resonance(random.normal(size=(600 + shape[0], *shape[1:])), damping=0.05)[600:]
    return driven + random.normal(size=shape)


NOISES: dict[str, Noise] = {
    "white": white,
    "first order, a tenth of a period": first_order(0.1),
    "first order, a period": first_order(1.0),
    "torque noise": torque,
}


def regression(slopes: np.ndarray, states: tuple[tuple[int, np.ndarray], ...], chunk: int = 40) -> Linearised:
    """A linear regression without residual; slopes are made orthogonal to the states' columns."""
    slopes = slopes.copy()
    for start, columns in states:
        part = slopes[start : start + columns.shape[0]]
        flat = columns.reshape(-1, columns.shape[2])
        left = part.reshape(flat.shape[0], -1)
        part[...] = (left - flat @ np.linalg.lstsq(flat, left, rcond=None)[0]).reshape(part.shape)
    information = np.einsum("nop,noq->pq", slopes, slopes)
    return Linearised(
        (Record(np.zeros(slopes.shape[:2]), slopes, states, 1.0),), information, np.zeros_like(information), chunk
    )


def with_noise(given: Linearised, noise: np.ndarray) -> tuple[np.ndarray, Linearised]:
    """Least squares on noise alone: the estimate, whose truth is zero, and the regression with its residual."""
    record = given.records[0]
    estimate = np.linalg.solve(given.information, np.einsum("nop,no->p", record.slopes, noise))
    residual = noise - record.slopes @ estimate
    for start, columns in record.states:
        part = residual[start : start + columns.shape[0]]
        flat = columns.reshape(-1, columns.shape[2])
        part[...] = (part.ravel() - flat @ np.linalg.lstsq(flat, part.ravel(), rcond=None)[0]).reshape(part.shape)
    return estimate, eqx.tree_at(lambda g: g.records[0].residual, given, residual)


def free_decay(samples: int, outputs: int) -> np.ndarray:
    """Response of the outputs to an initial state."""
    n = np.arange(samples)
    waves = np.exp(-0.02 * 2 * np.pi / PERIOD * n)[:, None] * np.stack(
        [np.cos(2 * np.pi / PERIOD * n), np.sin(2 * np.pi / PERIOD * n)], axis=1
    )
    return np.stack([waves * (1.0 + 0.3 * o) for o in range(outputs)], axis=1)


def broadband(outputs: int, count: int = COUNT, simulations: int = 1) -> Linearised:
    """A regression of three parameters of an excited oscillator, in `simulations` separate simulations."""
    random = np.random.default_rng(1)
    slopes = resonance(random.normal(size=(count + 400, outputs, 3)))[400:]
    length = count // simulations
    states = tuple((i * length, free_decay(length, outputs)) for i in range(simulations))
    return regression(slopes, states)


def covered_counts(
    given: Linearised, noise: Noise, *, draws: int = DRAWS, of: str = "robust", seed: int = 7
) -> np.ndarray:
    """Number of 95 % intervals that include the truth, by parameter."""
    random = np.random.default_rng(seed)
    shape = given.records[0].residual.shape
    hits = np.zeros(given.information.shape[0], dtype=int)
    for _ in range(draws):
        estimate, drawn = with_noise(given, noise(random, shape))
        found = covariance(drawn)
        freedom = found.degrees_of_freedom if of == "robust" else np.inf
        hits += np.abs(estimate) < t.ppf(0.975, freedom) * np.sqrt(np.diag(getattr(found, of)))
    return hits


def assert_nominal_coverage(hits: np.ndarray, draws: int = DRAWS, *, least: float = 0.93, most: float = 0.97):
    """Check a coverage between `least` and `most`, within the 99.9 % bands of so many draws."""
    low, high = binom.ppf(0.0005, draws, least), binom.ppf(0.9995, draws, most)
    assert (hits >= low).all() and (hits <= high).all(), (low, hits, high)


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("noise", NOISES)
def test_intervals_of_one_long_simulation_have_nominal_coverage(noise: str, outputs: int):
    assert_nominal_coverage(covered_counts(broadband(outputs), NOISES[noise]))


def test_coverage_check_fails_for_classical_intervals_under_torque_noise():
    # Noise at the resonance is twice that of a white residual.
    hits = covered_counts(broadband(1), torque, of="classical")
    with pytest.raises(AssertionError):
        assert_nominal_coverage(hits)


def test_intervals_of_many_short_simulations_have_nominal_coverage():
    """The response to torque noise grows from zero in each simulation and is not stationary."""
    given = broadband(1, count=40 * 64, simulations=40)

    def grown(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        each = resonance(random.normal(size=(64, 40, 1)), damping=0.05)
        return np.swapaxes(each, 0, 1).reshape(shape)

    assert_nominal_coverage(covered_counts(given, grown))


def test_intervals_cover_under_noise_proportional_to_the_slope():
    """Errors in proportion to the slope have three times the variance that stationary ones would give."""
    given = regression(np.random.default_rng(2).normal(size=(4 * COUNT, 1, 1)), (), chunk=4 * COUNT // 64)

    def proportional(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        return given.records[0].slopes[:, :, 0] * random.normal(size=shape)

    draws = 200
    # 1.96 of a standard error that is the square root of three too small: 74 %.
    assert covered_counts(given, proportional, draws=draws, of="classical")[0] < binom.ppf(0.9995, draws, 0.75)
    assert covered_counts(given, proportional, draws=draws)[0] >= binom.ppf(0.0005, draws, 0.93)


def test_intervals_of_a_single_sine_use_noise_at_neighbouring_lines():
    phase = 2 * np.pi * 50 * np.arange(COUNT) / COUNT
    given = regression(np.stack([np.cos(phase), np.sin(phase)], axis=1)[:, None], (), chunk=COUNT)
    # The fit takes the whole line. Its noise is estimated from four numbers, so that intervals are long.
    assert_nominal_coverage(covered_counts(given, first_order(1.0)), most=0.985)


def test_intervals_with_missing_samples_have_nominal_coverage():
    given = broadband(1)
    present = np.random.default_rng(3).uniform(size=COUNT) > 0.25
    slopes = given.records[0].slopes * present[:, None, None]
    states = ((0, given.records[0].states[0][1] * present[:, None, None]),)
    holed = eqx.tree_at(lambda g: g.records[0].present, regression(slopes, states), float(present.mean()))
    assert_nominal_coverage(covered_counts(holed, lambda random, shape: random.normal(size=shape) * present[:, None]))


def test_classical_covariance_equals_that_of_ordinary_least_squares():
    given = broadband(2)
    _, drawn = with_noise(given, np.random.default_rng(0).normal(size=(COUNT, 2)))
    record = drawn.records[0]
    design = np.concatenate([record.slopes, record.states[0][1]], axis=2).reshape(2 * COUNT, -1)
    expected = np.linalg.inv(design.T @ design) * np.sum(record.residual**2) / (2 * COUNT - 5)
    np.testing.assert_allclose(covariance(drawn).classical, expected[:3, :3], rtol=1e-9)


@pytest.mark.parametrize("simulations", [1, 40])
def test_covariance_scales_with_the_units_of_parameters(simulations: int):
    given = broadband(1, count=40 * 64, simulations=simulations)
    _, drawn = with_noise(given, np.random.default_rng(0).normal(size=given.records[0].residual.shape))
    units = np.array([1.0, 1e90, 1e-90])
    record = dataclasses.replace(drawn.records[0], slopes=drawn.records[0].slopes / units)
    information = drawn.information / np.outer(units, units)
    other = covariance(Linearised((record,), information, np.zeros_like(information), drawn.chunk))
    wanted = covariance(drawn)
    np.testing.assert_allclose(other.robust / units / units[:, None], wanted.robust, rtol=1e-9)
    np.testing.assert_allclose(other.degrees_of_freedom, wanted.degrees_of_freedom, rtol=1e-9)


def test_unobserved_parameters_have_huge_variance():
    given = broadband(1)
    slopes = given.records[0].slopes
    # First the third parameter has no effect; then the first two have the same effect.
    for blind in (slopes * np.array([1.0, 1.0, 0.0]), slopes[:, :, [0, 0, 2]]):
        _, drawn = with_noise(given, np.random.default_rng(0).normal(size=(COUNT, 1)))
        record = dataclasses.replace(drawn.records[0], slopes=blind)
        information = np.einsum("nop,noq->pq", blind, blind)
        found = covariance(Linearised((record,), information, np.zeros_like(information), 40))
        unseen = np.diag(found.robust)[[2]] if (blind[:, :, 2] == 0).all() else np.diag(found.robust)[:2]
        assert (unseen > 1e6 * np.diag(covariance(drawn).robust)[0]).all()
        assert np.isfinite(found.robust).all()


# The same with Jacobians of fits to the rig's logs, and with refits of them.

PATHS = ("K", "alpha", "B_sp")


def drive_fit(experiment, horizon: int) -> Fit:
    stretch = Stretch(experiment, 0, len(experiment))
    return fit(rig.drive_model(), [stretch], PATHS, Segmentation(horizon, substeps=1))


@pytest.mark.slow
def test_linearised_fit_is_in_the_order_of_time():
    """A log of one and a half segments, fitted as one simulation."""
    found = drive_fit(rig.drive_experiment(384), 10**6)
    given = linearised(found)
    (record,) = given.records
    assert record.residual.shape == (384, 2) and record.present == 1.0
    error = np.asarray(found.error).reshape(-1, 2)[:384]
    np.testing.assert_allclose(record.residual, error @ np.asarray(found.problem.whitening).T, atol=1e-6)
    ((start, columns),) = record.states
    assert start == 0 and columns.shape == (384, 2, 4)
    # The slopes are orthogonal to the columns of the initial states, as at a minimum.
    size = np.linalg.norm(columns.reshape(-1, 4), axis=0)[:, None] * np.linalg.norm(
        record.slopes.reshape(-1, 3), axis=0
    )
    product = np.einsum("nos,nop->sp", columns, record.slopes)
    np.testing.assert_allclose(product / size, 0.0, atol=1e-6)
    np.testing.assert_allclose(np.einsum("nop,noq->pq", record.slopes, record.slopes), given.information, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("horizon", [256, 10**6])
def test_intervals_with_the_jacobian_of_a_drive_have_nominal_coverage(noise: str, horizon: int):
    """Linearised fits of a log of four seconds, or fifty natural periods; torque noise has a memory of three."""
    draws = 1000
    given = linearised(drive_fit(rig.drive_experiment(8000), horizon))
    # Short simulations under torque noise are correlated with their neighbours, and few of them determine alpha.
    least = 0.88 if noise == "torque noise" and horizon == 256 else 0.93
    assert_nominal_coverage(covered_counts(given, NOISES[noise], draws=draws), draws, least=least, most=0.975)


@pytest.mark.slow
@pytest.mark.parametrize("colour", ["white", "encoder, half a period", "torque, half a period"])
def test_intervals_of_refitted_drive_logs_have_nominal_coverage(colour: str):
    """Full fits of noisy logs of a drive."""
    draws, count = 150, 4000
    excitation = rig.drive_torque(count)
    truth = {"K": rig.K, "alpha": rig.ALPHA, "B_sp": rig.B_SP}
    hits = np.zeros(3, dtype=int)
    half_period = 0.5 * 2 * np.pi / 385.5 / rig.STEP
    pole = np.exp(-1.0 / half_period)
    clean = rig.drive_motion(excitation)
    for seed in range(draws):
        random = np.random.default_rng(seed)
        motion, noise = clean.copy(), 1.0
        coloured = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], random.normal(size=(count + 200, 2)), axis=0)[200:]
        if colour.startswith("encoder"):
            motion[:, :2] += coloured * [rig.MOTOR_NOISE, rig.LOAD_NOISE]
            noise = 0.0
        elif colour.startswith("torque"):
            # Torque that acts and is not logged.
            motion = rig.drive_motion(excitation + 2e-4 * coloured[:, 0])
        log = rig.drive_log(motion, excitation, noise=noise, seed=seed)
        experiment = experiment_from_log(log, hold="zero-order", N=rig.N)
        estimates = uncertainty(drive_fit(experiment, 10**6)).estimates
        hits += [estimates[p].ci95[0] < truth[p] < estimates[p].ci95[1] for p in PATHS]
    assert_nominal_coverage(hits, draws, most=0.98)


def test_simulation_without_valid_samples_has_no_basis():
    given = broadband(1, simulations=2)
    (record,) = given.records
    blind = dataclasses.replace(record, states=((0, record.states[0][1]), (COUNT // 2, 0.0 * record.states[1][1])))
    assert [start for start, _ in blind.bases()] == [0]
