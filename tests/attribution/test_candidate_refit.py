"""Starts of a refit."""

from dataclasses import replace

import pytest

import rig
from fitting.attribution.candidate_fit import Trial
from fitting.attribution.candidate_refit import _as_sibling
from fitting.estimation.estimate import fit
from fitting.estimation.experiment import whole
from fitting.estimation.problem import Segmentation
from hdjax import Model
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.backlash import Backlash, UndampedBacklash


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
