"""The load's own equation determines K whatever acts on the motor, the motor's whatever acts on the load.

The base fit fixes K at that value where the other side does not move as the torque says.
"""

import dataclasses

import numpy as np
import pytest

import joints
from fitting.estimation.base_fit import base_fit, fit_behind_fixed_values, is_held
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.one_side import fit_of_side, held_at
from fitting.fit_drive import fit_only
from fitting.report.content import report_dict
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, LoadDrivenModel, MotorDrivenModel, TwoInertiaModel

SMOOTH = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, alpha=300.0, rms=0.05)
WITH_FRICTION = joints.with_friction(SMOOTH, 0.5, 0.4)


WITH_LOAD_FRICTION = dataclasses.replace(SMOOTH, load_friction=1.2 * SMOOTH.rms * SMOOTH.N, bend=3e-3)


def model_of(joint: joints.Joint) -> TwoInertiaModel:
    return TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))


def stretches_of(joint: joints.Joint, **changes) -> tuple[Stretch, ...]:
    log = dataclasses.replace(joints.log_of(joint), **changes)
    return whole([experiment_from_log(log, hold="zero-order", N=joint.N)])


@pytest.fixture(scope="module")
def stretches() -> tuple[Stretch, ...]:
    return stretches_of(WITH_FRICTION)


def test_motor_driven_fit_recovers_stiffness_under_motor_friction(stretches):
    found = fit_of_side(MotorDrivenModel, model_of(WITH_FRICTION), stretches)
    assert found is not None
    for path, estimate in uncertainty(found).estimates.items():
        truth = getattr(WITH_FRICTION, path)
        assert abs(estimate.value - truth) < 4.0 * estimate.std, (path, estimate)
    assert uncertainty(found).estimates["K"].std < 0.01 * WITH_FRICTION.K


def test_motor_driven_fit_does_not_depend_on_the_motor_torque(stretches):
    other = stretches_of(WITH_FRICTION, motor_torque=np.sin(np.arange(joints.COUNT)))
    one, two = (fit_of_side(MotorDrivenModel, model_of(WITH_FRICTION), s) for s in (stretches, other))
    assert one is not None and two is not None
    assert [float(one.model.get(p)) for p in base_paths(one.model)] == [
        float(two.model.get(p)) for p in base_paths(two.model)
    ]


def test_motor_driven_fit_includes_the_logged_load_torque():
    """A logged load torque that did not act enters the equation and makes the fit worse."""
    pushed = np.full(joints.COUNT, 0.05 * WITH_FRICTION.K * 1e-2)
    with_load = fit_of_side(MotorDrivenModel, model_of(WITH_FRICTION), stretches_of(WITH_FRICTION, load_torque=pushed))
    without = fit_of_side(MotorDrivenModel, model_of(WITH_FRICTION), stretches_of(WITH_FRICTION))
    assert with_load is not None and without is not None
    assert with_load.principal_std > 3.0 * without.principal_std


def test_motor_driven_residual_grows_with_a_wrong_stiffness(stretches):
    found = fit_of_side(MotorDrivenModel, model_of(WITH_FRICTION), stretches)
    assert found is not None
    off = held_at(model_of(WITH_FRICTION).replace({"K": 2.0 * WITH_FRICTION.K}), found)
    assert off.objective > found.objective + np.log(2.0)


def test_base_fit_fixes_parameters_at_the_motor_driven_fit(stretches):
    found = base_fit(model_of(WITH_FRICTION), stretches).fit
    assert is_held(found)
    assert float(found.model.get("K")) == pytest.approx(WITH_FRICTION.K, rel=0.01)
    assert fit_behind_fixed_values(found) is not None


def test_base_fit_without_friction_fixes_no_parameter():
    found = base_fit(model_of(SMOOTH), stretches_of(SMOOTH)).fit
    assert not is_held(found) and fit_behind_fixed_values(found) is None
    assert float(found.model.get("K")) == pytest.approx(SMOOTH.K, rel=0.01)


def test_report_states_intervals_from_the_load_equation(stretches):
    experiment = stretches[0].experiment
    report = report_dict(fit_only(model_of(WITH_FRICTION), {"zero-order": (experiment,)}, hold="zero-order"))
    assert report["parameters_from"] == "load equation"
    stiffness = report["before"]["parameters"]["K"]
    low, high = stiffness["ci95"]
    assert low < WITH_FRICTION.K < high and high - low < 0.1 * WITH_FRICTION.K
    assert "motor does not move as the logged torque predicts" in " ".join(report["meaning"])


def test_load_driven_fit_recovers_stiffness_under_load_friction():
    found = fit_of_side(LoadDrivenModel, model_of(WITH_LOAD_FRICTION), stretches_of(WITH_LOAD_FRICTION))
    assert found is not None
    for path, estimate in uncertainty(found).estimates.items():
        truth = getattr(WITH_LOAD_FRICTION, path)
        assert abs(estimate.value - truth) < 4.0 * estimate.std, (path, estimate)
    assert uncertainty(found).estimates["K"].std < 0.01 * WITH_LOAD_FRICTION.K


@pytest.mark.parametrize("share", [0.6, 2.0])
def test_base_fit_fixes_parameters_at_the_load_driven_fit(share):
    """A load that rubs, or hardly moves at all."""
    joint = dataclasses.replace(WITH_LOAD_FRICTION, load_friction=share * SMOOTH.rms * SMOOTH.N)
    found = base_fit(model_of(joint), stretches_of(joint)).fit
    assert is_held(found)
    assert float(found.model.get("K")) == pytest.approx(joint.K, rel=0.001)
    behind = fit_behind_fixed_values(found)
    assert behind is not None and isinstance(behind.model, LoadDrivenModel)


def test_report_states_intervals_from_the_motor_equation():
    experiment = stretches_of(WITH_LOAD_FRICTION)[0].experiment
    report = report_dict(fit_only(model_of(WITH_LOAD_FRICTION), {"zero-order": (experiment,)}, hold="zero-order"))
    assert report["parameters_from"] == "motor equation"
    low, high = report["before"]["parameters"]["K"]["ci95"]
    assert low < WITH_LOAD_FRICTION.K < high and high - low < 0.1 * WITH_LOAD_FRICTION.K
    assert "load does not move as the logged torque predicts" in " ".join(report["meaning"])
