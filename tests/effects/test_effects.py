"""Laws that every effect of the catalogue obeys: zero strength, derivatives and energy."""

import functools
from dataclasses import replace

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from simulated_outputs import BASE, START, STEP, TIME, TORQUE, outputs, rms, slopes

import hdjax.effects
from fitting.estimation.problem import stable_substeps
from hdjax import TwoInertiaModel, sampled
from hdjax.compilation import jit_small
from hdjax.effects import CATALOGUE, JointTorqueBias, JointTorqueDelay, Scales
from hdjax.effects.creep import Creep
from hdjax.effects.hysteresis import BoucWen, SharpBoucWen
from hdjax.effects.position import ConservativePositionDependentStiffness
from hdjax.effects.resonance import ExtraResonance, ResonanceBesideLoad
from hdjax.parameters import own_parameters
from hdjax.simulate import march


def base(form=None) -> TwoInertiaModel:
    """The base model with sensors that see what the form changes; the last output shows it."""
    of_torque = form in (JointTorqueBias, JointTorqueDelay)
    return replace(BASE, measured=("motor_turn", "joint_torque")) if of_torque else BASE


@functools.cache
def base_outputs(form=None, substeps=1):
    return np.asarray(outputs(base(form), TORQUE, START, substeps))


@functools.cache
def scales() -> Scales:
    """Scales of the base model's motion."""
    theta, x = base_outputs().T
    rate = functools.partial(np.gradient, axis=0)
    v, omega = rate(x) / STEP, rate(theta) / STEP
    return Scales(
        x=rms(x),
        x_max=float(np.abs(x).max()),
        v=rms(v),
        omega_m=50 * rms(omega),
        omega_l=rms(omega - v),
        time_step=STEP,
        duration=float(TIME[-1]),
        reduction_ratio=50.0,
        omega_0=386.0,
        temperature=303.0,
        temperature_change=3.0,
        residual_frequencies=(120.0, 260.0),
    )


@functools.cache
def at_strength(form, share: float):
    """The base model with the effect, each of whose strengths alone changes the last output by this share to first
    order.

    All strengths are positive.
    """
    effect = form.proposals(scales())[0]
    model = base(form).with_effects(effect)
    values = {}
    found = slopes(model, TORQUE, START)
    for name, info in own_parameters(effect):
        if info.role == "strength":
            path = f"{form.name}.{name}"
            slope = np.asarray(found[path])[:, 1]
            assert rms(slope) > 0, f"{path} does nothing at zero strength"
            values[path] = share * rms(base_outputs(form)[:, 1]) / rms(slope)
    return model.replace(values)


STORE_IS_KNOWN = (BoucWen, SharpBoucWen, Creep, ExtraResonance, ResonanceBesideLoad)
FIRST_OF_FAMILY = {form.family: form for form in reversed(CATALOGUE)}


def over(forms):
    """Every form, where all but the first of each family and those whose store of energy is known are slow."""
    quick = {*FIRST_OF_FAMILY.values(), *STORE_IS_KNOWN}
    marked = [pytest.param(f, marks=() if f in quick else pytest.mark.slow) for f in forms]
    return pytest.mark.parametrize("form", marked, ids=lambda form: form.name)


every_form = pytest.mark.parametrize("form", CATALOGUE, ids=lambda form: form.name)


DELAYED = ("input_delay", "input_lag", "motor_encoder_delay")


@every_form
def test_effect_of_zero_strength_is_the_base_model(form):
    for effect in form.proposals(scales()):
        model = base(form).with_effects(effect)
        bare = base_outputs(form, stable_substeps(model, STEP))
        found = np.asarray(outputs(model, TORQUE, START))
        # Rounding over 200 steps; a delayed torque is late by 1e-9 of a step, which changes the twist by as much.
        error = np.abs(found - bare).max(axis=0) / np.abs(bare).max(axis=0)
        assert error.max() < (1e-8 if form.name in DELAYED else 1e-12)


