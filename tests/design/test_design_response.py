"""Measures of the steady response against the linear drive's closed forms, and their gradients against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdjax import Drive, TwoInertiaModel
from hdjax.design import Case, Excitation
from hdjax.design.response_measures import FoldDistance, Loss, MeshTorque, PeakError, outside, responses
from hdjax.effects import MeshGeometryEffect
from hdjax.effects.kinematic import KinematicError, KinematicHarmonic, KinematicSidebands

# In units in which omega_0 = 1 and c = 1: J_m = J_l = 2, N = 1.
MU, TORQUE = 0.1, 0.6
SLOW, FAST = 0.3, 2.2


def case(alpha: float | jax.Array = 0.0, B_sp: float | jax.Array = MU) -> Case:
    drive = Drive(N=1.0, J_m=2.0, J_l=2.0, K=1.0, alpha=alpha, B_sp=B_sp)
    return Case(TwoInertiaModel(drive), Excitation(amplitude=TORQUE))


@eqx.filter_jit
def measured(alphas: jax.Array, dampings: jax.Array, ends: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Peak and loss by row, and their slopes by alpha and B_sp."""

    def of_one(p, end):
        at = case(p[0], p[1])
        # Folds of 0.5 to 1 are searched for from 0.25 to 2.
        measures = [PeakError(SLOW, end), Loss(SLOW, end), FoldDistance(0.5, 1.0)]
        found = jnp.stack(responses(at, measures))
        return found, found

    slopes, found = jax.vmap(jax.jacfwd(of_one, has_aux=True))(jnp.stack([alphas, dampings], axis=1), ends)
    return found, slopes


STEP = 1e-4
# Linear with the resonance, linear up to a speed below it, and a hardening drive with folds; then steps in both.
ALPHAS = np.array([0.0, 0.0, 1.0, 1.0 + STEP, 1.0 - STEP, 1.0, 1.0])
DAMPINGS = np.array([MU, MU, MU, MU, MU, MU + STEP, MU - STEP])
ENDS = np.array([FAST, 0.7, FAST, FAST, FAST, FAST, FAST])


@pytest.fixture(scope="module")
def found() -> tuple[np.ndarray, np.ndarray]:
    values, slopes = measured(*(jnp.asarray(a) for a in (ALPHAS, DAMPINGS, ENDS)))
    return np.asarray(values), np.asarray(slopes)


def linear(omega: np.ndarray) -> np.ndarray:
    return 0.5 * TORQUE / np.hypot(1.0 - omega**2, MU * omega)


def test_peak_error_of_a_linear_drive_agrees_with_the_closed_form(found: tuple[np.ndarray, np.ndarray]):
    values, slopes = found
    # The amplitude is largest, A/(mu omega_d), a little below omega_0.
    exact = 0.5 * TORQUE / (MU * np.sqrt(1.0 - MU**2 / 4.0))
    assert values[0, 0] == pytest.approx(exact, rel=1e-9)
    assert slopes[0, 0, 1] == pytest.approx(-exact / MU * (1.0 - MU**2 / 4.0 / (1.0 - MU**2 / 4.0)), rel=1e-6)


def test_peak_error_below_resonance_is_that_at_the_fastest_speed(found: tuple[np.ndarray, np.ndarray]):
    values, slopes = found
    size = linear(np.array(0.7))
    assert values[1, 0] == pytest.approx(size, rel=1e-9)
    assert slopes[1, 0, 1] == pytest.approx(-(size**3) * MU * 0.49 / (0.5 * TORQUE) ** 2, rel=1e-6)


def test_loss_of_a_linear_drive_is_the_power_of_its_damper(found: tuple[np.ndarray, np.ndarray]):
    """`pi B_sp w a^2` in a cycle, so `B_sp w^2 a^2/2` on average."""
    values, _ = found
    for row, end in ((0, FAST), (1, 0.7)):
        omega = SLOW + (end - SLOW) / 32 * (np.arange(32) + 0.5)
        power = 0.5 * MU * (omega * linear(omega)) ** 2
        assert values[row, 1] == pytest.approx(power.mean(), rel=1e-9)


