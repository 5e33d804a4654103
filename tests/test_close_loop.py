"""The whole loop with few candidates: the missing effect is identified, and none is found where none is missing."""

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module

import jax
import numpy as np
import pytest

import rig
from fitting.attribution.case_evidence import ChallengeEvidence
from fitting.attribution.decisions import decide
from fitting.attribution.effect_search import _holds_given_up
from fitting.attribution.rules import RULES
from fitting.attribution.selection_round import Round, Verdict
from fitting.discrepancy.challenge import Challenge, model_evidence
from fitting.estimation.experiment import Experiment, experiment_from_log
from fitting.loop import _named_findings, close_loop
from fitting.outcome import Loop
from fitting.search_options import SearchOptions
from fitting.uncertainty.noise_model import noise_model
from hdjax import Hold
from hdjax.effects import Effect
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.damping import QuadraticDamping
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.load import GravityLoad
from hdjax.effects.stiffness import QuadraticStiffness

COUNT, REDUCED_COUNT = 2000, 1200
BIAS = 0.02
FRICTION = (10.0, 0.3)
CATALOGUE: tuple[type[Effect], ...] = (TorqueBias, GravityLoad, QuadraticStiffness)
REDUCED_CATALOGUE: tuple[type[Effect], ...] = (CoulombFriction, QuadraticStiffness)
X_NOISE = np.hypot(rig.MOTOR_NOISE / rig.N, rig.LOAD_NOISE)
REDUCED_NOISE = 1e-3


def reduced_loop(experiment: Experiment, *, catalogue: Sequence[type[Effect]] = REDUCED_CATALOGUE, **options) -> Loop:
    """Close the loop from placeholders that are wrong by a factor of a hundred, with one effect at most: each further
    round has to compile again."""
    placeholder = rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0)
    return close_loop(
        placeholder, {"zero-order": (experiment,)}, catalogue=catalogue, search=SearchOptions(1), **options
    )


def drive_loop(experiment: Experiment, **options) -> Loop:
    placeholder = rig.drive_model(K=1.0, alpha=0.0, B_sp=0.0)
    return close_loop(
        placeholder, {"zero-order": (experiment,)}, catalogue=CATALOGUE, search=SearchOptions(1), **options
    )


@pytest.fixture(scope="module")
def friction_loop() -> tuple[Loop, list[str]]:
    told: list[str] = []
    experiment = rig.reduced_experiment(REDUCED_COUNT, noise=REDUCED_NOISE, friction=FRICTION)
    return reduced_loop(experiment, progress=told.append), told


def test_coulomb_friction_is_identified(friction_loop):
    found, told = friction_loop
    assert found.decision == "effect_found"
    (finding,) = found.findings
    assert (finding.family, finding.name) == ("coulomb_friction", "coulomb_friction")
    assert finding.p_value <= 0.01
    assert finding.gain > 0.2
    assert found.dropped == ()
    assert found.hold == "zero-order"
    assert any("found coulomb_friction" in message for message in told)


def test_parameters_are_unbiased_once_the_effect_is_added(friction_loop):
    after = friction_loop[0].after
    truth = {
        "omega_0": rig.OMEGA_0,
        "alpha": rig.REDUCED_ALPHA,
        "mu": rig.MU,
        "gain": rig.GAIN,
        "coulomb_friction.T_c": FRICTION[0],
    }
    assert set(truth) < set(after.uncertainty.estimates)
    for path, value in truth.items():
        estimate = after.uncertainty.estimates[path]
        assert abs(estimate.value - value) < 4 * estimate.std, (path, estimate)
    # Without friction in the model, its dissipation biases the damping by many standard errors.
    before = friction_loop[0].before.uncertainty.estimates["mu"]
    assert before.value - rig.MU > 5 * before.std


def test_error_on_selection_data_falls_to_the_noise(friction_loop):
    found, _ = friction_loop
    assert found.after.rmse["selection"] < found.before.rmse["selection"]
    assert found.after.rmse["selection"] < 1.3 * REDUCED_NOISE
    assert np.sqrt(float(found.noise[0, 0])) == pytest.approx(REDUCED_NOISE, rel=0.1)
    training, selection = found.stretches
    assert [len(s) for s in training + selection] == [960, 240]
    assert found.after.selection[0].time.size == 240
    assert not np.any(np.isin(found.after.selection[0].time, found.after.training[0].time))


