"""Creep against the closed form of the standard linear solid."""

import jax.numpy as jnp
import numpy as np
import pytest

from hdjax import Harmonic, ReducedDrive, ReducedModel, simulate
from hdjax.effects import Motion
from hdjax.effects.creep import Creep

OMEGA, SHARE, TAU = 60.0, 0.25, 0.8
EFFECT = Creep(k=SHARE * OMEGA**2, tau=TAU, span=1e-3)
DRIVE = ReducedDrive(mu=80.0, omega_0=OMEGA)


def test_creep_after_a_torque_step_agrees_with_the_closed_form():
    """At once F / (K (1 + share)), in the end F / K = F / omega_0^2, between them exp(-t / (tau (1 + share))).

    Inertia and damping follow in 1 / 30 s; they leave the slow motion late by about mu / omega_0^2 = 0.02 s.
    """
    F = 3.6
    times = np.linspace(0.0, 4.0, 41)
    found = simulate(ReducedModel(DRIVE, (EFFECT,)), Harmonic(F, 0.0), times).dynamic_error
    twist = F / OMEGA**2
    expected = twist * (1 - SHARE / (1 + SHARE) * np.exp(-times / (TAU * (1 + SHARE))))
    np.testing.assert_allclose(found[10:], expected[10:], atol=0.005 * twist)
    assert abs(float(found[-1]) - twist) < 0.005 * twist


@pytest.mark.parametrize("omega", (0.05, 1.25, 40.0))
def test_creep_has_the_complex_stiffness_of_the_standard_linear_solid(omega):
    """k(omega) = K (1 + share i omega tau / (1 + i omega tau)), from the rates at a harmonic twist."""
    s = 1j * omega
    z = 1.0 / (1.0 + s * TAU)  # of the harmonic twist 1
    for phase in (0.0, 0.7, 2.0):
        turn = np.exp(1j * phase)
        motion = Motion(x=jnp.asarray(turn.real), v=jnp.asarray((s * turn).real))
        state = jnp.asarray([(z * turn).real])
        assert float(EFFECT.state_rates(motion, state)[0]) == pytest.approx((s * z * turn).real, abs=1e-12)
        torque = DRIVE.stiffness * motion.x + EFFECT.torque(motion, DRIVE, state)
        k = OMEGA**2 * (1 + SHARE * s * TAU / (1 + s * TAU))
        assert float(torque) == pytest.approx((k * turn).real, rel=1e-12, abs=1e-9)


def test_creep_initial_state_is_the_relaxed_one():
    motion = Motion(x=jnp.asarray(2e-3), v=jnp.asarray(0.0))
    state = EFFECT.initial_state(motion)
    assert float(state[0]) == 2e-3
    assert float(EFFECT.torque(motion, DRIVE, state)) == 0.0
    assert float(EFFECT.initial_state()[0]) == 0.0
