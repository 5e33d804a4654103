"""Derived quantities of a drive, and how its parameters are named, described and changed."""

from dataclasses import fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdjax import (
    PRESETS,
    Drive,
    LoadDrivenModel,
    MotorDrivenModel,
    ReducedDrive,
    ReducedModel,
    TwoInertiaModel,
    hdc_40_050,
)
from hdjax.effects import BY_NAME, CATALOGUE, FAMILIES, Scales
from hdjax.effects.backlash import Backlash
from hdjax.effects.creep import Creep
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.kinematic import KinematicError
from hdjax.parameters import own_parameters

SCALES = Scales(
    x=1e-3,
    x_max=3e-3,
    v=0.4,
    omega_m=20.0,
    omega_l=0.4,
    time_step=1e-3,
    temperature=300.0,
    temperature_change=2.0,
    residual_frequencies=(90.0, 400.0),
)

# DESIGN 2.1 and the table of effects.
KNOWN_FAMILIES = {
    "kinematic_error", "stiffness_shape", "backlash", "hysteresis", "coulomb_friction", "motor_friction",
    "load_friction", "nonlinear_damping", "position_dependent_stiffness", "position_dependent_friction", "cogging",
    "gravity_load", "load_disturbance", "extra_resonance", "temperature", "torque_sensor", "input_delay",
    "encoder_eccentricity", "encoder_offset", "sensor_delay", "creep", "inertia_error", "unknown",
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value"), [("K", -1.0), ("J_m", 0.0), ("N", -50.0), ("J_l", np.nan), ("alpha", np.inf)]
)
def test_drive_that_cannot_be_is_refused(name: str, value: float):
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        replace(hdc_40_050(), **{name: value})
    with pytest.raises(ValueError, match="`omega_0` must be above 0 rad/s, but is -1"):
        ReducedDrive(mu=1.0, omega_0=-1.0)
    # Under a transformation there is no value to refuse.
    slope = jax.grad(lambda K: replace(hdc_40_050(), K=K).omega_0)(jnp.asarray(7160.0))
    assert slope > 0


def test_preset_has_the_natural_frequency_of_its_table():
    """Not the 122.5 rad/s that the source document prints beside it (DESIGN 2.3). Digits as published."""
    drive = hdc_40_050()
    assert float(drive.omega_0) == pytest.approx(385.545, abs=5e-4)
    assert float(drive.mu) == pytest.approx(0.353, abs=5e-4)
    # By hand: motor inertia at the output 2500 * 5.26e-4 = 1.315; 1/1.315 + 1/0.05 = 20.760456.
    assert float(drive.c) == pytest.approx(20.760456, abs=5e-7)
    assert PRESETS["HDC-40-050"]() == hdc_40_050()


def test_preset_has_the_closed_form_peak_twist():
    """A/(mu omega_0) at resonance under 10 N m is 2.79 rad (DESIGN 2.2), where the source document prints 0.015."""
    drive = hdc_40_050()
    amplitude = drive.error_forcing(jnp.asarray(10.0), jnp.asarray(0.0))
    assert float(amplitude / (drive.mu * drive.omega_0)) == pytest.approx(2.79, abs=0.005)


positive = st.floats(0.1, 10.0)


@given(N=st.floats(1.0, 200.0), J_m=positive, J_l=positive, K=positive, T_m=positive, T_l=positive)
def test_error_equation_follows_from_the_two_inertias(N, J_m, J_l, K, T_m, T_l):
    """x'' = theta_m''/N - theta_l'' with an unknown mesh torque tau: its factor is c, the rest is the forcing."""
    drive = Drive(N=N, J_m=J_m, J_l=J_l, K=K, B_sp=0.3)

    def error_acceleration(tau):
        return (T_m - tau / N) / J_m / N - (tau + T_l) / J_l

    assert float(drive.error_forcing(jnp.asarray(T_m), jnp.asarray(T_l))) == pytest.approx(
        error_acceleration(0.0), rel=1e-12
    )
    assert float(drive.c) == pytest.approx(error_acceleration(0.0) - error_acceleration(1.0), rel=1e-9)
    assert float(drive.mu) == pytest.approx(float(drive.c) * 0.3, rel=1e-12)
    assert float(drive.omega_0) == pytest.approx(np.sqrt(float(drive.c) * K), rel=1e-12)


