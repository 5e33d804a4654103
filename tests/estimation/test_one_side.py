"""The load's own equation determines K whatever acts on the motor, the motor's whatever acts on the load.

The base fit fixes K at that value where the other side does not move as the torque says.
"""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import numpy as np
import pytest

import joints
from fitting.estimation import base_fit as base_fit_module
from fitting.estimation.base_fit import base_fit, is_held
from fitting.estimation.estimate import Fit, mostly_lost
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.one_side import fit_of_side, fits_of_sides, held_at, one_side_fit, stiffness_error
from fitting.estimation.starting_values import start_beside_torques
from fitting.fit_drive import fit_only
from fitting.report.content import report_dict
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, LoadDrivenModel, MotorDrivenModel, TwoInertiaModel

SMOOTH = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, alpha=300.0, rms=0.05)
WITH_LOAD_FRICTION = dataclasses.replace(SMOOTH, load_friction=1.2 * SMOOTH.rms * SMOOTH.N, bend=3e-3)


def rubbing() -> joints.Joint:
    return joints.with_friction(SMOOTH, 0.5, 0.4)


def rubbing_beside_gravity() -> joints.Joint:
    return dataclasses.replace(rubbing(), gravity=1.5)


def model_of(joint: joints.Joint) -> TwoInertiaModel:
    return TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))


log_of = functools.cache(joints.log_of)


def stretches_of(joint: joints.Joint, **changes) -> tuple[Stretch, ...]:
    log = dataclasses.replace(log_of(joint), **changes)
    return whole([experiment_from_log(log, hold="zero-order", N=joint.N)])


@functools.cache
def sides_of(joint: joints.Joint) -> tuple[Fit, ...]:
    return tuple(fits_of_sides(model_of(joint), stretches_of(joint)))


@functools.cache
def side_of(joint: joints.Joint) -> Fit | None:
    return one_side_fit(model_of(joint), stretches_of(joint))


@pytest.fixture(scope="module")
def stretches() -> tuple[Stretch, ...]:
    return stretches_of(rubbing())


@pytest.fixture(scope="module")
def motor_driven_fit(stretches) -> Fit:
    found = fit_of_side(MotorDrivenModel, model_of(rubbing()), stretches)
    assert found is not None
    return found


def test_motor_driven_fit_recovers_stiffness_under_motor_friction(motor_driven_fit):
    found = motor_driven_fit
    for path, estimate in uncertainty(found).estimates.items():
        truth = getattr(rubbing(), path)
        assert abs(estimate.value - truth) < 4.0 * estimate.std, (path, estimate)
    assert uncertainty(found).estimates["K"].std < 0.01 * rubbing().K


def test_motor_driven_fit_does_not_depend_on_the_motor_torque(motor_driven_fit):
    other = stretches_of(rubbing(), motor_torque=np.sin(np.arange(joints.COUNT)))
    one, two = motor_driven_fit, fit_of_side(MotorDrivenModel, model_of(rubbing()), other)
    assert two is not None
    assert [float(one.model.get(p)) for p in base_paths(one.model)] == [
        float(two.model.get(p)) for p in base_paths(two.model)
    ]


def test_motor_driven_fit_includes_the_logged_load_torque(motor_driven_fit):
    """A logged load torque that did not act enters the equation and makes the fit worse."""
    pushed = np.full(joints.COUNT, 0.05 * rubbing().K * 1e-2)
    with_load = fit_of_side(MotorDrivenModel, model_of(rubbing()), stretches_of(rubbing(), load_torque=pushed))
    assert with_load is not None
    assert with_load.principal_std > 3.0 * motor_driven_fit.principal_std


def test_motor_driven_residual_grows_with_a_wrong_stiffness(motor_driven_fit):
    off = held_at(model_of(rubbing()).replace({"K": 2.0 * rubbing().K}), motor_driven_fit)
    assert off.objective > motor_driven_fit.objective + np.log(2.0)


def test_base_fit_fixes_parameters_at_the_motor_driven_fit(stretches):
    found, side = base_fit(model_of(rubbing()), stretches)
    assert is_held(found)
    assert float(found.model.get("K")) == pytest.approx(rubbing().K, rel=0.01)
    assert side is not None and isinstance(side.model, MotorDrivenModel)


def test_base_fit_without_friction_fixes_no_parameter():
    found, side = base_fit(model_of(SMOOTH), stretches_of(SMOOTH))
    assert not is_held(found) and side is None
    assert float(found.model.get("K")) == pytest.approx(SMOOTH.K, rel=0.01)


def test_report_states_intervals_from_the_load_equation(stretches):
    experiment = stretches[0].experiment
    report = report_dict(fit_only(model_of(rubbing()), {"zero-order": (experiment,)}, hold="zero-order"))
    assert report["parameters_from"] == "load equation"
    stiffness = report["before"]["parameters"]["K"]
    low, high = stiffness["ci95"]
    assert low < rubbing().K < high and high - low < 0.1 * rubbing().K
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
    found, side = base_fit(model_of(joint), stretches_of(joint))
    assert is_held(found)
    assert float(found.model.get("K")) == pytest.approx(joint.K, rel=0.001)
    assert side is not None and isinstance(side.model, LoadDrivenModel)


