"""Profile likelihood, compared with a closed form and an independent search, and where a parabola fails."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import t

import rig
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.profile_likelihood import profile, with_profiles
from fitting.uncertainty.standard_errors import Uncertainty, uncertainty

COUNT, SHORT, NOISE = 400, 128, 2e-3


def reduced_fit(*, noise: float = NOISE, rms: float = 10.0, physics: dict | None = None, **start) -> Fit:
    experiment = rig.reduced_experiment(COUNT, noise=noise, rms=rms, **(physics or {}))
    model = rig.reduced_model(**start)
    return fit(
        model,
        [Stretch(experiment, 0, COUNT)],
        ("mu", "omega_0", "alpha", "gain"),
        Segmentation(SHORT, substeps=2, count=4),
    )


def with_freedom(found: Uncertainty, freedom: float) -> Uncertainty:
    """Replace the degrees of freedom of every interval, and the covariance by that of white noise."""
    estimates = {p: dataclasses.replace(e, degrees_of_freedom=freedom) for p, e in found.estimates.items()}
    return dataclasses.replace(found, estimates=estimates, covariance=found.unit_covariance)


@pytest.fixture(scope="module")
def linear_fit() -> tuple[Fit, Uncertainty]:
    """A motion so small that the oscillator is linear, with noise so small that gain is nearly linear too."""
    found = reduced_fit(noise=1e-5, rms=0.5, alpha=0.0)
    return found, uncertainty(found)


def test_profile_of_a_linear_parameter_is_a_parabola(linear_fit: tuple[Fit, Uncertainty]):
    """In a linear problem, the rise is the squared distance in standard errors."""
    found, known = linear_fit
    for path in ("gain", "mu"):
        estimate = known.estimates[path]
        result = profile(found, path, known)
        reach = t.ppf(0.975, estimate.degrees_of_freedom) * estimate.std
        # The fit ends within some hundredths of a standard error of its minimum.
        np.testing.assert_allclose(result.ci95, estimate.value + reach * np.array([-1, 1]), atol=0.03 * reach)
        distance = (result.values - estimate.value) / reach
        np.testing.assert_allclose(result.rise, distance**2, atol=0.05 * np.max(distance) ** 2)
        assert result.value == estimate.value and (np.diff(result.values) > 0).all()


def test_profile_interval_is_wider_for_a_coloured_residual(linear_fit: tuple[Fit, Uncertainty]):
    found, known = linear_fit
    wide = dataclasses.replace(known, covariance=4.0 * known.unit_covariance)
    narrow = dataclasses.replace(known, covariance=known.unit_covariance)
    lengths = [np.diff(profile(found, "gain", k).ci95)[0] for k in (narrow, wide)]
    assert lengths[1] == pytest.approx(2.0 * lengths[0], rel=0.02)


def test_profile_interval_is_no_shorter_than_for_a_white_residual(linear_fit: tuple[Fit, Uncertainty]):
    """By chance the spectrum of a short log's residual may promise too small an error."""
    found, known = linear_fit
    lucky = dataclasses.replace(known, covariance=0.01 * known.unit_covariance)
    reach = 1.96 * known.estimates["gain"].std_classical
    assert np.diff(profile(found, "gain", lucky).ci95)[0] == pytest.approx(2.0 * reach, rel=0.03)


def test_profile_interval_equals_that_of_an_independent_search():
    """The reference uses the rig's Runge-Kutta and scipy, on a log that hardly determines its damping."""
    noise = 0.05
    found = reduced_fit(noise=noise, rms=10.0)
    known = with_freedom(uncertainty(found), np.inf)
    result = profile(found, "mu", known)
    experiment = found.stretches[0].experiment
    forcing, measured = rig.reduced_forcing(COUNT), experiment.measured[:, 0]
    weight = float(found.problem.whitening[0, 0])
    heads = range(0, COUNT, SHORT)

    def rows(y: np.ndarray, mu: float) -> np.ndarray:
        omega_0, alpha, gain = np.exp(y[0]), y[1], y[2]
        states = y[3:].reshape(-1, 2) * [1.0, 90.0]
        parts = []
        for state, start in zip(states, heads, strict=True):
            piece = slice(start, start + SHORT)
            x = rig.reduced_motion(
                forcing[piece], mu=mu, omega_0=omega_0, alpha=alpha, gain=gain, state=state, substeps=4
            )[:, 0]
            parts.append(measured[piece] - x)
        return weight * np.concatenate(parts)

    states = np.asarray(found.unknowns.states) / [1.0, 90.0]
    fitted = [np.log(float(found.model.get("omega_0"))), *(float(found.model.get(p)) for p in ("alpha", "gain"))]
    start = np.concatenate([fitted, states.ravel()])

    def cost(mu: float) -> float:
        return 2.0 * float(least_squares(rows, start, args=(mu,), x_scale="jac", ftol=1e-7).cost)

    lowest = cost(result.value)
    for end in result.ci95:
        # 1.96 squared at the ends; tolerances of the fits and of both integrators are some hundredths.
        assert cost(end) - lowest == pytest.approx(3.8415, abs=0.15)


def test_profile_interval_of_a_weakly_identified_parameter_is_asymmetric():
    """A log of small twist: it excludes a softening spring, which fails at some twist, before a hardening one."""
    found = reduced_fit(noise=0.02, rms=1.0, alpha=0.0)
    known = uncertainty(found)
    parabola = known.estimates["alpha"]
    assert not parabola.identifiable
    better = with_profiles(found, known)
    low, high = better.estimates["alpha"].ci95
    assert not better.estimates["alpha"].identifiable
    assert low < 0.0 < rig.REDUCED_ALPHA < high
    # The sides differ by far, while those of the parabola are equal.
    assert high - parabola.value > 1.3 * (parabola.ci95[1] - parabola.value)
    # Below -1/x^2 the spring force changes sign; free states of the segments allow somewhat less.
    x_max = np.max(np.abs(rig.reduced_experiment(COUNT, rms=1.0).measured))
    assert -2.0 / x_max**2 < low
    assert better.estimates["alpha"].interval == "profile" and better.estimates["omega_0"].interval == "curvature"
    # Correlations are in the order of the estimates.
    assert list(better.estimates) == list(known.estimates)
    # A well-identified parameter keeps its interval.
    assert better.estimates["omega_0"].ci95 == known.estimates["omega_0"].ci95


def test_unknown_path_is_refused(linear_fit: tuple[Fit, Uncertainty]):
    with pytest.raises(ValueError, match="^`path` must be one of"):
        profile(linear_fit[0], "K", linear_fit[1])
