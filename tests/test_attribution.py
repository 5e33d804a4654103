"""Competitors of one round: what a gain is worth."""

import pytest

import rig
from fitting.attribution import look
from fitting.base_fit import base_fit
from fitting.estimate import segment_length
from fitting.experiment import segment_count, split
from fitting.trial import Setting, Trial, attempt, halo_for
from hdjax import Hold
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.creep import Creep

HOLD: Hold = "zero-order"


@pytest.fixture(scope="module")
def verdicts():
    """Two competitors on data with an offset and a lopsided spring, neither of which is all that is missing."""
    experiment = rig.reduced_experiment(2400, noise=1e-3, bias=0.5, quadratic=0.3)
    data = {HOLD: split((experiment,))}
    training = data[HOLD][0]
    base = base_fit(rig.reduced_model(), training, halo=halo_for(training))
    count = segment_count(training, segment_length(base.horizon))
    setting = Setting(base.horizon, halo_for(training), base.substeps, count)
    before = attempt(base.model, data, HOLD, setting)
    found = look(before, data, setting, catalogue=(TorqueBias, Creep), seed=0, progress=lambda _: None)
    return before, {v.name: v for v in found.verdicts}


def short_gain(before: Trial, trial: Trial) -> float:
    return before.held_out.objective - trial.held_out.objective


def test_without_memory_all_of_a_gain_counts(verdicts):
    before, found = verdicts
    bias = found["torque_bias"]
    assert bias.gain == pytest.approx(short_gain(before, bias.trial))


def test_memory_that_stands_for_something_else_does_not_last(verdicts):
    """Over short segments hidden states that are fitted pass for an offset; over the whole log they relax."""
    before, found = verdicts
    creep = found["creep"]
    assert 0.0 <= creep.gain < 0.7 * short_gain(before, creep.trial)
