"""Candidates of one selection round: how their gains count and who leads."""

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
from fitting.attribution.case_evidence import EffectEvidence
from fitting.attribution.score import block_scores
from fitting.attribution.screening import Lead, Screen
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
from hdjax.effects.friction import MotorFriction, ViscousMotorFriction
from hdjax.effects.position import PositionDependentMotorFriction
from hdjax.effects.presliding import DahlMotorFriction

HOLD: Hold = "zero-order"
STUDY = Study({}, Setting(Segmentation(32, halo=4, substeps=2, count=8)))


@pytest.fixture(scope="module")
def verdicts():
    """Two candidates on data with a bias and a quadratic spring, neither of which explains both."""
    experiment = rig.reduced_experiment(2400, noise=1e-3, bias=0.5, quadratic=0.3)
    data = {HOLD: split((experiment,))}
    training = data[HOLD][0]
    base = base_fit(rig.reduced_model(), training, halo=halo_for(training)).fit
    study = Study(data, Setting(base.segmentation))
    before = attempt(base.model, study, HOLD)
    standing = Standing(before, before, measurement_noise(before.training))
    found = look(standing, study, catalogue=(TorqueBias, Creep))
    return before, {v.name: v for v in found.verdicts}


def short_gain(before: Trial, trial: Trial) -> float:
    return before.held_out.objective - trial.held_out.objective


def test_gain_of_a_form_without_memory_counts_fully(verdicts):
    before, found = verdicts
    bias = found["torque_bias"]
    assert bias.gain == pytest.approx(short_gain(before, bias.trial))


def test_gain_of_a_wrong_form_with_memory_shrinks_over_whole_stretches(verdicts):
    """Over short segments, fitted hidden states can imitate a bias; over the whole log they relax."""
    before, found = verdicts
    creep = found["creep"]
    assert 0.0 <= creep.gain < 0.7 * short_gain(before, creep.trial)


@pytest.mark.parametrize(
    ("long_before", "long_after", "share"),
    [
        (-2.0, -2.6, 0.6),
        (-2.0, -9.0, 1.0),
        (-2.0, -1.0, 0.0),  # like a resonance that imitates a wrong torque: it moves the motor alone
        (-2.0, 3.0, 0.0),
        (3.0, -2.0, 1.0),
        (3.0, 3.0, 1.0),  # neither follows the drive, so that whole stretches decide nothing
    ],
)
def test_lasting_share_is_that_of_the_gain_over_whole_stretches(
    verdicts, long_before: float, long_after: float, share: float, monkeypatch: pytest.MonkeyPatch
):
    trial, _ = verdicts

    def with_objective(value: float) -> Trial:
        return replace(trial, held_out=replace(trial.held_out, objective=value))

    before, after = with_objective(0.0), with_objective(-1.0)
    long = {0.0: long_before, -1.0: long_after}
    monkeypatch.setattr(of_a_trial, "over_whole_stretches", lambda f, **_: replace(f, objective=long[f.objective]))
    monkeypatch.setattr(of_a_trial, "without_gaps", lambda f: f)
    monkeypatch.setattr(of_a_trial, "follows", lambda f: f.objective < 0.0)
    assert of_a_trial.lasting_share(Creep(k=1.0, tau=1.0, span=1.0), before, after) == pytest.approx(share)
    assert of_a_trial.lasting_share(TorqueBias(), before, after) == 1.0
    assert of_a_trial.lasting_share(Creep(k=1.0, tau=1.0, span=1.0), after, before) == 1.0


def test_gain_over_whole_stretches_is_that_of_the_principal_output(verdicts, monkeypatch: pytest.MonkeyPatch):
    """A motor that nothing holds drifts with the smallest error of a torque, which says nothing about a law."""
    trial, _ = verdicts

    def with_errors(motor: float, twist: float) -> Trial:
        covariance = jnp.diag(jnp.asarray([motor, twist]) ** 2)
        return replace(trial, held_out=replace(trial.held_out, covariance=covariance))

    monkeypatch.setattr(of_a_trial, "over_whole_stretches", lambda f, **_: f)
    monkeypatch.setattr(of_a_trial, "without_gaps", lambda f: f)
    monkeypatch.setattr(of_a_trial, "follows", lambda f: True)
    before, drifting, wrong, lost = (with_errors(*e) for e in ((9.0, 8.0), (3.0, 1.0), (0.1, 4.0), (1.0, np.nan)))
    gains = of_a_trial.long_gains(before, [drifting, wrong, lost])
    assert gains == pytest.approx([np.log(8.0), np.log(2.0), -np.inf])


