"""Where one side's own equation leaves only noise, it supplies K, alpha and B_sp of a final model that leaves more."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import joints
import rig
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.free_parameters import MESH, base_paths, with_priors
from fitting.estimation.one_side import fits_of_sides, held_at
from fitting.estimation.problem import Segmentation, segment_length, short_horizon
from fitting.estimation.whole_log_fit import long_fit, refitted_on_all
from fitting.loop import close_loop
from fitting.one_side_check import better_side, held_by_side, source_of
from fitting.report.content import report_dict
from fitting.uncertainty.standard_errors import uncertainty
from fitting.validation.account import of_parameters
from hdjax import Drive, TwoInertiaModel
from hdjax.drive import Prior
from hdjax.effects import CATALOGUE, Effect, ViscousMotorFriction
from hdjax.effects.load import GravityLoad
from hdjax.effects.sensing import LoadEncoderDelay, MotorEncoderDelay

SMOOTH = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, alpha=300.0, rms=0.05)


def rubbing(source: str) -> joints.Joint:
    """The joint with friction on the side that is not named."""
    if source == "load equation":
        return joints.with_friction(SMOOTH, 0.3, 0.2)
    return dataclasses.replace(SMOOTH, load_friction=0.4 * SMOOTH.rms * SMOOTH.N, bend=3e-3)


@functools.cache
def stretches_of(joint: joints.Joint) -> tuple[Stretch, ...]:
    return whole([experiment_from_log(joints.log_of(joint), hold="zero-order", N=joint.N)])


@functools.cache
def wrong_law(joint: joints.Joint, *priors: Prior, stated: joints.Joint | None = None) -> Fit:
    """A fit with another friction than the joint has, from the true parameters, or those that are stated."""
    drive = Drive(**{p: getattr(stated or joint, p) for p in ("N", "J_m", "J_l", *MESH)}, priors=priors)
    model = TwoInertiaModel(drive).with_effects(ViscousMotorFriction())
    stretches = stretches_of(joint)
    horizon = short_horizon(model, stretches)
    paths = (*base_paths(model), "viscous_motor_friction.b")
    return fit(model, stretches, paths, Segmentation(horizon, segment_length(horizon)))


def test_values_of_a_side_are_not_forced_upon_a_model_that_they_do_not_suit():
    found = wrong_law(rubbing("load equation"))
    side = better_side(found)
    assert side is not None
    held = held_by_side(side, found)
    assert held is not None and float(held.model.drive.K) == float(side.model.drive.K)
    exploding = dataclasses.replace(side, model=side.model.replace({"B_sp": -100.0 * SMOOTH.B_sp}))
    assert held_by_side(exploding, found) is None


@pytest.mark.parametrize("source", ["load equation", "motor equation"])
def test_side_that_does_not_rub_supplies_the_parameters(source: str):
    joint = rubbing(source)
    found = wrong_law(joint)
    side = better_side(found)
    assert side is not None and source_of(side) == source
    for path, estimate in uncertainty(side).estimates.items():
        assert abs(estimate.value - getattr(joint, path)) < 4.0 * estimate.std, (path, estimate)
    assert abs(float(found.model.get("K")) - joint.K) > 4.0 * uncertainty(side).estimates["K"].std

    fixed = held_at(side.model, found, side.free.paths)
    long = long_fit(fixed)
    both = refitted_on_all(long, fixed)
    for each in (fixed, long, both):
        assert [float(each.model.get(p)) for p in MESH] == [float(side.model.get(p)) for p in MESH]
    assert fixed.held == long.held == MESH
    assert float(both.model.get("viscous_motor_friction.b")) != float(found.model.get("viscous_motor_friction.b"))

    known, told = of_parameters(both, drive_from=side)
    # K is in proportion to the load's inertia in the load's equation, which lacks the motor's.
    held = {h.path: h.changes["K"] for h in told.held}
    assert set(held) == ({"J_l"} if source == "load equation" else {"J_m"})
    assert source != "load equation" or held == {"J_l": pytest.approx(0.01, rel=0.05)}
    own = uncertainty(both).estimates["viscous_motor_friction.b"]
    assert known.estimates == uncertainty(side).estimates | {"viscous_motor_friction.b": own}
    assert np.all(np.linalg.eigvalsh(known.correlation) > 0.0)
    assert np.all(known.correlation[:3, 3] == 0.0)


def test_sides_that_contradict_each_other_supply_nothing():
    """An inertia is stated wrong: the equations of load and motor hold with different K."""
    assert better_side(wrong_law(SMOOTH, stated=dataclasses.replace(SMOOTH, J_l=1.3 * SMOOTH.J_l))) is None


def test_side_whose_inertia_is_unknown_supplies_nothing():
    assert better_side(wrong_law(rubbing("load equation"), Prior("J_l", SMOOTH.J_l, np.inf))) is None


@pytest.mark.parametrize("form", [LoadEncoderDelay, MotorEncoderDelay])
def test_model_that_corrects_a_reading_by_rows_is_not_checked(form: type[Effect]):
    """Both equations are driven by a reading; here the readings of the fit are moved."""
    found = wrong_law(rubbing("load equation"))
    late = form(delay=3.0 * joints.STEP)
    found = fit(
        found.model.with_effects(late), found.stretches, found.free.paths, found.segmentation, strategy=Strategy(2)
    )
    assert any(found.stretches[0].experiment.moved)
    assert better_side(found) is None
    assert fits_of_sides(with_priors(TwoInertiaModel(found.model.drive), ()), found.stretches)


@pytest.mark.parametrize(
    "catalogue",
    [(LoadEncoderDelay, GravityLoad, ViscousMotorFriction), pytest.param(CATALOGUE, marks=pytest.mark.slow)],
    ids=["few", "all"],
)
def test_side_driven_by_late_readings_supplies_nothing(catalogue: Sequence[type[Effect]]):
    """Readings late by 0.4 rows of a load that travels far: the motor's equation leaves only noise beside a viscous
    friction, with a damping that is a third off."""
    joint, late = dataclasses.replace(SMOOTH, alpha=0.0, B_sp=0.8), 0.4 * joints.STEP
    log = joints.log_of(joint, count=3000)
    motion = CubicSpline(log.time, joints.motion_of(joint, log.motor_torque))(log.time - late)[:, 1]
    noise = log.load_angle - joints.motion_of(joint, log.motor_torque)[:, 1]
    log = rig.log_of_angles(
        log.motor_angle, motion + noise, log.motor_torque, ratio=joint.N, step=joints.STEP, name="late"
    )
    experiment = experiment_from_log(log, hold="zero-order", N=joint.N)
    model = TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))
    loop = close_loop(model, {"zero-order": (experiment,)}, hold="zero-order", catalogue=catalogue)
    assert loop.decision == "effect_found"
    assert [f.name for f in loop.findings] == ["load_encoder_delay"]
    assert loop.parameters_from == "torque"
    known = loop.after.uncertainty.estimates
    for path, true in {"K": joint.K, "B_sp": joint.B_sp, "load_encoder_delay.delay": late}.items():
        assert abs(known[path].value - true) < 4.0 * known[path].std, (path, known[path])


@pytest.mark.slow
def test_loop_finds_gravity_behind_the_friction_of_the_motor():
    """An inexact law of the motor's friction may leave as much, but not in the load's own equation."""
    joint = dataclasses.replace(rubbing("load equation"), gravity=0.02 * SMOOTH.K)
    experiment = experiment_from_log(joints.log_of(joint, count=3000), hold="zero-order", N=joint.N)
    model = TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))
    report = report_dict(close_loop(model, {"zero-order": (experiment,)}, hold="zero-order"))
    assert report["decision"] == "effect_found"
    assert {e["family"] for e in report["after"]["effects"]} == {"motor_friction", "gravity_load"}
    low, high = report["after"]["parameters"]["K"]["ci95"]
    assert low < joint.K < high and high - low < 1e-3 * joint.K
    assert report["before"]["parameters"]["K"]["prior"] is None
