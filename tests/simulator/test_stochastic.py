"""Simulated motions under random torque against their exact stationary laws."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from noisy_oscillator import GAIN, MU, OMEGA_0, S, oscillator, pair
from scipy.linalg import expm, solve_discrete_lyapunov

from hdjax import (
    Drive,
    Ending,
    Harmonic,
    ReducedDrive,
    ReducedModel,
    SimulationError,
    TwoInertiaModel,
    hdc_40_050,
    simulate,
)
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.hysteresis import BoucWen
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.learned import LearnedMotorTorque
from hdjax.effects.learned_axes import PowerAxis
from hdjax.noise import ColouredNoise, WhiteNoise
from hdjax.stationary import coloured_variance, stationary_variance
from hdjax.stochastic import AdditiveRK4, simulate_noisy

# -- the solver --


def one_step(tableau, L: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """One step of a solver on `y' = L y + (0, w)`: its matrix, and the covariance that it adds."""
    identity = np.eye(2)
    # Columns: y, the increment W and its Levy area H.
    own, noise = np.eye(2, 4), np.zeros((2, 4))
    slopes = []
    for i, (u, area) in enumerate(zip(tableau.coeffs_w.a, tableau.coeffs_hh.a, strict=True)):
        noise = np.outer(identity[1], [0, 0, u, area])
        lower = tableau.a[i - 1] if i else []
        slopes.append(h * L @ (own + noise + sum(a * k for a, k in zip(lower, slopes, strict=True))))
    end = own + np.outer(identity[1], [0, 0, 1, 0]) + sum(b * k for b, k in zip(tableau.b_sol, slopes, strict=True))
    return end[:, :2], end[:, 2:] @ np.diag([h, h / 12]) @ end[:, 2:].T


def exact_step(L: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """By Van Loan's matrix exponential."""
    block = expm(h * np.block([[-L, np.diag([0.0, 1.0])], [np.zeros((2, 2)), L.T]]))
    return block[2:, 2:].T, block[2:, 2:].T @ block[:2, 2:]


def test_one_step_has_the_exact_mean_and_covariance_to_its_order():
    L = np.array([[0.0, 1.0], [-1.0, -0.3]])
    errors = []
    for h in (0.1, 0.05):
        errors.append(
            [np.abs(f - e).max() for f, e in zip(one_step(AdditiveRK4.tableau, L, h), exact_step(L, h), strict=True)]
        )
    orders = np.log2(errors[0]) - np.log2(errors[1])
    # The motion errs by h^5 a step; the covariance would by h^3 for weak order 2, but is better for linear motion.
    assert orders[0] == pytest.approx(5.0, abs=0.2)
    assert orders[1] > 3.8
    # The mean under a curved drift; a linear motion does not depend on this coefficient.
    weights, w = AdditiveRK4.tableau.b_sol, AdditiveRK4.tableau.coeffs_w.a
    assert weights @ (w**2 + 1 / 12) == pytest.approx(0.5, rel=1e-14)
    assert AdditiveRK4().order(None) == 4 and AdditiveRK4().strong_order(None) == 1.5


def stationary_bias(solver, z: float) -> float:
    """Relative error of the variance that steps of z/omega_0 give a drive of the damping ratio 5e-4."""
    matrix, added = one_step(solver.tableau, np.array([[0.0, 1.0], [-1.0, -1e-3]]), z)
    if np.abs(np.linalg.eigvals(matrix)).max() >= 1.0:
        return np.inf
    return solve_discrete_lyapunov(matrix, added)[0, 0] / 500.0 - 1.0


def test_variance_bias_at_light_damping_is_least_for_additive_rk4():
    assert stationary_bias(AdditiveRK4(), 0.1) == pytest.approx(-(0.1**5) / 72 / 1e-3, rel=0.05)
    assert stationary_bias(AdditiveRK4(), 0.2) == pytest.approx(-(0.2**5) / 72 / 1e-3, rel=0.05)
    for solver in (dfx.ShARK(), dfx.SRA1()):
        assert stationary_bias(solver, 0.1) > 0.3
        assert stationary_bias(solver, 0.16) == np.inf