@pytest.mark.parametrize(
    ("before_is_white", "white", "exempt", "least"),
    [
        (False, False, None, 0.02),
        (False, True, None, 0.0),  # what leaves only noise shows that the laws are exact
        (True, True, None, 0.02),  # only noise was left before
        (False, False, (Creep,), 0.02),
        (False, False, (TorqueBias,), 0.0),
        (False, True, (Creep,), 0.0),
    ],
)
def test_further_effect_must_remove_more_than_laws_may_get_wrong_unless_only_noise_is_left(
    verdicts, before_is_white: bool, white: bool, exempt, least: float, monkeypatch: pytest.MonkeyPatch
):
    before, found = verdicts
    monkeypatch.setattr(support, "imperfection", lambda kept: 0.01)
    monkeypatch.setattr(support, "leaves_white_noise", lambda fit: before_is_white if fit is before.training else white)
    standing = Standing(before, before, measurement_noise(before.training), exempt=exempt)
    assert attribution._evidence(found["torque_bias"], standing).imperfection == least


@pytest.mark.parametrize(
    ("bias_long", "creep_long", "leader"),
    [
        (2.00, 2.01, "torque_bias"),  # equal: the simpler one
        (1.00, 2.00, "creep"),
        (2.00, 1.00, "torque_bias"),
        (None, 2.00, "creep"),  # no model follows whole stretches: short segments decide
        (-np.inf, -np.inf, "creep"),  # none gains anything: likewise
    ],
)
def test_whole_stretches_decide_between_tied_candidates(
    verdicts, bias_long: float | None, creep_long: float, leader: str, monkeypatch: pytest.MonkeyPatch
):
    before, found = verdicts
    gains = {"torque_bias": 0.95, "creep": 1.0}
    tied = [Verdict(n, found[n].family, found[n].trial, g, 0.005, False) for n, g in gains.items()]
    tied.sort(key=lambda v: -v.gain)
    long = {id(found["torque_bias"].trial): bias_long, id(found["creep"].trial): creep_long}

    def long_gains(before, trials):
        gains = [long[id(trial)] for trial in trials]
        return None if None in gains else gains

    monkeypatch.setattr(attribution, "long_gains", long_gains)
    ordered, _ = attribution.simplest_first(tied, before)
    assert ordered[0].name == leader


@pytest.mark.parametrize(
    ("creep_long", "leader"),
    [(1.0, "torque_bias"), (3.0, "creep")],
)
def test_form_with_memory_leads_only_with_a_gain_over_whole_stretches(
    verdicts, creep_long: float, leader: str, monkeypatch: pytest.MonkeyPatch
):
    """A form with memory leads another form only if it gains more over whole stretches, which then separate the two."""
    before, found = verdicts
    bias, creep = found["torque_bias"], found["creep"]
    ordered = [
        Verdict("creep", creep.family, creep.trial, 0.1, 0.005, False),
        Verdict("torque_bias", bias.family, bias.trial, 0.05, 0.005, True),
    ]
    long = {id(bias.trial): 2.0, id(creep.trial): creep_long}
    monkeypatch.setattr(attribution, "long_gains", lambda before, trials: [long[id(t)] for t in trials])
    (first, second), rivals = attribution.simplest_first(ordered, before)
    assert {r.name: r.long_gain for r in rivals} == {"torque_bias": 2.0, "creep": creep_long}
    assert (first.name, first.separable, second.separable) == (leader, False, True)


def test_form_without_memory_is_preferred_at_equal_parameter_count(verdicts, monkeypatch: pytest.MonkeyPatch):
    _, found = verdicts
    monkeypatch.setattr(attribution, "long_gains", lambda before, trials: [1.0] * len(trials))

    def verdict(effect: Effect) -> Verdict:
        model = rig.drive_model().with_effects(effect)
        trial = eqx.tree_at(lambda t: t.model, found["torque_bias"].trial, model)
        return Verdict(effect.name, effect.family, trial, 1.0, 0.005, False)

    dahl, dry = DahlMotorFriction(T_c=0.1, bend=0.1, settling=1e-3), MotorFriction(T_c=0.1, transition=0.1)
    assert len(effect_paths(dahl)) == len(effect_paths(dry))
    ordered, _ = attribution.simplest_first([verdict(dahl), verdict(dry)], found["creep"].trial)
    assert [v.name for v in ordered] == ["motor_friction", "dahl_motor_friction"]


