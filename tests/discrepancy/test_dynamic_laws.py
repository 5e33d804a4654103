"""Learned torques with memory equal known laws as special cases, and are found where no function suffices."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rig
from fitting.attribution.effect_search import base_trial
from fitting.attribution.screening import Screen
from fitting.discrepancy.dynamic_laws import screen_memory
from fitting.discrepancy.dynamic_stiffness import learned_response
from fitting.discrepancy.learn import share_of
from fitting.discrepancy.variable_selection import search_context
from fitting.estimation.experiment import experiment_from_log, split
from fitting.first_order.motion import place_of
from fitting.loop import close_loop
from fitting.outcome import Loop
from fitting.report import Report
from fitting.report.plots import response_plot
from fitting.search_options import SearchOptions
from fitting.stored_model import StoredModel, read_model, to_json
from fitting.uncertainty.standard_errors import Estimate, Uncertainty
from hdjax import Model
from hdjax.effects import Effect, Motion, Scales
from hdjax.effects.hysteresis import BoucWen, Dahl, SharpBoucWen
from hdjax.effects.learned import FAMILY, LearnedMeshTorque
from hdjax.effects.learned_memory import (
    LEARNED_WITH_MEMORY,
    Lagging,
    LaggingLoadTorque,
    LaggingMeshTorque,
    LaggingMotorTorque,
    LearnedMemory,
    Yielding,
    YieldingMeshTorque,
    YieldingMotorTorque,
)
from hdjax.effects.resonance import ExtraResonance, ResonanceBesideLoad

BASE = rig.drive_model()
J_L = float(BASE.drive.J_l)
STATE = jnp.asarray([0.4, 0.0075, 3.0, -0.4])
SCALES = Scales(x=1e-3, x_max=3e-3, v=0.3, omega_m=12.0, omega_l=0.2, time_step=5e-4, duration=2.0, omega_0=380.0)
SPANS = {"lag_span": 1.0, "rate_span": 1.0}
COUNT, NOISE = 1600, 1e-3

every_form = pytest.mark.parametrize("form", LEARNED_WITH_MEMORY, ids=lambda form: form.name)


def rates(effect: Effect, own: list[float]) -> np.ndarray:
    state = jnp.concatenate([STATE, jnp.asarray(own)])
    return np.asarray(BASE.with_effects(effect).rates(state, jnp.asarray(0.3), jnp.zeros(())))


@every_form
def test_learned_law_of_zero_strength_does_not_act_and_has_finite_rates(form: type[LearnedMemory]):
    assert form.family == FAMILY
    for effect in form.proposals(SCALES):
        own = np.asarray(effect.initial_state(BASE.motion(STATE)))
        found = rates(effect, own.tolist())
        np.testing.assert_array_equal(found[:4], np.asarray(BASE.rates(STATE, jnp.asarray(0.3), jnp.zeros(()))))
        assert np.isfinite(found).all() and np.all(np.asarray(effect.state_scale()) > 0)


@pytest.mark.parametrize("beside", [False, True])
def test_lagging_load_torque_equals_a_third_inertia(beside: bool):
    share, omega, zeta = 0.3, 250.0, 0.04
    form = ResonanceBesideLoad if beside else ExtraResonance
    known = form(mass_ratio=share, omega_3=omega, zeta=zeta, twist_span=1.0, rate_span=1.0)
    k, b = share * J_L * omega**2, 2 * zeta * omega * share * J_L
    same = LaggingLoadTorque(k=k, b=b, omega=omega, zeta=zeta, share=0.0 if beside else share, **SPANS)
    own = [2e-3, -0.7]
    np.testing.assert_allclose(rates(same, own), rates(known, own), rtol=1e-12)
    np.testing.assert_array_equal(same.initial_state(BASE.motion(STATE)), known.initial_state(BASE.motion(STATE)))


def test_lagging_motor_torque_takes_its_share_of_the_motor_inertia():
    """A share of the motor inertia lags; the rest is accelerated by the same torque."""
    J_m, share, omega = float(BASE.drive.J_m), 0.4, 300.0
    k, b = share * J_m * omega**2, 0.2 * omega * share * J_m
    taken = LaggingMotorTorque(k=k, b=b, omega=omega, zeta=0.1, share=share, **SPANS)
    motion = BASE.motion(STATE)
    found = rates(taken, [0.0, float(STATE[2])])
    bare = np.asarray(BASE.rates(STATE, jnp.asarray(0.3), jnp.zeros(())))
    assert found[2] == pytest.approx(bare[2] / (1.0 - share), rel=1e-12)
    assert np.asarray(taken.state_rates(motion, jnp.asarray([0.0, STATE[2]])))[1] == 0.0
    # In slow motion nothing lags: the share moves with the motor, and the whole inertia acts.
    slow = taken.stiffness(jnp.asarray(1e-3 * omega), BASE.drive)
    assert abs(complex(slow)) < 1e-5 * share * J_m * (1e-3 * omega) ** 2


@pytest.mark.parametrize("omega", [20.0, 200.0, 900.0])
def test_dynamic_stiffness_of_a_lag_equals_that_of_its_equations(omega: float):
    effect = LaggingMeshTorque(k=500.0, b=0.7, omega=210.0, zeta=0.3, **SPANS)
    zero = jnp.zeros(())

    def of(x, v, state):
        motion = Motion(x=x, v=v)
        return effect.state_rates(motion, state), effect.torque(motion, BASE.drive, state)

    A, B = (np.asarray(jax.jacobian(lambda s, v: of(zero, v, s)[0], i)(jnp.zeros(2), zero)) for i in (0, 1))
    C, D = (np.asarray(jax.jacobian(lambda s, v: of(zero, v, s)[1], i)(jnp.zeros(2), zero)) for i in (0, 1))
    s = 1j * omega
    wanted = (C @ np.linalg.solve(s * np.eye(2) - A, B) + D) * s
    assert complex(effect.stiffness(jnp.asarray(omega), BASE.drive)) == pytest.approx(wanted, rel=1e-9)


YIELD, RATIO = 3e-4, 0.4
KNOWN = {
    "Dahl": (Dahl(k=900.0, yield_twist=YIELD, settling=1e-12), {"reach": YIELD, "bow": 0.0, "back": 1.0}),
    "Bouc-Wen": (
        BoucWen(k=900.0, memory_twist=YIELD, ratio=RATIO),
        {"reach": YIELD / (1 + RATIO), "bow": 0.0, "back": (1 - RATIO) / (1 + RATIO)},
    ),
    "Bouc-Wen with n = 2": (
        SharpBoucWen(k=900.0, memory_twist=YIELD, ratio=RATIO),
        {"reach": YIELD / (1 + RATIO) ** 0.5, "bow": 1.0, "back": 0.0, "back_bow": (1 - RATIO) / (1 + RATIO)},
    ),
}


@pytest.mark.parametrize("known", KNOWN)
@given(share=st.floats(-1.0, 1.0), backwards=st.booleans())
@settings(max_examples=20, deadline=None)
def test_yielding_torque_equals_known_hysteresis_laws(known: str, share: float, backwards: bool):
    effect, shape = KNOWN[known]
    same = YieldingMeshTorque(k=900.0, **{"back": 0.0, "back_bow": 0.0} | shape)
    motion = Motion(x=jnp.zeros(()), v=jnp.asarray(-0.2 if backwards else 0.2))
    state = jnp.asarray([share * shape["reach"]])
    found, wanted = (np.asarray(e.state_rates(motion, state)) for e in (same, effect))
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-9)
    assert float(same.torque(motion, BASE.drive, state)) == float(effect.torque(motion, BASE.drive, state))


@jax.jit
def end_and_power(effect: YieldingMotorTorque, moves: jax.Array, h: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Last state along prescribed rates of the motor, and the torque's power in each step."""

    def step(z, omega):
        motion = Motion(x=jnp.zeros(()), v=jnp.zeros(()), omega_m=omega, theta_m=jnp.zeros(()))
        middle = z + 0.5 * h * effect.state_rates(motion, z)
        return z + h * effect.state_rates(motion, middle), effect.torque(motion, BASE.drive, middle) * omega

    return jax.lax.scan(step, jnp.zeros(1), moves)


