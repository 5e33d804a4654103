"""Learned torques and readings as effects: against effects of the catalogue, and their derivatives."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learned_effects import jumping_torque, learned_effect, periodic_torque, rates, slopes

import rig
from fitting.estimation.experiment import experiment_from_log, split
from fitting.estimation.segments import cut
from fitting.first_order.motion import acting_at_knots, unit_pushes, unit_reading
from hdjax import sampled
from hdjax.effects import Conditions, Effect, Motion, Scales
from hdjax.effects.actuation import TorqueGain
from hdjax.effects.friction import CoulombFriction, LoadFriction, MotorFriction
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.learned import (
    LEARNED,
    LEARNED_TORQUES,
    LearnedFriction,
    LearnedLoadReading,
    LearnedLoadTorque,
    LearnedMeshError,
    LearnedMeshTorque,
    LearnedMotorReading,
    LearnedMotorTorque,
    LearnedReading,
    LearnedTorque,
)
from hdjax.effects.learned_axes import UNITS, AngleAxis, PowerAxis, axis_over
from hdjax.effects.load import LoadDisturbance
from hdjax.effects.sensing import LoadEncoderEccentricity, MotorEncoderEccentricity
from hdjax.simulate import march


@pytest.mark.parametrize(("form", "rate"), [(f, v) for f in LEARNED for v in UNITS])
def test_learned_torque_may_jump_only_with_the_rate_at_its_place(form: type, rate: str):
    own = {"learned_mesh_torque": "v", "learned_motor_torque": "omega_m", "learned_load_torque": "omega_l"}
    assert form.may_jump_with(rate) == (own.get(form.name) == rate)


FRICTIONS = {
    "mesh": (LearnedMeshTorque, lambda: [CoulombFriction(T_c=2.0, v_0=3e-3)], 0.0),
    "motor": (LearnedMotorTorque, lambda: [MotorFriction(T_c=2.0, transition=3e-3, b=0.1)], 0.1),
    "load": (LearnedLoadTorque, lambda: [LoadFriction(T_c=2.0, transition=3e-3, b=0.1)], 0.1),
}


@pytest.mark.parametrize(("form", "known", "slope"), FRICTIONS.values(), ids=FRICTIONS.keys())
def test_learned_jumping_torque_equals_dry_friction(form: type[LearnedTorque], known, slope: float):
    """In rates and derivatives, and in a simulation where it stops the drive within a step."""
    effect = jumping_torque(form, level=2.0, corner=3e-3, slope=slope)
    assert isinstance(effect, LearnedFriction) and isinstance(effect, form) and effect.name == form.name
    base = rig.drive_model()
    wanted = base.with_effects(*known())
    found = base.with_effects(effect)
    for state in (jnp.asarray([1.3, 0.025, 4.0, 0.05]), jnp.asarray([1.3, 0.025, 1e-3, -1e-3])):
        np.testing.assert_allclose(rates(found, state), rates(wanted, state), rtol=1e-12)
        scale = np.abs(slopes(wanted, state)).max()
        np.testing.assert_allclose(slopes(found, state), slopes(wanted, state), rtol=1e-10, atol=1e-12 * scale)
    torque = sampled(1e-3 * np.arange(200), 3.0 * np.sin(0.1 * np.arange(200)), hold="zero-order")
    runs = [march(m, torque, None, jnp.zeros(4), solver=dfx.Tsit5(), substeps=1)[0] for m in (found, wanted)]
    np.testing.assert_allclose(runs[0], runs[1], rtol=1e-9, atol=1e-12 * np.abs(runs[1]).max())


def test_learned_friction_level_may_depend_on_another_variable():
    effect = jumping_torque(LearnedMeshTorque, level=2.0, corner=3e-3, on=PowerAxis("theta_m", largest=2.0))
    assert isinstance(effect, LearnedFriction)
    motion = Motion(x=jnp.asarray(0.3), v=jnp.asarray(-1.0), theta_m=jnp.asarray(1.0))
    # 1 + 1/2 + 1/4 + 1/4 + 1/8, times the level.
    np.testing.assert_allclose(effect.level(motion, rig.drive_model().drive), 4.25, rtol=1e-12)
    np.testing.assert_allclose(effect.torque(motion, rig.drive_model().drive, jnp.zeros(0)), -4.25, rtol=1e-12)


def test_learned_friction_level_may_depend_on_the_motor_torque():
    """In a simulation too: under a constant torque it equals friction of constant level."""
    torque = sampled(1e-3 * np.arange(100), np.full(100, 2.0), hold="zero-order")
    kinds = {"on": PowerAxis("T_m", largest=4.0), "level": 0.5}, {"level": 0.5 * 2.125}
    models = [rig.drive_model().with_effects(jumping_torque(LearnedMotorTorque, corner=3e-3, **kind)) for kind in kinds]
    runs = [march(m, torque, None, jnp.zeros(4), solver=dfx.Tsit5(), substeps=1)[0] for m in models]
    np.testing.assert_allclose(runs[0], runs[1], rtol=1e-9, atol=1e-12 * np.abs(runs[1]).max())


def test_learned_friction_uses_the_fitted_transition_width():
    model = rig.drive_model().with_effects(jumping_torque(LearnedMeshTorque, level=2.0, corner=3e-3, slope=0.5))
    (effect,) = model.replace({"learned_mesh_torque.transition": 0.1}).effects
    motion = Motion(x=jnp.zeros(()), v=jnp.asarray(0.05))
    np.testing.assert_allclose(effect.value(motion), 2.0 * np.tanh(0.5) + 0.025, rtol=1e-12)
    np.testing.assert_allclose(effect.torque(motion, model.drive, jnp.zeros(0)), effect.value(motion), rtol=1e-12)


def test_learned_periodic_torque_equals_a_load_disturbance():
    """At any frequency, and in the derivative by the frequency that a fit may change."""
    effect = periodic_torque(LearnedLoadTorque, 20.0, [0.2, 1.0, -2.0])
    base, state = rig.drive_model(), jnp.asarray([1.3, 0.025, 4.0, 0.05])
    line = LoadDisturbance(constant=0.2, cosine=1.0, sine=-2.0, omega=21.0)
    found, wanted = base.with_effects(effect), base.with_effects(line)
    motion = Motion(x=jnp.zeros(()), v=jnp.zeros(()), time=jnp.asarray(0.7))

    @eqx.filter_jit
    def rates_at(model, path, omega):
        moved = model.replace({path: omega})
        return moved.rates(state, jnp.zeros(()), jnp.zeros(()), Conditions(jnp.asarray(0.7), None))

    names = (found, "learned_load_torque.omega"), (wanted, "load_disturbance.omega")
    for differentiate in (lambda f: f, lambda f: jax.jacfwd(f, argnums=2)):
        one, other = (differentiate(rates_at)(model, path, jnp.asarray(21.0)) for model, path in names)
        np.testing.assert_allclose(one, other, rtol=1e-12)
    (moved,) = found.replace({"learned_load_torque.omega": 21.0}).effects
    np.testing.assert_allclose(moved.value(motion), line.torque(motion, base.drive, jnp.zeros(0)), rtol=1e-12)


@pytest.mark.parametrize("form", LEARNED_TORQUES, ids=lambda form: form.name)
def test_learned_torque_with_zero_coefficients_is_the_base_model(form: type[Effect]):
    base = rig.drive_model()
    whole = base.with_effects(learned_effect(form, axis_over("omega_m", -10.0, 10.0), axis_over("x", -1e-3, 1e-3)))
    # Beyond the data as well.
    for state in (jnp.asarray([1.3, 0.025, 4.0, 0.05]), jnp.asarray([50.0, 0.9, -30.0, 0.5])):
        found, wanted = (rates(m, state) for m in (whole, base))
        # Compiled as two programs, which may round differently.
        np.testing.assert_allclose(found, wanted, rtol=1e-13)


@pytest.mark.parametrize("variable", list(UNITS))
def test_learned_torque_gradients_agree_with_differences(variable: str):
    state = jnp.asarray([1.3, 0.025, 4.0, 0.05])
    axis = axis_over(variable, -0.7, 0.9)
    effect = learned_effect(LearnedMotorTorque, axis, c=0.1 * np.sin(np.arange(axis.count)))
    model = rig.drive_model().with_effects(effect)
    found = np.asarray(slopes(model, state))
    step = 1e-6
    ends = [[np.asarray(rates(model, state + s * step * e)) for s in (1, -1)] for e in jnp.eye(4)]
    wanted = np.stack([(after - before) / (2 * step) for after, before in ends], axis=1)
    # Central differences of a cubic: the third derivative times the step squared, and rounding.
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-4 * np.abs(wanted).max())


def test_unit_pushes_do_not_depend_on_torques_learned_before():
    states = jnp.asarray([[1.3, 0.025, 4.0, 0.05], [0.3, 0.003, -2.0, -0.04]])
    conditions = Conditions(jnp.zeros(2), None)
    base = rig.drive_model()
    effects = [learned_effect(form, axis_over("x", -1e-3, 1e-3), c=-0.1 * np.ones(12)) for form in LEARNED_TORQUES]
    found, wanted = (unit_pushes(m, states, conditions) for m in (base.with_effects(*effects), base))
    for place in (form.name for form in LEARNED_TORQUES):
        assert np.any(np.asarray(wanted[place]))
        np.testing.assert_allclose(found[place], wanted[place], rtol=1e-12, err_msg=place)


def test_learned_torque_acts_at_its_place():
    state = jnp.asarray([1.3, 0.025, 4.0, 0.05])
    base = rig.drive_model()
    added = {
        f: rates(base.with_effects(learned_effect(f, c=[2.0])), state) - rates(base, state) for f in LEARNED_TORQUES
    }
    np.testing.assert_allclose(added[LearnedMotorTorque], [0, 0, 2.0 / rig.J_M, 0], rtol=1e-9)
    np.testing.assert_allclose(added[LearnedLoadTorque], [0, 0, 0, 2.0 / rig.J_L], rtol=1e-9)
    np.testing.assert_allclose(added[LearnedMeshTorque], [0, 0, -2.0 / rig.N / rig.J_M, 2.0 / rig.J_L], rtol=1e-9)


def test_learned_motor_torque_may_depend_on_the_simulated_motor_torque():
    """That torque is the one behind all actuator effects."""
    assert [f for f in LEARNED if f.may_depend_on("T_m")] == [LearnedMotorTorque]
    state, zero = jnp.asarray([1.3, 0.025, 4.0, 0.05]), jnp.zeros(())
    base = rig.drive_model()
    added = learned_effect(LearnedMotorTorque, PowerAxis("T_m", largest=2.0), c=[0.0, 0.0, 0.0, 3.0, 0.0])
    for torque in (0.0, -1.5):
        own, wanted = (m.rates(state, jnp.asarray(torque), zero) for m in (base.with_effects(added), base))
        np.testing.assert_allclose(own - wanted, [0, 0, 3.0 * (torque / 2.0) ** 2 / rig.J_M, 0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("gain_error", [0.0, 0.1])
def test_acting_torque_at_a_knot_is_the_mean_of_both_sides(gain_error: float):
    torque = np.random.default_rng(0).normal(size=64)
    log = rig.drive_log(np.zeros((64, 4)), torque)
    (stretch, *_), _ = split([experiment_from_log(log, hold="zero-order", N=rig.N)])
    segments = cut([stretch], 16, halo=4, count=4)
    found = np.asarray(acting_at_knots(rig.drive_model().with_effects(TorqueGain(gain_error=gain_error)), segments))
    first = (1.0 + gain_error) * torque[stretch.start :][:16]
    np.testing.assert_allclose(found[0, 0], first[0])
    np.testing.assert_allclose(found[0, 1:-1], 0.5 * (first[1:] + first[:-1]))
    np.testing.assert_allclose(found[0, -1], first[-1])


def test_learned_mesh_error_equals_a_kinematic_error():
    state = jnp.asarray([1.3, 0.025, 40.0, 0.05])
    base = rig.drive_model()
    axis = AngleAxis("theta_m", 4)
    c = np.zeros(axis.count)
    nothing = base.with_effects(learned_effect(LearnedMeshError, axis, c=c))
    np.testing.assert_allclose(rates(nothing, state), rates(base, state), rtol=1e-13)
    # One, then cosine and sine of each order.
    c[3], c[8] = 2e-4, -1e-4
    found = base.with_effects(learned_effect(LearnedMeshError, axis, c=c))
    wanted = base.with_effects(KinematicError(cos_2=2e-4, sin_4=-1e-4))
    np.testing.assert_allclose(rates(found, state), rates(wanted, state), rtol=1e-12)
    scale = np.abs(slopes(wanted, state)).max()
    np.testing.assert_allclose(slopes(found, state), slopes(wanted, state), rtol=1e-10, atol=1e-12 * scale)


def test_learned_reading_equals_an_encoder_eccentricity():
    """Outputs are those of the catalogue's effect at any angle, and the motion does not change."""
    base, state = rig.drive_model(), jnp.asarray([1.3, 0.025, 40.0, 0.05])
    for form, known, angle in (
        (LearnedMotorReading, MotorEncoderEccentricity(cosine=2e-4, sine=-1e-4, n=2.0), "theta_m"),
        (LearnedLoadReading, LoadEncoderEccentricity(cosine=2e-4, sine=-1e-4, n=2.0), "theta_l"),
    ):
        axis = AngleAxis(angle, 3)
        c = np.zeros(axis.count)
        nothing = base.with_effects(learned_effect(form, axis, c=c))
        np.testing.assert_array_equal(nothing.outputs(state), base.outputs(state))
        c[3], c[4] = 2e-4, -1e-4
        found, wanted = base.with_effects(learned_effect(form, axis, c=c)), base.with_effects(known)
        np.testing.assert_allclose(found.outputs(state), wanted.outputs(state), rtol=1e-14)
        assert np.any(np.asarray(found.outputs(state) != base.outputs(state)))
        np.testing.assert_array_equal(rates(found, state), rates(base, state))
        by_state = [np.asarray(jax.jacfwd(m.outputs)(state)) for m in (found, wanted)]
        np.testing.assert_allclose(*by_state, rtol=1e-12)


@pytest.mark.parametrize(("form", "unit"), [(LearnedMotorReading, [1 / rig.N] * 2), (LearnedLoadReading, [0.0, -1.0])])
def test_unit_reading_is_one_radian_with_and_without_a_learned_reading(form: type[LearnedReading], unit: list[float]):
    learned_already = learned_effect(
        form, AngleAxis("theta_m" if form is LearnedMotorReading else "theta_l", 1), c=[1.0] * 3
    )
    for model in (rig.drive_model(), rig.drive_model().with_effects(learned_already)):
        np.testing.assert_allclose(unit_reading(model, form), unit, rtol=1e-14)


def test_learned_forms_are_not_proposed_without_data():
    scales = Scales(x=1.0, x_max=1.0, v=1.0, omega_m=1.0, omega_l=1.0, time_step=1.0)
    assert all(form.proposals(scales) == () for form in LEARNED)
