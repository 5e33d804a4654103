"""Dry friction in a solver's steps: stopping, sticking and reversal, against closed forms and fine integration."""

from dataclasses import replace

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdjax import Drive, TwoInertiaModel, sampled
from hdjax.effects import Motion, Rubbing
from hdjax.effects.friction import CoulombFriction, LoadFriction, MotorFriction
from hdjax.effects.position import PositionDependentMotorFriction
from hdjax.effects.thermal import ThermalMotorFriction
from hdjax.rubbing import mean_signs
from hdjax.simulate import march

N, J_M, J_L = 50.0, 5.26e-4, 5.0e-2
LOOSE = Drive(N=N, J_m=J_M, J_l=J_L, K=1e-9)
DRIVE = Drive(N=100.0, J_m=1e-4, J_l=1.0, K=2e4, B_sp=5.0)
rates = st.floats(-3.0, 3.0)


@jax.jit
def sign_over_step(rate, change, reach, corner):
    return mean_signs([rate], [change], [[reach]], [corner])[0]


def mean_sign(rate, change, reach, corner=0.0):
    return float(sign_over_step(*(jnp.asarray(float(v)) for v in (rate, change, reach, corner))))


@eqx.filter_jit
def marched(model, torque, temperature=None):
    """States from rest at the samples and at the end, by one step for each sample."""
    start = jnp.zeros(4)
    return march(model, torque, None, start, solver=dfx.Tsit5(), substeps=1, temperature=temperature)


@given(rate=rates, change=rates, reach=st.floats(0.05, 3.0), corner=st.sampled_from([0.1, 1.0]))
@settings(max_examples=40, deadline=None)
def test_mean_sign_agrees_with_fine_integration_under_constant_acceleration(rate, change, reach, corner):
    """Against small steps of `rate' = change - reach clip(rate / ramp)`, with a ramp in place of the tanh."""
    ramp, steps = 2 * np.log(2) * corner, 4000
    now, total = rate, 0.0
    for _ in range(steps):
        middle = now + (change - reach * min(max(now / ramp, -1.0), 1.0)) / (2 * steps)
        sign = min(max(middle / ramp, -1.0), 1.0)
        now, total = now + (change - reach * sign) / steps, total + sign / steps
    assert mean_sign(rate, change, reach, corner) == pytest.approx(total, abs=1e-5)


@given(rate=rates, change=rates, reach=st.floats(0.05, 3.0), corner=st.sampled_from([0.0, 1e-3, 0.3]))
@settings(max_examples=60, deadline=None)
def test_mean_sign_is_odd_bounded_and_opposes_the_rate(rate, change, reach, corner):
    sign = mean_sign(rate, change, reach, corner)
    assert abs(sign) <= 1.0 + 1e-9
    assert mean_sign(-rate, -change, reach, corner) == pytest.approx(-sign, abs=1e-9)
    # Friction alone never increases the rate.
    assert abs(rate - reach * mean_sign(rate, 0.0, reach, corner)) <= abs(rate) + 1e-9


def test_mean_sign_of_a_sharp_corner_agrees_with_slip_stick_and_reversal():
    assert mean_sign(5.0, -1.0, 2.0) == pytest.approx(1.0)
    # At rest after half the step, and held there against a third of the friction.
    assert mean_sign(1.0, 1.0, 3.0) == pytest.approx(0.5 + 0.5 / 3, abs=1e-3)
    assert mean_sign(0.0, 1.0, 3.0) == pytest.approx(1 / 3, abs=1e-3)
    # At rest after a quarter of the step, then backwards.
    assert mean_sign(1.0, -3.0, 1.0) == pytest.approx(0.25 - 0.75, abs=3e-3)
    assert mean_sign(0.0, 4.0, 1.0) == pytest.approx(1.0, abs=1e-2)


SLOPES = [jax.jit(derivative(sign_over_step, argnums=(0, 1, 2, 3))) for derivative in (jax.jacfwd, jax.jacrev)]


@pytest.mark.parametrize("corner", [0.0, 0.2])
@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 1.0), (0.0, 1.0, 1e-12)])
def test_derivatives_of_the_mean_sign_are_finite(at, corner):
    """Also at rest, without friction, and at the limit of sticking; in forward and reverse mode."""
    for slopes in SLOPES:
        assert np.all(np.isfinite(slopes(*(jnp.asarray(v) for v in (*at, corner)))))


def test_mean_signs_bring_two_coupled_rates_to_rest_together():
    """Sufficiently strong friction on the motor and in the mesh: both rates end at zero."""
    mobility = np.array([[1.0, 0.5], [0.5, 1.0]])
    rate, change = np.array([0.2, -0.1]), np.array([0.3, 0.4])
    reaches = [[jnp.asarray(5.0 * m) for m in row] for row in mobility]
    signs = mean_signs([jnp.asarray(r) for r in rate], [jnp.asarray(c) for c in change], reaches, [jnp.zeros(())] * 2)
    np.testing.assert_allclose(rate + change - 5.0 * mobility @ np.array(signs), 0.0, atol=2e-2)


