"""Figures that follow from the parameters, and their standard errors, against draws from the parameters' law."""

import numpy as np
import pytest

import rig
from fitting.compare import Account
from fitting.derived import derived, drive_figures
from fitting.uncertainty import Estimate, Uncertainty
from hdjax import Model

X_MAX = 2e-3


def account_of(model: Model, std: dict[str, float], correlation: np.ndarray) -> Account:
    estimates = {
        path: Estimate(path, float(model.get(path)), error, error, (0.0, 1.0), "1", True) for path, error in std.items()
    }
    return Account(model, Uncertainty(estimates, correlation), (), ())


def test_drive_by_draws():
    """First-order propagation, so that errors of a thousandth agree to their own size and to the draws' chance."""
    std = {"K": 5.0, "alpha": 60.0, "B_sp": 4e-4}
    correlation = np.array([[1.0, -0.8, 0.3], [-0.8, 1.0, -0.1], [0.3, -0.1, 1.0]])
    found = derived(account_of(rig.drive_model(), std, correlation), lambda m: drive_figures(m, X_MAX))
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


def test_reduced_drive_leaves_out_its_own_parameters():
    std = {"mu": 0.01, "omega_0": 0.1, "alpha": 0.02, "gain": 0.1}
    found = derived(account_of(rig.reduced_model(), std, np.eye(4)), lambda m: drive_figures(m, 0.5))
    assert list(found) == ["natural_frequency", "zeta", "nonlinear_share", "stiffness_at_full_twist"]
    zeta = rig.MU / (2 * rig.OMEGA_0)
    assert found["zeta"].value == pytest.approx(zeta)
    assert found["zeta"].std == pytest.approx(zeta * np.hypot(0.01 / rig.MU, 0.1 / rig.OMEGA_0))
    assert found["stiffness_at_full_twist"].unit == "1/s^2"
