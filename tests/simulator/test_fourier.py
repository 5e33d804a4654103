"""Fourier series against direct sums, and their largest value against dense sampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hdjax.fourier import FourierSeries, fourier_series, harmonic_series

H, COORDINATES = 4, 2
# One shape, so that nothing compiles twice.
COEFFICIENTS = arrays(float, (COORDINATES, 2 * H + 1), elements=st.floats(-100.0, 100.0, width=32))
OMEGAS = st.floats(1e-2, 1e3)


def series(omega: float, rows: np.ndarray) -> FourierSeries:
    m, c, s = (jnp.asarray(v) for v in (rows[..., 0], rows[..., 1 : H + 1], rows[..., H + 1 :]))
    return FourierSeries(omega, m, c, s)


def direct_sum(rows: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """The series as a sum of cosines and sines, by row of `phase` and coordinate."""
    total = np.zeros((phase.size, rows.shape[0])) + rows[:, 0]
    for k in range(1, H + 1):
        total += np.outer(np.cos(k * phase), rows[:, k]) + np.outer(np.sin(k * phase), rows[:, H + k])
    return total


@given(omega=OMEGAS, rows=COEFFICIENTS)
def test_fourier_series_agrees_with_the_direct_sum(omega, rows):
    wave = series(omega, rows)
    t = np.linspace(-1.0, 2.0, 7) * 2 * np.pi / omega
    size = 1e-12 * (1.0 + np.abs(rows).sum())
    np.testing.assert_allclose(wave(jnp.asarray(t)), direct_sum(rows, omega * t), rtol=0, atol=10 * size)
    steps = 2 * np.pi * np.arange(11) / 11
    np.testing.assert_allclose(wave.values(11), direct_sum(rows, steps).T, rtol=0, atol=size)
    k = np.arange(1, H + 1)
    B, psi = np.asarray(wave.amplitudes), np.asarray(wave.phases)
    again = [m + np.sum(b * np.cos(k * 0.7 + p)) for m, b, p in zip(rows[:, 0], B, psi, strict=True)]
    np.testing.assert_allclose(again, direct_sum(rows, np.array([0.7]))[0], rtol=0, atol=size)


@given(omega=OMEGAS, rows=COEFFICIENTS)
def test_derivative_of_a_fourier_series_agrees_with_differences(omega, rows):
    """Against central differences of fourth order, whose error is `(4 h)^4 / 30` relative, twice."""
    t, h = 0.3 / omega, 1e-3
    f = [direct_sum(rows, np.array([0.3 + j * h]))[0] for j in (-2, -1, 1, 2)]
    difference = omega * (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h)
    size = omega * (1.0 + np.abs(rows).sum())
    np.testing.assert_allclose(series(omega, rows).derivative()(jnp.asarray(t)), difference, rtol=0, atol=1e-8 * size)


@given(omega=OMEGAS, rows=COEFFICIENTS)
def test_fourier_series_is_recovered_from_its_samples(omega, rows):
    wave = series(omega, rows)
    for n in (9, 12):
        back = fourier_series(omega, wave.values(n), H)
        for found, true in zip(jax.tree.leaves(back), jax.tree.leaves(wave), strict=True):
            np.testing.assert_allclose(found, true, rtol=0, atol=1e-12 * (1.0 + np.abs(rows).sum() + omega))


# A sample of cos(3 t) + sin(2 t) lies at a point of zero curvature.
@example(rows=np.array([[0, 0, 0, 1, 0, 0, 1, 0, 0], [0] * 9], dtype=float))
@given(rows=COEFFICIENTS)
def test_largest_value_agrees_with_dense_samples(rows):
    dense = np.abs(direct_sum(rows, np.linspace(0.0, 2 * np.pi, 4097))).max(axis=0)
    found = np.asarray(series(3.0, rows).largest())
    size = np.abs(rows).sum()
    assert np.all(found >= dense - 1e-12 * size)
    # Between dense samples a maximum rises by at most `(H h)^2 / 8`.
    assert np.all(found <= dense + (H * 2 * np.pi / 4096) ** 2 / 8 * size + 1e-12)


def test_largest_values_of_many_series_agree_with_dense_samples():
    """Among them are flat maxima, where Newton's method may find a minimum, and two nearly equal maxima."""
    rows = np.random.default_rng(0).normal(size=(20_000, 2 * H + 1))
    dense = np.abs(direct_sum(rows, np.linspace(0.0, 2 * np.pi, 1025))).max(axis=0)
    found = np.asarray(series(1.0, rows).largest())
    assert (found - dense).min() > -1e-12
    assert (found / dense - 1.0).max() < (H * 2 * np.pi / 1024) ** 2


