"""Swept sines and their jumps against scipy and the peak of the frequency response."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orbits import duffing, duffing_rates
from scipy.integrate import solve_ivp

from hdjax.response.swept_sine import hysteresis_band, swept_sine

SWEPT = duffing(0.1, 0.5)
OMEGAS = np.linspace(0.8, 2.0, 121)


@pytest.fixture(scope="module")
def sweeps():
    return tuple(swept_sine(SWEPT, 0.4, OMEGAS, direction) for direction in ("up", "down"))


def scipy_amplitude(k: int, start: np.ndarray) -> float:
    """Half of peak to peak after 60 periods, by scipy."""
    omega = OMEGAS[k]
    rates = duffing_rates(0.1, 0.5, 0.4, omega)
    T = 2 * np.pi / omega
    found = solve_ivp(rates, [0, 61 * T], start, t_eval=np.linspace(60 * T, 61 * T, 2001), rtol=1e-9, atol=1e-10)
    return float(np.ptp(found.y[0]) / 2)


def test_hardening_drive_jumps_at_a_higher_frequency_in_the_upward_sweep(sweeps):
    up, down = sweeps
    drop, rise = (np.asarray(OMEGAS)[np.flatnonzero(np.asarray(sweep.jumps()))] for sweep in sweeps)
    assert drop.size == rise.size == 1
    assert drop[0] > rise[0] + 0.2
    low, high = hysteresis_band(up, down) or (0.0, 0.0)
    assert low == pytest.approx(rise[0] + 0.01) and high == pytest.approx(drop[0])
    outside = (OMEGAS < low) | (OMEGAS > high)
    np.testing.assert_allclose(np.asarray(up.amplitude)[outside], np.asarray(down.amplitude)[outside], rtol=1e-3)
    # The peak's frequency-response curve: omega^2 = 1 + 3/4 alpha a^2 at a = F/(mu omega), to the first harmonic.
    peak = np.sqrt((1 + np.sqrt(1 + 4 * 0.75 * 0.5 * (0.4 / 0.1) ** 2)) / 2)
    assert drop[0] == pytest.approx(peak, rel=0.03)


@pytest.mark.parametrize("k", (20, 60, 110))
def test_swept_amplitudes_agree_with_scipy(sweeps, k):
    for sweep in sweeps:
        other = scipy_amplitude(k, np.asarray(sweep.states[k]))
        assert float(sweep.amplitude[k]) == pytest.approx(other, rel=1e-3)


def test_swept_amplitudes_on_both_branches_agree_with_scipy(sweeps):
    """From starts on either side of the unstable orbit, not from the sweep's own states."""
    k = 70
    assert float(sweeps[0].amplitude[k]) == pytest.approx(scipy_amplitude(k, np.array([1.3, 2.2])), rel=1e-2)
    assert float(sweeps[1].amplitude[k]) == pytest.approx(scipy_amplitude(k, np.zeros(2)), rel=1e-2)
    assert sweeps[0].amplitude[k] > 4 * sweeps[1].amplitude[k]


def test_weak_forcing_has_no_hysteresis_band():
    up, down = (swept_sine(SWEPT, 0.01, OMEGAS, direction) for direction in ("up", "down"))
    assert not np.asarray(up.jumps()).any()
    assert hysteresis_band(up, down) is None


def test_escape_of_a_softening_drive_in_a_sweep_is_marked():
    sweep = swept_sine(duffing(0.1, -1.0), 0.4, OMEGAS, "up")
    assert np.asarray(sweep.escaped).any()
    assert np.isfinite(np.asarray(sweep.states)).all()
    assert (np.asarray(sweep.amplitude)[np.asarray(sweep.escaped)] == 0.0).all()


def test_sweeps_in_lanes_equal_single_sweeps():
    amplitudes = jnp.asarray([0.05, 0.4])
    omegas = OMEGAS[:5]
    together = jax.vmap(lambda a: swept_sine(SWEPT, a, omegas, transient_periods=5))(amplitudes)
    for k in range(2):
        alone = swept_sine(SWEPT, amplitudes[k], omegas, transient_periods=5)
        np.testing.assert_allclose(together.amplitude[k], alone.amplitude, rtol=1e-12)


def test_traced_frequency_without_a_number_of_periods_is_refused():
    with pytest.raises(ValueError, match="`transient_periods` must be given where the drive .* is traced"):
        jax.jit(lambda omega: swept_sine(SWEPT, 0.1, omega[None]))(jnp.asarray(1.0))
