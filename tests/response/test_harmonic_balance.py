"""Harmonic balance against time integration by scipy and closed forms, for both kinds of drive."""

from math import cos, sin

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orbits import duffing, period_error
from scipy.integrate import solve_ivp

from hdjax import Drive, ReducedModel, TwoInertiaModel
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.damping import QuadraticDamping
from hdjax.effects.friction import MotorFriction, ViscousLoadFriction
from hdjax.effects.hysteresis import BoucWen
from hdjax.effects.kinematic import KinematicError, KinematicHarmonic
from hdjax.effects.load import ConstantLoad, GravityLoad
from hdjax.effects.stiffness import QuadraticStiffness
from hdjax.fourier import FourierSeries, harmonic_series
from hdjax.response.harmonic_balance import SteadyState, balance, solve

SUFFICES = 1e-10
"""A defect below this means that the harmonics suffice for 1e-8: errors grow in a period, but by far less than 100."""


# -- random cases --

CASES = 60


def random_cases() -> tuple[np.ndarray, ...]:
    """mu, omega_0, alpha, omega, mean, cosines, sines; the first ten are a drive's, with its alpha."""
    rng = np.random.default_rng(0)
    omega_0 = 10 ** rng.uniform(-1, 3.5, CASES)
    omega_0[:10] = 385.545
    softens = rng.random(CASES) < 0.35
    alpha = np.where(softens, -1.0, 1.0) * 10 ** rng.uniform(-2, 5.3, CASES)
    alpha[:10] = np.sign(alpha[:10]) * 1e5
    # alpha x^2 at the static deflection of the forcing.
    nonlinearity = np.where(softens, rng.uniform(0.003, 0.03, CASES), 10 ** rng.uniform(-2, 0, CASES))
    level = omega_0**2 * np.sqrt(nonlinearity / np.abs(alpha))
    waves = rng.normal(size=(CASES, 2, 3)) * np.array([1.0, 0.4, 0.2])
    waves *= (level / np.linalg.norm(waves, axis=(1, 2)))[:, None, None]
    mu = 2 * omega_0 * 10 ** rng.uniform(-2, -0.5, CASES)
    omega = omega_0 * rng.uniform(0.4, 3.0, CASES)
    return mu, omega_0, alpha, omega, rng.uniform(-0.5, 0.5, CASES) * level, waves[:, 0], waves[:, 1]


def steady_state_of_case(mu, omega_0, alpha, omega, mean, cosine, sine) -> SteadyState:
    model = duffing(mu, alpha, omega_0)
    return solve(balance(model, FourierSeries(omega, mean, cosine, sine), harmonics=20), omega)


@pytest.fixture(scope="module")
def found() -> SteadyState:
    return eqx.filter_jit(jax.vmap(steady_state_of_case))(*(jnp.asarray(v) for v in random_cases()))


def test_steady_states_of_random_cases_agree_with_time_integration(found):
    cases = random_cases()
    usable = np.asarray(found.converged) & (np.asarray(found.defect) < SUFFICES)
    assert usable.sum() >= 50 and usable[:10].sum() >= 8
    assert (cases[2][usable] < 0).sum() > 10
    strength = np.abs(cases[2]) * np.asarray(jax.vmap(lambda s: s.x.largest())(found)) ** 2
    assert np.median(strength[usable]) > 0.03 and strength[usable].max() > 0.5
    for i in np.flatnonzero(usable):
        mu, omega_0, alpha, w, mean = (float(v[i]) for v in cases[:5])

        def rates(t, y, w=w, mean=mean, mu=mu, omega_0=omega_0, alpha=alpha, a=cases[5][i], b=cases[6][i]):
            p = w * t
            push = mean + sum(a[k] * cos((k + 1) * p) + b[k] * sin((k + 1) * p) for k in range(3))
            return y[1], push - mu * y[1] - omega_0**2 * y[0] * (1 + alpha * y[0] * y[0])

        x = jax.tree.map(lambda leaf, i=i: leaf[i], found).x
        assert period_error(rates, x) < 1e-8, i