def test_peak_error_of_a_hardening_drive_lies_on_the_backbone(found: tuple[np.ndarray, np.ndarray]):
    """There `A = mu omega a`, and the backbone of one harmonic is `omega^2 = 1 + 3/4 a^2`."""
    values, _ = found
    a = np.roots([0.75 * MU**2, 0.0, MU**2, 0.0, -((0.5 * TORQUE) ** 2)])
    first = a[(np.abs(a.imag) < 1e-9) & (a.real > 0)].real.item()
    # Higher harmonics are a hundredth of it.
    assert values[2, 0] == pytest.approx(first, rel=0.03)


def test_peak_error_gradients_agree_with_differences(found: tuple[np.ndarray, np.ndarray]):
    values, slopes = found
    differences = np.stack([values[3] - values[4], values[5] - values[6]], axis=1) / (2 * STEP)
    # Which speeds lie between which folds, and so the loss, changes by jumps; the peak does not.
    np.testing.assert_allclose(slopes[2, 0], differences[0], rtol=1e-5)
    np.testing.assert_allclose(slopes[2, 1], differences[1], rtol=1e-4)


def test_fold_distance_is_the_log_ratio_to_the_nearest_fold(found: tuple[np.ndarray, np.ndarray]):
    """Folds of this hardening drive are at 1.7797 and 1.3242 (docs/response.md); the linear one has none in reach."""
    values, slopes = found
    assert values[2, 2] == pytest.approx(np.log(1.3242), abs=1e-4)
    differences = np.array([values[3, 2] - values[4, 2], values[5, 2] - values[6, 2]]) / (2 * STEP)
    np.testing.assert_allclose(slopes[2, 2], differences, rtol=1e-5)
    assert values[0, 2] == pytest.approx(np.log(2.0)) and (slopes[0, 2] == 0.0).all()
    inside = outside(jnp.array([0.9, 1.2]), jnp.asarray(1.0), jnp.asarray(1.5))
    np.testing.assert_allclose(inside, [np.log(1.0 / 0.9), -np.log(1.2)])


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (KinematicSidebands(ratio=50.0), "longer period"),
        (KinematicHarmonic(n=6.0), "up to 5"),
        (KinematicHarmonic(n=2.5), "whole orders"),
    ],
)
def test_kinematic_errors_that_the_balance_can_not_carry_are_refused(error: MeshGeometryEffect, why: str):
    at = Case(TwoInertiaModel(case().drive, (error,)))
    with pytest.raises(ValueError, match=why):
        PeakError(0.2, 0.9, rotating=True).refuse(at)


@pytest.mark.slow
def test_peak_error_and_mesh_torque_under_kinematic_error_agree_with_closed_form():
    """`x'' + mu (x' + e') + (x + e) = 0`, e = E cos 2 theta_m at the speed of the motor: amplitude and mesh torque."""
    E, speeds = 1e-3, np.linspace(0.2, 0.9, 20_001)
    at = Case(TwoInertiaModel(case().drive, (KinematicError(cos_2=E),)))
    w = 2.0 * speeds
    size = E * np.abs((1.0 + 1j * MU * w) / (1.0 - w**2 + 1j * MU * w))
    found = eqx.filter_jit(PeakError(0.2, 0.9, rotating=True))(at)
    # The error's slope moves the motor's share of the torque: of order E N.
    assert float(found) == pytest.approx(size.max(), rel=0.02)
    # The mesh is twisted by x + e, far below the resonance by much less than x.
    twist = E * w**2 / np.abs(1.0 - w**2 + 1j * MU * w)
    for fast in (0.9, 0.25):
        torque = eqx.filter_jit(MeshTorque(0.2, fast, rotating=True))(at)
        assert float(torque) == pytest.approx(twist[speeds <= fast].max(), rel=0.02)
