"""Periodic orbits by shooting against closed forms, long simulations and differences."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from hdjax import Drive, ReducedDrive, ReducedModel, SimulationError, TwoInertiaModel, simulate
from hdjax.fourier import FourierSeries, harmonic_series
from hdjax.response.shooting import PeriodicOrbit, monodromy, period_map, shoot, steady_series

REST = jnp.zeros(2)


def duffing(alpha: float = 0.5, mu: float = 0.1, omega_0: float = 1.0, gain: float = 1.0) -> ReducedModel:
    return ReducedModel(ReducedDrive(mu=mu, omega_0=omega_0, alpha=alpha, gain=gain))


def settled(model: ReducedModel, forcing: FourierSeries, state: Array, periods: int) -> Array:
    """End state of a long simulation by another solver."""
    times = np.array([0.0, 2 * np.pi / float(forcing.omega) * periods])
    return simulate(model, forcing, times, state, solver=dfx.Tsit5(), rtol=1e-11, atol=1e-13).states[-1]


# -- the linear drive, whose orbit has a closed form --

MU, OMEGA_0, OMEGA, GAIN = 3.0, 50.0, 43.0, 2.0
LINEAR = duffing(0.0, MU, OMEGA_0, GAIN)
TWO_TONES = harmonic_series(OMEGA, np.array([300.0, 80.0]), np.array([0.4, -1.1]), mean=50.0)


def linear_phasors() -> np.ndarray:
    """Complex amplitudes of x at k omega, k = 0, 1, 2."""
    rates = 1j * OMEGA * np.arange(3)
    pushes = GAIN * np.array([50.0, 300.0 * np.exp(0.4j), 80.0 * np.exp(-1.1j)])
    return pushes / (OMEGA_0**2 + MU * rates + rates**2)


def test_orbit_and_multipliers_of_a_linear_drive_agree_with_the_closed_form():
    orbit = shoot(LINEAR, TWO_TONES, REST)
    phasors = linear_phasors()
    start = [phasors.sum().real, (1j * OMEGA * np.arange(3) * phasors).sum().real]
    assert bool(orbit.converged) and bool(orbit.stable)
    np.testing.assert_allclose(orbit.state, start, rtol=1e-8)
    T = 2 * np.pi / OMEGA
    exact = np.exp((-MU / 2 + 1j * np.sqrt(OMEGA_0**2 - MU**2 / 4)) * T)
    found = np.asarray(orbit.multipliers)
    np.testing.assert_allclose(np.sort(np.imag(found)), np.sort([exact.imag, -exact.imag]), atol=1e-8)
    np.testing.assert_allclose(np.real(found), exact.real, atol=1e-8)
    np.testing.assert_allclose(monodromy(LINEAR, TWO_TONES, REST), orbit.monodromy, rtol=1e-7)


def test_steady_series_of_a_linear_drive_agrees_with_the_closed_form():
    series = steady_series(LINEAR, TWO_TONES, shoot(LINEAR, TWO_TONES, REST))
    phasors = linear_phasors()
    assert float(series.mean) == pytest.approx(phasors[0].real, rel=1e-8)
    np.testing.assert_allclose(series.amplitudes, [*np.abs(phasors[1:]), *np.zeros(14)], atol=1e-9)
    np.testing.assert_allclose(series.phases[:2], np.angle(phasors[1:]), atol=1e-7)


# -- Duffing --

# Three orbits at one frequency: hardening, driven above its natural frequency.
FORCING = harmonic_series(1.5, 0.4).padded(2)


def harmonic_guess(a: float) -> list[float]:
    """State at t = 0 of `a cos(omega t - phi)` with the first harmonic's balance."""
    phi = np.arctan2(0.1 * 1.5 * a, (1 + 0.75 * 0.5 * a**2 - 1.5**2) * a)
    return [a * np.cos(phi), 1.5 * a * np.sin(phi)]


def branches() -> list[float]:
    """Amplitudes of the three branches, by the first harmonic's balance: a cubic in a^2."""
    k, c = 0.75 * 0.5, 1 - 1.5**2
    squares = np.roots([k**2, 2 * k * c, c**2 + (0.1 * 1.5) ** 2, -(0.4**2)])
    assert np.abs(squares.imag).max() < 1e-12
    return sorted(np.sqrt(squares.real))


