"""Learned torques and readings as effects: against effects of the catalogue, and their derivatives."""

import json
from collections.abc import Callable
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

import rig
from fitting.errors import InputError
from fitting.estimation.experiment import experiment_from_log, split
from fitting.estimation.segments import cut
from fitting.first_order.motion import acting_at_knots, unit_pushes, unit_reading
from fitting.stored_model import StoredModel, read_model, to_json
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
    LearnedPeriodic,
    LearnedReading,
    LearnedTorque,
)
from hdjax.effects.learned_axes import (
    ANGLES,
    UNITS,
    AngleAxis,
    Axis,
    LinearAxis,
    PeriodicAxis,
    PowerAxis,
    SignAxis,
    SplineAxis,
    axes_over,
    axis_over,
    combined,
    functions,
)
from hdjax.effects.load import LoadDisturbance
from hdjax.effects.sensing import LoadEncoderEccentricity, MotorEncoderEccentricity
from hdjax.simulate import march


@eqx.filter_jit
def rates(model, state):
    return model.rates(state, jnp.zeros(()), jnp.zeros(()), Conditions(jnp.asarray(0.2), jnp.asarray(0.4)))


@eqx.filter_jit
def slopes(model, state):
    return jax.jacfwd(lambda s: rates(model, s))(state)


@eqx.filter_jit
def evaluated(axis: Axis, values):
    return jax.vmap(axis.functions)(values)


def learned_effect(form, *axes: Axis, c=None):
    count = int(np.prod([a.count for a in axes])) if axes else 1
    return form(axes=axes, mixing=jnp.eye(count), c=np.zeros(count) if c is None else c)


def test_spline_axis_agrees_with_scipy():
    axis = SplineAxis("x", low=-2.0, high=3.0, intervals=5)
    knots = np.arange(-5.0, 9.0)
    inside = np.linspace(-2.0, 3.0, 41)
    found = np.asarray(evaluated(axis, jnp.asarray(inside)))
    wanted = BSpline.design_matrix(np.minimum(inside, 3.0 - 1e-12), knots, 3).toarray()[:, : axis.count]
    np.testing.assert_allclose(found, wanted[:, : axis.count], atol=1e-9)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-12)


def test_spline_axis_is_linear_beyond_its_range():
    axis = SplineAxis("x", low=-1.0, high=1.0, intervals=4)
    end, before, far = np.asarray(evaluated(axis, jnp.asarray([1.0, 1.0 - 1e-6, 4.0])))
    # Of a slope from a step of 1e-6, over three units.
    np.testing.assert_allclose(far, end + 3.0 * (end - before) / 1e-6, atol=1e-4)


def test_power_axis_agrees_with_its_formula():
    axis = PowerAxis("v", largest=2.0)
    values = np.linspace(-3.0, 3.0, 7)
    share = values / 2.0
    wanted = np.stack([np.ones(7), share, share * np.abs(share), share**2, share**3], axis=1)
    np.testing.assert_allclose(evaluated(axis, jnp.asarray(values)), wanted, rtol=1e-14)


def forms_over(jumps_with: str | None = None, **ranges: tuple[float, float]) -> list[tuple[type, ...]]:
    return [tuple(type(axis) for axis in axes) for axes in axes_over(ranges, jumps_with=jumps_with)]


@pytest.mark.parametrize("variable", ["theta_m", "time", "temperature"])
def test_drifting_and_periodic_variables_have_no_power_axis(variable: str):
    """Powers extrapolate a drift without bound, and an angle is periodic."""
    assert all(PowerAxis not in axes for axes in forms_over(**{variable: (0.0, 1.0)}))


def test_candidate_axes_are_ordered_from_simple_to_complex():
    (powers,), (spline,) = axes_over({"v": (-2.0, 1.0)})
    assert isinstance(powers, PowerAxis) and float(powers.largest) == 2.0
    assert isinstance(spline, SplineAxis) and (float(spline.low), float(spline.high)) == (-2.0, 1.0)
    # A stiffness that changes with speed, damping that changes with twist, any function.
    assert forms_over(x=(-1.0, 1.0), omega_m=(-9.0, 9.0)) == [
        (LinearAxis, SplineAxis),
        (SplineAxis, LinearAxis),
        (SplineAxis, SplineAxis),
    ]
    assert forms_over(x=(-1.0, 1.0), theta_m=(0.0, 9.0)) == [(LinearAxis, AngleAxis), (SplineAxis, AngleAxis)]
    assert forms_over(theta_l=(0.0, 1.0), time=(0.0, 9.0)) == [(AngleAxis, SplineAxis)]