def friction_of(name: str, width: float):
    return {
        "motor": (MotorFriction(T_c=0.12, transition=width),),
        "mesh": (CoulombFriction(T_c=2.0, v_0=width / 100),),
        "load": (LoadFriction(T_c=5.0, transition=width / 100),),
        "ripple": (PositionDependentMotorFriction(T_c=0.12, cosine=0.04, transition=width),),
        "motor and mesh": (MotorFriction(T_c=0.12, transition=width), CoulombFriction(T_c=2.0, v_0=width / 100)),
    }[name]


@pytest.mark.parametrize("name", ["motor", "mesh", "load", "ripple", "motor and mesh"])
def test_one_step_a_sample_suffices_for_stick_slip(name):
    """A corner far sharper than the steps, and one about as sharp, to 2 % of the twist and better with finer steps."""
    count, dt = 600, 1e-3
    t = dt * np.arange(count)
    torque = sampled(t, 0.25 * np.sin(2 * np.pi * 3 * t) + 0.1 * np.sin(2 * np.pi * 8 * t), hold="zero-order")

    @jax.jit
    def twist(model, substeps):
        states, _ = march(model, torque, None, jnp.zeros(4), solver=dfx.Tsit5(), substeps=substeps)
        return states[:, 0] / DRIVE.N - states[:, 1]

    for width in (1e-3, 0.3):
        model = TwoInertiaModel(DRIVE).with_effects(*friction_of(name, width))
        fine = twist(model, 128)
        coarse, finer = (float(jnp.std(twist(model, n) - fine) / jnp.std(fine)) for n in (1, 4))
        assert coarse < (0.1 if name == "ripple" else 0.02)
        assert finer < 0.5 * coarse


@pytest.mark.parametrize("substeps", [1, 4])
def test_free_motor_with_friction_stops_at_the_closed_form_angle(substeps):
    """It stops after `J_m omega / T_c`, having turned by `J_m omega^2 / (2 T_c)`, to within the change of one step.

    It stays at rest with finite derivatives, although the transition is a millionth of that rate.
    """
    count, dt, level, omega = 400, 1e-3, 0.05, 20.0
    sharp = TwoInertiaModel(LOOSE).with_effects(MotorFriction(T_c=level, transition=1e-6))
    torque = sampled(dt * np.arange(count), np.zeros(count), hold="zero-order")

    def states(start):
        return march(sharp, torque, None, jnp.asarray([0.0, 0.0, start, 0.0]), solver=dfx.Tsit5(), substeps=substeps)[0]

    motion, slope = jax.jit(lambda omega: jax.jvp(states, (omega,), (1.0,)))(omega)
    stop, turned = J_M * omega / level, J_M * omega**2 / (2 * level)
    a_step = level / J_M * dt / substeps
    assert stop < 0.8 * count * dt
    late = int(np.ceil(1.2 * stop / dt))
    assert np.all(np.abs(motion[late:, 2]) < 1e-3 * a_step)
    # One step decelerates evenly although the motor rests for a part of it.
    np.testing.assert_allclose(motion[late:, 0], turned, atol=0.2 * a_step * dt / substeps)
    np.testing.assert_allclose(slope[late:, 0], J_M * omega / level, rtol=2 * a_step / omega)


def test_motor_sticks_below_the_friction_level_and_slides_above_it():
    count, dt, level = 200, 1e-3, 0.05
    model = TwoInertiaModel(LOOSE).with_effects(MotorFriction(T_c=level, transition=1e-6))

    def end(torque):
        signal = sampled(dt * np.arange(count), np.full(count, torque), hold="zero-order")
        return np.asarray(marched(model, signal)[1])

    assert np.all(np.abs(end(0.9 * level)[2]) < 1e-4)
    assert end(1.5 * level)[2] == pytest.approx(0.5 * level / J_M * dt * count, rel=1e-4)


def test_frictions_on_one_rate_stick_with_their_sum():
    """A temperature that reduces the motor's friction reduces the torque at which it slips."""
    warm = ThermalMotorFriction(T_c_T=0.003, transition=1e-6, T_0=300.0)
    model = TwoInertiaModel(LOOSE).with_effects(MotorFriction(T_c=0.05, transition=1e-6), warm)
    t = 1e-3 * np.arange(200)

    def rate_under(torque):
        signal, warmth = (sampled(t, np.full(200, v), hold="zero-order") for v in (torque, 310.0))
        return float(marched(model, signal, warmth)[1][2])

    assert abs(rate_under(0.019)) < 1e-3
    assert rate_under(0.022) == pytest.approx(0.002 / J_M * 0.2, rel=1e-3)


def test_friction_law_is_unchanged_where_steps_resolve_its_transition():
    motion = Motion(x=jnp.zeros(()), v=jnp.asarray(0.01), omega_m=jnp.asarray(0.5))
    friction = MotorFriction(T_c=0.05, transition=0.5)

    def torque(reach):
        """In a step over which the sign's mean is 0.3."""
        held = Rubbing(sign=jnp.asarray(0.3), reach=jnp.asarray(reach))
        return float(friction.torque(replace(motion, rubbing={"omega_m": held}), LOOSE, jnp.zeros(0)))

    by_law = -0.05 * np.tanh(1.0)
    assert float(friction.torque(motion, LOOSE, jnp.zeros(0))) == pytest.approx(by_law)
    assert torque(1e-6) == pytest.approx(by_law)
    assert torque(0.05) == pytest.approx(by_law, rel=1e-4)
    assert torque(500.0) == pytest.approx(-0.05 * 0.3, rel=1e-3)
