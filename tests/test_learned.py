"""The learned torque as an effect: what its functions are, at each place, and nothing at zero."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

import rig
from fitting.errors import InputError
from fitting.model_file import StoredModel, read_model, to_json
from hdjax import simulate
from hdjax.effects import Effect, Motion, Scales
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.learned import (
    ANGLES,
    LEARNED,
    UNITS,
    AngleAxis,
    Axis,
    LearnedLoadTorque,
    LearnedMeshTorque,
    LearnedMotorTorque,
    SplineAxis,
    axis_over,
    functions,
)
from hdjax.signals import sampled

TIME = np.arange(300) * 5e-4
TORQUE = sampled(TIME, rig.drive_torque(300), hold="zero-order")


def learned(form, *axes: Axis, c=None):
    count = int(np.prod([a.count for a in axes])) if axes else 1
    return form(axes=axes, mixing=jnp.eye(count), c=np.zeros(count) if c is None else c)


def test_splines_are_those_of_scipy():
    axis = SplineAxis("x", low=-2.0, high=3.0, intervals=5)
    knots = np.arange(-5.0, 9.0)
    inside = np.linspace(-2.0, 3.0, 41)
    found = np.stack([axis.functions(jnp.asarray(v)) for v in inside])
    wanted = BSpline.design_matrix(np.minimum(inside, 3.0 - 1e-12), knots, 3).toarray()[:, : axis.count]
    np.testing.assert_allclose(found, wanted[:, : axis.count], atol=1e-9)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-12)


def test_beyond_the_data_a_spline_goes_on_straight():
    axis = SplineAxis("x", low=-1.0, high=1.0, intervals=4)
    value, slope = jax.jvp(axis.functions, (jnp.asarray(1.0 - 1e-9),), (jnp.ones(()),))
    np.testing.assert_allclose(axis.functions(jnp.asarray(4.0)), value + 3.0 * slope, atol=1e-6)


def test_rates_have_their_knots_near_zero():
    axis = axis_over("omega_m", -30.0, 40.0)
    assert isinstance(axis, SplineAxis) and axis.bend is not None
    values = np.linspace(-30.0, 40.0, 4001)
    basis = np.stack(jax.vmap(axis.functions)(jnp.asarray(values)))
    friction = np.tanh(values / 0.4)
    left = friction - basis @ np.linalg.lstsq(basis, friction, rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 0.01


def test_angles_are_periodic():
    axis = axis_over("theta_m", 0.0, 100.0)
    assert isinstance(axis, AngleAxis) and axis.orders == ANGLES["theta_m"]
    found = axis.functions(jnp.asarray(0.7))
    wanted = [1.0] + [f(n * 0.7) for n in range(1, axis.orders + 1) for f in (np.cos, np.sin)]
    np.testing.assert_allclose(found, wanted, atol=1e-14)
    np.testing.assert_allclose(found, axis.functions(jnp.asarray(0.7 - 4 * np.pi)), atol=1e-12)


def test_two_variables_are_products():
    one, other = axis_over("x", -1.0, 1.0, fine=False), axis_over("theta_m", 0.0, 1.0, fine=False)
    motion = Motion(x=jnp.asarray(0.3), v=jnp.zeros(()), theta_m=jnp.asarray(2.0))
    wanted = np.outer(one.functions(motion.x), other.functions(jnp.asarray(2.0))).reshape(-1)
    np.testing.assert_array_equal(functions((one, other), motion), wanted)


@pytest.mark.parametrize("form", LEARNED, ids=lambda form: form.name)
def test_zero_coefficients_are_the_base_model(form: type[Effect]):
    base = rig.drive_model()
    whole = base.with_effects(learned(form, axis_over("omega_m", -10.0, 10.0), axis_over("x", -1e-3, 1e-3)))
    options = {"step_size": 2.5e-4}
    found, wanted = (simulate(m, TORQUE, TIME, **options).outputs for m in (whole, base))
    # Rounding over 300 samples.
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * float(jnp.abs(wanted).max()))


@pytest.mark.parametrize("variable", list(UNITS))
def test_gradients_agree_with_differences(variable: str):
    state = jnp.asarray([1.3, 0.025, 4.0, 0.05])
    axis = axis_over(variable, -0.7, 0.9)
    effect = learned(LearnedMotorTorque, axis, c=0.1 * np.sin(np.arange(axis.count)))
    model = rig.drive_model().with_effects(effect)

    def rates(state):
        return model.rates(state, jnp.zeros(()), jnp.zeros(()))

    found = np.asarray(jax.jacfwd(rates)(state))
    step = 1e-6
    wanted = np.stack([(rates(state + step * e) - rates(state - step * e)) / (2 * step) for e in jnp.eye(4)], axis=1)
    # Central differences of a cubic: the third derivative times the step squared, and rounding.
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-4 * np.abs(wanted).max())


def test_each_place_is_where_it_says():
    state = jnp.asarray([1.3, 0.025, 4.0, 0.05])
    zero = jnp.zeros(())
    base = rig.drive_model()
    added = {
        form: base.with_effects(learned(form, c=[2.0])).rates(state, zero, zero) - base.rates(state, zero, zero)
        for form in LEARNED
    }
    np.testing.assert_allclose(added[LearnedMotorTorque], [0, 0, 2.0 / rig.J_M, 0], rtol=1e-9)
    np.testing.assert_allclose(added[LearnedLoadTorque], [0, 0, 0, 2.0 / rig.J_L], rtol=1e-9)
    np.testing.assert_allclose(added[LearnedMeshTorque], [0, 0, -2.0 / rig.N / rig.J_M, 2.0 / rig.J_L], rtol=1e-9)


def test_nothing_is_proposed_without_data():
    scales = Scales(x=1.0, x_max=1.0, v=1.0, omega_m=1.0, omega_l=1.0, time_step=1.0)
    assert all(form.proposals(scales) == () for form in LEARNED)


def written() -> str:
    axes = (axis_over("omega_m", -30.0, 1e2 / 3), axis_over("theta_l", 0.0, 1.0, fine=False))
    count = axes[0].count * axes[1].count
    mixing = np.random.default_rng(0).normal(size=(count, 3))
    effect = LearnedMotorTorque(axes=axes, mixing=mixing, c=[1 / 3, -1e-5, 2.0])
    model = rig.drive_model().with_effects(CoulombFriction(T_c=1.0, v_0=0.1), effect)
    return to_json(StoredModel(model, "zero-order", 2, 4, 1e-12 * jnp.eye(2)))


def read(text: str, folder: Path):
    path = folder / "model.json"
    path.write_text(text, encoding="utf-8")
    return read_model(path)


def test_round_trip(tmp_path: Path):
    found = read(written(), tmp_path)
    assert to_json(found) == written()
    effect = found.model.effect("learned_motor_torque")
    assert isinstance(effect, LearnedMotorTorque)
    assert float(found.model.get("learned_motor_torque.c_1")) == -1e-5
    state = jnp.asarray([1.0, 0.02, 3.0, 0.1])
    assert np.isfinite(found.model.rates(state, jnp.zeros(()), jnp.zeros(()))).all()


BROKEN = {
    "no axes": lambda e: e.pop("axes"),
    "unknown variable": lambda e: e["axes"][0].update(variable="colour"),
    "empty range": lambda e: e["axes"][0].update(high=-40.0),
    "too many functions": lambda e: e["axes"][1].update(orders=10**9),
    "other shape": lambda e: e["mixing"].pop(),
    "not finite": lambda e: e["mixing"][0].__setitem__(0, float("nan")),
    "a coefficient less": lambda e: e["parameters"].pop("c_1"),
}


@pytest.mark.parametrize("change", BROKEN.values(), ids=BROKEN.keys())
def test_broken_files(change, tmp_path: Path):
    content = json.loads(written())
    change(content["effects"][1])
    with pytest.raises(InputError, match=r"give the model\.json of a report"):
        read(json.dumps(content), tmp_path)
