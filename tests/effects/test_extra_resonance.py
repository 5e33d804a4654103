"""The third inertia against three masses on a line, solved by numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitting.uncertainty.identifiability import parameters_at_bounds
from hdjax import Drive, TwoInertiaModel
from hdjax.effects.resonance import ExtraResonance, ResonanceBesideLoad

N, J_M, J_L, K, B = 50.0, 5.26e-4, 5.0e-2, 7160.0, 0.4


def model(J_3: float, K_3: float, B_3: float, form=ExtraResonance) -> TwoInertiaModel:
    omega = np.sqrt(K_3 / J_3)
    effect = form(mass_ratio=J_3 / J_L, omega_3=omega, zeta=B_3 / (2 * omega * J_3), twist_span=1e-3, rate_span=1.0)
    return TwoInertiaModel(Drive(N=N, J_m=J_M, J_l=J_L, K=K, B_sp=B), (effect,))


@jax.jit
def linear(model: TwoInertiaModel) -> tuple[jax.Array, jax.Array]:
    """System matrix and input column of the motor torque."""
    nothing = jnp.zeros(())
    return (
        jax.jacfwd(lambda y: model.rates(y, nothing, nothing))(jnp.zeros(6)),
        jax.jacfwd(lambda u: model.rates(jnp.zeros(6), u, nothing))(nothing),
    )


def three_masses(J_3: float, K_3: float, B_3: float, left: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass, damping and stiffness of motor (at the output), load and third inertia."""
    pair = np.array([[1.0, -1.0], [-1.0, 1.0]])
    stiffness, damping = np.zeros((3, 3)), np.zeros((3, 3))
    stiffness[:2, :2] += K * pair
    stiffness[1:, 1:] += K_3 * pair
    damping[:2, :2] += B * pair
    damping[1:, 1:] += B_3 * pair
    return np.diag([N**2 * J_M, left, J_3]), damping, stiffness


@pytest.mark.parametrize("form", [ExtraResonance, ResonanceBesideLoad])
@given(ratio=st.floats(1e-3, 0.8), omega=st.floats(50.0, 3000.0), zeta=st.floats(1e-3, 0.5))
def test_third_inertia_has_poles_and_transfer_function_of_three_masses(form, ratio, omega, zeta):
    J_3 = ratio * J_L
    K_3, B_3 = J_3 * omega**2, 2 * zeta * omega * J_3
    A, b = (np.asarray(a) for a in linear(model(J_3, K_3, B_3, form)))
    left = J_L - J_3 if form is ExtraResonance else J_L
    M, D, S = three_masses(J_3, K_3, B_3, left)
    inverse = np.linalg.inv(M)
    other = np.block([[np.zeros((3, 3)), np.eye(3)], [-inverse @ S, -inverse @ D]])
    # Eigenvalues of a double root at zero (the drive turns freely) err by the root of the rounding.
    key = lambda v: (np.round(np.abs(v), 1), v.imag)  # noqa: E731
    found, expected = (sorted(np.linalg.eigvals(a), key=key) for a in (A, other))
    np.testing.assert_allclose(found, expected, atol=1e-4 * omega + 1e-2)
    for s in (1j * 80.0, 1j * 386.0, 1j * omega, 10.0 + 1j * 900.0):
        state = np.linalg.solve(s * np.eye(6) - A, b)
        output = np.linalg.solve(s**2 * M + s * D + S, np.array([N, 0.0, 0.0]))  # N T_m at the output
        np.testing.assert_allclose(state[0] / N, output[0], rtol=1e-7)
        np.testing.assert_allclose(state[1], output[1], rtol=1e-7)
        np.testing.assert_allclose(state[4], output[2] - output[1], rtol=1e-6, atol=1e-9 * abs(output[2]))


def test_load_response_has_a_zero_at_the_third_inertias_frequency():
    """The zero of the load's response, undamped."""
    A, b = (np.asarray(a) for a in linear(model(1e-2, 1e-2 * 500.0**2, 0.0)))
    state = np.linalg.solve(500j * np.eye(6) - A, b)
    assert abs(state[1]) < 1e-9 * abs(state[4])


def test_third_inertia_exerts_no_torque_on_a_load_at_constant_speed():
    """The third inertia starts at the load's angle and rate, so that their spring is not twisted."""
    drive = model(1e-2, 4000.0, 0.1)
    turning = drive.settled(jnp.asarray([50.0 * 12.0, 12.0, 50.0 * 3.0, 3.0]))
    rates = drive.rates(turning, jnp.zeros(()), jnp.zeros(()))
    np.testing.assert_allclose(rates, [150.0, 3.0, 0.0, 0.0, 0.0, 0.0], atol=1e-9)


def test_third_inertia_reports_its_derived_parameters():
    effect = model(1e-2, 4000.0, 0.1)
    found = {name: float(v) for name, (v, _) in effect.effects[0].derived(effect.drive).items()}
    assert found == pytest.approx({"J_3": 1e-2, "K_3": 4000.0, "B_3": 0.1, "zero": np.sqrt(4e5) / (2 * np.pi)})


@pytest.mark.parametrize(("zeta", "ended"), [(1e-20, ["extra_resonance.zeta"]), (1e-2, [])])
def test_undamped_third_inertia_has_ended_at_a_bound(zeta, ended):
    """A free motion without damping that begins anew in each segment imitates a line."""
    J_3, omega = 0.1 * J_L, 200.0
    undamped = model(J_3, J_3 * omega**2, 2 * zeta * omega * J_3)
    assert parameters_at_bounds(undamped, "extra_resonance") == ended