def test_ties_are_those_of_the_first_candidate(verdicts, monkeypatch: pytest.MonkeyPatch):
    """A candidate that is worse than the best one may be tied with the simpler one that was chosen."""
    _, found = verdicts
    names = ("best", "chosen", "third")
    trials = [replace(found["torque_bias"].trial, lasting=share) for share in (1.0, 0.9, 0.8)]
    blocks = {
        1.0: np.array([1.0, 1.0, 1.0, 5.0]),
        0.9: np.array([0.0, 0.5, 1.5, 5.0]),
        0.8: np.array([0.0, 0.4, 0.6, 4.7]),
    }
    monkeypatch.setattr(attribution, "block_scores", lambda trial, whitening: blocks[trial.lasting])
    candidates = [Verdict(n, "family", t, t.lasting, 0.001, True) for n, t in zip(names, trials, strict=True)]

    def tied(order: list[Verdict]) -> list[str]:
        return [v.name for v in attribution.with_ties(order)[0] if not v.separable]

    best, chosen, third = candidates
    assert tied([best, chosen, third]) == ["best", "chosen"]
    assert tied([chosen, best, third]) == ["chosen", "best", "third"]


def test_a_simpler_form_of_less_gain_is_asked_where_noise_explains_the_residual(verdicts):
    """Against a noise model no least gain is asked for, and each parameter costs some likelihood."""
    _, found = verdicts
    trial = found["torque_bias"].trial
    over_noise = {"with_four_parameters": -5.0, "with_one_parameter": 12.0}
    tried = [Verdict(name, "family", trial, 0.0007, 0.002, False) for name in over_noise]

    def ask(verdict: Verdict) -> EffectEvidence:
        return EffectEvidence(verdict.name, verdict.gain, verdict.p_value, over_noise=over_noise[verdict.name])

    ordered, asked, accepted = attribution._supported_first(tried, ask)
    assert accepted and ordered[0].name == "with_one_parameter" and len(asked) == 2


def test_hopeless_candidates_are_skipped_but_the_first_is_asked(verdicts):
    """Whole stretches may choose one that gains less over short segments than those behind it."""
    _, found = verdicts
    trial = found["torque_bias"].trial
    chosen, none, better = (
        Verdict(name, "family", trial, gain, p, True)
        for name, gain, p in (("chosen", 0.01, 0.3), ("none", -1.0, 1.0), ("better", 0.1, 0.002))
    )

    def ask(verdict: Verdict) -> EffectEvidence:
        return EffectEvidence(verdict.name, verdict.gain, verdict.p_value)

    ordered, asked, accepted = attribution._supported_first([chosen, none, better], ask)
    assert accepted and [v.name for v in ordered] == ["better", "chosen", "none"]
    assert [seen.name for seen in asked] == ["chosen", "better"]
    ordered, asked, accepted = attribution._supported_first([chosen, none], ask)
    assert not accepted and ordered == [chosen, none] and [seen.name for seen in asked] == ["chosen"]


def test_blocks_are_the_same_for_a_candidate_without_samples_in_a_segment(verdicts):
    """A delay of an encoder moves its readings beyond the end of the log."""
    before, _ = verdicts
    last = int(before.held_out.pieces.sum()) - 1
    moved = eqx.tree_at(
        lambda t: (t.held_out.error, t.held_out.problem.segments.weight),
        before,
        replace_fn=lambda values: values.at[last].set(0.0),
    )
    whitening = np.asarray(before.held_out.problem.whitening)
    every, some = block_scores(before, whitening), block_scores(moved, whitening)
    assert every.size == some.size == last + 1
    np.testing.assert_array_equal(every[:-1], some[:-1])
    assert some[-1] == 0.0 > every[-1]


def test_forms_that_the_best_one_contains_are_refitted(verdicts, monkeypatch: pytest.MonkeyPatch):
    before, found = verdicts
    wide, narrow, other = (
        MotorFriction(transition=0.1),
        ViscousMotorFriction(),
        DahlMotorFriction(bend=1.0, settling=1.0),
    )
    screened = Screen(tuple(Lead(e, {}, 1.0) for e in (wide, narrow, other)), np.zeros(1))
    trial = eqx.tree_at(lambda t: t.model, found["torque_bias"].trial, rig.drive_model().with_effects(wide))
    asked = []

    def refit(self, leads, study, share=0.0):
        asked.extend(lead.effect.name for lead in leads)

    refits = attribution._Refits(before, STUDY)
    refits.done = {wide.name: trial}
    monkeypatch.setattr(attribution._Refits, "_likely", lambda self, screened: None)
    monkeypatch.setattr(attribution._Refits, "_refit", refit)
    refits.in_proportion(screened)
    assert asked == [narrow.name]