@every_form
def test_effect_changes_the_motion_as_its_derivative_predicts(form):
    """By about a tenth for each strength, according to the derivative at zero."""
    model = at_strength(form, 0.1)
    bare = base_outputs(form)[:, 1]
    change = rms(np.asarray(outputs(model, TORQUE, START))[:, 1] - bare) / rms(bare)
    count = sum(info.role == "strength" for _, info in own_parameters(model.effects[0]))
    assert 0.03 < change < 0.3 * count


@over(CATALOGUE)
def test_gradients_by_strength_and_shape_agree_with_differences(form):
    model = at_strength(form, 0.03)
    gradients = slopes(model, TORQUE, START)
    for name, info in own_parameters(model.effects[0]):
        # Bouc-Wen's n is a constant of the form: neither strength nor shape.
        if info.role == "base":
            continue
        path = f"{form.name}.{name}"
        value = float(model.get(path))
        h = 1e-6 * value
        near = (model.replace({path: value + sign * h}) for sign in (1, -1))
        after, before = (outputs(changed, TORQUE, START, settled=model) for changed in near)
        differences = (after - before) / (2 * h) * value
        found = np.asarray(gradients[path]) * value
        # Differences err by rounding, 1e-14 / 1e-6 of the angles, and where a kink lies between the two motions.
        np.testing.assert_allclose(found, differences, atol=1e-8 + 1e-4 * np.abs(found).max())
        assert np.abs(found[:, 1]).max() > 1e-4 * np.abs(base_outputs(form)[:, 1]).max()


# -- energy --

# Fine enough that Tsit5 errs by 1e-9 where forces are smooth; a step across the edge of a backlash's zone errs by up to
# (omega_0 h)^2 / 2 = 3e-5 of the energy. Five periods of omega_0.
FREE_STEP = 2e-5
FREE_TIME = FREE_STEP * np.arange(4000)
NO_TORQUE = sampled(FREE_TIME, np.zeros(FREE_TIME.size), hold="zero-order")
SPRUNG = jnp.asarray([0.2, 0.7, 3.0, 0.1]).at[0].add(50 * 0.7)  # twisted by 4 mrad off its equilibrium


@jit_small
def released(model):
    """States of a drive released from a twist, without torque."""
    state = model.rest().at[:4].set(SPRUNG)
    return march(model, NO_TORQUE, None, state, solver=dfx.Tsit5(), substeps=1)[0]


def spring(x, alpha):
    return x**2 / 2 + alpha * x**4 / 4