def test_printed_forcing_lacks_the_ratio_on_the_load_torque():
    drive = hdc_40_050()
    T_m, T_l = 10.0, -7.0
    N, J_m, J_l = 50.0, 5.26e-4, 5.0e-2
    printed = (T_m * J_l - T_l * J_m) / (N * J_m * J_l)
    corrected = (T_m * J_l - N * T_l * J_m) / (N * J_m * J_l)
    found = float(drive.error_forcing(jnp.asarray(T_m), jnp.asarray(T_l)))
    assert found == pytest.approx(corrected, rel=1e-12)
    assert abs(found - printed) > 0.2 * abs(found)


def test_reduced_drive_has_the_dynamics_of_the_full_drive():
    drive = eqx.tree_at(lambda d: d.alpha, hdc_40_050(), jnp.asarray(2e5))
    reduced = drive.reduced()
    assert float(reduced.mu) == pytest.approx(float(drive.mu))
    assert float(reduced.omega_0) == pytest.approx(float(drive.omega_0))
    assert float(reduced.alpha) == 2e5
    # Acceleration of the error per N m of motor torque.
    assert float(reduced.gain) == pytest.approx(float(drive.error_forcing(jnp.asarray(1.0), jnp.asarray(0.0))))
    x, v = jnp.asarray(1.3e-3), jnp.asarray(-0.2)
    by_hand = 20.760456 * (7160.0 * (1.3e-3 + 2e5 * 1.3e-3**3) + 0.017 * -0.2)
    assert float(reduced.mesh_torque(x, v)) == pytest.approx(by_hand, rel=1e-7)
    assert float(drive.c * drive.mesh_torque(x, v)) == pytest.approx(by_hand, rel=1e-7)


OWNERS = (hdc_40_050(), hdc_40_050().reduced(), *(form.proposals(SCALES)[0] for form in CATALOGUE))


@pytest.mark.parametrize("owner", OWNERS, ids=lambda owner: type(owner).__name__)
def test_every_parameter_has_unit_doc_source_and_bounds(owner):
    infos = dict(own_parameters(owner))
    assert infos
    for name, info in infos.items():
        assert info.unit.strip(), name
        assert info.doc.strip(), name
        assert info.source.strip(), name
        assert info.bounds[0] < info.bounds[1], name
    # Every field is a declared parameter, except what is known about parameters beforehand, and what a fit has done to
    # its data.
    assert set(infos) == {field.name for field in fields(owner)} - {"priors", "moved"}


@pytest.mark.parametrize("form", CATALOGUE)
def test_every_effect_has_a_known_family_and_valid_starting_values(form):
    assert form.family in KNOWN_FAMILIES
    proposals = form.proposals(SCALES)
    assert proposals
    for effect in proposals:
        assert "strength" in {info.role for _, info in own_parameters(effect)}
        for name, info in own_parameters(effect):
            value = float(getattr(effect, name))
            assert np.isfinite(value)
            if info.role == "strength":
                # An input delay starts slightly above zero.
                assert abs(value) <= 1e-9 * SCALES.time_step
            else:
                assert info.bounds[0] < value < info.bounds[1], name
        for quantity, unit in effect.derived(hdc_40_050()).values():
            assert quantity.shape == ()
            assert unit.strip()


def test_names_in_the_catalogue_are_unique():
    assert len(BY_NAME) == len(CATALOGUE)
    assert set(FAMILIES) == {form.family for form in CATALOGUE}


# -- the model: dotted paths and changes --


def example_model() -> TwoInertiaModel:
    return TwoInertiaModel(hdc_40_050(), (KinematicError(cos_2=1e-4), CoulombFriction(T_c=0.5, v_0=0.01)))


