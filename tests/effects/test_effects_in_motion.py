"""Effects of angles, rates, time and temperature against the equations of EFFECTS.md, solved by scipy."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hdjax import Drive, Harmonic, ReducedDrive, ReducedModel, TwoInertiaModel, sampled, simulate
from hdjax.effects import CATALOGUE, Conditions, Motion, Scales, applicable
from hdjax.effects.cogging import Cogging, SingleOrderCogging
from hdjax.effects.damping import CubicDamping
from hdjax.effects.friction import LoadDependentFriction, LoadFriction, StribeckLoadFriction
from hdjax.effects.kinematic import KinematicSidebands
from hdjax.effects.load import LoadDisturbance, TwoLineDisturbance
from hdjax.effects.position import (
    PositionDependentMeshFriction,
    PositionDependentMotorFriction,
    PositionDependentStiffness,
)
from hdjax.effects.sensing import EncoderOffset, JointTorqueBias, LoadEncoderEccentricity, MotorEncoderEccentricity
from hdjax.effects.stiffness import SmoothKneeStiffness, ThreeSlopeStiffness
from hdjax.effects.thermal import ThermalDamping, ThermalMotorFriction, ThermalStiffness

N, J_M, J_L, K, ALPHA, B = 50.0, 5.26e-4, 5.0e-2, 7160.0, 2e4, 2.0
BASE = TwoInertiaModel(Drive(N=N, J_m=J_M, J_l=J_L, K=K, alpha=ALPHA, B_sp=B))
START = jnp.asarray([0.3, 0.007, 5.0, 0.2])
TIME = 1e-3 * np.arange(200)


def temperature(t):
    return 300.0 + 40.0 * t


def assert_agrees_with_scipy(effects, rates):
    """The model with these effects, and `rates(t, y)` -> (on_motor, on_load), under 1.5 cos(50 t + 0.2) N m."""
    found = simulate(
        BASE.with_effects(*effects),
        Harmonic(1.5, 50.0, 0.2),
        TIME,
        START,
        temperature=temperature,
        rtol=1e-9,
        atol=1e-12,
    )

    def whole(t, y):
        on_motor, on_load = rates(t, y)
        return [y[2], y[3], (1.5 * np.cos(50 * t + 0.2) + on_motor) / J_M, on_load / J_L]

    other = solve_ivp(whole, TIME[[0, -1]], np.asarray(START), "DOP853", TIME, rtol=1e-9, atol=1e-12)
    # Some 1e3 steps that err by 1e-9 of angles of order one.
    np.testing.assert_allclose(found.states[:, :2], other.y[:2].T, atol=3e-7)
    twist = other.y[0] / N - other.y[1]
    np.testing.assert_allclose(found.states[:, 0] / N - found.states[:, 1], twist, atol=1e-7)
    base = simulate(BASE, Harmonic(1.5, 50.0, 0.2), TIME, START)
    assert np.abs(np.asarray(base.dynamic_error) - twist).max() > 1e-5  # the effects take part
    return found


def spring(x, v):
    return K * (x + ALPHA * x**3) + B * v


def test_angle_dependent_effects_agree_with_scipy():
    effects = (
        Cogging(cos_1=0.02, sin_2=-0.03, cos_4=0.01),
        SingleOrderCogging(cosine=0.02, sine=0.01, n=6.0),
        PositionDependentStiffness(cosine=0.05, sine=-0.02, n=2.0),
        PositionDependentMotorFriction(T_c=0.1, cosine=0.03, sine=0.02, n=4.0, transition=2.0),
        PositionDependentMeshFriction(T_c=0.4, cosine=0.1, sine=-0.2, n=1.0, v_0=0.1),
    )

    def rates(t, y):
        theta_m, theta_l, omega_m, omega_l = y
        x, v = theta_m / N - theta_l, omega_m / N - omega_l
        tau = spring(x, v) + K * (x + ALPHA * x**3) * (0.05 * np.cos(2 * theta_m) - 0.02 * np.sin(2 * theta_m))
        tau += (0.4 + 0.1 * np.cos(theta_m) - 0.2 * np.sin(theta_m)) * np.tanh(v / 0.1)
        cogging = 0.02 * np.cos(theta_m) - 0.03 * np.sin(2 * theta_m) + 0.01 * np.cos(4 * theta_m)
        cogging += 0.02 * np.cos(6 * theta_m) + 0.01 * np.sin(6 * theta_m)
        level = 0.1 + 0.03 * np.cos(4 * theta_m) + 0.02 * np.sin(4 * theta_m)
        return cogging - level * np.tanh(omega_m / 2.0) - tau / N, tau

    assert_agrees_with_scipy(effects, rates)


def test_time_and_temperature_dependent_effects_agree_with_scipy():
    effects = (
        LoadDisturbance(constant=0.5, cosine=1.0, sine=-2.0, omega=130.0),
        TwoLineDisturbance(constant=0.1, cos_1=0.3, sin_1=0.4, cos_2=0.5, sin_2=0.6, omega_1=60.0, omega_2=270.0),
        ThermalStiffness(k_T=-0.02, T_0=303.0),
        ThermalDamping(kappa=0.1, T_0=303.0),
        ThermalMotorFriction(T_c_T=0.01, b_T=0.001, transition=2.0, T_0=303.0),
    )

    def rates(t, y):
        theta_m, theta_l, omega_m, omega_l = y
        x, v = theta_m / N - theta_l, omega_m / N - omega_l
        warmer = 40.0 * t - 3.0
        tau = K * (1 - 0.02 * warmer) * (x + ALPHA * x**3) + B * np.exp(-0.1 * warmer) * v
        disturbance = 0.6 + np.cos(130 * t) - 2 * np.sin(130 * t)
        disturbance += 0.3 * np.cos(60 * t) + 0.4 * np.sin(60 * t) + 0.5 * np.cos(270 * t) + 0.6 * np.sin(270 * t)
        fall = warmer * (0.01 * np.tanh(omega_m / 2.0) + 0.001 * omega_m)
        return fall - tau / N, tau + disturbance

    assert_agrees_with_scipy(effects, rates)


def test_rate_and_twist_dependent_effects_agree_with_scipy():
    effects = (
        LoadFriction(T_c=0.5, b=0.2, transition=0.05),
        StribeckLoadFriction(T_c=0.3, T_excess=0.4, b=0.1, transition=0.05, omega_s=0.1),
        LoadDependentFriction(T_c=0.2, share=0.05, v_0=0.1),
        CubicDamping(c3=3.0),
        SmoothKneeStiffness(stiffening=0.4, knee=5e-4, width=1e-4),
    )

    def rates(t, y):
        theta_m, theta_l, omega_m, omega_l = y
        x, v = theta_m / N - theta_l, omega_m / N - omega_l
        tau = spring(x, v) + 3.0 * v**3
        tau += (0.2 + 0.05 * np.abs(K * (x + ALPHA * x**3))) * np.tanh(v / 0.1)
        rise = lambda u: (u + np.sqrt(u**2 + 1e-8)) / 2  # noqa: E731
        tau += 0.4 * K * (rise(x - 5e-4) - rise(-x - 5e-4))
        level = 0.5 + 0.3 + 0.4 * np.exp(-((omega_l / 0.1) ** 2))
        return -tau / N, tau - level * np.tanh(omega_l / 0.05) - 0.3 * omega_l

    assert_agrees_with_scipy(effects, rates)


def test_kinematic_sidebands_are_an_amplitude_modulated_error():
    """cos(n t)(1 + cos(t / N)) has its sidebands at n +- 1/N, each of half the size."""
    effect = KinematicSidebands(cos_below=5e-5, cos_above=5e-5, n=2.0, ratio=N)
    theta = jnp.linspace(-30.0, 400.0, 301)
    np.testing.assert_allclose(effect.error(theta), 1e-4 * np.cos(2 * theta) * np.cos(theta / N), atol=1e-16)
    by_jax = jax.vmap(jax.grad(effect.error))(theta)
    np.testing.assert_allclose(effect.slope(theta), by_jax, atol=1e-15)


def test_encoder_eccentricity_changes_outputs_and_not_the_motion():
    model = BASE.with_effects(
        MotorEncoderEccentricity(cosine=3e-3, sine=1e-3), LoadEncoderEccentricity(cosine=-2e-4, sine=1e-4, n=2.0)
    )
    for state in (START, jnp.asarray([-70.0, -1.43, 3.0, 0.1])):
        theta_m, theta_l = float(state[0]), float(state[1])
        motor = theta_m + 3e-3 * np.cos(theta_m) + 1e-3 * np.sin(theta_m)
        load = theta_l - 2e-4 * np.cos(2 * theta_l) + 1e-4 * np.sin(2 * theta_l)
        np.testing.assert_allclose(model.outputs(state), [motor / N, motor / N - load], atol=1e-15)
        nothing = jnp.zeros(())
        np.testing.assert_array_equal(model.rates(state, nothing, nothing), BASE.rates(state, nothing, nothing))


def test_offsets_of_sensors_change_readings_and_not_the_motion():
    model = replace(BASE, measured=("dynamic_error", "load_angle", "joint_torque"))
    shifted = model.with_effects(EncoderOffset(offset=3e-4), JointTorqueBias(bias=0.7))
    read, nothing = np.asarray(model.outputs(START)), jnp.zeros(())
    np.testing.assert_allclose(shifted.outputs(START), read + [-3e-4, 3e-4, 0.7], rtol=1e-14)
    np.testing.assert_array_equal(shifted.rates(START, nothing, nothing), BASE.rates(START, nothing, nothing))


def test_narrow_smooth_knee_equals_three_slope_stiffness():
    """With a narrow knee it is three slopes whose second knee is never reached."""
    smooth = SmoothKneeStiffness(stiffening=0.4, knee=5e-4, width=1e-9)
    sharp = ThreeSlopeStiffness(stiffening_2=0.4, stiffening_3=0.2, x1=5e-4, gap=0.05)
    x = jnp.linspace(-2e-3, 2e-3, 401)
    at = lambda e: np.asarray(  # noqa: E731
        jax.vmap(lambda x: e.torque(Motion(x=x, v=jnp.zeros(())), BASE.drive, jnp.zeros(0)))(x)
    )
    np.testing.assert_allclose(at(smooth), at(sharp), atol=1e-5)
    assert float(smooth.derived(BASE.drive)["K2"][0]) == pytest.approx(1.4 * K)


def test_position_dependent_friction_dissipates_with_a_ripple_below_its_mean():
    """At every angle and rate, on either side."""
    motor = PositionDependentMotorFriction(T_c=0.1, cosine=0.05, sine=0.05, n=2.0, transition=1.0)
    mesh = PositionDependentMeshFriction(T_c=0.1, cosine=0.05, sine=0.05, n=2.0, v_0=0.01)
    for theta in np.linspace(0, 2 * np.pi, 17):
        for rate in (-20.0, -0.1, 0.3, 9.0):
            motion = Motion(x=jnp.zeros(()), v=jnp.asarray(rate), theta_m=jnp.asarray(theta), omega_m=jnp.asarray(rate))
            assert float(motor.torque(motion, BASE.drive, jnp.zeros(0))) * rate < 0
            # Torque on the load, which moves against v.
            assert float(mesh.torque(motion, BASE.drive, jnp.zeros(0))) * rate > 0


def test_model_without_needed_time_or_temperature_is_refused():
    nothing = jnp.zeros(())
    for effect, asked in (
        (ThermalStiffness(k_T=1e-3), "`thermal_stiffness` needs the drive's temperature"),
        (LoadDisturbance(omega=3.0), "`load_disturbance` needs the time"),
    ):
        model = BASE.with_effects(effect)
        with pytest.raises(ValueError, match=asked):
            model.rates(START, nothing, nothing)
        model.rates(START, nothing, nothing, Conditions(nothing, nothing))


SCALES = Scales(x=1e-3, x_max=3e-3, v=0.4, omega_m=20.0, omega_l=0.4, time_step=1e-3)


@pytest.mark.parametrize("has_motor", (True, False))
def test_only_effects_supported_by_the_logs_signals_are_proposed(has_motor):
    names = {form.name for form in applicable(CATALOGUE, SCALES, has_motor=has_motor)}
    assert not names & {"thermal_stiffness", "thermal_damping", "thermal_motor_friction"}
    assert not names & {"load_disturbance", "two_line_disturbance"}
    assert ("cogging" in names) is has_motor
    assert {"creep", "maxwell_slip", "quintic_stiffness"} < names
    rich = Scales(
        **{n: getattr(SCALES, n) for n in ("x", "x_max", "v", "omega_m", "omega_l", "time_step")},
        temperature=300.0,
        temperature_change=1.0,
        residual_frequencies=(90.0, 400.0, 700.0),
    )
    found = applicable(CATALOGUE, rich, has_motor=has_motor)
    names = {form.name for form in found}
    assert {"thermal_stiffness", "thermal_damping"} < names
    if has_motor:
        assert len(found) == len(CATALOGUE)
        assert [float(e.omega) for e in found[LoadDisturbance]] == [90.0, 400.0, 700.0]
        assert len(found[TwoLineDisturbance]) == 3
        ReducedDrive_forms = [f for f in CATALOGUE if not f.needs_motor]
        ReducedModel(ReducedDrive(mu=1.0, omega_0=30.0), tuple(found[f][0] for f in ReducedDrive_forms))


@pytest.mark.parametrize("lag", (1e-8, 3e-5, 8.3e-5, 4e-4, 3e-3))
def test_lag_of_a_held_torque_is_a_first_order_filter(lag):
    """Against the exact response to a held torque, by its mean in each interval."""
    random = np.random.default_rng(5)
    step, count = 1e-3, 40
    time = step * np.cumsum(random.uniform(0.8, 1.2, count))
    values = random.normal(size=count)
    signal = sampled(time, values, hold="zero-order")
    found = signal.lagged(jnp.asarray(lag))
    width = np.diff(np.asarray(signal.knots))
    y, means = values[0], []
    for u, h in zip(values, width, strict=True):
        means.append(u + (y - u) * lag / h * -np.expm1(-h / lag))
        y = u + (y - u) * np.exp(-h / lag)
    powers = 1.0 / np.arange(1.0, 7.0)
    ours = np.sum(np.asarray(found.coefficients) * width[:, None] ** np.arange(6) * powers, axis=1)
    np.testing.assert_allclose(ours, means, atol=1e-12)


def test_lag_of_a_linear_torque_agrees_with_scipy():
    time = 1e-3 * np.arange(30)
    values = np.sin(200 * time) + 0.3 * np.cos(700 * time)
    lag = 2e-3
    found = sampled(time, values, hold="linear").lagged(jnp.asarray(lag))
    inside = time[:-1] + 0.4e-3
    # It starts settled: u - lag u'.
    start = [values[0] - lag * (values[1] - values[0]) / 1e-3]
    lagging = lambda t, y: (np.interp(t, time, values) - y) / lag  # noqa: E731
    other = solve_ivp(lagging, (0.0, 0.029), start, "RK45", inside, rtol=1e-8, atol=1e-10, max_step=2e-4).y[0]
    # The exponential's quintic errs by (h/lag)^6 / 6! / 2^11 = 1e-8 here, scipy by its tolerance at the corners.
    np.testing.assert_allclose(jax.vmap(found)(jnp.asarray(inside)), other, atol=3e-6)


@jax.jit
def first_coefficients(signal, lag):
    """Sum of the lagging signal at the knots, and its slope by the lag."""
    return jax.value_and_grad(lambda lag: jnp.sum(signal.lagged(lag).coefficients[:, 0]))(lag)


def test_derivative_by_the_lag_is_finite_for_tiny_lags():
    signal = sampled(1e-3 * np.arange(20), np.random.default_rng(1).normal(size=20), hold="zero-order")
    for lag in (1e-12, 1e-6, 8.33333e-5, 1e-3):
        value = jnp.asarray(lag)
        slope = float(first_coefficients(signal, value)[1])
        assert np.isfinite(slope)
        if lag > 1e-5:
            h = 1e-5 * lag
            after, before = (first_coefficients(signal, value + s * h)[0] for s in (1, -1))
            assert slope == pytest.approx(float(after - before) / (2 * h), rel=1e-5)


def test_every_effect_is_documented():
    text = (Path(__file__).parents[2] / "docs" / "effects.md").read_text(encoding="utf-8")
    for form in CATALOGUE:
        assert f"`{form.family}`" in text
        assert f"`{form.name}`" in text