@pytest.fixture(scope="module")
def orbits() -> list[PeriodicOrbit]:
    return [shoot(duffing(), FORCING, jnp.asarray(harmonic_guess(a))) for a in branches()]


def test_middle_one_of_three_orbits_is_unstable(orbits):
    assert all(orbit.converged for orbit in orbits)
    assert [bool(orbit.stable) for orbit in orbits] == [True, False, True]
    assert max(float(orbit.residual) for orbit in orbits) < 1e-9
    saddle = np.sort(np.real(orbits[1].multipliers))
    assert 0 < saddle[0] < 1 < saddle[1]
    np.testing.assert_allclose(np.imag(orbits[1].multipliers), 0.0, atol=1e-12)
    found = [float(steady_series(duffing(), FORCING, orbit).amplitudes[0]) for orbit in orbits]
    # The third harmonic, which the balance leaves out, is alpha a^2/32 of the first: 6 % at the largest.
    np.testing.assert_allclose(found, branches(), rtol=0.02)


def test_product_of_multipliers_is_the_damping_over_a_period(orbits):
    """Liouville's formula: phase volume shrinks by exp(-mu T) whatever the orbit."""
    products = [np.prod(np.asarray(orbit.multipliers)) for orbit in orbits]
    np.testing.assert_allclose(products, np.exp(-0.1 * 2 * np.pi / 1.5), rtol=1e-9)


def test_long_simulations_end_on_stable_orbits(orbits):
    """After 120 periods exp(-mu t / 2) = 1e-11."""
    for k, start in ((0, [0.0, 0.0]), (2, [1.3, 2.0])):
        end = settled(duffing(), FORCING, jnp.asarray(start), 120)
        np.testing.assert_allclose(orbits[k].state, end, atol=1e-7)


def test_long_simulation_leaves_the_unstable_orbit(orbits):
    ends = [settled(duffing(), FORCING, orbits[1].state + jnp.asarray([d, 0.0]), 120) for d in (1e-3, -1e-3)]
    states = np.stack([orbit.state for orbit in orbits])
    assert {int(np.argmin(np.abs(states - end).max(axis=1))) for end in np.asarray(ends)} == {0, 2}


