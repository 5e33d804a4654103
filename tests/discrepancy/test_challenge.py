"""When named effects stand against a learned term, and when they are withdrawn."""

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.attribution.candidate_fit import Trial
from fitting.attribution.case_evidence import ChallengeEvidence, ModelEvidence
from fitting.attribution.decisions import names_stand, next_question, unknown_ties
from fitting.attribution.effect_search import base_trial
from fitting.attribution.study import Setting, Study
from fitting.discrepancy import challenge as module
from fitting.discrepancy.learn import Unknown
from fitting.discrepancy.variable_selection import Candidate
from fitting.estimation.experiment import split
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.measurement_noise import measurement_noise
from hdjax.effects import Conditions
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.creep import Creep
from hdjax.effects.learned import LearnedMeshTorque
from hdjax.effects.learned_axes import axes_over

NOISE = 1e-3
AXES = axes_over({"v": (-1.0, 1.0)})[0]
LEARNED = LearnedMeshTorque.made_of(AXES, np.eye(AXES[0].count)[:, :1], (1.0,))


NOISE_OBJECTIVE = float(np.log(NOISE))


def model(
    selection: float, *, parameters: int = 5, white: bool = False, training: float | None = None
) -> ModelEvidence:
    return ModelEvidence(selection if training is None else training, selection, parameters, (10.0,), white)


def challenge_evidence(better_by: float, *, beside: bool, fewer: int, **answers) -> ChallengeEvidence:
    """Evidence of names that gain 5 or more, with a learned term in their place that gains 10."""
    instead = model(-10.0, parameters=5 - fewer)
    rival = model(-10.0 + better_by)
    named = model(-5.0) if beside else rival
    return ChallengeEvidence(
        model(0.0),
        named,
        2,
        NOISE_OBJECTIVE,
        False,
        rival if beside else None,
        instead,
        ("instead", "beside"),
        **answers,
    )


@pytest.mark.parametrize(
    ("better_by", "beside", "come_out", "fewer", "one_shape", "stands"),
    [
        (-0.5, True, False, 1, True, True),  # the learned term in their place is worse
        (0.0, True, False, 0, False, False),  # as good as with a term beside them, and different
        (0.0, True, True, 1, False, True),  # as good, and equal to the names
        (0.0, True, True, 0, True, False),  # the learned law has another shape
        (0.0, True, True, -1, True, True),  # another shape, with more parameters
        (0.9, True, True, 0, False, True),
        (0.9, True, True, 1, False, False),  # better by far and simpler
        (0.0, False, False, 1, False, True),  # as good as the names alone
        (0.9, False, False, 0, False, False),
        (0.9, False, True, 1, False, False),
    ],
)
def test_names_stand_unless_a_learned_term_is_better_or_simpler(
    better_by: float, beside: bool, come_out: bool, fewer: int, one_shape: bool, stands: bool
):
    answers = {"come_out": 0.9 if come_out else 0.5, "one_shape": one_shape}
    seen = challenge_evidence(better_by, beside=beside, fewer=fewer, **answers)
    assert any(check.holds for check in names_stand(seen)) == stands


@pytest.mark.parametrize(("longer_worse", "stand"), [(0.0, False), (0.05, False), (3.6, True)])
def test_names_stand_if_the_learned_term_is_worse_in_free_runs(longer_worse: float, stand: bool):
    seen = challenge_evidence(0.9, beside=False, fewer=0, come_out=0.72, longer_worse=longer_worse)
    assert any(check.holds for check in names_stand(seen)) == stand


@pytest.mark.parametrize(
    ("names", "white", "imperfect", "asks_for"),
    [
        (2, True, False, []),
        (2, False, False, ["instead", "beside"]),
        (2, False, True, []),
        (3, False, False, ["instead", "beside"]),
        (0, False, False, ["beside"]),
        (0, True, False, ["beside"]),
    ],
)
def test_learned_terms_to_fit_depend_on_names_and_noise(names: int, white: bool, imperfect: bool, asks_for: list[str]):
    seen = ChallengeEvidence(model(0.0), model(-2.0, white=white), names, NOISE_OBJECTIVE, imperfect)
    asked = []
    while (question := next_question(seen)) is not None:
        asked.append(question)
        seen = seen.answered(question, None)
    assert asked == asks_for
    assert not seen.names or any(check.holds for check in names_stand(seen))


@pytest.mark.parametrize(("come_out", "asks_for"), [(0.5, ["instead"]), (0.9, ["instead", "beside"])])
def test_no_term_is_learned_beside_names_if_one_in_their_place_leaves_noise(come_out: float, asks_for: list[str]):
    """The exception is a learned term that equals the names."""
    seen = ChallengeEvidence(model(0.0), model(-2.0), 1, NOISE_OBJECTIVE, False)
    asked = []
    while (question := next_question(seen)) is not None:
        asked.append(question)
        found = model(-7.0, white=True, parameters=4) if question == "instead" else None
        seen = seen.answered(question, found, come_out=come_out)
    assert asked == asks_for
    assert not any(check.holds for check in names_stand(seen))


