"""The law of an effect that was chosen while others were missing is compared again beside them."""

from dataclasses import replace

import numpy as np
import pytest

import rig
from fitting.attribution.candidate_fit import Trial
from fitting.attribution.candidate_refit import _with_form
from fitting.attribution.rivals_again import _decided_again
from fitting.attribution.screening import Screen
from fitting.attribution.selection_round import Round, Verdict
from fitting.attribution.study import Setting, Study
from fitting.estimation.estimate import fit
from fitting.estimation.experiment import whole
from fitting.estimation.problem import Segmentation
from fitting.loop import close_loop
from fitting.outcome import kept_rounds
from fitting.report.content import report_dict
from hdjax.effects import KinematicError, LoadFriction, MotorFriction, StribeckMotorFriction, ViscousMotorFriction
from hdjax.effects.position import PositionDependentMotorFriction
from hdjax.effects.presliding import DahlMotorFriction

DAHL = DahlMotorFriction(T_c=0.2, b=1e-3, bend=0.01, settling=1e-4)


def test_a_shaft_has_one_law_of_friction():
    assert MotorFriction.replaces(DAHL) and DahlMotorFriction.replaces(MotorFriction(T_c=0.1, transition=0.1))
    assert StribeckMotorFriction.replaces(ViscousMotorFriction(b=1.0))
    assert not LoadFriction.replaces(DAHL) and not MotorFriction.replaces(LoadFriction(T_c=0.1, transition=0.1))
    assert not PositionDependentMotorFriction.replaces(DAHL) and not KinematicError.replaces(DAHL)


def test_another_law_takes_over_the_strengths_that_it_has():
    model = _with_form(rig.drive_model().with_effects(DAHL), MotorFriction(T_c=0.01, b=0.0, transition=0.3))
    (friction,) = model.effects
    assert friction.name == "motor_friction"
    known = [float(model.get(f"motor_friction.{p}")) for p in ("T_c", "b", "transition")]
    assert known == pytest.approx([0.21, 1e-3, 0.3])
    (friction,) = _with_form(model, ViscousMotorFriction(b=0.0)).effects
    assert float(friction.b) == pytest.approx(1e-3)


def test_tie_with_a_hold_stays_in_its_round():
    """A hold is no effect that could take another's place in the final model."""
    model = rig.drive_model().with_effects(DAHL)
    found = fit(model, whole([rig.drive_experiment(128)]), (), Segmentation(64))
    trial = Trial(model, found, found, "zero-order")
    friction = Verdict("dahl_motor_friction", "motor_friction", trial, 1.0, 0.001, True)
    hold = Verdict("linear hold", "input_delay", replace(trial, hold="linear"), 1.0, 0.001, False)
    study = Study({}, Setting(Segmentation(64)))
    for verdicts in ((friction, hold), (hold, friction)):
        this = Round(trial, Screen((), np.zeros(1)), verdicts, True)
        assert _decided_again(this, trial, study) == (this,)


@pytest.mark.slow
def test_simpler_law_replaces_one_that_followed_a_missing_effect():
    """Beside the kinematic error Coulomb friction suffices; K is not extended to what it was without that error."""
    experiment = rig.drive_experiment(4000, motor_friction=(0.05, 1.0), kinematic=(2e-4, 1e-4))
    catalogue = (MotorFriction, StribeckMotorFriction, KinematicError)
    loop = close_loop(rig.drive_model(), {"zero-order": (experiment,)}, hold="zero-order", catalogue=catalogue)
    assert loop.decision == "effect_found"
    assert {f.name for f in loop.findings} == {"motor_friction", "kinematic_error"}
    compared = kept_rounds(loop)
    chosen = {this.winner.name: this for this in compared}
    assert set(chosen) == {"motor_friction", "kinematic_error"}
    beside = {e.name for this in compared for v in this.verdicts if v.trial is not None for e in v.trial.model.effects}
    assert "kinematic_error" in beside
    low, high = report_dict(loop)["after"]["parameters"]["K"]["ci95"]
    assert low < rig.K < high and high - low < 1e-2 * rig.K
    assert np.isfinite(loop.after.uncertainty.estimates["K"].std)
