"""Learned torques in model files: read back unchanged, and refused where invalid."""

import json
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from learned_effects import jumping_torque, learned_effect, periodic_torque, rates

import rig
from fitting.errors import InputError
from fitting.stored_model import StoredModel, read_model, to_json
from hdjax import Model
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.learned import (
    LearnedFriction,
    LearnedMeshError,
    LearnedMeshTorque,
    LearnedMotorTorque,
    LearnedPeriodic,
)
from hdjax.effects.learned_axes import AngleAxis, Axis, LinearAxis, PowerAxis, SplineAxis, axis_over


def test_stored_mesh_error_of_other_variables_than_the_angle_is_refused(tmp_path: Path):
    content = json.loads(stored_torque())
    content["effects"][1]["name"] = LearnedMeshError.name
    with pytest.raises(InputError, match=r"give the model\.json of a report"):
        read_stored(json.dumps(content), tmp_path)


def stored(model: Model) -> str:
    """A model file."""
    return to_json(StoredModel(model, "zero-order", 2, 4, 1e-12 * jnp.eye(2)))


def stored_torque() -> str:
    axes = (axis_over("omega_m", -30.0, 1e2 / 3), axis_over("theta_l", 0.0, 1.0, beside="omega_m"))
    count = axes[0].count * axes[1].count
    mixing = np.random.default_rng(0).normal(size=(count, 3))
    effect = LearnedMotorTorque(axes=axes, mixing=mixing, c=[1 / 3, -1e-5, 2.0])
    model = rig.drive_model().with_effects(CoulombFriction(T_c=1.0, v_0=0.1), effect)
    return stored(model)


def read_stored(text: str, folder: Path):
    path = folder / "model.json"
    path.write_text(text, encoding="utf-8")
    return read_model(path)


def test_stored_torque_is_read_back_unchanged(tmp_path: Path):
    found = read_stored(stored_torque(), tmp_path)
    assert to_json(found) == stored_torque()
    effect = found.model.effect("learned_motor_torque")
    assert isinstance(effect, LearnedMotorTorque)
    assert float(found.model.get("learned_motor_torque.c_1")) == -1e-5
    assert np.isfinite(rates(found.model, jnp.asarray([1.0, 0.02, 3.0, 0.1]))).all()


@pytest.mark.parametrize(
    "axis", [AngleAxis("theta_l", 3), LinearAxis("v"), PowerAxis("v", 1 / 3), SplineAxis("v", -1 / 3, 2.0, 0.1)]
)
def test_stored_axis_is_read_back_unchanged(axis: Axis, tmp_path: Path):
    model = rig.drive_model().with_effects(learned_effect(LearnedMeshTorque, axis))
    effect = read_stored(stored(model), tmp_path).model.effect("learned_mesh_torque")
    assert isinstance(effect, LearnedMeshTorque)
    assert eqx.tree_equal(effect.axes, (axis,))


def stored_jump() -> str:
    effect = jumping_torque(LearnedMotorTorque, level=1 / 3, corner=3e-3, on=AngleAxis("theta_m", 2))
    model = rig.drive_model().with_effects(effect).replace({"learned_motor_torque.transition": 1 / 7})
    return stored(model)


def test_stored_jump_is_read_back_unchanged(tmp_path: Path):
    found = read_stored(stored_jump(), tmp_path)
    assert to_json(found) == stored_jump()
    effect = found.model.effect("learned_motor_torque")
    assert isinstance(effect, LearnedFriction)
    assert float(effect.corner) == 1 / 7


def stored_periodic_torque() -> str:
    effect = periodic_torque(LearnedMotorTorque, 20.0, [1 / 3, 0.1, 0.0])
    model = rig.drive_model().with_effects(effect).replace({"learned_motor_torque.omega": 61 / 3})
    return stored(model)


def test_stored_periodic_torque_is_read_back_unchanged(tmp_path: Path):
    found = read_stored(stored_periodic_torque(), tmp_path)
    assert to_json(found) == stored_periodic_torque()
    effect = found.model.effect("learned_motor_torque")
    assert isinstance(effect, LearnedPeriodic)
    assert float(effect.omega) == 61 / 3


def assert_refused(text: str, change: Callable[[dict], object], which: int, folder: Path) -> None:
    """A model file of which one effect was changed."""
    content = json.loads(text)
    change(content["effects"][which])
    with pytest.raises(InputError, match=r"give the model\.json of a report"):
        read_stored(json.dumps(content), folder)


BROKEN_LINES = {
    "no place for a torque": lambda e: e.update(name="learned_motor_reading"),
    "of an angle": lambda e: e["axes"][0].update(variable="theta_m"),
    "standing still": lambda e: e["axes"][0].update(omega=0.0),
    "backwards": lambda e: e["parameters"].update(omega=-1.0),
    "no frequency": lambda e: e["parameters"].pop("omega"),
    "a frequency and no line": lambda e: e["axes"][0].pop("omega"),
}


@pytest.mark.parametrize("change", BROKEN_LINES.values(), ids=BROKEN_LINES.keys())
def test_invalid_stored_periodic_torque_is_refused(change, tmp_path: Path):
    assert_refused(stored_periodic_torque(), change, 0, tmp_path)


BROKEN_JUMPS = {
    "of another place": lambda e: e.update(name="learned_load_torque"),
    "no first variable": lambda e: e["axes"].reverse(),
    "twice": lambda e: e["axes"].__setitem__(1, e["axes"][0]),
    "not wide": lambda e: e["parameters"].update(transition=0.0),
    "no width": lambda e: e["parameters"].pop("transition"),
    "a width and no jump": lambda e: e["axes"].__setitem__(0, e["axes"][0]["beside"]),
    "beside it what it can't be": lambda e: e["axes"][0]["beside"].update(variable="colour"),
}


@pytest.mark.parametrize("change", BROKEN_JUMPS.values(), ids=BROKEN_JUMPS.keys())
def test_invalid_stored_jump_is_refused(change, tmp_path: Path):
    assert_refused(stored_jump(), change, 0, tmp_path)


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
def test_invalid_stored_torque_is_refused(change, tmp_path: Path):
    assert_refused(stored_torque(), change, 1, tmp_path)
