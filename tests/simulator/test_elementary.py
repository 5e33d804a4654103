"""Elementary functions in plain arithmetic: against numpy's, which call the processor's library."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdjax.elementary import cosine_and_sine, cosines_and_sines, exponential, power


@given(turns=st.integers(-250_000, 250_000), rest=st.floats(-4.0, 4.0))
def test_cosine_and_sine_agree_with_numpy(turns: int, rest: float):
    angle = 2 * np.pi * turns + rest
    cosine, sine = cosine_and_sine(jnp.asarray(angle))
    assert float(cosine) == pytest.approx(np.cos(angle), abs=3e-16)
    assert float(sine) == pytest.approx(np.sin(angle), abs=3e-16)


def test_cosine_and_sine_of_an_array_agree_with_numpy():
    angles = np.arange(-40, 41) * (np.pi / 4)
    cosine, sine = cosine_and_sine(jnp.asarray(angles))
    np.testing.assert_allclose(cosine, np.cos(angles), atol=3e-16)
    np.testing.assert_allclose(sine, np.sin(angles), atol=3e-16)


def test_derivatives_of_cosine_and_sine_agree_with_the_closed_form():
    angle = jnp.asarray(0.7)
    for mode in (jax.jacfwd, jax.jacrev):
        by_angle = mode(lambda a: jnp.stack(cosine_and_sine(a)))(angle)
        np.testing.assert_allclose(by_angle, [-np.sin(0.7), np.cos(0.7)], rtol=1e-15)
    twice = jax.hessian(lambda a: cosine_and_sine(a)[1])(angle)
    assert float(twice) == pytest.approx(-np.sin(0.7), rel=1e-15)


ORDERS = (4, 1, 3, 6)


@given(st.floats(-1e3, 1e3))
def test_cosines_and_sines_of_multiples_agree_with_numpy(angle: float):
    for order, (cosine, sine) in zip(ORDERS, cosines_and_sines(jnp.asarray(angle), ORDERS), strict=True):
        # The multiple is formed by a power, since a rounded multiple of the angle is another angle.
        turned = np.exp(1j * angle) ** order
        np.testing.assert_allclose([cosine, sine], [turned.real, turned.imag], atol=3e-15)


def test_derivatives_of_multiples_agree_with_the_closed_form():
    angle = jnp.asarray(-2.3)
    wanted = [(-n * np.sin(n * angle), n * np.cos(n * angle)) for n in ORDERS]
    for mode in (jax.jacfwd, jax.jacrev):
        by_angle = mode(lambda a: cosines_and_sines(a, ORDERS))(angle)
        np.testing.assert_allclose(by_angle, wanted, rtol=1e-13)


@given(st.floats(-700.0, 50.0))
def test_exponential_agrees_with_numpy(exponent: float):
    expected = np.exp(exponent)
    assert float(exponential(jnp.asarray(exponent))) == pytest.approx(expected, rel=1e-15, abs=3e-16)


@given(base=st.floats(1e-30, 1e3), exponent=st.floats(0.0, 3.0))
def test_power_agrees_with_python(base: float, exponent: float):
    expected = base**exponent
    found = float(power(jnp.asarray(base), jnp.asarray(exponent)))
    assert found == pytest.approx(expected, rel=1e-13, abs=3e-16)