# -- simulated variances --

TIMES = np.linspace(0.3, 3.3, 31)
LATE = 10  # saves after 1 s, when the transient has decayed to exp(-12) of its energy


@eqx.filter_jit
def motions(model, noise, keys, substeps, solver):
    def motion(key):
        return simulate_noisy(model, noise, TIMES, key, substeps=substeps, solver=solver, throw=False)

    return jax.vmap(motion)(keys)


def assert_variances(found: np.ndarray, exact: np.ndarray) -> None:
    """Mean squares of (lanes, saves, quantities) against the law, within 4 standard errors of independent lanes."""
    squares = np.mean(found**2, axis=1)
    standard_error = np.std(squares, axis=0, ddof=1) / np.sqrt(squares.shape[0]) / exact
    assert standard_error.max() < 0.01
    np.testing.assert_array_less(np.abs(squares.mean(axis=0) / exact - 1.0), 4 * standard_error)


def white(intensity: float) -> WhiteNoise:
    """Of that intensity in the oscillator's error forcing."""
    return WhiteNoise(intensity=intensity / GAIN**2)


@pytest.mark.parametrize(("alpha", "solver"), ((0.0, AdditiveRK4()), (1.0, AdditiveRK4()), (1.0, dfx.ShARK())))
def test_simulation_settles_to_the_stationary_variance(alpha, solver):
    # Steps of 0.1 rad, at which ShARK's energy gain of 0.1^3/4 omega_0 is 1e-3 of the damping.
    found = motions(ReducedModel(oscillator(alpha)), white(S), jax.random.split(jax.random.key(1), 2048), 50, solver)
    np.testing.assert_array_equal(found.ending, int(Ending.successful))
    assert_variances(np.asarray(found.states)[:, LATE:], pair(stationary_variance(oscillator(alpha), S)))


def test_coarse_steps_have_the_variance_that_the_tableau_predicts():
    """At 1.25 rad a step that law is far from the exact one, and depends on increments and Levy areas."""
    L = np.array([[0.0, 1.0], [-(OMEGA_0**2), -MU]])
    matrix, added = one_step(AdditiveRK4.tableau, L, 0.025)
    law = np.diag(solve_discrete_lyapunov(matrix, S * added))
    assert np.abs(law / [1.0, OMEGA_0**2] - 1.0).max() > 0.1
    found = motions(ReducedModel(oscillator()), white(S), jax.random.split(jax.random.key(7), 4096), 4, None)
    assert_variances(np.asarray(found.states)[:, LATE:], law)


def test_comparison_of_variances_detects_a_wrong_one():
    found = motions(
        ReducedModel(oscillator(1.0)), white(1.1 * S), jax.random.split(jax.random.key(1), 2048), 50, AdditiveRK4()
    )
    with pytest.raises(AssertionError):
        assert_variances(np.asarray(found.states)[:, LATE:], pair(stationary_variance(oscillator(1.0), S)))


def test_simulation_under_coloured_noise_settles_to_the_closed_form():
    noise = ColouredNoise(rms=500.0, correlation_time=0.02)
    found = motions(ReducedModel(oscillator()), noise, jax.random.split(jax.random.key(2), 2048), 25, None)
    states = np.asarray(found.states)[..., :3]  # without the load torque's noise, which is zero
    exact = pair(coloured_variance(oscillator(), noise.error_rms(oscillator()), 0.02))
    assert_variances(states[:, LATE:], np.append(exact, 500.0**2))
    # The noise itself is stationary from the start.
    torque = states[..., 2]
    assert np.mean(torque[:, 0] ** 2) == pytest.approx(500.0**2, rel=4 * np.sqrt(2 / 2048))
    np.testing.assert_array_equal(np.asarray(found.states)[..., 3], 0.0)