def test_orbit_under_a_mean_and_two_harmonics_agrees_with_simulation():
    forcing = harmonic_series(1.1, np.array([0.3, 0.2]), np.array([0.0, 1.0]), mean=0.2)
    orbit = shoot(duffing(mu=0.3), forcing, REST)
    assert bool(orbit.stable)
    np.testing.assert_allclose(orbit.state, settled(duffing(mu=0.3), forcing, REST, 40), atol=1e-7)
    series = steady_series(duffing(mu=0.3), forcing, orbit, harmonics=16)
    times = jnp.linspace(0.0, 2 * jnp.pi / 1.1, 37)
    motion = simulate(duffing(mu=0.3), forcing, times, orbit.state, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(series(times), motion.dynamic_error, atol=1e-8)


def test_subharmonic_orbit_repeats_after_three_periods():
    """The harmonic motion at the same frequency repeats after three periods too."""
    model, forcing = duffing(1.0, 0.05), harmonic_series(3.6, 6.0).padded(2)
    orbit = shoot(model, forcing, jnp.asarray([-0.7, -0.5]), periods=3)
    assert bool(orbit.stable)
    once = period_map(model, forcing, orbit.state)
    assert np.abs(once - orbit.state).max() > 0.1
    np.testing.assert_allclose(period_map(model, forcing, orbit.state, periods=3), orbit.state, atol=1e-8)
    np.testing.assert_allclose(np.prod(orbit.multipliers), np.exp(-0.05 * 3 * 2 * np.pi / 3.6), rtol=1e-8)
    series = steady_series(model, forcing, orbit, harmonics=16)
    assert float(series.omega) == pytest.approx(1.2)
    assert series.amplitudes[0] > 0.5 * series.amplitudes[2] > 0.1  # omega/3 beside omega
    harmonic = shoot(model, forcing, jnp.asarray([-0.5, 0.0]), periods=3)
    np.testing.assert_allclose(period_map(model, forcing, harmonic.state), harmonic.state, atol=1e-8)


# -- derivatives, jit, vmap --

PATHS = ("mu", "omega_0", "alpha", "gain")
AT = np.array([0.1, 1.0, 0.5, 1.0, 1.5, 0.4])


def orbit_state(values: Array) -> Array:
    """The middle orbit's state and trace of the monodromy over the parameters, omega and forcing amplitude."""
    model = duffing().replace(dict(zip(PATHS, values[:4], strict=True)))
    orbit = shoot(model, harmonic_series(values[4], values[5]).padded(2), jnp.asarray(harmonic_guess(branches()[1])))
    return jnp.concatenate([orbit.state, jnp.trace(orbit.monodromy)[None]])


@eqx.filter_jit
def orbit_slope(values: Array) -> Array:
    return jax.jacfwd(orbit_state)(values)


@pytest.mark.slow
def test_derivatives_of_an_unstable_orbit_agree_with_differences():
    h = 1e-5
    ends = np.stack([[np.asarray(orbit_state(jnp.asarray(AT + s * h * e))) for s in (1, -1)] for e in np.eye(6)])
    differences = ((ends[:, 0] - ends[:, 1]) / (2 * h)).T
    slope = np.asarray(orbit_slope(jnp.asarray(AT)))
    assert np.abs(slope).min() > 1e-2
    # Orbits good to 1e-9 over steps of 1e-5.
    np.testing.assert_allclose(slope, differences, rtol=1e-4, atol=1e-3)


ALPHAS = jnp.asarray([0.5, -1.0, -1.0])
OMEGAS = jnp.asarray([2.5, 0.5, 0.5])
STARTS = jnp.asarray([[0.0, 0.0], [3.0, 3.0], [0.0, 0.0]])  # the middle one is beyond the saddle, and escapes


def lane(alpha: Array, omega: Array, start: Array) -> PeriodicOrbit:
    return shoot(duffing().replace({"alpha": alpha}), harmonic_series(omega, 0.1).padded(2), start)


@pytest.mark.slow
def test_orbits_in_lanes_equal_a_loop_and_failures_are_marked():
    """Compiled and in lanes against one by one."""
    orbits = eqx.filter_jit(eqx.filter_vmap(lane))(ALPHAS, OMEGAS, STARTS)
    assert np.asarray(orbits.converged).tolist() == np.asarray(orbits.stable).tolist() == [True, False, True]
    assert np.isposinf(float(orbits.residual[1]))
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(orbits))
    np.testing.assert_allclose(orbits.state[1], STARTS[1])
    for k in (0, 2):
        alone = lane(ALPHAS[k], OMEGAS[k], STARTS[k])
        np.testing.assert_allclose(orbits.state[k], alone.state, atol=1e-9)
        np.testing.assert_allclose(orbits.monodromy[k], alone.monodromy, atol=1e-8)


def test_period_map_of_an_escaping_motion_raises_an_error():
    with pytest.raises(SimulationError):
        period_map(duffing(-1.0), harmonic_series(0.5, 0.1).padded(2), STARTS[1])


def test_two_inertias_have_a_period_map_and_no_orbit():
    drive = Drive(N=2, J_m=1, J_l=3, K=5, B_sp=0.3, alpha=0.2)
    forcing, load = harmonic_series(1.5, 0.4), harmonic_series(1.5, 0.7, 0.3)
    with pytest.raises(ValueError, match=r"`model` must be a ReducedModel.* TwoInertiaModel"):
        shoot(TwoInertiaModel(drive), forcing, jnp.zeros(4))
    end = period_map(TwoInertiaModel(drive), forcing, jnp.zeros(4), periods=2, load_torque=load)
    error = forcing.cosine / 2 - load.cosine / 3, forcing.sine / 2 - load.sine / 3
    reduced = ReducedModel(eqx.tree_at(lambda d: d.gain, drive.reduced(), jnp.asarray(1.0)))
    other = period_map(reduced, FourierSeries(1.5, jnp.asarray(0.0), *error).padded(2), REST, periods=2)
    np.testing.assert_allclose([end[0] / 2 - end[1], end[2] / 2 - end[3]], other, atol=1e-9)
