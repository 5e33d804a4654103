"""Simpler forms and torque holds that a search has accepted, and that later effects make superfluous."""

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.attribution import effect_search
from fitting.attribution.candidate_refit import _with_form
from fitting.attribution.study import Setting, Study
from fitting.estimation.problem import Segmentation
from fitting.loop import _named_findings, close_loop
from hdjax.effects import BY_NAME, CATALOGUE, Creep, Effect, GravityLoad
from hdjax.effects.friction import MotorFriction, ViscousLoadFriction, ViscousMotorFriction

COUNT, B = 3000, 2e-5
WIDER = [form for form in CATALOGUE if form.contains]


def test_parameters_of_a_contained_form_belong_to_the_wider_form():
    assert len(WIDER) == 7
    for form in WIDER:
        for name in form.contains:
            narrow = BY_NAME[name]
            assert narrow.family == form.family
            assert {f.name for f in dataclasses.fields(narrow)} <= {f.name for f in dataclasses.fields(form)}


def test_wider_form_adds_the_value_of_the_form_that_it_replaces():
    beside = ViscousLoadFriction(b=jnp.asarray(0.3))
    model = rig.drive_model().with_effects(ViscousMotorFriction(b=jnp.asarray(0.2)), beside)
    found = _with_form(model, MotorFriction(T_c=jnp.asarray(0.1), b=jnp.asarray(0.05), transition=jnp.asarray(1.0)))
    assert [e.name for e in found.effects] == ["viscous_load_friction", "motor_friction"]
    assert float(found.get("motor_friction.b")) == pytest.approx(0.25)


# A corner far beyond the drive's speeds: viscous friction alone.
@pytest.mark.parametrize(
    "friction, form",
    [((B * 1e5, 1e5), ViscousMotorFriction), pytest.param((2e-3, 0.1), MotorFriction, marks=pytest.mark.slow)],
    ids=["viscous", "dry"],
)
def test_loop_finds_the_simplest_sufficient_form(friction: tuple[float, float], form: type[Effect]):
    experiment = rig.drive_experiment(COUNT, motor_friction=friction)
    catalogue = (MotorFriction, ViscousMotorFriction)
    loop = close_loop(rig.drive_model(), {"zero-order": (experiment,)}, hold="zero-order", catalogue=catalogue)
    assert [f.name for f in loop.findings] == [form.name]
    if form is ViscousMotorFriction:
        np.testing.assert_allclose(float(loop.after.model.get("viscous_motor_friction.b")), B, rtol=0.05)


def trial(objective: float, *effects: Effect) -> Any:
    return SimpleNamespace(
        held_out=SimpleNamespace(objective=objective), model=rig.drive_model().with_effects(*effects)
    )


@pytest.mark.parametrize("better", [True, False])
def test_hold_made_superfluous_by_later_effects_is_dropped(monkeypatch: pytest.MonkeyPatch, better: bool):
    """A base model without friction may follow a log better under a wrong hold."""

    current, reverted, poor = (trial(objective) for objective in (-20.0, -22.0 if better else -19.0, -10.0))
    refits = {"linear hold": reverted, "motor_friction": poor}
    monkeypatch.setattr(effect_search, "refitted_without", lambda names, *_: refits[names[0]])
    found, dropped, without = effect_search._without_superfluous(list(refits), current, trial(0.0), cast(Any, None))
    assert dropped == (["linear hold"] if better else [])
    assert found is (reverted if better else current)
    assert set(without) == (set(refits) - set(dropped))


def test_last_effect_is_dropped_where_the_others_improved_beside_it(monkeypatch: pytest.MonkeyPatch):
    current, equal, poor = (trial(objective) for objective in (-20.0, -20.0, -10.0))
    refits = {"load_friction": poor, "cubic_damping": equal}
    monkeypatch.setattr(effect_search, "refitted_without", lambda names, *_: refits[names[0]])
    arguments = cast(Any, (list(refits), current, poor, None))
    found, dropped, _ = effect_search._without_superfluous(*arguments)
    assert dropped == ["cubic_damping"] and found is equal


def test_effect_whose_parameter_ended_at_a_bound_is_dropped(monkeypatch: pytest.MonkeyPatch):
    """Creep that takes forever is no creep."""
    slow, gravity = Creep(k=1.0, tau=1e20, span=1.0), GravityLoad(sine=1.0)
    current, without_creep, base = trial(-20.0, slow, gravity), trial(-12.0, gravity), trial(-5.0)
    monkeypatch.setattr(effect_search, "refitted_without", lambda names, *_: without_creep)
    found, dropped, _ = effect_search._without_superfluous(["creep", "gravity_load"], current, base, cast(Any, None))
    assert dropped == ["creep"] and found is without_creep
    found, dropped, _ = effect_search._without_superfluous(["creep"], trial(-20.0, slow), base, cast(Any, None))
    assert dropped == ["creep"] and found is base


def test_superfluous_form_that_comes_back_is_kept_and_told_once(monkeypatch: pytest.MonkeyPatch):
    """Beside later effects a form that was dropped may be the better law of another one."""

    def any_trial(*effects: Effect) -> Any:
        own = trial(0.0, *effects)
        return SimpleNamespace(model=own.model, hold="linear", training=SimpleNamespace(substeps=1))

    base = any_trial()

    def a_round(effect: Effect, p_value: float = 0.001) -> Any:
        winner = SimpleNamespace(name=effect.name, family=effect.family, trial=any_trial(effect), p_value=p_value)
        return SimpleNamespace(accepted=True, before=base, winner=winner)

    creep, gravity = Creep(k=1.0, tau=1.0, span=1.0), GravityLoad(sine=1.0)
    rounds, back = iter([a_round(creep), a_round(gravity)]), a_round(creep, 0.002)
    superfluous = iter([(base, ["creep"], {}), (base, [], {"creep": base})])
    monkeypatch.setattr(effect_search, "measurement_noise", lambda _: None)
    monkeypatch.setattr(effect_search, "leaves_imperfection", lambda *_: (False, None))
    monkeypatch.setattr(effect_search, "Standing", lambda *_, **__: None)
    monkeypatch.setattr(effect_search, "look", lambda *_, **__: next(rounds))
    monkeypatch.setattr(effect_search, "continued", lambda found, _: found)
    monkeypatch.setattr(effect_search, "_without_superfluous", lambda *_: next(superfluous))
    monkeypatch.setattr(effect_search, "compare_again", lambda *_: (base, [back], {"gravity_load": back}))
    study = Study({}, Setting(Segmentation(64)))
    found = effect_search.search_effects(base, study, max_effects=2, catalogue=(), hold="linear")
    assert found.dropped == ("gravity_load",)
    (told,) = _named_findings(found.rounds, base.model, 1.0, {"creep": 2.0})
    assert (told.name, told.p_value) == ("creep", 0.002)