@pytest.mark.parametrize(
    ("left", "asks_for"),
    [
        (1.02, ["beside"]),
        (1.15, ["beside"]),  # of a hundredfold error: a twentieth of its logarithm
        (1.3, ["instead", "beside"]),
    ],
)
def test_names_near_the_noise_are_not_challenged_by_a_term_in_their_place(left: float, asks_for: list[str]):
    base, named = (model(float(np.log(ratio * NOISE))) for ratio in (100.0, left))
    seen = ChallengeEvidence(base, named, 1, NOISE_OBJECTIVE, False)
    asked = []
    while (question := next_question(seen)) is not None:
        asked.append(question)
        seen = seen.answered(question, None)
    assert asked == asks_for


@pytest.mark.parametrize(
    ("training", "selection", "little"),
    [
        (0.01, 0.01, True),
        (0.3, 0.01, False),  # the selection data lack the motion where the names fail
        (0.01, 0.3, False),
    ],
)
def test_names_stand_if_a_learned_term_beside_them_adds_little(training: float, selection: float, little: bool):
    """Names that gain 2 on training data and 1 on selection data."""
    base, named = model(0.0), model(-1.0, training=-2.0)
    beside = model(-1.0 - selection, training=-2.0 - training)
    instead = model(-3.0, parameters=named.parameters)
    seen = ChallengeEvidence(base, named, 1, -9.0, False, beside, instead, ("instead", "beside"))
    assert any(check.holds for check in names_stand(seen)) == little


@pytest.mark.parametrize(
    ("better", "fewer", "come_out", "stand"),
    [(0.02, 4, 0.0, False), (0.02, 0, 0.0, True), (0.0, 4, 0.0, True), (0.02, 4, 0.9, True)],
)
def test_names_fall_if_a_learned_term_predicts_better_with_fewer_parameters(
    better: float, fewer: int, come_out: float, stand: bool
):
    """Sidebands of a kinematic error and a resonance, in place of an eccentric encoder that was left out."""
    base, named = model(0.0), model(-1.87, parameters=10)
    beside, instead = model(-1.90, parameters=12), model(-1.87 - better, parameters=10 - fewer)
    asked = ("instead", "beside")
    seen = ChallengeEvidence(base, named, 2, -2.05, False, beside, instead, asked, come_out=come_out)
    assert any(check.holds for check in names_stand(seen)) == stand


@pytest.fixture(scope="module")
def base() -> Trial:
    data = {"zero-order": split((rig.reduced_experiment(1200, noise=NOISE),))}
    return base_trial(rig.reduced_model(), data, "zero-order")[0]


def _with_effects(base: Trial, *effects, objective: float) -> Trial:
    model = base.model.with_effects(*effects)
    return replace(base, model=model, held_out=replace(base.held_out, objective=objective))


