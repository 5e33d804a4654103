"""Bouc-Wen hysteresis against its closed forms."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_outputs import DRIVE

from hdjax.effects import Motion
from hdjax.effects.hysteresis import BoucWen


@jax.jit
def hysteresis_states(effect: BoucWen, x: jax.Array) -> jax.Array:
    """z along a prescribed, piecewise linear twist, by Runge-Kutta steps in the path."""

    def step(z, dx):
        def rate(z):
            return effect.state_rates(Motion(x=dx, v=dx), z)

        k1 = rate(z)
        k2 = rate(z + 0.5 * k1)
        k3 = rate(z + 0.5 * k2)
        k4 = rate(z + k3)
        z = z + (k1 + 2 * k2 + 2 * k3 + k4) / 6
        return z, z[0]

    return jax.lax.scan(step, effect.initial_state(), jnp.diff(x))[1]


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    ratio=st.floats(-0.7, 3.0),
    n=st.floats(1.0, 4.0),
    memory_twist=st.floats(1e-5, 1e-2),
)
def test_bouc_wen_state_never_exceeds_its_yield_twist(seed, ratio, n, memory_twist):
    rng = np.random.default_rng(seed)
    yield_twist = memory_twist * (1 + ratio) ** (-1 / n)
    x = np.interp(np.arange(3000) / 100, np.arange(31), yield_twist * 4 * rng.normal(size=31))
    z = np.asarray(hysteresis_states(BoucWen(k=1.0, memory_twist=memory_twist, ratio=ratio, n=n), jnp.asarray(x)))
    assert np.abs(z).max() <= yield_twist * (1 + 1e-9)
    assert np.abs(z).max() > 0.5 * yield_twist


def test_bouc_wen_with_unit_exponent_agrees_with_the_closed_form():
    """Loading from 0 gives `y (1 - exp(-x/y))`, unloading has the slope `1 + (beta - gamma)|z|`.

    Where gamma < -beta, y is negative and z diverges.
    """
    y = 1e-3
    x = np.linspace(0, 3 * y, 1001)
    effect = BoucWen(k=1.0, memory_twist=y / 0.7, ratio=3 / 7)
    z = np.asarray(hysteresis_states(effect, jnp.asarray(x)))
    np.testing.assert_allclose(z, y * (1 - np.exp(-x[1:] / y)), atol=1e-9 * y)
    hardening = BoucWen(k=1.0, memory_twist=1e-3, ratio=-1.5)
    np.testing.assert_allclose(
        np.asarray(hysteresis_states(hardening, jnp.asarray(x))), 2 * y * (np.exp(x[1:] / (2 * y)) - 1), rtol=1e-9
    )
    unloading = effect.state_rates(Motion(x=jnp.asarray(0.0), v=jnp.asarray(-2.0)), jnp.asarray([0.5 * y]))
    np.testing.assert_allclose(unloading, [-2.0 * (1 + 0.4 * 0.5)], rtol=1e-12)
    derived = {name: float(v) for name, (v, _) in effect.derived(DRIVE).items()}
    assert derived == pytest.approx({"beta": 700.0, "gamma": 300.0})


def loop_area(omega: float) -> float:
    """Area of torque against twist over the third cycle of a harmonic twist."""
    model = BoucWen(k=3000.0, memory_twist=4e-4 / 0.6, ratio=2 / 3)
    t = np.linspace(0, 3 * 2 * np.pi / omega, 3 * 400 + 1)

    @jax.jit
    def settle(times):
        def rate(t, z, args):
            x, v = 1e-3 * jnp.sin(omega * t), 1e-3 * omega * jnp.cos(omega * t)
            return model.state_rates(Motion(x=x, v=v), z)

        return dfx.diffeqsolve(
            dfx.ODETerm(rate), dfx.Tsit5(), times[0], times[-1], times[1], model.initial_state(),
            saveat=dfx.SaveAt(ts=times), stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-14),
        ).ys  # fmt: skip

    z = np.asarray(settle(jnp.asarray(t)))[-401:, 0]
    return float(np.trapezoid(3000.0 * z, 1e-3 * np.sin(omega * t[-401:])))


def test_bouc_wen_loop_area_does_not_depend_on_frequency():
    slow, fast = loop_area(1.0), loop_area(30.0)
    assert slow == pytest.approx(fast, rel=1e-5)
    # Less than the parallelogram of an ideal element that slips at the yield, 4 T (x - x_yield), by its round corners.
    assert 0.5 < slow / (4 * 3000 * 4e-4 * (1e-3 - 4e-4)) < 1.0
