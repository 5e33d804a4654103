"""A wrong inertia is the effect of an inertia error, and is found with its value."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rig
from fitting.loop import close_loop
from fitting.report.limits import _of_scale
from hdjax import Drive, TwoInertiaModel
from hdjax.effects import GravityLoad, LoadInertiaError, MotorInertiaError, TorqueGain

DRIVE = {"N": 50.0, "J_m": 5.26e-4, "J_l": 5.0e-2, "K": 7160.0, "alpha": 1e3, "B_sp": 0.4}
UNITS = np.array([1.0, 50.0, 0.02, 1.0])


@eqx.filter_jit
def rates(model, state, torques):
    return model.rates(state, *torques)


@pytest.mark.parametrize(("form", "path"), [(MotorInertiaError, "J_m"), (LoadInertiaError, "J_l")])
@given(error=st.floats(-0.6, 2.0), seed=st.integers(0, 99))
def test_motion_is_that_of_a_drive_with_the_other_inertia(form, path, error, seed):
    stated = TwoInertiaModel(Drive(**DRIVE), (form(error=error),))
    true = TwoInertiaModel(Drive(**DRIVE | {path: (1.0 + error) * DRIVE[path]}))
    random = np.random.default_rng(seed)
    state = jnp.asarray(UNITS * random.normal(size=4))
    torques = jnp.asarray(random.normal(size=2))
    np.testing.assert_allclose(rates(stated, state, torques), rates(true, state, torques), rtol=1e-12)
    (inertia,) = stated.effects[0].derived(stated.drive).values()
    assert float(inertia[0]) == pytest.approx(float(true.get(path)))


@pytest.mark.parametrize(
    ("path", "gravity"),
    [("J_m", 0.0), *(pytest.param("J_l", gravity, marks=pytest.mark.slow) for gravity in (0.0, 8.0))],
)
def test_loop_finds_a_stated_inertia_that_is_wrong(path: str, gravity: float):
    """Gravity makes the load's own equation the source of K, in proportion to the inertia as stated."""
    experiment = rig.drive_experiment(4000, gravity=gravity)
    model = rig.drive_model()
    true = float(model.get(path))
    drive = replace(model.drive, **{path: 1.1 * true})
    catalogue = (MotorInertiaError, LoadInertiaError, TorqueGain, GravityLoad)
    loop = close_loop(TwoInertiaModel(drive), {"zero-order": (experiment,)}, hold="zero-order", catalogue=catalogue)
    assert loop.decision == "effect_found"
    form = MotorInertiaError if path == "J_m" else LoadInertiaError
    assert {f.name for f in loop.findings} == {form.name} | ({"gravity_load"} if gravity else set())
    (inertia,) = loop.after.model.effect(form.name).derived(drive).values()
    assert float(inertia[0]) == pytest.approx(true, rel=1e-3)
    assert loop.parameters_from == "torque"
    assert path not in {held.path for held in loop.after.identifiability.held}
    K = loop.after.uncertainty.estimates["K"]
    assert K.ci95[0] < rig.K < K.ci95[1]


def test_two_corrections_of_the_scale_are_told():
    def report(*names: str) -> dict:
        return {"after": {"effects": [{"name": name} for name in names]}}

    assert not _of_scale(report("torque_gain", "motor_friction"))
    (note,) = _of_scale(report("torque_gain", "motor_inertia_error"))
    assert "torque_gain and motor_inertia_error" in note