def test_steady_states_of_random_cases_satisfy_the_energy_balance(found):
    """Mean of forcing times rate, and of mu times rate squared, by Parseval."""
    mu, _, _, omega, _, cosine, sine = random_cases()
    k = np.arange(1, 21)
    c, s = np.asarray(found.motion.cosine)[:, 0], np.asarray(found.motion.sine)[:, 0]
    rate_c, rate_s = omega[:, None] * k * s, -omega[:, None] * k * c
    power_in = 0.5 * (cosine * rate_c[:, :3] + sine * rate_s[:, :3]).sum(axis=1)
    lost = 0.5 * mu * (rate_c**2 + rate_s**2).sum(axis=1)
    rows = np.asarray(found.converged)
    assert rows.sum() >= 55
    np.testing.assert_allclose(power_in[rows], lost[rows], rtol=1e-9)


# -- closed forms --


def test_steady_state_of_a_linear_drive_agrees_with_the_closed_form():
    forcing = harmonic_series(43.0, np.array([300.0, 80.0]), np.array([0.4, -1.1]), mean=50.0)
    steady = solve(balance(duffing(3.0, 0.0, 50.0), forcing, harmonics=4), 43.0)
    rates = 43.0j * np.arange(3)
    phasors = np.array([50.0, 300 * np.exp(0.4j), 80 * np.exp(-1.1j)]) / (2500 + 3 * rates + rates**2)
    assert bool(steady.converged)
    assert float(steady.x.mean) == pytest.approx(phasors[0].real, rel=1e-12)
    np.testing.assert_allclose(steady.x.amplitudes, [*np.abs(phasors[1:]), 0.0, 0.0], atol=1e-14)
    np.testing.assert_allclose(steady.x.phases[:2], np.angle(phasors[1:]), atol=1e-12)
    assert float(steady.defect) < 1e-14


def test_defect_falls_geometrically_with_the_number_of_harmonics():
    """The motion is analytic in time; only odd harmonics exist, so that two more multiply it by the same factor."""
    system = [balance(duffing(0.2, 1.0), harmonic_series(1.0, 1.0), harmonics=h) for h in (5, 9, 13)]
    steady = [solve(s, 1.2) for s in system]
    assert all(bool(s.converged) for s in steady)
    ratios = np.diff(np.log([float(s.defect) for s in steady]))
    assert ratios.max() < np.log(1e-2)
    np.testing.assert_allclose(ratios[0], ratios[1], rtol=0.15)


def test_derivatives_of_a_steady_state_agree_with_differences():
    """By mu, omega_0, alpha, forcing and frequency, against central differences."""

    def wave(p):
        model = duffing(p[0], p[2], p[1])
        x = solve(balance(model, harmonic_series(1.0, p[3]), harmonics=5), p[4]).x
        return jnp.stack([x.cosine[0], x.sine[0], x.cosine[2]])

    at, h = np.array([0.3, 1.0, 0.4, 0.5, 1.3]), 1e-5
    slope = jax.jit(jax.jacfwd(wave))(jnp.asarray(at))
    steps = np.concatenate([at + h * np.eye(5), at - h * np.eye(5)])
    ends = np.asarray(jax.jit(jax.vmap(wave))(jnp.asarray(steps)))
    np.testing.assert_allclose(slope, ((ends[:5] - ends[5:]) / (2 * h)).T, rtol=1e-6, atol=1e-8)


# -- two inertias --

DRIVE = Drive(N=2.0, J_m=1.0, J_l=3.0, K=5.0, B_sp=0.6, alpha=0.2)
TORQUE = harmonic_series(1.5, np.array([0.8, 0.2]), np.array([0.0, 0.5]), mean=7.0)
LOAD = harmonic_series(1.5, np.array([0.7, 0.1]), np.array([0.3, 1.0]), mean=0.9)