def test_candidate_axes_of_a_jump_follow_the_smooth_ones():
    smooth, jumping_torque = axes_over({"v": (-2.0, 1.0)})[:2], axes_over({"v": (-2.0, 1.0)}, jumps_with="v")[2:]
    for (axis,), (sign,) in zip(smooth, jumping_torque, strict=True):
        assert isinstance(sign, SignAxis) and sign.variable == "v"
        assert 0.0 < float(sign.corner) < 0.1
        assert eqx.tree_equal(sign.beside, axis)
    assert forms_over(v=(-1.0, 1.0), theta_m=(0.0, 9.0), jumps_with="v")[1] == (SignAxis, AngleAxis)
    # The axis with the sign comes first.
    assert forms_over(x=(-1.0, 1.0), v=(-1.0, 1.0), jumps_with="v")[2] == (SignAxis, SplineAxis)
    assert SignAxis not in sum(forms_over(x=(-1.0, 1.0), omega_l=(-1.0, 1.0), jumps_with="v"), ())


@pytest.mark.parametrize(("form", "rate"), [(f, v) for f in LEARNED for v in UNITS])
def test_learned_torque_may_jump_only_with_the_rate_at_its_place(form: type, rate: str):
    own = {"learned_mesh_torque": "v", "learned_motor_torque": "omega_m", "learned_load_torque": "omega_l"}
    assert form.may_jump_with(rate) == (own.get(form.name) == rate)


def jumping_torque(form: type[LearnedTorque], *, level: float, corner: float, slope: float = 0.0, on: Axis | None = None):
    """A torque that opposes the rate at its place by a level and in proportion to it.

    `on` has functions of one further variable, all of equal weight.
    """
    rate = next(variable for variable in UNITS if form.may_jump_with(variable))
    against = 1.0 if form is LearnedMeshTorque else -1.0
    axes = SignAxis(rate, corner=corner, beside=LinearAxis(rate)), *([] if on is None else [on])
    mixing = np.kron(np.eye(2), np.ones((1 if on is None else on.count, 1)))
    return form.made_of(axes, mixing, [against * level, against * slope])


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


def test_linear_axis_multiplies_the_other_axis_by_its_variable():
    axes = LinearAxis("x"), axis_over("omega_m", -9.0, 9.0)
    motion = Motion(x=jnp.asarray(0.3), v=jnp.zeros(()), omega_m=jnp.asarray(2.0))
    wanted = 0.3 * np.asarray(axes[1].functions(jnp.asarray(2.0)))
    np.testing.assert_allclose(functions(axes, motion), wanted, rtol=1e-15)