def energy(model: TwoInertiaModel, states) -> np.ndarray:
    """Kinetic energy and every potential, by the equations of EFFECTS.md."""
    theta_m, theta_l, omega_m, omega_l, *own = np.asarray(states).T
    value = {path.split(".")[-1]: float(v) for path, (v, _) in model.parameters().items()}
    names = {effect.name for effect in model.effects}
    K, alpha = value["K"], value["alpha"]
    x = theta_m / value["N"] - theta_l
    total = 0.5 * value["J_m"] * omega_m**2 + 0.5 * value["J_l"] * omega_l**2
    if "kinematic_error" in names:
        for n in (1, 2, 4):
            x = x + value[f"cos_{n}"] * np.cos(n * theta_m) + value[f"sin_{n}"] * np.sin(n * theta_m)
    if "kinematic_harmonic" in names:
        x = x + value["cosine"] * np.cos(value["n"] * theta_m) + value["sine"] * np.sin(value["n"] * theta_m)
    if names & {"backlash", "undamped_backlash"}:
        return total + K * spring(np.sign(x) * np.maximum(np.abs(x) - value["b"], 0.0), alpha)
    total = total + K * spring(x, alpha)
    if "quadratic_stiffness" in names:
        total = total + K * value["k2"] * x**3 / 3
    if "quintic_stiffness" in names:
        total = total + K * value["k5"] * x**6 / 6
    if "three_slope_stiffness" in names:
        for stiffening, knee in ((value["stiffening_2"], 0.0), (value["stiffening_3"], value["gap"])):
            total = total + K * stiffening * np.maximum(np.abs(x) - value["x1"] - knee, 0.0) ** 2 / 2
    if "gravity_load" in names:
        total = total - value["sine"] * np.cos(theta_l) + value["cosine"] * np.sin(theta_l)
    if "smooth_knee_stiffness" in names:
        knee, width = value["knee"], value["width"]

        def area(u):
            root = np.sqrt(u**2 + width**2)
            return (u**2 + u * root + width**2 * np.log(u + root)) / 4

        total = total + K * value["stiffening"] * (area(x - knee) + area(-x - knee))
    if "constant_load" in names:
        total = total - value["constant"] * theta_l
    if "cogging" in names:
        for n in (1, 2, 4):
            total = total - (value[f"cos_{n}"] * np.sin(n * theta_m) - value[f"sin_{n}"] * np.cos(n * theta_m)) / n
    if "single_order_cogging" in names:
        n = value["n"]
        total = total - (value["cosine"] * np.sin(n * theta_m) - value["sine"] * np.cos(n * theta_m)) / n
    if "kinematic_sidebands" in names:
        for side, n in (("below", 2 - 1 / 50), ("above", 2 + 1 / 50)):
            a, b = value[f"cos_{side}"], value[f"sin_{side}"]
            shifted = a * np.cos(n * theta_m) + b * np.sin(n * theta_m)
            total = total + K * (spring(x + shifted, alpha) - spring(x, alpha))
            x = x + shifted
    if "conservative_position_dependent_stiffness" in names:
        n = value["n"]
        ripple = value["cosine"] * np.cos(n * theta_m) + value["sine"] * np.sin(n * theta_m)
        total = total + K * spring(x, alpha) * ripple
    if names & {"bouc_wen", "sharp_bouc_wen"}:
        total = total + value["k"] * own[0] ** 2 / 2
    if "creep" in names:
        total = total + value["k"] * (x - own[0]) ** 2 / 2
    if names & {"extra_resonance", "resonance_beside_load"}:
        J_3 = value["mass_ratio"] * value["J_l"]
        total = total + J_3 * (value["omega_3"] ** 2 * own[0] ** 2 + own[1] ** 2) / 2
    if "extra_resonance" in names:
        total = total - J_3 * omega_l**2 / 2
    return total


CONSERVATIVE = ("stiffness_shape", "backlash", "kinematic_error", "gravity_load", "cogging")
DISSIPATIVE = (
    "coulomb_friction",
    "motor_friction",
    "load_friction",
    "nonlinear_damping",
    "hysteresis",
    "creep",
    "extra_resonance",
)


@functools.cache
def lossless(form, share=0.2):
    model = at_strength(form, share).replace({"B_sp": 0.0})
    return model, np.asarray(released(model))


@over([*(f for f in CATALOGUE if f.family in CONSERVATIVE), ConservativePositionDependentStiffness])
def test_conservative_effect_keeps_the_energy(form):
    model, states = lossless(form)
    found = energy(model, states)
    exchanged = np.ptp(energy(model.without_effect(form.name), states))
    assert exchanged > 1e-3 * found[0]  # the effect takes part
    kinks = form.family in ("backlash", "stiffness_shape")
    np.testing.assert_allclose(found, found[0], atol=(1e-4 if kinks else 1e-8) * abs(found[0]))


@over([f for f in CATALOGUE if f.family in DISSIPATIVE])
def test_dissipative_effect_loses_energy(form):
    model, states = lossless(form)
    found = energy(model, states)
    # A light third inertia or a slow creep dissipates little energy in five periods.
    assert found[-1] < (0.999 if form.family in ("creep", "extra_resonance") else 0.97) * found[0]
    # A form with hidden states stores some energy and returns it.
    if not form.states or form in STORE_IS_KNOWN:
        assert np.all(np.diff(found) < 1e-9 * found[0])


def test_package_exports_every_form():
    assert {form.__name__ for form in CATALOGUE} <= set(hdjax.effects.__all__)