def test_report_states_intervals_from_the_motor_equation():
    experiment = stretches_of(WITH_LOAD_FRICTION)[0].experiment
    report = report_dict(fit_only(model_of(WITH_LOAD_FRICTION), {"zero-order": (experiment,)}, hold="zero-order"))
    assert report["parameters_from"] == "motor equation"
    low, high = report["before"]["parameters"]["K"]["ci95"]
    assert low < WITH_LOAD_FRICTION.K < high and high - low < 0.1 * WITH_LOAD_FRICTION.K
    assert "load does not move as the logged torque predicts" in " ".join(report["meaning"])


@pytest.fixture(scope="module")
def hanging() -> tuple[Stretch, ...]:
    return stretches_of(rubbing_beside_gravity())


def test_load_equation_beside_gravity_recovers_stiffness_under_motor_friction(hanging):
    """Neither equation holds alone: gravity is not logged, and the motor rubs."""
    found, side = base_fit(model_of(rubbing_beside_gravity()), hanging)
    assert is_held(found) and side is not None and isinstance(side.model, MotorDrivenModel)
    for path, estimate in uncertainty(side).estimates.items():
        assert abs(estimate.value - getattr(rubbing_beside_gravity(), path)) < 4.0 * estimate.std, (path, estimate)
        assert float(found.model.get(path)) == estimate.value
    assert uncertainty(side).estimates["K"].std < 0.01 * rubbing_beside_gravity().K
    alone = fit_of_side(MotorDrivenModel, model_of(rubbing_beside_gravity()), hanging)
    assert alone is None or alone.principal_std > 3.0 * side.principal_std


def test_strengths_of_shaft_torques_are_those_of_gravity(hanging):
    beside = start_beside_torques("load", model_of(rubbing_beside_gravity()), hanging)
    assert beside is not None
    start, (sine, cosine, coulomb, viscous) = beside
    assert sine == pytest.approx(-rubbing_beside_gravity().gravity, rel=0.01)
    assert float(start.get("K")) == pytest.approx(rubbing_beside_gravity().K, rel=0.01)
    speed = np.std(np.gradient(hanging[0].experiment.measured[:, 0], joints.STEP))
    assert max(abs(cosine), abs(coulomb), abs(viscous) * speed) < 0.02 * rubbing_beside_gravity().gravity


def test_standard_errors_include_the_strengths_of_shaft_torques():
    """A pendulum that swings little is a second spring, which the stiffness could be exchanged for."""
    side = side_of(rubbing_beside_gravity())
    assert side is not None
    known = tuple(
        dataclasses.replace(s, experiment=dataclasses.replace(s.experiment, shaft_torques=None)) for s in side.stretches
    )
    wide, narrow = (
        uncertainty(found, torque_noise=False).estimates["K"].std
        for found in (side, eqx.tree_at(lambda f: f.stretches, side, known))
    )
    assert 1.02 * narrow < wide < 10.0 * narrow


def test_torques_of_a_shaft_add_to_a_logged_torque():
    """Friction of the motor, given as a shaft torque, leaves the motor's equation as the load's."""
    beside = start_beside_torques("motor", model_of(rubbing()), stretches_of(rubbing()))
    assert beside is not None
    _, (_, _, coulomb, viscous) = beside
    assert coulomb == pytest.approx(-rubbing().coulomb, rel=0.05)
    assert viscous == pytest.approx(-rubbing().viscous, rel=0.05)
    fits = {type(f.model): f for f in sides_of(rubbing())}
    assert float(fits[LoadDrivenModel].model.get("K")) == pytest.approx(rubbing().K, rel=0.05)


def test_logs_with_and_without_a_load_torque_are_fitted_together():
    pushed = np.zeros(len(log_of(rubbing()).time))
    logs = stretches_of(rubbing()), stretches_of(rubbing(), load_torque=pushed)
    alone, both = (fit_of_side(MotorDrivenModel, model_of(rubbing()), some) for some in (logs[0], sum(logs, ())))
    assert alone is not None and both is not None
    assert float(both.model.get("K")) == pytest.approx(float(alone.model.get("K")), rel=1e-6)


@pytest.mark.parametrize("side", ["load", "motor"])
def test_no_torque_is_added_where_an_equation_holds_alone(side):
    assert start_beside_torques(side, model_of(SMOOTH), stretches_of(SMOOTH)) is None


@pytest.mark.parametrize(
    "made",
    [rubbing, pytest.param(lambda: WITH_LOAD_FRICTION, marks=pytest.mark.slow), rubbing_beside_gravity],
    ids=["motor rubs", "load rubs", "motor rubs beside gravity"],
)
def test_side_that_determines_stiffness_better_is_chosen(made: Callable[[], joints.Joint]):
    joint = made()
    sides = sides_of(joint)
    errors = [uncertainty(one).estimates["K"].std / float(one.model.get("K")) for one in sides]
    chosen = side_of(joint)
    assert chosen is not None
    assert float(chosen.model.get("K")) == float(sides[int(np.argmin(errors))].model.get("K"))
    assert stiffness_error(chosen) == pytest.approx(min(errors), rel=0.5)


def test_values_of_a_side_under_which_the_drive_diverges_are_not_taken(stretches, motor_driven_fit, monkeypatch):
    """What the equation lacks itself, such as a flexible load, may make its damping negative."""
    unstable = eqx.tree_at(lambda f: f.model, motor_driven_fit, motor_driven_fit.model.replace({"B_sp": -20.0}))
    monkeypatch.setattr(base_fit_module, "one_side_fit", lambda *_: unstable)
    found = base_fit(model_of(rubbing()), stretches).fit
    assert not is_held(found)
    assert not mostly_lost(found)
