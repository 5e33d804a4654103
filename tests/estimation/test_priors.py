"""Inertias and torque factor with a Gaussian prior, or entirely free."""

import math

import numpy as np
import pytest

import joints
from fitting.estimation.base_fit import base_fit
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.starting_values import with_starting_inertias
from fitting.uncertainty.profile_likelihood import profile
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, TwoInertiaModel
from hdjax.drive import Prior

JOINT = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, alpha=300.0, rms=0.05)
FREE = (Prior("J_m", 1.0, math.inf), Prior("J_l", 1.0, math.inf))


def model_of(*priors: Prior) -> TwoInertiaModel:
    known = {"J_m": JOINT.J_m, "J_l": JOINT.J_l, "k_T": 1.0} | {p.path: p.value for p in priors}
    return TwoInertiaModel(Drive(N=JOINT.N, K=1.0, priors=priors, **known))


def stretches_of(joint: joints.Joint, seed: int = 0) -> tuple[Stretch, ...]:
    return whole([experiment_from_log(joints.log_of(joint, seed=seed, count=3000), hold="zero-order", N=joint.N)])


@pytest.fixture(scope="module")
def stretches() -> tuple[Stretch, ...]:
    return stretches_of(JOINT)


def fitted(stretches: tuple[Stretch, ...], *priors: Prior) -> Fit:
    return base_fit(model_of(*priors), stretches).fit


def test_free_inertias_are_recovered(stretches):
    for path, estimate in uncertainty(fitted(stretches, *FREE)).estimates.items():
        truth = getattr(JOINT, path)
        assert abs(estimate.value - truth) < 4.0 * estimate.std, (path, estimate)
        assert path in ("alpha",) or estimate.std < 0.01 * truth


@pytest.mark.parametrize("rubs", [False, True], ids=["smooth", "rubbing"])
def test_starting_inertias_follow_from_the_torque(rubs: bool):
    joint = joints.with_friction(JOINT, 0.2, 0.2) if rubs else JOINT
    begun = with_starting_inertias(model_of(*FREE), stretches_of(joint))
    assert float(begun.get("J_m")) == pytest.approx(joint.J_m, rel=0.1)
    assert float(begun.get("J_l")) == pytest.approx(joint.J_l, rel=0.1)


def test_wrong_prior_value_is_corrected_by_the_log(stretches):
    """Angles and torque determine the inertias far better than 10 %."""
    found = fitted(stretches, Prior("J_m", 1.15 * JOINT.J_m, 0.1), Prior("J_l", 0.9 * JOINT.J_l, 0.1))
    assert float(found.model.get("J_m")) == pytest.approx(JOINT.J_m, rel=1e-3)
    assert float(found.model.get("K")) == pytest.approx(JOINT.K, rel=1e-3)


def test_common_torque_factor_is_determined_by_the_priors(stretches):
    """A log of angles determines all parameters only in proportion to the torque.

    The priors alone determine the common factor, as two Gaussian measurements of one number.
    """
    motor, constant = Prior("J_m", 1.04 * JOINT.J_m, 0.05), Prior("k_T", 1.0, 0.1)
    found = fitted(stretches, motor, Prior("J_l", JOINT.J_l, math.inf), constant)
    estimates = uncertainty(found).estimates
    weights = np.array([0.05**-2, 0.1**-2])
    factor = np.exp(weights @ [np.log(1.04), 0.0] / weights.sum())
    spread = weights.sum() ** -0.5
    for path in ("J_m", "J_l", "K", "B_sp"):
        assert estimates[path].value == pytest.approx(factor * getattr(JOINT, path), rel=2e-3), path
        assert estimates[path].std == pytest.approx(spread * estimates[path].value, rel=0.05), path
    assert estimates["k_T"].value == pytest.approx(factor, rel=1e-3)


def test_profile_likelihood_includes_the_prior(stretches):
    found = fitted(stretches, Prior("J_m", JOINT.J_m, 0.05), Prior("J_l", JOINT.J_l, math.inf), Prior("k_T", 1.0, 0.1))
    known = uncertainty(found)
    low, high = profile(found, "J_m", known).ci95
    # The priors are Gaussian in the logarithm.
    assert math.log(high / low) == pytest.approx(2 * 1.96 * (0.05**-2 + 0.1**-2) ** -0.5, rel=0.1)


def test_free_torque_factor_is_recovered(stretches):
    found = fitted(stretches, Prior("k_T", 1.0, math.inf))
    assert float(found.model.get("k_T")) == pytest.approx(1.0, rel=1e-3)