@given(bow=st.floats(0.0, 1.0), back=st.floats(0.0, 2.0), swing=st.floats(0.1, 30.0))
@settings(max_examples=15, deadline=None)
def test_yielding_torque_saturates_and_dissipates_energy(bow: float, back: float, swing: float):
    reach, steps = 1e-3, 4000
    effect = YieldingMotorTorque(k=5.0, reach=reach, bow=bow, back=back)
    phase = np.linspace(0.0, 4 * np.pi, steps)
    z, power = end_and_power(effect, jnp.asarray(swing * reach * np.cos(phase)), jnp.asarray(phase[1] - phase[0]))
    assert abs(float(z[0])) < 1.01 * reach
    # Power over the second period, whose start and end are the same.
    assert float(jnp.sum(power[steps // 2 :])) < 0.0


@every_form
def test_learned_law_is_read_from_its_file_unchanged(form: type[LearnedMemory], tmp_path: Path):
    effect = form.proposals(SCALES)[0]
    stored = StoredModel(
        BASE.with_effects(effect).replace({f"{form.name}.k": 1 / 7}), "linear", 2, 4, 1e-12 * jnp.eye(2)
    )
    path = tmp_path / "model.json"
    path.write_text(to_json(stored))
    (read,) = read_model(path).model.effects
    assert type(read) is form and float(read.k) == 1 / 7


def test_no_second_law_with_memory_is_screened_at_the_same_place(monkeypatch: pytest.MonkeyPatch):
    asked = []

    def screen(training, held_out, *, catalogue, seed, side):
        asked.extend(catalogue)
        return Screen((), np.zeros(1))

    monkeypatch.setattr("fitting.discrepancy.dynamic_laws.screen", screen)
    data = {"zero-order": split((rig.reduced_experiment(1200, noise=NOISE),))}
    before, study = base_trial(rig.reduced_model(), data, "zero-order")
    seen = search_context(before.training)
    before = replace(before, model=before.model.with_effects(KNOWN["Dahl"][0]))
    screen_memory(before, seen, study, least=0.1)
    assert set(asked) == {form for form in LEARNED_WITH_MEMORY if place_of(form) is not LearnedMeshTorque}


def loop_with_yielding_spring() -> Loop:
    """A loop on a log of a yielding spring (Bouc-Wen, implemented here), without a search for named effects."""
    forcing = rig.reduced_forcing(COUNT, rms=14.0)
    k, beta, gamma = 0.35 * rig.OMEGA_0**2, 2.0, 0.8

    def rates(y, u):
        x, v, z = y
        spring = rig.OMEGA_0**2 * (x + rig.REDUCED_ALPHA * x**3)
        return v, rig.GAIN * u - rig.MU * v - spring - k * z, v - beta * abs(v) * z - gamma * v * abs(z)

    motion = rig.rk4(rates, (0.0, 0.0, 0.0), forcing, rig.REDUCED_STEP, 10)
    log = replace(rig.reduced_log(motion[:, 0], forcing, noise=NOISE), name="yielding")
    experiment = experiment_from_log(log, hold="zero-order")
    placeholder: Model = rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0)
    return close_loop(placeholder, {"zero-order": (experiment,)}, hold="zero-order", search=SearchOptions(0))


@pytest.fixture(scope="module")
def yielding_loop() -> Loop:
    return loop_with_yielding_spring()


def test_hysteresis_missing_from_the_catalogue_is_learned_with_memory(yielding_loop: Loop):
    assert yielding_loop.decision == "unexplained" and yielding_loop.unknown is not None
    assert [f.name for f in yielding_loop.findings] == [YieldingMeshTorque.name]
    assert yielding_loop.after.rmse["selection"] < 1.2 * NOISE < 0.2 * yielding_loop.before.rmse["selection"]
    assert yielding_loop.findings[0].p_value <= 0.01
    assert float(yielding_loop.after.model.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=5e-3)


def test_learned_hysteresis_agrees_with_the_equivalent_named_effect(yielding_loop: Loop):
    """A learned term with memory confirms a named effect of the same law."""
    found = yielding_loop.unknown
    assert found is not None
    training = found.trial.training
    effect = training.model.effects[0]
    assert isinstance(effect, Yielding)
    # The same torque as a named effect, with the same states.
    named = BoucWen(k=effect.k, memory_twist=effect.reach, ratio=0.0)
    model = found.before.model.with_effects(named)
    names = {"yielding_mesh_torque.z": "bouc_wen.z"}
    assert model.state_names[2:] == tuple(names.values())
    assert share_of(training.model, found, training) > 0.99
    assert share_of(model, found) < 0.1  # without motion it has no torque


def test_report_states_the_learned_yielding_torque(yielding_loop: Loop, tmp_path: Path):
    units = {"dynamic_error": "V", "forcing": "V"}
    paths = Report.of(yielding_loop, units=units).write(tmp_path)
    report = json.loads(paths["report.json"].read_text())
    told = report["unknown"]
    assert (told["place"], told["variables"], told["memory"]) == ("mesh", ["x"], "yields")
    assert told["coefficients"] == 5 and told["symbolic"]["families"] == ["hysteresis"]
    assert "yields to the twist" in report["summary"]
    page = paths["report.html"].read_text()
    assert "What the learned torque looks like" in page and 'id="evidence-yielding-mesh-torque"' in page
    assert read_model(paths["model.json"]).model.effects[0].name == YieldingMeshTorque.name


def test_dynamic_stiffness_of_a_learned_lag_is_plotted_with_its_band():
    effect = LaggingLoadTorque(k=900.0, b=0.5, omega=250.0, zeta=0.1, **SPANS)
    model = BASE.with_effects(effect)
    paths = ["K", *(f"{effect.name}.{n}" for n in ("k", "b", "omega", "zeta", "share"))]
    stds = [1.0, 9.0, 0.0, 0.0, 0.0, 0.0]
    estimates = {
        p: Estimate(p, float(model.get(p)), s, s, (0.0, 1.0), "1", True) for p, s in zip(paths, stds, strict=True)
    }
    found = learned_response(effect.name, model, Uncertainty(estimates, np.eye(6), np.eye(6), np.eye(6)))
    assert (found.place, found.angle) == ("load", "theta_l")
    wanted = np.abs(np.asarray(effect.stiffness(jnp.asarray(2 * np.pi * found.frequency), BASE.drive)))
    np.testing.assert_allclose(found.stiffness, wanted, rtol=1e-9)
    # At low frequency only the spring acts, so that 1 % of k is 1 % of the whole.
    assert found.std[0] == pytest.approx(0.01, rel=1e-2)
    assert isinstance(effect, Lagging)
    drawn = response_plot(found, unit="N m/rad")
    assert drawn.title == "The learned torque on the load" and len(drawn.figure["data"]) == 2
