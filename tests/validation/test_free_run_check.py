"""Errors of free runs of whole held-out stretches, compared with their prediction bands."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import rig
from fitting.attribution.rules import RULES
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import experiment_from_log, split
from fitting.estimation.free_run import FreeRun
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.measurement_noise import measurement_noise
from fitting.uncertainty.prediction_band import PredictionBand
from fitting.validation.account import Account, account, of_parameters
from fitting.validation.free_run_check import over_bands, share_explained, surprise

NOISE, SWING = 1e-6, 1e3
PATHS = ("mu", "omega_0", "alpha", "gain")


def run(times_noise: float, weight: np.ndarray | None = None, count: int = 50) -> FreeRun:
    """A free run with the same error at every sample, of a motion a thousand times the noise."""
    measured = SWING * NOISE * (-1.0) ** np.arange(count)
    return FreeRun("log", np.arange(count) * 1e-3, measured - times_noise * NOISE, measured, None, weight)


def band(of: FreeRun, std_parameters: float = 0.0, std_state: float = 0.0) -> PredictionBand:
    """A prediction band with standard deviations in units of the noise."""
    ones = np.ones(of.time.size) * NOISE
    return PredictionBand(of, std_parameters * ones, std_state * ones, NOISE)


@pytest.fixture(scope="module")
def fitted() -> tuple[Fit, Account]:
    """A fit and its account; tests replace its free runs."""
    training, selection = split((rig.reduced_experiment(600, noise=2e-3),))
    found = fit(rig.reduced_model(), training, PATHS, Segmentation(128, substeps=2, count=8))
    return found, account(found, training, selection, noise=found.covariance, halo=0, known=of_parameters(found))


@pytest.mark.parametrize(
    ("bands", "expected"),
    [
        ([band(run(1.0))], 1.0),
        ([band(run(3.0), std_parameters=2.0, std_state=2.0)], 1.0),
        ([band(run(3.0))], 3.0),
        # Squares count, over all stretches.
        ([band(run(1.0)), band(run(7.0), std_parameters=7.0)], np.sqrt(50.0 / 51.0)),
        # The band of a chaotic motion is large.
        ([band(run(5.0), std_state=0.5 * SWING)], 0.01),
    ],
)
def test_error_over_band_is_that_of_the_squares_over_all_stretches(bands: list[PredictionBand], expected: float):
    assert over_bands(bands) == pytest.approx(expected, rel=1e-3)


def test_invalid_samples_do_not_count_in_error_over_band():
    weight = np.repeat([1.0, 0.0], 25)
    odd = run(1.0, weight)
    odd = replace(odd, measured=np.where(weight > 0, odd.measured, 1.0))
    assert over_bands([band(odd)]) == pytest.approx(1.0)


@pytest.mark.parametrize("std", [2.0 * SWING, np.inf, np.nan])
def test_error_over_a_band_wider_than_the_motion_is_none(std: float):
    assert over_bands([band(run(9.0), std_state=std), band(run(9.0))]) is None
    # Its mean, by which a constant would predict it as well, does not count.
    assert over_bands([band(replace(run(9.0), measured=np.full(50, 1.0)), std_state=9.0)]) is None


def test_error_of_runs_that_diverge_is_infinite():
    assert over_bands([band(run(np.inf)), band(run(1.0))]) == np.inf


@pytest.mark.parametrize(
    ("before", "after", "asked"),
    [
        (10.0, 1.1, False),
        (10.0, 3.2, False),  # nine tenths of the variance beyond the noise
        (10.0, 4.0, True),
        (1.5, 1.4, True),
        (0.9, 1.4, True),  # the base model leaves nothing beyond the noise
        (np.inf, 50.0, False),
        (np.inf, np.inf, False),
        (10.0, np.inf, True),
    ],
)
def test_free_runs_are_checked_only_where_effects_leave_unexplained_error(
    fitted: tuple[Fit, Account], before: float, after: float, asked: bool
):
    found, _ = fitted
    then, now = ((run(times),) for times in (before, after))
    noise = NOISE**2 * jnp.eye(1)
    share = share_explained(then, now, replace(found, covariance=noise), noise)
    assert (share is not None and share < RULES.free_run_explained) == asked
    assert share is None or -1.0 <= share <= 1.0


def test_free_runs_of_the_true_model_agree_with_their_bands(fitted: tuple[Fit, Account]):
    """Errors of the free runs are as large as their bands predict."""
    found, known = fitted
    _, selection = split((rig.reduced_experiment(600, noise=2e-3),))
    held_out = replace(found, stretches=tuple(selection))
    beyond = surprise(found, known.test, held_out, of_parameters=known.uncertainty, noise=found.covariance, halo=0)
    assert beyond == pytest.approx(1.0, abs=0.2)


def test_free_runs_under_coloured_noise_agree_with_their_bands():
    """Pieces of half a period count the slow part of such noise as motion, so that free runs have a larger error."""
    rng = np.random.default_rng(3)
    forcing = rig.reduced_forcing(4000, rms=10.0, seed=3)
    noise = 2e-3 * np.asarray(lfilter([np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], rng.normal(size=4000)))
    log = rig.reduced_log(rig.reduced_motion(forcing)[:, 0] + noise, forcing)
    training, selection = split((experiment_from_log(log, hold="zero-order"),))
    found = fit(rig.reduced_model(), training, PATHS, Segmentation(256, substeps=2, count=16))
    held_out = fit(
        found.model, selection, PATHS, Segmentation(256, substeps=2, count=16), strategy=Strategy(hold_parameters=True)
    )
    of_pieces = measurement_noise(found).covariance
    known = account(found, training, selection, noise=of_pieces, halo=0, known=of_parameters(found))
    assert known.rmse["test"] > 1.3 * np.sqrt(of_pieces[0, 0])
    beyond = surprise(found, known.test, held_out, of_parameters=known.uncertainty, noise=of_pieces, halo=0)
    assert beyond == pytest.approx(1.0, abs=0.15)