def test_spline_knots_of_a_rate_are_dense_near_zero():
    axis = axis_over("omega_m", -30.0, 40.0)
    assert isinstance(axis, SplineAxis) and axis.bend is not None
    values = np.linspace(-30.0, 40.0, 4001)
    basis = np.asarray(evaluated(axis, jnp.asarray(values)))
    friction = np.tanh(values / 0.4)
    left = friction - basis @ np.linalg.lstsq(basis, friction, rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 0.01


def test_angle_axis_is_periodic():
    axis = axis_over("theta_m", 0.0, 100.0)
    assert isinstance(axis, AngleAxis) and axis.orders == ANGLES["theta_m"]
    found = axis.functions(jnp.asarray(0.7))
    wanted = [1.0] + [f(n * 0.7) for n in range(1, axis.orders + 1) for f in (np.cos, np.sin)]
    np.testing.assert_allclose(found, wanted, atol=1e-14)
    np.testing.assert_allclose(found, axis.functions(jnp.asarray(0.7 - 4 * np.pi)), atol=1e-12)


def test_time_axis_may_be_periodic_at_given_spectral_lines():
    (drift,), *lines = axes_over({"time": (0.0, 9.0)}, lines=(20.0, 30.0))
    assert isinstance(drift, SplineAxis)
    for (axis,), omega in zip(lines, (20.0, 30.0), strict=True):
        assert isinstance(axis, PeriodicAxis) and float(axis.omega) == omega
    for other in ({"theta_m": (0.0, 9.0)}, {"x": (0.0, 1.0), "time": (0.0, 9.0)}):
        assert PeriodicAxis not in sum(([type(a) for a in axes] for axes in axes_over(other, lines=(20.0,))), [])
    found = PeriodicAxis("time", 20.0, 2).functions(jnp.asarray(0.3))
    np.testing.assert_allclose(found, [1.0, np.cos(6), np.sin(6), np.cos(12), np.sin(12)], rtol=1e-14)


def periodic_torque(form: type[LearnedTorque], at: float, c: list[float]) -> LearnedPeriodic:
    """A torque whose coefficients are a constant, a cosine and a sine of time."""
    effect = form.made_of((PeriodicAxis("time", at, 1),), np.eye(3), c)
    assert isinstance(effect, LearnedPeriodic)
    return effect


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


def test_functions_of_two_axes_are_their_products():
    one, other = axis_over("x", -1.0, 1.0, beside="theta_m"), axis_over("theta_m", 0.0, 1.0, beside="x")
    motion = Motion(x=jnp.asarray(0.3), v=jnp.zeros(()), theta_m=jnp.asarray(2.0))
    wanted = np.outer(one.functions(motion.x), other.functions(jnp.asarray(2.0))).reshape(-1)
    np.testing.assert_array_equal(functions((one, other), motion), wanted)


@pytest.mark.slow
def test_combined_axes_have_the_derivatives_of_the_formula():
    axes = axis_over("x", -1.0, 1.0, beside="theta_m"), axis_over("theta_m", 0.0, 1.0, beside="x")
    count = int(np.prod([axis.count for axis in axes]))
    random = np.random.default_rng(0)
    mixing, c = jnp.asarray(random.normal(size=(count, 5))), jnp.asarray(random.normal(size=5))

    def motion(x, theta_m) -> Motion:
        return Motion(x=x, v=jnp.zeros(()), theta_m=theta_m)

    def by_hand(x, theta_m, c):
        return combined(axes, mixing, tuple(c), motion(x, theta_m))

    def formula(x, theta_m, c):
        return functions(axes, motion(x, theta_m)) @ mixing @ c

    at = jnp.asarray(0.3), jnp.asarray(2.0), c
    for differentiate in (jax.jacfwd, jax.jacrev):
        found, wanted = (differentiate(f, argnums=(0, 1, 2))(*at) for f in (by_hand, formula))
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-10)


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
    added = {f: rates(base.with_effects(learned_effect(f, c=[2.0])), state) - rates(base, state) for f in LEARNED_TORQUES}
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
    learned_already = learned_effect(form, AngleAxis("theta_m" if form is LearnedMotorReading else "theta_l", 1), c=[1.0] * 3)
    for model in (rig.drive_model(), rig.drive_model().with_effects(learned_already)):
        np.testing.assert_allclose(unit_reading(model, form), unit, rtol=1e-14)


def test_stored_mesh_error_of_other_variables_than_the_angle_is_refused(tmp_path: Path):
    content = json.loads(stored_torque())
    content["effects"][1]["name"] = LearnedMeshError.name
    with pytest.raises(InputError, match=r"give the model\.json of a report"):
        read_stored(json.dumps(content), tmp_path)


def test_learned_forms_are_not_proposed_without_data():
    scales = Scales(x=1.0, x_max=1.0, v=1.0, omega_m=1.0, omega_l=1.0, time_step=1.0)
    assert all(form.proposals(scales) == () for form in LEARNED)


def stored_torque() -> str:
    axes = (axis_over("omega_m", -30.0, 1e2 / 3), axis_over("theta_l", 0.0, 1.0, beside="omega_m"))
    count = axes[0].count * axes[1].count
    mixing = np.random.default_rng(0).normal(size=(count, 3))
    effect = LearnedMotorTorque(axes=axes, mixing=mixing, c=[1 / 3, -1e-5, 2.0])
    model = rig.drive_model().with_effects(CoulombFriction(T_c=1.0, v_0=0.1), effect)
    return to_json(StoredModel(model, "zero-order", 2, 4, 1e-12 * jnp.eye(2)))


def read_stored(text: str, folder: Path):
    path = folder / "model.json"
    path.write_text(text, encoding="utf-8")
    return read_model(path)


def test_stored_torque_is_read_back_unchanged(tmp_path: Path):
    found = read_stored(stored_torque(), tmp_path)
    assert to_json(found) == stored_torque()
    effect = found.model.effect("learned_motor_torque")
    assert isinstance(effect, LearnedMotorTorque)
    assert float(found.model.get("learned_motor_torque.c_1")) == -1e-5
    assert np.isfinite(rates(found.model, jnp.asarray([1.0, 0.02, 3.0, 0.1]))).all()