def with_error(trial: Trial, rms: float, *, by_effects: float = 0.0) -> Trial:
    """A trial with given errors on selection data [urad]: what other effects remove, and what is orthogonal to that."""
    turns = np.cumsum(np.ones_like(np.asarray(trial.held_out.error)), axis=1) % 2 * 2.0 - 1.0
    return eqx.tree_at(
        lambda t: (t.held_out.covariance, t.held_out.error),
        trial,
        (jnp.asarray([[1e-12 * (rms**2 + by_effects**2)]]), jnp.asarray(1e-6 * (by_effects + rms * turns))),
    )


def test_removed_share_is_relative_to_earlier_effects(verdicts):
    """With errors of 1000 and 1 in units of the noise, the last unit is 1e-3 of the influence of earlier effects; where
    these leave as much, since another effect hides theirs, that is no excuse."""
    trial, _ = verdicts
    base, before, after = with_error(trial, 1.0, by_effects=1000.0), with_error(trial, 1.0), with_error(trial, 0.0)
    assert support.share_of_removed(after, before, base) == pytest.approx(1e-3, rel=1e-3)
    assert support.share_of_removed(after, base, base) == np.inf
    hidden = with_error(trial, 1000.0, by_effects=30.0), with_error(trial, 1000.1)
    assert support.share_of_removed(after, hidden[1], hidden[0]) == pytest.approx(1000.0 / 30.0, rel=1e-2)


@pytest.mark.parametrize(
    ("effect", "left", "noise", "is_all", "asked"),
    [
        (TorqueBias(), 2.0, 1.0, True, True),  # 1.7 units beyond the noise, of 1000 that were removed earlier
        (TorqueBias(), 5.0, 1.0, False, True),
        (MotorFriction(T_c=0.1, transition=0.1), 5.0, 1.0, True, True),  # the law of friction near rest is uncertain
        (MotorFriction(T_c=0.1, transition=0.1), 20.0, 1.0, False, False),  # the base model's noise suffices to decide
        (TorqueBias(), 5.0, 4.9, True, True),
        (None, 0.0, 1.0, False, False),
    ],
)
def test_search_ends_when_only_imperfection_of_effects_is_left(
    verdicts,
    effect: Effect | None,
    left: float,
    noise: float,
    is_all: bool,
    asked: bool,
    monkeypatch: pytest.MonkeyPatch,
):
    trial, _ = verdicts

    def seen_as(rms: float) -> MeasurementNoise:
        return MeasurementNoise(jnp.asarray([[1e-12 * rms**2]]), ())

    monkeypatch.setattr(MeasurementNoise, "and_beside", lambda self, fit: seen_as(noise))
    base, by_base = with_error(trial, left, by_effects=1000.0), seen_as(5.0)
    before = base
    if effect is not None:
        before = eqx.tree_at(lambda t: t.model, with_error(trial, left), rig.drive_model().with_effects(effect))
    found, seen = support.leaves_imperfection(before, base, by_base)
    assert found == is_all
    assert (seen is not by_base) == asked


def has_nonzero_strength(verdicts, effect, covariance: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether a strength counts as nonzero beside a parameter of the drive, in a fit with this covariance."""
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


def test_strength_counts_as_nonzero_at_the_fitted_shape(verdicts, monkeypatch: pytest.MonkeyPatch):
    """Only the ratio of creep stiffness and creep time is determined, but at the fitted time the stiffness is known."""
    creep = Creep(k=400.0, tau=0.5, span=1e-3)
    along_valley = np.diag([1.0, 0.0, 0.0])
    along_valley[1:, 1:] = np.outer([400.0, 1.0], [400.0, 1.0])
    assert has_nonzero_strength(verdicts, creep, along_valley + np.diag([0.0, 50.0**2, 0.0]), monkeypatch)
    assert not has_nonzero_strength(verdicts, creep, along_valley + np.diag([0.0, 400.0**2, 0.0]), monkeypatch)
    assert not has_nonzero_strength(verdicts, creep, np.diag([1.0, 400.0**2, 1.0]), monkeypatch)


def test_defining_strength_of_an_effect_must_be_nonzero(verdicts, monkeypatch: pytest.MonkeyPatch):
    """Position-dependent friction needs a nonzero ripple, however well its mean is known."""
    rippling = PositionDependentMotorFriction(T_c=0.1, cosine=2e-3, sine=0.0, n=2.0, transition=0.1)
    std = dict.fromkeys(effect_paths(rippling), 1e-4)
    assert has_nonzero_strength(verdicts, rippling, np.diag([1.0, *(s**2 for s in std.values())]), monkeypatch)
    std |= {f"{rippling.name}.{n}": 1e-3 for n in ("cosine", "sine")}
    assert not has_nonzero_strength(verdicts, rippling, np.diag([1.0, *(s**2 for s in std.values())]), monkeypatch)