def test_largest_value_has_the_gradient_at_the_maximum():
    rows = np.array([0.3, 1.0, 0.4, 0.0, 0.1, -0.2, 0.0, 0.3, 0.0])
    slope = jax.grad(lambda r: series(1.0, r).largest())(jnp.asarray(rows))
    phase = np.linspace(0.0, 2 * np.pi, 200_001)
    top = phase[np.argmax(np.abs(direct_sum(rows[None], phase)[:, 0]))]
    k = np.arange(1, H + 1)
    sign = np.sign(direct_sum(rows[None], np.array([top]))[0, 0])
    # The instant of the maximum is known to the step of 3e-5.
    np.testing.assert_allclose(slope, sign * np.concatenate([[1.0], np.cos(k * top), np.sin(k * top)]), atol=2e-4)


def test_harmonic_series_agrees_with_the_sum_of_cosines():
    wave = harmonic_series(2.0, np.array([1.0, 0.5]), np.array([0.3, -1.2]), mean=0.1)
    t = np.linspace(0.0, 5.0, 9)
    written = 0.1 + np.cos(2 * t + 0.3) + 0.5 * np.cos(4 * t - 1.2)
    np.testing.assert_allclose(wave(jnp.asarray(t)), written, atol=1e-14)
    np.testing.assert_allclose(wave.amplitudes, [1.0, 0.5], rtol=1e-14)
    np.testing.assert_allclose(wave.phases, [0.3, -1.2], rtol=1e-13)
    np.testing.assert_allclose(harmonic_series(2.0, 3.0)(jnp.asarray(t)), 3 * np.cos(2 * t), atol=1e-14)


def test_amplitudes_and_phases_have_gradients_beside_a_vanishing_harmonic():
    def wave(a):
        return FourierSeries(1.0, jnp.zeros(()), jnp.stack([3.0 * a, 0.0 * a]), jnp.stack([4.0 + 0.0 * a, 0.0 * a]))

    # B = hypot(3 a, 4) and psi = -atan2(4, 3 a), at a = 1.
    assert float(jax.grad(lambda a: wave(a).amplitudes[0])(1.0)) == pytest.approx(9.0 / 5.0)
    assert float(jax.grad(lambda a: wave(a).phases[0])(1.0)) == pytest.approx(12.0 / 25.0)
    assert float(wave(1.0).phases[1]) == 0.0


def test_padding_keeps_the_values_and_the_first_harmonics():
    wave = series(1.5, np.arange(18.0).reshape(2, 9))
    t = jnp.linspace(0.0, 3.0, 5)
    np.testing.assert_allclose(wave.padded(7)(t), wave(t), atol=1e-12)
    assert wave.padded(7).harmonics == 7
    np.testing.assert_array_equal(wave.padded(2).cosine, wave.cosine[:, :2])


def test_fourier_series_in_lanes_equals_a_loop():
    rows = np.random.default_rng(1).normal(size=(3, 2 * H + 1))
    together = jax.vmap(lambda omega, r: (series(omega, r).largest(), series(omega, r).values(9)))
    largest, values = together(jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray(rows))
    for i in range(3):
        np.testing.assert_allclose(largest[i], series(i + 1.0, rows[i]).largest(), rtol=1e-13)
        np.testing.assert_allclose(values[i], series(i + 1.0, rows[i]).values(9), atol=1e-13)


def test_too_few_samples_are_refused():
    wave = series(1.0, np.ones((1, 2 * H + 1)))
    with pytest.raises(ValueError, match="`samples` must be above 8, but is 8"):
        wave.values(8)
    with pytest.raises(ValueError, match="`harmonics` must be below 4.0"):
        fourier_series(1.0, jnp.ones(8), 4)
