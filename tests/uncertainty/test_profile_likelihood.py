"""Profiles against a closed form, against a search by another route, and where a parabola fails."""

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
    """The same with other degrees of freedom of every interval, and the covariance of white noise."""
    estimates = {p: dataclasses.replace(e, degrees_of_freedom=freedom) for p, e in found.estimates.items()}
    return dataclasses.replace(found, estimates=estimates, covariance=found.unit_covariance)


@pytest.fixture(scope="module")
def linear() -> tuple[Fit, Uncertainty]:
    """So faint that the oscillator is linear, and so well seen that gain is as good as linear too."""
    found = reduced_fit(noise=1e-5, rms=0.5, alpha=0.0)
    return found, uncertainty(found)


def test_a_linear_parameter_has_a_parabola(linear: tuple[Fit, Uncertainty]):
    """The closed form: where everything is linear, the rise is the squared distance in standard errors."""
    found, known = linear
    for path in ("gain", "mu"):
        estimate = known.estimates[path]
        result = profile(found, path, known)
        reach = t.ppf(0.975, estimate.degrees_of_freedom) * estimate.std
        # The fit ends within some hundredths of a standard error of its minimum.
        np.testing.assert_allclose(result.ci95, estimate.value + reach * np.array([-1, 1]), atol=0.03 * reach)
        distance = (result.values - estimate.value) / reach
        np.testing.assert_allclose(result.rise, distance**2, atol=0.05 * np.max(distance) ** 2)
        assert result.value == estimate.value and (np.diff(result.values) > 0).all()


def test_the_colour_of_the_residual_widens_it(linear: tuple[Fit, Uncertainty]):
    found, known = linear
    wide = dataclasses.replace(known, covariance=4.0 * known.unit_covariance)
    narrow = dataclasses.replace(known, covariance=known.unit_covariance)
    lengths = [np.diff(profile(found, "gain", k).ci95)[0] for k in (narrow, wide)]
    assert lengths[1] == pytest.approx(2.0 * lengths[0], rel=0.02)


def test_a_grid_search_by_another_route():
    """Plain Runge-Kutta and scipy, one grid point after the other, on a log that says little of its damping."""
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
        # 1.96 squared at the ends; a fit's own tolerance and the two integrators differ by some hundredths.
        assert cost(end) - lowest == pytest.approx(3.8415, abs=0.15)


def test_a_parameter_that_the_log_hardly_bounds():
    """A faint log: a softening spring would let go at some twist, a hardening one is excluded only late."""
    found = reduced_fit(noise=0.02, rms=1.0, alpha=0.0)
    known = uncertainty(found)
    parabola = known.estimates["alpha"]
    assert not parabola.identifiable
    better = with_profiles(found, known)
    low, high = better.estimates["alpha"].ci95
    assert not better.estimates["alpha"].identifiable
    assert low < 0.0 < rig.REDUCED_ALPHA < high
    # The sides differ by far, where the parabola's are the same.
    assert high - parabola.value > 1.3 * (parabola.ci95[1] - parabola.value)
    # Beyond -1/x^2 the spring has no way back; the segments' own states leave some room.
    x_max = np.max(np.abs(rig.reduced_experiment(COUNT, rms=1.0).measured))
    assert -2.0 / x_max**2 < low
    assert better.estimates["alpha"].interval == "profile" and better.estimates["omega_0"].interval == "curvature"
    # Correlations are in the order of the estimates.
    assert list(better.estimates) == list(known.estimates)
    # What is well known keeps its interval.
    assert better.estimates["omega_0"].ci95 == known.estimates["omega_0"].ci95


def test_unknown_path(linear: tuple[Fit, Uncertainty]):
    with pytest.raises(ValueError, match="^`path` must be one of"):
        profile(linear[0], "K", linear[1])