def test_no_effect_is_found_where_none_is_missing():
    clean = reduced_loop(rig.reduced_experiment(REDUCED_COUNT, noise=REDUCED_NOISE))
    assert clean.decision == "model_sufficient"
    assert clean.findings == ()
    assert clean.after is clean.before
    assert not clean.rounds[0].accepted
    assert float(clean.before.model.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=1e-3)
    assert clean.before.rmse["selection"] < 1.3 * REDUCED_NOISE


@pytest.mark.slow
def test_torque_bias_of_a_drive_is_identified():
    found = drive_loop(rig.drive_experiment(COUNT, torque_bias=BIAS))
    assert found.decision == "effect_found"
    (finding,) = found.findings
    assert (finding.family, finding.name) == ("torque_sensor", "torque_bias")
    assert finding.p_value <= 0.01
    assert finding.gain > 0.3
    assert float(finding.effect.bias) == pytest.approx(BIAS, rel=0.05)
    # The placeholder is wrong by a factor of thousands.
    assert float(found.after.model.get("K")) == pytest.approx(rig.K, rel=2e-3)
    assert float(found.after.model.get("alpha")) == pytest.approx(rig.ALPHA, rel=0.1)
    assert found.after.rmse["selection"] < 2 * X_NOISE


@pytest.mark.slow
def test_base_model_suffices_for_a_drive_without_effects():
    clean = drive_loop(rig.drive_experiment(COUNT))
    assert clean.decision == "model_sufficient"
    assert clean.findings == ()
    assert float(clean.before.model.get("K")) == pytest.approx(rig.K, rel=2e-3)


@pytest.mark.slow
def test_gravity_load_larger_than_the_motor_torque_is_identified():
    """No minimum of the base model is near the true parameters; gravity is found with the base parameters fixed."""
    torque = np.repeat(0.1 * np.random.default_rng(0).normal(size=20), 300)
    log = rig.drive_log(rig.drive_motion(torque, gravity=20.0), torque, noise=0.1)
    found = drive_loop(experiment_from_log(log, hold="zero-order", N=rig.N))
    assert found.decision == "effect_found"
    (finding,) = found.findings
    assert finding.name == "gravity_load" and float(finding.effect.sine) == pytest.approx(20.0, rel=1e-4)
    assert float(found.after.model.get("K")) == pytest.approx(rig.K, rel=1e-4)
    before = found.before.uncertainty.estimates["K"]
    assert abs(before.value / rig.K - 1) < 0.02
    assert before.std < rig.K


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [2.0, 10.0])
def test_ground_spring_is_learned_and_not_identified_as_gravity(stiffness: float):
    """The catalogue lacks a ground spring: a learned function of one variable explains more than gravity."""
    torque = np.repeat(0.1 * np.random.default_rng(0).normal(size=20), 300)
    log = rig.drive_log(rig.drive_motion(torque, tether=stiffness), torque, noise=0.1)
    found = drive_loop(experiment_from_log(log, hold="zero-order", N=rig.N))
    assert found.decision == "unexplained" and found.unknown is not None
    chosen = found.unknown.chosen
    assert (chosen.form.name, chosen.variables) == ("learned_load_torque", ("theta_l",))
    assert float(found.after.model.get("K")) == pytest.approx(rig.K, rel=1e-3)
    assert found.after.rmse["selection"] < 0.01 * found.before.rmse["selection"]


def test_effects_with_which_free_runs_diverge_come_last_and_without_a_gain(friction_loop):
    (this, *_) = friction_loop[0].rounds
    rounds = [
        replace(this, verdicts=(replace(this.winner, name=name),), accepted=True) for name in ("one", "two", "three")
    ]
    without = {"one": 4.0, "two": np.inf, "three": 8.0}
    model = friction_loop[0].after.model
    assert [f.gain for f in _named_findings(rounds, model, 2.0, without)] == [1.0, 0.75, 0.5]
    assert all(np.isnan(f.gain) for f in _named_findings(rounds, model, np.inf, without))


