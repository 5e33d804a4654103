"""Fits of candidates: their solver steps, and the objective that they must reach."""

from dataclasses import replace

import pytest

import rig
from fitting.attribution import candidate_fit
from fitting.attribution.candidate_fit import attempt, challenge, completed, continued, first_pass, halo_for
from fitting.attribution.study import Data, Setting, Study
from fitting.estimation.base_fit import base_fit
from fitting.estimation.estimate import Fit, Strategy
from fitting.estimation.experiment import split
from hdjax import Hold, Model
from hdjax.effects.friction import CoulombFriction

HOLD: Hold = "zero-order"
SHARP = 100.0, 0.05
"""Friction and the rate over which its sign changes, too sharp for the solver steps of the base model."""


@pytest.fixture(scope="module")
def base_trial_and_study():
    """The base model's trial on a log of a drive with friction, and the study that trials share."""
    experiment = rig.reduced_experiment(3000, noise=2e-4, rms=30.0, friction=SHARP, substeps=60)
    data: Data = {HOLD: split((experiment,))}
    training = data[HOLD][0]
    base = base_fit(rig.reduced_model(), training, halo=halo_for(training)).fit
    study = Study(data, Setting(base.segmentation))
    return attempt(base.model, study, HOLD), study


def with_friction(model, T_c: float, v_0: float):
    return model.with_effects(CoulombFriction(T_c=T_c, v_0=v_0))


@pytest.mark.slow
def test_candidate_with_sharp_friction_gets_finer_solver_steps(base_trial_and_study):
    """The smooth base model keeps its solver steps; a trial with friction determines the steps that it needs."""
    before, study = base_trial_and_study
    assert study.fine_enough(before.training) is study
    found = challenge(with_friction(before.model, 50.0, 0.3), study, HOLD, champion=before)
    assert found is not None
    assert found.training.substeps == found.held_out.substeps > study.setting.segmentation.substeps
    assert float(found.model.effects[0].T_c) == pytest.approx(SHARP[0], rel=0.02)


def test_candidate_that_explains_less_than_the_limit_is_rejected(base_trial_and_study):
    before, study = base_trial_and_study
    limit = before.training.objective - 20.0
    start = with_friction(before.model, 50.0, 0.3)
    first = first_pass([start], study, HOLD, champion=before)
    assert completed(first, study, HOLD, champion=before, give_up_above=limit) is None


@pytest.mark.parametrize("gain, taken", [(0.0, False), (0.1, True)])
def test_continued_fit_takes_a_shape_beyond_its_bound_only_for_a_gain(
    base_trial_and_study, monkeypatch: pytest.MonkeyPatch, gain: float, taken: bool
):
    before, study = base_trial_and_study
    trial = attempt(with_friction(before.model, 50.0, 0.3), study, HOLD)
    model = trial.model.replace({"coulomb_friction.v_0": -1.0})
    training = replace(trial.training, objective=trial.training.objective - 0.1, model=model)
    held_out = replace(trial.held_out, objective=trial.held_out.objective - gain)
    beyond = replace(trial, model=model, training=training, held_out=held_out)
    monkeypatch.setattr(candidate_fit, "trained", lambda *_: training)
    monkeypatch.setattr(candidate_fit, "_judged", lambda *_: beyond)
    assert continued(trial, study) is (beyond if taken else trial)


def test_shape_that_the_data_do_not_determine_stays_where_it_was(base_trial_and_study, monkeypatch: pytest.MonkeyPatch):
    before, study = base_trial_and_study
    trial = attempt(with_friction(before.model, 50.0, 0.3), study, HOLD)

    def fitted(model: Model, study: Study, hold: Hold, near: Fit, strategy: Strategy) -> Fit:
        """A pass in which the corner runs away, unless it is held."""
        held = isinstance(strategy.hold_parameters, tuple)
        assert not held or strategy.hold_parameters == ("coulomb_friction.v_0",)
        model = model if held else model.replace({"coulomb_friction.v_0": -1.0})
        return replace(trial.training, model=model, objective=trial.training.objective - (0.0999 if held else 0.1))

    monkeypatch.setattr(candidate_fit, "trained", fitted)
    monkeypatch.setattr(candidate_fit, "_judged", lambda fit, *_: replace(trial, model=fit.model, training=fit))
    found = continued(trial, study)
    assert found is not trial
    assert float(found.model.effects[0].v_0) == float(trial.model.effects[0].v_0)