def test_steady_state_of_two_inertias_equals_that_of_the_reduced_drive():
    whole = solve(balance(TwoInertiaModel(DRIVE), TORQUE, load_torque=LOAD), 1.5)
    # The load's mean torque is held by the motor: -T_l N at the output, and so the mesh carries it alone.
    mean = -0.9 / 3.0 - 0.9 / (2.0 * 2.0 * 1.0)
    error = [a / 2.0 - b / 3.0 for a, b in ((TORQUE.cosine, LOAD.cosine), (TORQUE.sine, LOAD.sine))]
    one = ReducedModel(eqx.tree_at(lambda d: d.gain, DRIVE.reduced(), jnp.asarray(1.0)))
    alone = solve(balance(one, FourierSeries(1.5, jnp.asarray(mean), *error)), 1.5)
    assert bool(whole.converged) and bool(alone.converged)
    for a, b in zip(jax.tree.leaves(whole.x), jax.tree.leaves(alone.x), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    assert float(whole.mean_torque) == pytest.approx(-0.9 / 2.0, rel=1e-12)


N, J_M, J_L, K, ALPHA, B, OMEGA = 50.0, 5.26e-4, 5.0e-2, 7160.0, 2e3, 1.7, 150.0
K_2, C_2, FRICTION, COS_1, SIN_2 = 3.0, 0.8, 1e-3, 1e-4, 3e-4


def rotating_drive(c_2: float) -> TwoInertiaModel:
    drive = Drive(N=N, J_m=J_M, J_l=J_L, K=K, B_sp=B, alpha=ALPHA)
    effects = (
        QuadraticStiffness(k2=K_2),
        MotorFriction(b=FRICTION, transition=1.0),
        KinematicError(cos_1=COS_1, sin_2=SIN_2),
        QuadraticDamping(c2=c_2),
    )
    return TwoInertiaModel(drive, effects)


@pytest.mark.parametrize("c_2, tolerance", [pytest.param(0.0, 1e-9, marks=pytest.mark.slow), (C_2, 1e-6)])
def test_steady_state_of_a_rotating_drive_agrees_with_time_integration(c_2, tolerance):
    """`v |v|` has corners, for which the harmonics fall with a power only."""
    torque, load = harmonic_series(1.0, np.array([0.3, 0.5])), harmonic_series(1.0, 20.0, 0.4, mean=-30.0)
    system = balance(rotating_drive(c_2), torque, load_torque=load, harmonics=20, rotating=True)
    steady = solve(system, OMEGA)
    assert bool(steady.converged)
    drive_torque = float(steady.mean_torque)
    # The torque that holds the load, and the friction.
    assert drive_torque == pytest.approx(30.0 / N + FRICTION * OMEGA, rel=0.01)

    def rates(t, y):
        theta_m, theta_l, omega_m, omega_l = y
        slope = -COS_1 * sin(theta_m) + 2 * SIN_2 * cos(2 * theta_m)
        x = theta_m / N + COS_1 * cos(theta_m) + SIN_2 * sin(2 * theta_m) - theta_l
        v = omega_m / N + slope * omega_m - omega_l
        tau = K * (x + ALPHA * x**3 + K_2 * x**2) + B * v + c_2 * v * abs(v)
        motor = drive_torque + 0.3 * cos(OMEGA * t) + 0.5 * cos(2 * OMEGA * t) - FRICTION * omega_m
        on_load = -30.0 + 20.0 * cos(OMEGA * t + 0.4)
        return omega_m, omega_l, (motor - (1 / N + slope) * tau) / J_M, (tau + on_load) / J_L

    def state(q, q_rate, t):
        (x, theta_l), (v, rate) = q.T, q_rate.T
        turned = [N * (x + theta_l) + OMEGA * t, theta_l + OMEGA * t / N]
        return np.stack([*turned, N * (v + rate) + OMEGA, rate + OMEGA / N], axis=1)

    # Errors refer to the deviation from the rigid rotation, which harmonic balance solves for.
    start = state(*(np.asarray(s(jnp.zeros(1))) for s in (steady.motion, steady.motion.derivative())), np.zeros(1))[0]
    T = 2 * np.pi / OMEGA
    for part in (0.4, 1.0):
        t = np.array([part * T])
        end = solve_ivp(rates, (0.0, t[0]), start, method="DOP853", rtol=1e-12, atol=1e-15).y[:, -1]
        expected = state(*(np.asarray(s(jnp.asarray(t))) for s in (steady.motion, steady.motion.derivative())), t)[0]
        x = end[0] / N - end[1], expected[0] / N - expected[1]
        v = end[2] / N - end[3], expected[2] / N - expected[3]
        size = float(steady.x.largest())
        assert abs(x[0] - x[1]) < tolerance * size
        assert abs(v[0] - v[1]) < tolerance * size * OMEGA * 10
        assert abs(end[2] - expected[2]) < tolerance * OMEGA


@pytest.mark.slow
def test_rotating_steady_state_over_two_revolutions_equals_that_over_one():
    torque, load = harmonic_series(1.0, np.array([0.3, 0.5])), harmonic_series(1.0, 20.0, 0.4, mean=-30.0)
    once, twice = (
        solve(balance(rotating_drive(0.0), torque, load_torque=load, harmonics=h, rotating=True, subharmonic=n), OMEGA)
        for h, n in ((6, 1), (12, 2))
    )
    assert bool(once.converged) and bool(twice.converged)
    assert float(twice.motion.omega) == OMEGA / 2
    np.testing.assert_allclose(twice.x.amplitudes[1::2], once.x.amplitudes, atol=1e-6 * float(once.x.largest()))
    np.testing.assert_allclose(twice.x.amplitudes[::2], 0.0, atol=1e-12)
    assert float(twice.mean_torque) == pytest.approx(float(once.mean_torque), rel=1e-9)


def test_rotating_drive_carries_friction_and_a_constant_torque_on_the_load():
    """Without a kinematic error the mesh holds both, and the motor gives an N-th of it."""
    loaded = TwoInertiaModel(DRIVE, (ViscousLoadFriction(b=0.3), ConstantLoad(constant=-0.1)))
    found = solve(balance(loaded, harmonics=1, rotating=True), OMEGA)
    held = 0.3 * OMEGA / float(DRIVE.N) + 0.1
    assert bool(found.converged)
    assert float(DRIVE.mesh_torque(found.x.mean, jnp.zeros(()))) == pytest.approx(held, rel=1e-8)
    assert float(found.mean_torque) == pytest.approx(held / float(DRIVE.N), rel=1e-8)


# -- refusals --


def test_unsupported_models_and_settings_are_refused():
    plain, whole = duffing(0.1, 0.0), TwoInertiaModel(DRIVE)
    with pytest.raises(ValueError, match="`bouc_wen` has memory"):
        balance(plain.with_effects(BoucWen(memory_twist=0.1)))
    with pytest.raises(ValueError, match="`torque_bias` has memory or acts on a logged torque"):
        balance(plain.with_effects(TorqueBias()))
    with pytest.raises(ValueError, match="`gravity_load` turns with the output"):
        balance(whole.with_effects(GravityLoad()), rotating=True)
    with pytest.raises(ValueError, match="`kinematic_harmonic` has order 2.5"):
        balance(whole.with_effects(KinematicHarmonic(cosine=1e-4, n=2.5)), rotating=True)
    with pytest.raises(ValueError, match="`rotating` needs a TwoInertiaModel"):
        balance(plain, rotating=True)
    with pytest.raises(ValueError, match="`samples` must be above 18, but is 18"):
        balance(plain, samples=18)
    with pytest.raises(ValueError, match="`motion` can be given for a ReducedModel only"):
        solve(balance(whole, TORQUE), 1.5, guess=TORQUE)


def test_unsolved_balance_is_reported_as_not_converged():
    steady = solve(balance(duffing(0.01, 1.0), harmonic_series(1.0, 1.0)), 1.1, max_steps=1)
    assert not bool(steady.converged)
    np.testing.assert_array_equal(steady.x.amplitudes, 0.0)
