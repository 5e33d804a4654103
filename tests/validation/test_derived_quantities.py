"""Derived quantities and their standard errors, compared with draws from the parameters' distribution."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import rig
from fitting.uncertainty.standard_errors import Estimate, Uncertainty
from fitting.validation.derived_quantities import derived, drive_figures
from hdjax import Model

X_MAX = 2e-3


def known_of(model: Model, std: dict[str, float], correlation: np.ndarray) -> Uncertainty:
    estimates = {
        path: Estimate(path, float(model.get(path)), error, error, (0.0, 1.0), "1", True) for path, error in std.items()
    }
    spread = np.array(list(std.values()))
    covariance = correlation * np.outer(spread, spread)
    return Uncertainty(estimates, correlation, covariance, covariance)


def test_derived_quantities_of_a_drive_equal_those_of_parameter_draws():
    """Propagation is of first order, so that relative errors of 1e-3 agree to 1e-3 and to the scatter of draws."""
    std = {"K": 5.0, "alpha": 60.0, "B_sp": 4e-4}
    correlation = np.array([[1.0, -0.8, 0.3], [-0.8, 1.0, -0.1], [0.3, -0.1, 1.0]])
    found = derived(rig.drive_model(), known_of(rig.drive_model(), std, correlation), lambda m: drive_figures(m, X_MAX))
    spread = np.array(list(std.values()))
    random = np.random.default_rng(0)
    K, alpha, B_sp = random.multivariate_normal(
        [rig.K, rig.ALPHA, rig.B_SP], correlation * np.outer(spread, spread), size=200_000
    ).T
    c = 1 / (rig.N**2 * rig.J_M) + 1 / rig.J_L
    draws = {
        "omega_0": np.sqrt(c * K),
        "natural_frequency": np.sqrt(c * K) / (2 * np.pi),
        "mu": c * B_sp,
        "zeta": 0.5 * c * B_sp / np.sqrt(c * K),
        "nonlinear_share": alpha * X_MAX**2,
        "stiffness_at_full_twist": K * (1 + 3 * alpha * X_MAX**2),
    }
    assert list(found) == list(draws)
    for name, values in draws.items():
        assert found[name].value == pytest.approx(np.mean(values), rel=1e-4), name
        # The standard deviation of 200 000 draws scatters by 0.16 %.
        assert found[name].std == pytest.approx(np.std(values), rel=0.01), name
        low, high = found[name].ci95
        assert np.mean((values > low) & (values < high)) == pytest.approx(0.95, abs=0.005), name


def test_derived_quantities_of_a_reduced_log_exclude_its_fitted_parameters():
    std = {"mu": 0.01, "omega_0": 0.1, "alpha": 0.02, "gain": 0.1}
    found = derived(rig.reduced_model(), known_of(rig.reduced_model(), std, np.eye(4)), lambda m: drive_figures(m, 0.5))
    assert list(found) == ["natural_frequency", "zeta", "nonlinear_share", "stiffness_at_full_twist"]
    zeta = rig.MU / (2 * rig.OMEGA_0)
    assert found["zeta"].value == pytest.approx(zeta)
    assert found["zeta"].std == pytest.approx(zeta * np.hypot(0.01 / rig.MU, 0.1 / rig.OMEGA_0))
    assert found["stiffness_at_full_twist"].unit == "1/s^2"


def with_freedom(known: Uncertainty, freedom: dict[str, float]) -> Uncertainty:
    estimates = {p: dataclasses.replace(e, degrees_of_freedom=freedom[p]) for p, e in known.estimates.items()}
    return dataclasses.replace(known, estimates=estimates)


def test_intervals_use_degrees_of_freedom_of_the_parameters():
    """Intervals are Student's t of the only parameter of a quantity, or lie between those of several parameters."""
    std = {"mu": 0.01, "omega_0": 0.1, "alpha": 0.02, "gain": 0.1}
    freedom = {"mu": 4.0, "omega_0": 30.0, "alpha": 7.0, "gain": 2.0}
    known = with_freedom(known_of(rig.reduced_model(), std, np.eye(4)), freedom)
    found = derived(rig.reduced_model(), known, lambda m: drive_figures(m, 0.5))
    for name, path in (("natural_frequency", "omega_0"), ("nonlinear_share", "alpha")):
        low, high = found[name].ci95
        assert high - low == pytest.approx(2 * stats.t.ppf(0.975, freedom[path]) * found[name].std), name
    # The damping ratio's error is mostly that of mu.
    assert freedom["mu"] < found["zeta"].degrees_of_freedom < 1.1 * freedom["mu"]
    # At most the degrees of freedom of Satterthwaite for independent errors.
    shares = np.array([0.01 / rig.MU, 0.1 / rig.OMEGA_0]) ** 2
    satterthwaite = shares.sum() ** 2 / np.sum(shares**2 / [freedom["mu"], freedom["omega_0"]])
    assert found["zeta"].degrees_of_freedom <= satterthwaite