@pytest.mark.parametrize(
    "axis", [AngleAxis("theta_l", 3), LinearAxis("v"), PowerAxis("v", 1 / 3), SplineAxis("v", -1 / 3, 2.0, 0.1)]
)
def test_stored_axis_is_read_back_unchanged(axis: Axis, tmp_path: Path):
    model = rig.drive_model().with_effects(learned_effect(LearnedMeshTorque, axis))
    stored_torque = to_json(StoredModel(model, "zero-order", 2, 4, 1e-12 * jnp.eye(2)))
    effect = read_stored(stored_torque, tmp_path).model.effect("learned_mesh_torque")
    assert isinstance(effect, LearnedMeshTorque)
    assert eqx.tree_equal(effect.axes, (axis,))


def stored_jump() -> str:
    effect = jumping_torque(LearnedMotorTorque, level=1 / 3, corner=3e-3, on=AngleAxis("theta_m", 2))
    model = rig.drive_model().with_effects(effect).replace({"learned_motor_torque.transition": 1 / 7})
    return to_json(StoredModel(model, "zero-order", 2, 4, 1e-12 * jnp.eye(2)))


def test_stored_jump_is_read_back_unchanged(tmp_path: Path):
    found = read_stored(stored_jump(), tmp_path)
    assert to_json(found) == stored_jump()
    effect = found.model.effect("learned_motor_torque")
    assert isinstance(effect, LearnedFriction)
    assert float(effect.corner) == 1 / 7


def stored_periodic_torque() -> str:
    effect = periodic_torque(LearnedMotorTorque, 20.0, [1 / 3, 0.1, 0.0])
    model = rig.drive_model().with_effects(effect).replace({"learned_motor_torque.omega": 61 / 3})
    return to_json(StoredModel(model, "zero-order", 2, 4, 1e-12 * jnp.eye(2)))


def test_stored_periodic_torque_is_read_back_unchanged(tmp_path: Path):
    found = read_stored(stored_periodic_torque(), tmp_path)
    assert to_json(found) == stored_periodic_torque()
    effect = found.model.effect("learned_motor_torque")
    assert isinstance(effect, LearnedPeriodic)
    assert float(effect.omega) == 61 / 3


def assert_refused(text: str, change: Callable[[dict], object], which: int, folder: Path) -> None:
    """A model file of which one effect was changed."""
    content = json.loads(text)
    change(content["effects"][which])
    with pytest.raises(InputError, match=r"give the model\.json of a report"):
        read_stored(json.dumps(content), folder)


BROKEN_LINES = {
    "no place for a torque": lambda e: e.update(name="learned_motor_reading"),
    "of an angle": lambda e: e["axes"][0].update(variable="theta_m"),
    "standing still": lambda e: e["axes"][0].update(omega=0.0),
    "backwards": lambda e: e["parameters"].update(omega=-1.0),
    "no frequency": lambda e: e["parameters"].pop("omega"),
    "a frequency and no line": lambda e: e["axes"][0].pop("omega"),
}


@pytest.mark.parametrize("change", BROKEN_LINES.values(), ids=BROKEN_LINES.keys())
def test_invalid_stored_periodic_torque_is_refused(change, tmp_path: Path):
    assert_refused(stored_periodic_torque(), change, 0, tmp_path)


BROKEN_JUMPS = {
    "of another place": lambda e: e.update(name="learned_load_torque"),
    "no first variable": lambda e: e["axes"].reverse(),
    "twice": lambda e: e["axes"].__setitem__(1, e["axes"][0]),
    "not wide": lambda e: e["parameters"].update(transition=0.0),
    "no width": lambda e: e["parameters"].pop("transition"),
    "a width and no jump": lambda e: e["axes"].__setitem__(0, e["axes"][0]["beside"]),
    "beside it what it can't be": lambda e: e["axes"][0]["beside"].update(variable="colour"),
}


@pytest.mark.parametrize("change", BROKEN_JUMPS.values(), ids=BROKEN_JUMPS.keys())
def test_invalid_stored_jump_is_refused(change, tmp_path: Path):
    assert_refused(stored_jump(), change, 0, tmp_path)


BROKEN = {
    "no axes": lambda e: e.pop("axes"),
    "unknown variable": lambda e: e["axes"][0].update(variable="colour"),
    "empty range": lambda e: e["axes"][0].update(high=-40.0),
    "too many functions": lambda e: e["axes"][1].update(orders=10**9),
    "other shape": lambda e: e["mixing"].pop(),
    "not finite": lambda e: e["mixing"][0].__setitem__(0, float("nan")),
    "a coefficient less": lambda e: e["parameters"].pop("c_1"),
}


@pytest.mark.parametrize("change", BROKEN.values(), ids=BROKEN.keys())
def test_invalid_stored_torque_is_refused(change, tmp_path: Path):
    assert_refused(stored_torque(), change, 1, tmp_path)
