"""Starts of a refit."""

from dataclasses import replace

import pytest

import rig
from fitting.attribution.candidate_fit import Trial, attempt, first_pass
from fitting.attribution.candidate_refit import _as_sibling, _unstuck, begin, under_best_hold
from fitting.attribution.screening import Lead
from fitting.attribution.selection_round import _are_siblings
from fitting.attribution.study import Setting, Study
from fitting.estimation.estimate import fit
from fitting.estimation.experiment import experiment_from_log, split, whole
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from hdjax import Hold, Model
from hdjax.effects.actuation import InputDelay, TorqueBias
from hdjax.effects.backlash import Backlash, UndampedBacklash
from hdjax.effects.effect import Scales
from hdjax.effects.friction import LoadFriction, MotorFriction
from hdjax.effects.position import PositionDependentMotorFriction
from hdjax.effects.presliding import LuGreLoadFriction


def trial_of(model: Model) -> Trial:
    found = fit(model, whole([rig.drive_experiment(128)]), (), Segmentation(64))
    return Trial(model, found, found, "zero-order")


def test_a_form_starts_from_the_values_of_another_of_its_family():
    before = trial_of(rig.drive_model().with_effects(TorqueBias(bias=0.01)))
    sibling = before.model.replace({"K": 1.1 * rig.K}).with_effects(Backlash(b=2e-4))
    model = _as_sibling(UndampedBacklash(b=1e-5), before, replace(before, model=sibling))
    assert model is not None and [e.name for e in model.effects] == ["torque_bias", "undamped_backlash"]
    assert float(model.get("K")) == pytest.approx(1.1 * rig.K)
    assert float(model.get("undamped_backlash.b")) == 2e-4


def test_a_sibling_that_replaced_an_effect_is_no_start():
    before = trial_of(rig.drive_model().with_effects(TorqueBias(bias=0.01)))
    replaced = replace(before, model=rig.drive_model().with_effects(Backlash(b=2e-4)))
    assert _as_sibling(UndampedBacklash(b=1e-5), before, replaced) is None


def test_forms_at_one_place_with_common_parameters_start_from_each_other():
    friction = MotorFriction(T_c=0.1, transition=0.1)
    assert _are_siblings(friction, PositionDependentMotorFriction(T_c=0.1, transition=0.1))
    assert not _are_siblings(friction, LoadFriction(T_c=0.1, transition=0.1))
    assert not _are_siblings(TorqueBias(bias=0.1), friction)


def test_parameter_at_its_bound_starts_again_from_typical_values():
    """LuGre friction whose Stribeck rate has run away is Dahl friction."""
    scales = Scales(x=2e-4, x_max=1e-3, v=0.03, omega_m=15.0, omega_l=0.15, time_step=1e-3, omega_0=400.0)
    friction = LuGreLoadFriction(T_c=0.5, excess=2.6, omega_s=2e13, bend=9e-5, tau=7e-4, settling=2e-4)
    model = rig.drive_model().with_effects(friction)
    starts = _unstuck(model, scales)
    rates = [float(start.get("lugre_load_friction.omega_s")) for start in starts]
    assert sorted(rates) == sorted({float(p.omega_s) for p in LuGreLoadFriction.proposals(scales)})
    assert {float(start.get("lugre_load_friction.excess")) for start in starts} == {2.6}
    settled = model.replace({"lugre_load_friction.omega_s": 0.03})
    assert _unstuck(settled, scales) == []


def test_shape_that_vanished_starts_again_beside_any_candidate():
    """The corner of dry friction may be sharp while a later effect is missing."""
    scales = Scales(x=2e-4, x_max=1e-3, v=0.03, omega_m=15.0, omega_l=0.15, time_step=1e-3, omega_0=400.0)
    model = rig.drive_model().with_effects(MotorFriction(T_c=0.1, transition=1e-28), TorqueBias(bias=0.1))
    (start,) = _unstuck(model, scales)
    (typical,) = MotorFriction.proposals(scales)
    assert float(start.get("motor_friction.transition")) == float(typical.transition)
    assert float(start.get("motor_friction.T_c")) == 0.1 and float(start.get("torque_bias.bias")) == 0.1
    assert _unstuck(model.replace({"motor_friction.transition": 1e-3}), scales) == []


def test_a_refit_that_was_led_away_starts_from_the_model_that_it_contains():
    """A first-order estimate may lie far beyond where it holds."""
    stretches = whole([rig.drive_experiment(2000)])
    segmentation = Segmentation(128, halo=4)
    found = fit(rig.drive_model(), stretches, base_paths(rig.drive_model()), segmentation)
    before = Trial(found.model, found, found, "zero-order")
    lead = Lead(TorqueBias(bias=50.0), {"K": 60.0 * rig.K, "B_sp": 300.0 * rig.B_SP}, gain=1.0)
    study = Study({"zero-order": (stretches, stretches)}, Setting(segmentation))
    starts = [found.model.replace({"K": 61.0 * rig.K, "B_sp": 301.0 * rig.B_SP}).with_effects(lead.effect)]
    assert first_pass(starts, study, "zero-order", champion=before).objective > found.objective
    replaced = replace(before, model=rig.drive_model().with_effects(TorqueBias(bias=0.1), Backlash(b=2e-4)))
    for sibling in (None, replaced):
        assert begin(before, lead, study, sibling=sibling).objective <= found.objective


def test_delay_goes_on_under_the_hold_that_suits_it():
    """A smooth hold with a delay of half a sample is nearly a zero-order hold without any."""
    torque = rig.drive_torque(3000)
    log = rig.drive_log(rig.drive_motion(torque), torque)
    holds: tuple[Hold, ...] = ("cubic", "zero-order")
    data = {h: split([experiment_from_log(log, hold=h, N=rig.N)]) for h in holds}
    study = Study(data, Setting(Segmentation(128, halo=4)))
    half = 0.5 * float(log.time[1] - log.time[0])
    smooth = attempt(rig.drive_model().with_effects(InputDelay(delay=half)), study, "cubic")
    found = under_best_hold(smooth, study)
    assert found.hold == "zero-order" and abs(float(found.model.get("input_delay.delay"))) < 0.02 * half
    assert float(smooth.model.get("input_delay.delay")) == pytest.approx(half, rel=0.05)
    assert under_best_hold(found, study) is found