def test_coloured_noise_has_an_exponential_autocorrelation():
    noise = ColouredNoise(rms=1.0, load_rms=3.0, correlation_time=0.1)

    @jax.jit
    @jax.vmap
    def torques(key):
        return simulate_noisy(ReducedModel(oscillator()), noise, TIMES, key, throw=False).states[:, 2:]

    w = np.asarray(torques(jax.random.split(jax.random.key(3), 512)))
    # Saves are one correlation time apart.
    for lag in (1, 2):
        products = np.mean(w[:, :-lag] * w[:, lag:], axis=1) / [1.0, 9.0]
        standard_error = products.std(axis=0, ddof=1) / np.sqrt(512)
        np.testing.assert_array_less(np.abs(products.mean(axis=0) - np.exp(-lag)), 4 * standard_error)
    cross = np.mean(w[..., 0] * w[..., 1], axis=1) / 3.0
    assert abs(cross.mean()) < 4 * cross.std(ddof=1) / np.sqrt(512)


# -- two inertias --

PAIR = Drive(N=3, J_m=0.2, J_l=2.0, K=2250, alpha=300.0, B_sp=10.8)  # reduced: omega_0 = 48.7 rad/s, mu = 11.4 1/s


def test_two_inertias_settle_to_the_variance_of_the_error_equation():
    """Comparable noise on motor and load; the angles drift without bound, the dynamic error does not."""
    noise = WhiteNoise(intensity=20.0, load_intensity=150.0)
    motor, load = 20.0 / (3 * 0.2) ** 2, 150.0 / 2.0**2
    intensity = float(noise.error_intensity(PAIR))
    assert intensity == pytest.approx(motor + load, rel=1e-12)
    exact = pair(stationary_variance(PAIR, intensity))
    assert exact[0] < 0.8 * intensity / (2 * float(PAIR.mu) * float(PAIR.omega_0) ** 2)  # nonlinear
    found = motions(TwoInertiaModel(PAIR), noise, jax.random.split(jax.random.key(4), 2048), 25, None)
    states = np.asarray(found.states)
    twist = np.asarray(found.outputs)[..., 1]
    assert_variances(np.stack([twist, states[..., 2] / 3 - states[..., 3]], axis=-1)[:, LATE:], exact)


def test_same_noise_gives_the_same_error_in_both_models():
    """A Runge-Kutta method commutes with the linear map to (x, v): to rounding, not only in law."""
    hysteresis, reduced_hysteresis = (BoucWen(k=k, memory_twist=0.05) for k in (300.0, 300.0 * float(PAIR.c)))
    noise, forcing, key = ColouredNoise(rms=30.0, correlation_time=0.02), Harmonic(20.0, 40.0), jax.random.key(5)
    both = simulate_noisy(TwoInertiaModel(PAIR, (hysteresis,)), noise, TIMES, key, forcing=forcing)
    alone = simulate_noisy(ReducedModel(PAIR.reduced(), (reduced_hysteresis,)), noise, TIMES, key, forcing=forcing)
    np.testing.assert_allclose(both.dynamic_error, alone.dynamic_error, atol=1e-9)
    assert np.abs(alone.dynamic_error).max() > 0.04
    np.testing.assert_allclose(both.states[:, 4:], alone.states[:, 2:], atol=1e-9)
    for strength in (noise.error_rms, noise.white.error_intensity):
        assert float(strength(PAIR)) == pytest.approx(float(strength(PAIR.reduced())), rel=1e-14)


# -- agreement with simulate --


def test_noisy_simulation_without_noise_agrees_with_simulate():
    drive = hdc_40_050()
    model = TwoInertiaModel(drive, (KinematicError(cos_2=1e-3), BoucWen(k=700.0, memory_twist=2e-3)))
    times = np.linspace(0.1, 0.2, 21)
    motor, load = Harmonic(4.0, 300.0, 0.3, 1.0), Harmonic(5.0, 170.0, 1.1, -2.0)
    exact = simulate(model, motor, times, load_torque=load, rtol=1e-10, atol=1e-13)
    found = simulate_noisy(model, WhiteNoise(), times, jax.random.key(0), forcing=motor, load_torque=load, substeps=40)
    # RK4 at 0.05 rad a step errs by some 1e-6; where the hysteresis reverses, a step contains a kink.
    scale = np.abs(np.asarray(exact.states)).max(axis=0)
    np.testing.assert_allclose(found.states / scale[None, :], exact.states / scale[None, :], atol=1e-4)
    np.testing.assert_allclose(found.outputs[:, 1], exact.outputs[:, 1], atol=1e-4 * scale[1])