@pytest.mark.parametrize(
    ("tried", "given_up"),
    [
        ([], []),
        (["linear"], []),
        (["linear", "zero-order"], ["linear hold", "zero-order hold"]),  # the first hold again: no finding
        (["linear", "cubic"], ["linear hold"]),
    ],
)
def test_withdrawn_hold_is_not_a_finding(friction_loop, tried: list[Hold], given_up: list[str]):
    first: Hold = "zero-order"
    (this, *_) = friction_loop[0].rounds
    rounds, now = [this], first
    for hold in tried:
        before, after = replace(this.before, hold=now), replace(this.before, hold=hold)
        rounds.append(
            Round(before, this.screen, (Verdict(f"{hold} hold", "input_delay", after, 1.0, 0.005, True),), True)
        )
        now = hold
    assert _holds_given_up(rounds, first, now) == given_up
    # Another one that suits the final model better.
    assert _holds_given_up(rounds, first, "band-limited") == [f"{hold} hold" for hold in tried]


def test_single_precision_is_refused():
    experiment = rig.reduced_experiment(200)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match=r'call jax\.config\.update\("jax_enable_x64", True\) first'):
            reduced_loop(experiment)
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.parametrize("drifting", ["training", pytest.param("selection", marks=pytest.mark.slow)])
def test_effect_that_does_not_explain_free_runs_is_unexplained(drifting: str, monkeypatch: pytest.MonkeyPatch):
    """An effect found over short segments is reported where no term can be learned; the decision is `unexplained`."""

    def seen(final, runs, short, **options) -> float:
        part = "training" if runs is None else "selection"
        return 1.4 if part == drifting else 1.0

    module = import_module("fitting.conclusion")
    monkeypatch.setattr(module, "share_explained", lambda *args: 0.5)
    monkeypatch.setattr(module, "surprise", seen)
    monkeypatch.setattr(module, "learn_supported", lambda *args, **options: None)
    loop = reduced_loop(rig.reduced_experiment(REDUCED_COUNT, noise=REDUCED_NOISE, friction=FRICTION))
    assert [f.name for f in loop.findings] == ["coulomb_friction"]
    assert (loop.decision, loop.surprise) == ("unexplained", 1.4)


@pytest.mark.slow
def test_learned_term_replaces_an_effect_that_does_not_explain_free_runs(monkeypatch: pytest.MonkeyPatch):
    """Quadratic damping is accepted in place of dry friction, by substituted evidence; a learned jump explains more.
    What damping leaves was attributed to noise of the torque: not so beside the jump."""
    module, loop_module = import_module("fitting.conclusion"), import_module("fitting.loop")
    monkeypatch.setattr(module, "surprise", lambda *args, **options: 1.4)
    monkeypatch.setattr(module, "share_explained", lambda *args: 0.5)
    explains = {"excess": (1.0,), "excess_at_first": (9.0,), "learned": False}
    final = module._final_evidence
    monkeypatch.setattr(module, "_final_evidence", lambda *args: replace(final(*args), **explains))

    def unchallenged(base, named, *args, **options):
        seen = model_evidence(named, options["noise"])
        left = noise_model(named.training, options["noise"].covariance, predictable=RULES.innovations)
        return Challenge(named, None, left, None, None, ChallengeEvidence(seen, seen, 1, 0.0, True))

    monkeypatch.setattr(loop_module, "challenge_names", unchallenged)
    experiment = rig.reduced_experiment(REDUCED_COUNT, noise=REDUCED_NOISE, friction=FRICTION)
    loop = reduced_loop(experiment, catalogue=(QuadraticDamping,))
    assert [f.name for f in loop.findings] == ["learned_mesh_torque"]
    assert loop.doubted == ("quadratic_damping",)
    assert (loop.decision, loop.surprise) == ("unexplained", None)
    assert (loop.torque_noise, loop.noise_memory) == (None, None)
    assert np.sqrt(float(loop.noise[0, 0])) == pytest.approx(REDUCED_NOISE, rel=0.2)
    # The evidence is that against the damping.
    assert loop.case.final.names == ("quadratic_damping",) and loop.case.final.surprise == 1.4
    assert any(check.rule == "surprise" and not check.holds for check in loop.checks)
    assert decide(loop.case).lacking is None and decide(loop.case).names == ()
    assert loop.after.rmse["selection"] < 1.2 * REDUCED_NOISE
