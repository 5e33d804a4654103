"""Torques as functions of time against their definitions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdjax import Chirp, Harmonic, MultiHarmonic, random_phase_multisine

number = st.floats(-5.0, 5.0)


@jax.jit
def evaluate(forcing, times):
    return jax.vmap(forcing)(times)


@given(amplitude=number, omega=st.floats(0.0, 400.0), phase=number, offset=number, t=st.floats(0.0, 10.0))
def test_harmonic_agrees_with_its_formula(amplitude, omega, phase, offset, t):
    forcing = Harmonic(amplitude, omega, phase, offset)
    found = evaluate(forcing, jnp.asarray([t]))
    # Phases of up to 4000 rad are known to 4000 * 2e-16.
    np.testing.assert_allclose(found, [amplitude * np.cos(omega * t + phase) + offset], atol=1e-11)


def test_harmonic_accepts_integers():
    np.testing.assert_allclose(evaluate(Harmonic(2, 3), jnp.asarray([0.5])), [2 * np.cos(1.5)], atol=1e-15)


def test_multiharmonic_is_the_sum_of_its_lines():
    """Frequencies need not be multiples of one another."""
    rng = np.random.default_rng(4)
    lines = rng.uniform(0.5, 30.0, (3, 4))
    times = np.linspace(0, 3, 40)
    found = evaluate(MultiHarmonic(*(jnp.asarray(row) for row in lines)), jnp.asarray(times))
    expected = sum(evaluate(Harmonic(a, omega, phase), jnp.asarray(times)) for a, omega, phase in lines.T)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@settings(max_examples=20)
@given(start=st.floats(1.0, 200.0), end=st.floats(1.0, 200.0), duration=st.floats(1.0, 10.0), share=st.floats(0.0, 1.0))
def test_chirp_has_its_stated_instantaneous_frequency(start, end, duration, share):
    """The signal and its derivative give phase and frequency: y = a sin(phi), y' = a omega cos(phi)."""
    forcing = Chirp(2.0, start, end, duration)
    t = share * duration
    omega = start + (end - start) * share
    y, rate = jax.jvp(forcing, (jnp.asarray(t),), (jnp.asarray(1.0),))
    assert float(y) ** 2 + (float(rate) / omega) ** 2 == pytest.approx(4.0, rel=1e-9)
    assert float(forcing(jnp.asarray(0.0))) == 0.0


@settings(max_examples=10)
@given(seed=st.integers(0, 2**31 - 1), rms=st.floats(0.1, 5.0), first=st.integers(0, 5), more=st.sampled_from((0, 30)))
def test_multisine_has_its_rms_period_and_band(seed, rms, first, more):
    period = 0.7
    line = 2 * np.pi / period
    last = max(first, 1) + more
    forcing = random_phase_multisine(
        rms=rms, omega_min=(first - 0.3) * line, omega_max=(last + 0.3) * line, period=period, key=jax.random.key(seed)
    )
    n = 256
    times = period * np.arange(n) / n
    y = np.asarray(evaluate(forcing, jnp.asarray(times)))
    assert np.sqrt(np.mean(y**2)) == pytest.approx(rms, rel=1e-9)
    np.testing.assert_allclose(evaluate(forcing, jnp.asarray(times + 3 * period)), y, atol=1e-9)
    spectrum = np.abs(np.fft.rfft(y)) / n
    inside = np.zeros(spectrum.size, bool)
    inside[max(first, 1) : last + 1] = True
    # Flat: each of the lines carries the same share.
    np.testing.assert_allclose(spectrum[inside], rms / np.sqrt(2 * inside.sum()), rtol=1e-9)
    np.testing.assert_allclose(spectrum[~inside], 0.0, atol=1e-12 * n)


def test_edges_of_the_band_are_lines_of_the_multisine():
    """10 Hz is the 30th line of 3 s, though not to the last bit."""
    edge = 2 * np.pi * 10.0
    made = random_phase_multisine(rms=1.0, omega_min=edge, omega_max=edge, period=3.0, key=jax.random.key(0))
    np.testing.assert_allclose(made.omegas, [edge])


def test_multisine_phases_depend_on_the_key():
    band = {"rms": 1.0, "omega_min": 1.0, "omega_max": 50.0, "period": 2.0}
    one, same, other = (random_phase_multisine(**band, key=jax.random.key(k)) for k in (0, 0, 1))
    np.testing.assert_array_equal(one.phases, same.phases)
    assert np.abs(np.asarray(one.phases - other.phases)).min() > 0


def test_harmonic_of_integers_has_a_gradient():
    slope = eqx.filter_grad(lambda forcing: forcing(jnp.asarray(0.5)))(Harmonic(2, 3))
    np.testing.assert_allclose(slope.amplitude, np.cos(1.5), rtol=1e-12)


def test_multisine_without_a_period_is_refused():
    with pytest.raises(ValueError, match="`period` must be above zero"):
        random_phase_multisine(rms=1.0, omega_min=1.0, omega_max=50.0, period=0.0, key=jax.random.key(0))


@pytest.mark.parametrize(("low", "high"), ((3.2, 6.2), (50.0, 40.0), (0.0, 0.0)))
def test_multisine_band_without_a_line_is_refused(low, high):
    """Lines at multiples of 2 pi."""
    with pytest.raises(ValueError, match="`period` must be long enough"):
        random_phase_multisine(rms=1.0, omega_min=low, omega_max=high, period=1.0, key=jax.random.key(0))