SHORT = TIMES[:6]
KEYS = jax.random.split(jax.random.key(6), 3)


def test_key_gives_the_same_motion_in_a_lane_under_jit_and_alone():
    model = ReducedModel(oscillator(1.0))
    lanes = motions(model, white(S), KEYS, 10, None)
    for k, key in enumerate(KEYS):
        alone = simulate_noisy(model, white(S), TIMES, key)
        np.testing.assert_allclose(lanes.states[k], alone.states, atol=1e-9)
    assert np.abs(np.asarray(lanes.states[0, -1] - lanes.states[1, -1])).max() > 1e-2
    compiled = eqx.filter_jit(simulate_noisy)(model, white(S), jnp.asarray(TIMES), KEYS[0])
    np.testing.assert_allclose(compiled.states, lanes.states[0], atol=1e-9)


@pytest.mark.slow
def test_gradients_of_a_noisy_motion_agree_with_differences():
    """Of the last twist, in everything; forward, reverse and by differences, at the same noise."""
    values = np.array([MU, OMEGA_0, 0.8, S / GAIN**2])

    def last(p, adjoint):
        model = ReducedModel(ReducedDrive(mu=p[0], omega_0=p[1], alpha=p[2], gain=GAIN))
        return simulate_noisy(model, WhiteNoise(intensity=p[3]), SHORT, KEYS[0], adjoint=adjoint).states[-1, 0]

    forward = jax.jit(jax.jacfwd(lambda p: last(p, dfx.ForwardMode())))
    reverse = jax.jit(jax.grad(lambda p: last(p, dfx.RecursiveCheckpointAdjoint())))
    ends = jax.jit(jax.vmap(lambda p: last(p, dfx.RecursiveCheckpointAdjoint())))
    h = 1e-5 * values
    both = np.asarray(ends(jnp.asarray(np.concatenate([values + np.diag(h), values - np.diag(h)]))))
    differences = (both[:4] - both[4:]) / (2 * h)
    found = np.asarray(forward(jnp.asarray(values)))
    # The motion turns by 25 rad: third derivatives are 25^2 times the first, steps of 1e-5 err by 1e-7.
    np.testing.assert_allclose(found * values, differences * values, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(reverse(jnp.asarray(values)), found, rtol=1e-9)
    assert np.isfinite(np.asarray(reverse(jnp.asarray(values).at[3].set(0.0)))).all()


def test_diverging_noisy_simulation_is_reported():
    """Noise drives a softening drive beyond its saddle."""
    model = ReducedModel(oscillator(-0.3))
    with pytest.raises(SimulationError, match="alpha"):
        simulate_noisy(model, white(4 * S), TIMES, KEYS[0])
    lanes = motions(model, white(4 * S), KEYS, 10, None)
    assert int(lanes.ending[0]) == Ending.not_finite


def test_invalid_arguments_of_a_noisy_simulation_are_refused():
    model = ReducedModel(oscillator())
    with pytest.raises(ValueError, match="`substeps` must be at least 1, but is 0"):
        simulate_noisy(model, white(S), TIMES, KEYS[0], substeps=0)
    with pytest.raises(ValueError, match="`forcing` must be a sampled signal for .*torque_bias"):
        simulate_noisy(model.with_effects(TorqueBias(bias=1.0)), white(S), TIMES, KEYS[0])
    learned = LearnedMotorTorque(axes=(PowerAxis("T_m", 1.0),), mixing=np.ones((5, 1)), c=(0.1,))
    with pytest.raises(ValueError, match="`learned_motor_torque` is a function of the motor torque"):
        simulate_noisy(TwoInertiaModel(hdc_40_050(), (learned,)), white(S), TIMES, KEYS[0])
    for times in ([0.0], [0.0, 0.1, 0.1]):
        with pytest.raises(ValueError, match="`times` must be two or more"):
            simulate_noisy(model, white(S), np.array(times), KEYS[0])
