"""The load's own equation tells K whatever acts on the motor; the base fit holds it where the torque misleads."""

import dataclasses

import numpy as np
import pytest

import joints
from fitting.estimation.base_fit import base_fit, fit_behind_fixed_values, is_held
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.motor_driven import held_at, motor_driven_fit
from fitting.fit_drive import fit_only
from fitting.report.content import report_dict
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, TwoInertiaModel

SMOOTH = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, alpha=300.0, rms=0.05)
RUBBING = joints.with_friction(SMOOTH, 0.5, 0.4)


def model_of(joint: joints.Joint) -> TwoInertiaModel:
    return TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))


def stretches_of(joint: joints.Joint, **changes) -> tuple[Stretch, ...]:
    log = dataclasses.replace(joints.log_of(joint), **changes)
    return whole([experiment_from_log(log, hold="zero-order", N=joint.N)])


@pytest.fixture(scope="module")
def stretches() -> tuple[Stretch, ...]:
    return stretches_of(RUBBING)


def test_the_load_tells_stiffness_under_friction_of_the_motor(stretches):
    found = motor_driven_fit(model_of(RUBBING), stretches)
    assert found is not None
    for path, estimate in uncertainty(found).estimates.items():
        truth = getattr(RUBBING, path)
        assert abs(estimate.value - truth) < 4.0 * estimate.std, (path, estimate)
    assert uncertainty(found).estimates["K"].std < 0.01 * RUBBING.K


def test_the_torque_has_no_say_in_it(stretches):
    other = stretches_of(RUBBING, motor_torque=np.sin(np.arange(joints.COUNT)))
    one, two = (motor_driven_fit(model_of(RUBBING), s) for s in (stretches, other))
    assert one is not None and two is not None
    assert [float(one.model.get(p)) for p in base_paths(one.model)] == [
        float(two.model.get(p)) for p in base_paths(two.model)
    ]


def test_a_torque_on_the_load_is_part_of_it():
    """A load torque that is logged but did not act is in the equation, and spoils the fit."""
    pushed = np.full(joints.COUNT, 0.05 * RUBBING.K * 1e-2)
    with_load = motor_driven_fit(model_of(RUBBING), stretches_of(RUBBING, load_torque=pushed))
    without = motor_driven_fit(model_of(RUBBING), stretches_of(RUBBING))
    assert with_load is not None and without is not None
    assert with_load.principal_std > 3.0 * without.principal_std


def test_another_stiffness_leaves_more(stretches):
    found = motor_driven_fit(model_of(RUBBING), stretches)
    assert found is not None
    off = held_at(model_of(RUBBING).replace({"K": 2.0 * RUBBING.K}), found)
    assert off.objective > found.objective + np.log(2.0)


def test_the_base_fit_holds_what_the_load_tells(stretches):
    found = base_fit(model_of(RUBBING), stretches)
    assert is_held(found)
    assert float(found.model.get("K")) == pytest.approx(RUBBING.K, rel=0.01)
    assert fit_behind_fixed_values(found) is not None


def test_without_friction_nothing_is_held():
    found = base_fit(model_of(SMOOTH), stretches_of(SMOOTH))
    assert not is_held(found) and fit_behind_fixed_values(found) is None
    assert float(found.model.get("K")) == pytest.approx(SMOOTH.K, rel=0.01)


def test_a_fit_reports_it_with_the_intervals_of_the_loads_equation(stretches):
    experiment = stretches[0].experiment
    report = report_dict(fit_only(model_of(RUBBING), {"zero-order": (experiment,)}, hold="zero-order"))
    assert report["parameters_from"] == "load equation"
    stiffness = report["before"]["parameters"]["K"]
    low, high = stiffness["ci95"]
    assert low < RUBBING.K < high and high - low < 0.1 * RUBBING.K
    assert "motor does not move as the logged torque predicts" in " ".join(report["meaning"])