@pytest.mark.parametrize(
    ("told", "missed_by", "left"),
    [
        (set(), 0.0, set()),
        (set(), 0.09, set()),  # a small loss, compared with a gain of two
        (set(), 0.2, {"creep", "torque_bias"}),
        ({"torque_bias"}, 0.0, {"torque_bias"}),
        ({"creep"}, 0.0, {"creep"}),
        ({"creep", "torque_bias"}, 0.0, {"creep", "torque_bias"}),
    ],
)
def test_names_without_strength_beside_a_learned_term_are_dropped(
    base: Trial, told: set[str], missed_by: float, left: set[str], monkeypatch: pytest.MonkeyPatch
):
    with_effects = functools.partial(_with_effects, base)

    def refitted_without(fallen, trial, base, study):
        kept = [e for e in trial.model.effects if e.name not in fallen]
        learned = any(isinstance(e, LearnedMeshTorque) for e in kept)
        return with_effects(*kept, objective=-7.0 + missed_by if learned else -5.0)

    monkeypatch.setattr(module, "nonzero_effects", lambda fit, names: told)
    monkeypatch.setattr(module, "refitted_without", refitted_without)
    names = (Creep(k=1.0, tau=1.0, span=1.0), TorqueBias())
    chosen = Candidate(LearnedMeshTorque, ("v",), 1.0, LEARNED, np.zeros((2, 1)))
    named, trial = with_effects(*names, objective=-5.0), with_effects(*names, LEARNED, objective=-7.0)
    motion, push = np.asarray([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), np.ones((2, 3))
    instants = np.arange(2)
    beside = Unknown(named, trial, (), chosen, instants, motion, Conditions(time=jnp.zeros(2)), push, 2.0, 0.005)
    bare, beside = module._without_superfluous(base, named, beside, Study({}, Setting(Segmentation(32))))
    assert {e.name for e in bare.model.effects} == left
    assert (bare is base) == (left == set()) and beside.before is bare
    assert {e.name for e in beside.trial.model.effects} == left | {LEARNED.name}
    # The states of dropped effects are removed with them; creep has one.
    assert beside.states.shape == beside.push.shape == (2, 3 if "creep" in left else 2)
    assert beside.gain == pytest.approx(bare.held_out.objective - beside.trial.held_out.objective)


def test_share_of_a_replacing_term_is_that_of_the_names_that_are_left(base: Trial, monkeypatch: pytest.MonkeyPatch):
    """One of two names is dropped beside a learned term, after a term in their place was learned."""
    with_effects = functools.partial(_with_effects, base)
    names = (Creep(k=1.0, tau=1.0, span=1.0), TorqueBias())
    named, bare = with_effects(*names, objective=-5.0), with_effects(TorqueBias(), objective=-5.0)
    chosen = Candidate(LearnedMeshTorque, ("v",), 1.0, LEARNED, np.zeros((2, 1)))
    motion = np.zeros((2, 2))
    instead, beside = (
        Unknown(before, trial, (), chosen, np.arange(2), motion, Conditions(time=jnp.zeros(2)), motion, 2.0, 0.005)
        for before, trial in (
            (base, with_effects(LEARNED, objective=-6.0)),
            (named, with_effects(*names, LEARNED, objective=-7.0)),
        )
    )
    monkeypatch.setattr(module, "_learned", lambda standing, _: instead if standing.before is base else beside)
    monkeypatch.setattr(module, "_without_learned", lambda *_: None)
    monkeypatch.setattr(module, "_without_superfluous", lambda *_: (bare, replace(beside, before=bare)))
    monkeypatch.setattr(module, "share_of", lambda model, *_: 0.1 * len(model.effects))
    monkeypatch.setattr(module, "_long_errors", lambda *_: None)
    monkeypatch.setattr(module, "nonzero_effects", lambda fit, names: names)
    monkeypatch.setattr(module, "leaves_imperfection", lambda _, __, noise: (False, noise))
    monkeypatch.setattr(module, "leaves_white_noise", lambda _: False)
    monkeypatch.setattr(module.Standing, "left", None)
    study = Study({}, Setting(Segmentation(32)))
    seen = module.challenge_names(base, named, study, noise=measurement_noise(base.training)).seen
    assert seen.asked == ("instead", "beside") and seen.names == 1
    assert seen.come_out == pytest.approx(0.1)


@pytest.mark.parametrize(("objective", "superfluous"), [(-7.0, True), (-6.91, True), (-6.8, False), (-5.0, False)])
def test_learned_term_is_dropped_where_named_effects_reach_its_error(
    base: Trial, objective: float, superfluous: bool, monkeypatch: pytest.MonkeyPatch
):
    with_effects = functools.partial(_with_effects, base)

    named, trial = (
        with_effects(*e, objective=o) for e, o in (((TorqueBias(),), -5.0), ((TorqueBias(), LEARNED), -7.0))
    )
    alone = with_effects(TorqueBias(), objective=objective)
    asked = []
    monkeypatch.setattr(module, "refitted_without", lambda names, *_: asked.append(names) or alone)
    chosen = Candidate(LearnedMeshTorque, ("v",), 1.0, LEARNED, np.zeros((2, 1)))
    no_states = np.zeros((2, 2))
    beside = Unknown(named, trial, (), chosen, np.arange(2), no_states, Conditions(), no_states, 2.0, 0.005)
    study = Study({}, Setting(Segmentation(32)))
    assert module._without_learned(base, named, beside, study) is (alone if superfluous else None)
    assert asked == [{LEARNED.name}]
    assert module._without_learned(base, replace(named, model=base.model), beside, study) is None


@pytest.mark.parametrize(
    ("come_out", "worse", "tied"),
    [
        (0.2, 0.0, True),
        # The learned term is the named law.
        (0.9, 0.0, False),
        # It predicts every block worse.
        (0.2, 3.0, False),
    ],
)
def test_a_learned_term_that_differs_from_the_names_may_be_tied_with_them(come_out: float, worse: float, tied: bool):
    scatter = np.random.default_rng(1).normal(size=40)
    behind = tuple(scatter - scatter.mean() + worse)
    seen = challenge_evidence(-0.1, beside=False, fewer=0, come_out=come_out, behind=behind)
    assert any(check.holds for check in unknown_ties(seen)) == tied
    assert unknown_ties(replace(seen, behind=())) == ()
