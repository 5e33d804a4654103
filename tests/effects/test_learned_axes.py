"""Axes of learned functions: their functions, derivatives and the candidates over given variables."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

from hdjax.effects import Motion
from hdjax.effects.learned_axes import (
    ANGLES,
    AngleAxis,
    Axis,
    LinearAxis,
    PeriodicAxis,
    PowerAxis,
    SignAxis,
    SplineAxis,
    axes_over,
    axis_over,
    combined,
    functions,
)


@eqx.filter_jit
def evaluated(axis: Axis, values):
    return jax.vmap(axis.functions)(values)


def test_spline_axis_agrees_with_scipy():
    axis = SplineAxis("x", low=-2.0, high=3.0, intervals=5)
    knots = np.arange(-5.0, 9.0)
    inside = np.linspace(-2.0, 3.0, 41)
    found = np.asarray(evaluated(axis, jnp.asarray(inside)))
    wanted = BSpline.design_matrix(np.minimum(inside, 3.0 - 1e-12), knots, 3).toarray()[:, : axis.count]
    np.testing.assert_allclose(found, wanted[:, : axis.count], atol=1e-9)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-12)


def test_spline_axis_is_linear_beyond_its_range():
    axis = SplineAxis("x", low=-1.0, high=1.0, intervals=4)
    end, before, far = np.asarray(evaluated(axis, jnp.asarray([1.0, 1.0 - 1e-6, 4.0])))
    # Of a slope from a step of 1e-6, over three units.
    np.testing.assert_allclose(far, end + 3.0 * (end - before) / 1e-6, atol=1e-4)


def test_power_axis_agrees_with_its_formula():
    axis = PowerAxis("v", largest=2.0)
    values = np.linspace(-3.0, 3.0, 7)
    share = values / 2.0
    wanted = np.stack([np.ones(7), share, share * np.abs(share), share**2, share**3], axis=1)
    np.testing.assert_allclose(evaluated(axis, jnp.asarray(values)), wanted, rtol=1e-14)


def forms_over(jumps_with: str | None = None, **ranges: tuple[float, float]) -> list[tuple[type, ...]]:
    return [tuple(type(axis) for axis in axes) for axes in axes_over(ranges, jumps_with=jumps_with)]


@pytest.mark.parametrize("variable", ["theta_m", "time", "temperature"])
def test_drifting_and_periodic_variables_have_no_power_axis(variable: str):
    """Powers extrapolate a drift without bound, and an angle is periodic."""
    assert all(PowerAxis not in axes for axes in forms_over(**{variable: (0.0, 1.0)}))


def test_candidate_axes_are_ordered_from_simple_to_complex():
    (powers,), (spline,) = axes_over({"v": (-2.0, 1.0)})
    assert isinstance(powers, PowerAxis) and float(powers.largest) == 2.0
    assert isinstance(spline, SplineAxis) and (float(spline.low), float(spline.high)) == (-2.0, 1.0)
    # A stiffness that changes with speed, damping that changes with twist, any function.
    assert forms_over(x=(-1.0, 1.0), omega_m=(-9.0, 9.0)) == [
        (LinearAxis, SplineAxis),
        (SplineAxis, LinearAxis),
        (SplineAxis, SplineAxis),
    ]
    assert forms_over(x=(-1.0, 1.0), theta_m=(0.0, 9.0)) == [(LinearAxis, AngleAxis), (SplineAxis, AngleAxis)]
    assert forms_over(theta_l=(0.0, 1.0), time=(0.0, 9.0)) == [(AngleAxis, SplineAxis)]


def test_candidate_axes_of_a_jump_follow_the_smooth_ones():
    smooth, jumping_torque = axes_over({"v": (-2.0, 1.0)})[:2], axes_over({"v": (-2.0, 1.0)}, jumps_with="v")[2:]
    for (axis,), (sign,) in zip(smooth, jumping_torque, strict=True):
        assert isinstance(sign, SignAxis) and sign.variable == "v"
        assert 0.0 < float(sign.corner) < 0.1
        assert eqx.tree_equal(sign.beside, axis)
    assert forms_over(v=(-1.0, 1.0), theta_m=(0.0, 9.0), jumps_with="v")[1] == (SignAxis, AngleAxis)
    # The axis with the sign comes first.
    assert forms_over(x=(-1.0, 1.0), v=(-1.0, 1.0), jumps_with="v")[2] == (SignAxis, SplineAxis)
    assert SignAxis not in sum(forms_over(x=(-1.0, 1.0), omega_l=(-1.0, 1.0), jumps_with="v"), ())


def test_linear_axis_multiplies_the_other_axis_by_its_variable():
    axes = LinearAxis("x"), axis_over("omega_m", -9.0, 9.0)
    motion = Motion(x=jnp.asarray(0.3), v=jnp.zeros(()), omega_m=jnp.asarray(2.0))
    wanted = 0.3 * np.asarray(axes[1].functions(jnp.asarray(2.0)))
    np.testing.assert_allclose(functions(axes, motion), wanted, rtol=1e-15)


def test_spline_knots_of_a_rate_are_dense_near_zero():
    axis = axis_over("omega_m", -30.0, 40.0)
    assert isinstance(axis, SplineAxis) and axis.bend is not None
    values = np.linspace(-30.0, 40.0, 4001)
    basis = np.asarray(evaluated(axis, jnp.asarray(values)))
    friction = np.tanh(values / 0.4)
    left = friction - basis @ np.linalg.lstsq(basis, friction, rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 0.01


def test_angle_axis_is_periodic():
    axis = axis_over("theta_m", 0.0, 100.0)
    assert isinstance(axis, AngleAxis) and axis.orders == ANGLES["theta_m"]
    found = axis.functions(jnp.asarray(0.7))
    wanted = [1.0] + [f(n * 0.7) for n in range(1, axis.orders + 1) for f in (np.cos, np.sin)]
    np.testing.assert_allclose(found, wanted, atol=1e-14)
    np.testing.assert_allclose(found, axis.functions(jnp.asarray(0.7 - 4 * np.pi)), atol=1e-12)


def test_time_axis_may_be_periodic_at_given_spectral_lines():
    (drift,), *lines = axes_over({"time": (0.0, 9.0)}, lines=(20.0, 30.0))
    assert isinstance(drift, SplineAxis)
    for (axis,), omega in zip(lines, (20.0, 30.0), strict=True):
        assert isinstance(axis, PeriodicAxis) and float(axis.omega) == omega
    for other in ({"theta_m": (0.0, 9.0)}, {"x": (0.0, 1.0), "time": (0.0, 9.0)}):
        assert PeriodicAxis not in sum(([type(a) for a in axes] for axes in axes_over(other, lines=(20.0,))), [])
    found = PeriodicAxis("time", 20.0, 2).functions(jnp.asarray(0.3))
    np.testing.assert_allclose(found, [1.0, np.cos(6), np.sin(6), np.cos(12), np.sin(12)], rtol=1e-14)


def test_functions_of_two_axes_are_their_products():
    one, other = axis_over("x", -1.0, 1.0, beside="theta_m"), axis_over("theta_m", 0.0, 1.0, beside="x")
    motion = Motion(x=jnp.asarray(0.3), v=jnp.zeros(()), theta_m=jnp.asarray(2.0))
    wanted = np.outer(one.functions(motion.x), other.functions(jnp.asarray(2.0))).reshape(-1)
    np.testing.assert_array_equal(functions((one, other), motion), wanted)


@pytest.mark.slow
def test_combined_axes_have_the_derivatives_of_the_formula():
    axes = axis_over("x", -1.0, 1.0, beside="theta_m"), axis_over("theta_m", 0.0, 1.0, beside="x")
    count = int(np.prod([axis.count for axis in axes]))
    random = np.random.default_rng(0)
    mixing, c = jnp.asarray(random.normal(size=(count, 5))), jnp.asarray(random.normal(size=5))

    def motion(x, theta_m) -> Motion:
        return Motion(x=x, v=jnp.zeros(()), theta_m=theta_m)

    def by_hand(x, theta_m, c):
        return combined(axes, mixing, tuple(c), motion(x, theta_m))

    def formula(x, theta_m, c):
        return functions(axes, motion(x, theta_m)) @ mixing @ c

    at = jnp.asarray(0.3), jnp.asarray(2.0), c
    for differentiate in (jax.jacfwd, jax.jacrev):
        found, wanted = (differentiate(f, argnums=(0, 1, 2))(*at) for f in (by_hand, formula))
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-10)
