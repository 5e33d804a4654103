"""The vector of a fit maps to the free parameters of the model, which stay in their domains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rig
from fitting.estimation.free_parameters import as_they_are, base_paths, effect_paths, free_parameters, strength_paths
from hdjax.effects import BY_NAME, CATALOGUE, Effect, Scales
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.hysteresis import BoucWen

SCALES = Scales(
    x=5e-4,
    x_max=2e-3,
    v=0.1,
    omega_m=40.0,
    omega_l=0.8,
    time_step=5e-4,
    temperature=300.0,
    temperature_change=2.0,
    residual_frequencies=(90.0, 400.0),
)
PATHS = ("K", "alpha", "B_sp", "coulomb_friction.T_c", "coulomb_friction.v_0")
SCALE = {"alpha": 2e4, "B_sp": 0.1}


def model(K: float = 7000.0, alpha: float = 1e4, B_sp: float = 0.2, T_c: float = 0.5, v_0: float = 0.01):
    return rig.drive_model(K=K, alpha=alpha, B_sp=B_sp).with_effects(CoulombFriction(T_c=T_c, v_0=v_0))


@settings(max_examples=20)
@given(
    K=st.floats(1.0, 1e8),
    alpha=st.floats(-1e6, 1e6),
    B_sp=st.floats(-10.0, 1e3),
    T_c=st.floats(1e-6, 1e2),
)
def test_unpack_inverts_pack(K: float, alpha: float, B_sp: float, T_c: float):
    wanted = model(K, alpha, B_sp, T_c)
    # The scales come from another model, as they do after the first iteration of a fit.
    free = free_parameters(model(), PATHS, SCALE)
    back = free.unpack(model(), free.pack(wanted))
    for path in PATHS:
        np.testing.assert_allclose(back.get(path), wanted.get(path), rtol=1e-13, atol=1e-290)
    assert float(back.get("J_m")) == rig.J_M


def test_parameters_as_they_are_keep_every_bit():
    free, values = as_they_are(model(K=0.1 + 0.2, alpha=-1.0 / 3.0), PATHS)
    back = free.unpack(model(), values)
    assert back.values(PATHS) == model(K=0.1 + 0.2, alpha=-1.0 / 3.0).values(PATHS)


@settings(max_examples=20)
@given(st.lists(st.floats(-1e4, 1e4), min_size=5, max_size=5))
def test_positive_parameters_stay_positive_and_finite(vector: list[float]):
    free = free_parameters(model(), PATHS, SCALE)
    assert free.logarithmic == (True, False, False, True, True)
    moved = free.unpack(model(), jnp.asarray(vector))
    for path, positive in zip(PATHS, free.logarithmic, strict=True):
        assert np.isfinite(moved.get(path))
        if positive:
            assert float(moved.get(path)) > 0


def test_scale_of_a_parameter_is_its_value_or_a_typical_one():
    free = free_parameters(model(alpha=0.0), PATHS, SCALE)
    np.testing.assert_allclose(free.scale[1:3], [2e4, 0.2])
    far = free_parameters(model(alpha=-5e5), PATHS, SCALE)
    assert float(far.scale[1]) == 5e5
    # Without a value and a typical one, the scale is 1.
    assert float(free_parameters(model(alpha=0.0), ("alpha",), {}).scale[0]) == 1.0


def test_slopes_are_derivatives_of_parameters_by_the_vector():
    # Not at the model that the scales come from.
    start = model(K=9000.0, alpha=3e4, B_sp=0.5, T_c=0.2, v_0=0.05)
    free = free_parameters(model(), PATHS, SCALE)
    vector = free.pack(start)
    step = 1e-6
    for i, path in enumerate(PATHS):
        nudge = step * jnp.eye(len(PATHS))[i]
        up, down = (free.unpack(start, vector + sign * nudge).get(path) for sign in (1, -1))
        # The truncation is of the order of the squared step, rounding of 1e-16 over it.
        np.testing.assert_allclose(free.slopes(start)[i], (up - down) / (2 * step), rtol=1e-8)
    jacobian = jax.jacfwd(lambda v: jnp.stack([free.unpack(start, v).get(p) for p in PATHS]))(vector)
    np.testing.assert_allclose(jacobian, np.diag(free.slopes(start)), rtol=1e-12)


def test_empty_list_of_free_parameters_leaves_the_model_unchanged():
    start = model()
    free = free_parameters(start, (), {})
    assert free.pack(start).shape == (0,)
    assert free.slopes(start).shape == (0,)
    assert free.unpack(start, jnp.zeros(0)) is start


@pytest.mark.parametrize("path", ["k", "friction.T_c", "coulomb_friction.T", "coulomb_friction", ""])
def test_unknown_parameter_path_is_refused(path: str):
    with pytest.raises(ValueError, match=f"^`{path}` must be one of .*'alpha'"):
        free_parameters(model(), ("K", path), {})


@pytest.mark.parametrize("value", [0.0, -3.0, float("nan")])
def test_nonpositive_value_of_a_positive_parameter_is_refused(value: float):
    with pytest.raises(ValueError, match="^`K` must be positive, but is"):
        free_parameters(model().replace({"K": value}), ("K",), {})


def test_base_paths_are_those_of_the_base_model():
    assert base_paths(model()) == ("K", "alpha", "B_sp")
    assert base_paths(rig.reduced_model()) == ("mu", "omega_0", "alpha", "gain")


@pytest.mark.parametrize("form", CATALOGUE, ids=lambda form: form.name)
def test_effect_paths_of_every_form_can_be_freed(form: type[Effect]):
    for effect in form.proposals(SCALES):
        everything = effect_paths(effect)
        strengths = strength_paths(effect)
        assert strengths
        assert set(strengths) <= set(everything)
        whole = rig.drive_model().with_effects(effect)
        known = whole.parameters()
        assert all(p in known and known[p][1].role != "base" for p in everything)
        assert {p for p in known if p.startswith(f"{form.name}.") and known[p][1].role == "strength"} == set(strengths)
        # All parameters can be freed once the strengths differ from zero, and unpack inverts pack.
        filled = whole.replace({p: 0.3 for p in strengths})
        free = free_parameters(filled, everything, {})
        back = free.unpack(whole, free.pack(filled))
        for path in everything:
            np.testing.assert_allclose(back.get(path), filled.get(path), rtol=1e-14)


def test_effect_paths_of_bouc_wen_are_as_listed():
    effect = BoucWen(k=1.0, memory_twist=1e-3)
    assert strength_paths(effect) == ("bouc_wen.k",)
    assert effect_paths(effect) == ("bouc_wen.k", "bouc_wen.memory_twist", "bouc_wen.ratio")
    assert BY_NAME["bouc_wen"] is BoucWen
