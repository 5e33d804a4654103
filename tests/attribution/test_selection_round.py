"""Competitors of one round: what a gain is worth."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.attribution import candidate_fit as of_a_trial
from fitting.attribution import selection_round as attribution
from fitting.attribution import support
from fitting.attribution.candidate_fit import Trial, attempt, halo_for
from fitting.attribution.selection_round import Verdict, look
from fitting.attribution.study import Setting, Study
from fitting.attribution.support import Standing
from fitting.estimation.base_fit import base_fit
from fitting.estimation.experiment import split
from fitting.estimation.free_parameters import effect_paths
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.measurement_noise import MeasurementNoise, measurement_noise
from fitting.uncertainty.standard_errors import Estimate, Uncertainty
from hdjax import Hold
from hdjax.effects import Effect
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.creep import Creep
from hdjax.effects.friction import MotorFriction
from hdjax.effects.position import PositionDependentMotorFriction
from hdjax.effects.presliding import DahlMotorFriction

HOLD: Hold = "zero-order"
STUDY = Study({}, Setting(Segmentation(32, halo=4, substeps=2, count=8)))


@pytest.fixture(scope="module")
def verdicts():
    """Two competitors on data with an offset and a lopsided spring, neither of which is all that is missing."""
    experiment = rig.reduced_experiment(2400, noise=1e-3, bias=0.5, quadratic=0.3)
    data = {HOLD: split((experiment,))}
    training = data[HOLD][0]
    base = base_fit(rig.reduced_model(), training, halo=halo_for(training))
    study = Study(data, Setting(base.segmentation))
    before = attempt(base.model, study, HOLD)
    standing = Standing(before, before, measurement_noise(before.training))
    found = look(standing, study, catalogue=(TorqueBias, Creep))
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


@pytest.mark.parametrize(
    ("long_before", "long_after", "share"),
    [
        (-2.0, -2.6, 0.6),
        (-2.0, -9.0, 1.0),
        (-2.0, -1.0, 0.0),  # as of a resonance that stood for a torque that is off: it moved the motor alone
        (-2.0, 3.0, 0.0),
        (3.0, -2.0, 1.0),
        (3.0, 3.0, 1.0),  # neither follows the drive: nothing is told
    ],
)
def test_what_lasts_is_what_whole_stretches_gain(
    verdicts, long_before: float, long_after: float, share: float, monkeypatch: pytest.MonkeyPatch
):
    trial, _ = verdicts

    def with_objective(value: float) -> Trial:
        return replace(trial, held_out=replace(trial.held_out, objective=value))

    before, after = with_objective(0.0), with_objective(-1.0)
    long = {0.0: long_before, -1.0: long_after}
    monkeypatch.setattr(of_a_trial, "over_whole_stretches", lambda f, **_: replace(f, objective=long[f.objective]))
    monkeypatch.setattr(of_a_trial, "follows", lambda f: f.objective < 0.0)
    assert of_a_trial.lasting_share(Creep(k=1.0, tau=1.0, span=1.0), before, after) == pytest.approx(share)
    assert of_a_trial.lasting_share(TorqueBias(), before, after) == 1.0
    assert of_a_trial.lasting_share(Creep(k=1.0, tau=1.0, span=1.0), after, before) == 1.0


@pytest.mark.parametrize(
    ("bias_long", "creep_long", "leader"),
    [
        (2.00, 2.01, "torque_bias"),  # the same: the simpler one
        (1.00, 2.00, "creep"),
        (2.00, 1.00, "torque_bias"),
        (None, 2.00, "creep"),  # free runs tell nothing: what short segments tell
        (-np.inf, -np.inf, "torque_bias"),
    ],
)
def test_free_runs_tell_apart_what_short_segments_cannot(
    verdicts, bias_long: float | None, creep_long: float, leader: str, monkeypatch: pytest.MonkeyPatch
):
    before, found = verdicts
    gains = {"torque_bias": 0.95, "creep": 1.0}
    tied = [Verdict(n, found[n].family, found[n].trial, g, 0.005, False) for n, g in gains.items()]
    tied.sort(key=lambda v: -v.gain)
    long = {id(found["torque_bias"].trial): bias_long, id(found["creep"].trial): creep_long}

    def long_gains(before, trials, study):
        gains = [long[id(trial)] for trial in trials]
        return None if None in gains else gains

    monkeypatch.setattr(attribution, "long_gains", long_gains)
    ordered, _ = attribution._simplest_first(tied, before, STUDY)
    assert ordered[0].name == leader


@pytest.mark.parametrize(
    ("creep_long", "leader"),
    [(1.0, "torque_bias"), (3.0, "creep")],
)
def test_whole_stretches_judge_what_remembers(
    verdicts, creep_long: float, leader: str, monkeypatch: pytest.MonkeyPatch
):
    """A form with memory leads another one that gains only where it does so over whole stretches; these then tell the
    two apart."""
    before, found = verdicts
    bias, creep = found["torque_bias"], found["creep"]
    ordered = [
        Verdict("creep", creep.family, creep.trial, 0.1, 0.005, False),
        Verdict("torque_bias", bias.family, bias.trial, 0.05, 0.005, True),
    ]
    long = {id(bias.trial): 2.0, id(creep.trial): creep_long}
    monkeypatch.setattr(attribution, "long_gains", lambda before, trials, study: [long[id(t)] for t in trials])
    (first, second), rivals = attribution._simplest_first(ordered, before, STUDY)
    assert {r.name: r.long_gain for r in rivals} == {"torque_bias": 2.0, "creep": creep_long}
    assert (first.name, first.separable, second.separable) == (leader, False, True)


def test_of_as_many_parameters_the_one_without_memory_is_simpler(verdicts, monkeypatch: pytest.MonkeyPatch):
    _, found = verdicts
    monkeypatch.setattr(attribution, "long_gains", lambda before, trials, study: [1.0] * len(trials))

    def verdict(effect: Effect) -> Verdict:
        model = rig.drive_model().with_effects(effect)
        trial = eqx.tree_at(lambda t: t.model, found["torque_bias"].trial, model)
        return Verdict(effect.name, effect.family, trial, 1.0, 0.005, False)

    dahl, dry = DahlMotorFriction(T_c=0.1, bend=0.1, settling=1e-3), MotorFriction(T_c=0.1, transition=0.1)
    assert len(effect_paths(dahl)) == len(effect_paths(dry))
    ordered, _ = attribution._simplest_first([verdict(dahl), verdict(dry)], found["creep"].trial, STUDY)
    assert [v.name for v in ordered] == ["motor_friction", "dahl_motor_friction"]


def test_what_the_effects_before_may_get_wrong_is_no_further_effect(verdicts):
    """Errors of 1000 and 1 in units of the noise: the last unit is a thousandth of what was removed before."""
    trial, _ = verdicts

    def with_error(rms: float) -> Trial:
        return eqx.tree_at(lambda t: t.held_out.covariance, trial, jnp.asarray([[1.0 + rms**2]]))

    base, before, after = with_error(1000.0), with_error(1.0), with_error(0.0)
    assert support.share_of_removed(after, before, base) == pytest.approx(1e-3, rel=1e-3)
    assert support.share_of_removed(after, base, base) == np.inf


@pytest.mark.parametrize(
    ("effect", "left", "noise", "is_all", "asked"),
    [
        (TorqueBias(), 2.0, 1.0, True, True),  # 1.7 units beyond the noise, of 1000 that were removed
        (TorqueBias(), 5.0, 1.0, False, True),
        (MotorFriction(T_c=0.1, transition=0.1), 5.0, 1.0, True, True),  # nobody knows how a sign turns near rest
        (MotorFriction(T_c=0.1, transition=0.1), 20.0, 1.0, False, False),  # even the base model tells
        (TorqueBias(), 5.0, 4.9, True, True),
        (None, 0.0, 1.0, False, False),
    ],
)
def test_where_only_what_laws_get_wrong_is_left_no_further_effect_is_looked_for(
    verdicts,
    effect: Effect | None,
    left: float,
    noise: float,
    is_all: bool,
    asked: bool,
    monkeypatch: pytest.MonkeyPatch,
):
    trial, _ = verdicts

    def with_error(rms: float, *effects: Effect) -> Trial:
        parts = (rig.drive_model().with_effects(*effects), jnp.asarray([[rms**2]]))
        return eqx.tree_at(lambda t: (t.model, t.held_out.covariance), trial, parts)

    def seen_as(rms: float) -> MeasurementNoise:
        return MeasurementNoise(jnp.asarray([[rms**2]]), ())

    monkeypatch.setattr(MeasurementNoise, "and_beside", lambda self, fit: seen_as(noise))
    base, by_base = with_error(1000.0), seen_as(5.0)
    before = base if effect is None else with_error(left, effect)
    found, seen = support.leaves_imperfection(before, base, by_base)
    assert found == is_all
    assert (seen is not by_base) == asked


def nonzero_effects(verdicts, effect, covariance: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether a strength counts as determined beside a parameter of the drive, by a fit with this covariance."""
    drive, own = (rig.drive_model(), "B_sp") if effect.needs_motor else (rig.reduced_model(), "mu")
    model = drive.with_effects(effect)
    paths = (own, *effect_paths(effect))
    spread = np.sqrt(np.diag(covariance))
    values = {p: float(model.get(p)) for p in paths}
    estimates = {
        p: Estimate(p, v, s, s, (v - 1.96 * s, v + 1.96 * s), "", False)
        for (p, v), s in zip(values.items(), spread, strict=True)
    }
    found = Uncertainty(estimates, covariance / np.outer(spread, spread), covariance, covariance)
    monkeypatch.setattr(support, "uncertainty", lambda *args, **options: found)
    before, _ = verdicts
    return support.nonzero_effects(eqx.tree_at(lambda f: f.model, before.training, model), {effect.name}) != set()