def test_parameters_are_accessed_by_dotted_path():
    model = example_model()
    parameters = model.parameters()
    assert list(parameters)[:6] == ["N", "J_m", "J_l", "K", "alpha", "B_sp"]
    assert {"kinematic_error.cos_2", "coulomb_friction.T_c", "coulomb_friction.v_0"} < set(parameters)
    for path, (value, info) in parameters.items():
        assert float(model.get(path)) == float(value)
        assert info.unit
    assert parameters["coulomb_friction.T_c"][1].role == "strength"


def test_replace_changes_only_the_named_parameters():
    model = example_model()
    changed = model.replace({"K": 9000.0, "coulomb_friction.T_c": 0.7})
    expected = {path: float(value) for path, (value, _) in model.parameters().items()}
    expected |= {"K": 9000.0, "coulomb_friction.T_c": 0.7}
    assert {path: float(value) for path, (value, _) in changed.parameters().items()} == expected
    assert float(model.get("K")) == 7160.0


@pytest.mark.parametrize("path", ("stiffness_2", "backlash.b", "coulomb_friction.b"))
def test_unknown_names_of_parameters_effects_and_outputs_are_refused(path):
    model = TwoInertiaModel(hdc_40_050(), (CoulombFriction(v_0=0.1),))
    for refused in (lambda: model.get(path), lambda: model.replace({path: 1.0})):
        with pytest.raises(ValueError, match=f"{path}.* must be parameters of this model; there are N, J_m"):
            refused()
    with pytest.raises(ValueError, match="`backlash` is no effect of this model; there are .'coulomb_friction'."):
        model.effect("backlash")
    with pytest.raises(ValueError, match="`measured` must be among motor_turn, .*, but is .'twist'"):
        TwoInertiaModel(hdc_40_050(), measured=("twist",))


def test_effects_are_added_and_removed():
    model = example_model()
    more = model.with_effects(Backlash(b=1e-5))
    assert [e.name for e in more.effects] == ["kinematic_error", "coulomb_friction", "backlash"]
    assert float(more.get("backlash.b")) == 1e-5
    less = more.without_effect("kinematic_error")
    assert [e.name for e in less.effects] == ["coulomb_friction", "backlash"]
    assert "kinematic_error.cos_2" not in less.parameters()
    assert len(model.effects) == 2


def test_effects_with_memory_of_one_name_are_refused():
    both = Creep(tau=0.1, span=1e-3), Creep(tau=1.0, span=1e-3)
    with pytest.raises(ValueError, match="effects with memory must have different names, but are creep, creep"):
        TwoInertiaModel(hdc_40_050(), both)


@pytest.mark.parametrize("form", CATALOGUE)
def test_state_names_include_the_states_of_effects(form):
    effect = form.proposals(SCALES)[0]
    model = TwoInertiaModel(hdc_40_050()).with_effects(Backlash(), effect)
    assert model.state_names[:4] == ("theta_m", "theta_l", "omega_m", "omega_l")
    assert model.state_names[4:] == tuple(f"{form.name}.{state}" for state in form.states)
    assert model.rest().shape == (len(model.state_names),)
    if form.states:
        assert effect.state_scale().shape == (len(form.states),)


@pytest.mark.parametrize("form", CATALOGUE)
def test_reduced_drive_refuses_effects_that_need_the_motor(form):
    effect = form.proposals(SCALES)[0]
    drive = ReducedDrive(mu=1.0, omega_0=20.0)
    if not form.needs_motor:
        assert ReducedModel(drive).with_effects(effect).effects == (effect,)
        return
    with pytest.raises(ValueError, match=f"`{form.name}` needs the motor"):
        ReducedModel(drive, (effect,))
    with pytest.raises(ValueError, match=f"`{form.name}` needs the motor"):
        ReducedModel(drive).with_effects(effect)


@pytest.mark.parametrize("side", [MotorDrivenModel, LoadDrivenModel])
def test_equation_of_one_side_refuses_effects_that_need_the_motor(side):
    with pytest.raises(ValueError, match="`kinematic_error` needs the motor"):
        side(hdc_40_050()).with_effects(KinematicError())


def test_parameters_are_converted_to_arrays():
    drive = replace(hdc_40_050(), N=np.int64(100))
    assert drive.N.dtype == jnp.asarray(1.0).dtype
    assert drive.N.shape == ()