def test_a_strength_in_a_valley_of_shapes_is_determined(verdicts, monkeypatch: pytest.MonkeyPatch):
    """A creep's stiffness over its time is known, neither of them is; at the fitted time the stiffness is known."""
    creep = Creep(k=400.0, tau=0.5, span=1e-3)
    along_valley = np.diag([1.0, 0.0, 0.0])
    along_valley[1:, 1:] = np.outer([400.0, 1.0], [400.0, 1.0])
    assert nonzero_effects(verdicts, creep, along_valley + np.diag([0.0, 50.0**2, 0.0]), monkeypatch)
    assert not nonzero_effects(verdicts, creep, along_valley + np.diag([0.0, 400.0**2, 0.0]), monkeypatch)
    assert not nonzero_effects(verdicts, creep, np.diag([1.0, 400.0**2, 1.0]), monkeypatch)


def test_what_an_effect_is_named_for_must_be_there(verdicts, monkeypatch: pytest.MonkeyPatch):
    """Rippling friction whose ripple may be zero is friction, however well that is known."""
    rippling = PositionDependentMotorFriction(T_c=0.1, cosine=2e-3, sine=0.0, n=2.0, transition=0.1)
    std = dict.fromkeys(effect_paths(rippling), 1e-4)
    assert nonzero_effects(verdicts, rippling, np.diag([1.0, *(s**2 for s in std.values())]), monkeypatch)
    std |= {f"{rippling.name}.{n}": 1e-3 for n in ("cosine", "sine")}
    assert not nonzero_effects(verdicts, rippling, np.diag([1.0, *(s**2 for s in std.values())]), monkeypatch)
