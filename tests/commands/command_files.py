"""Logs, drive files and models for the tests of commands."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.stored_model import StoredModel, to_json
from hdjax import Model, TwoInertiaModel

COUNT = 600


DRIVE = """\
[drive]
name = "rig"
reduction_ratio = 50
motor_inertia = 5.26e-4
load_inertia = 5.0e-2
[signals]
torque_hold = "zero-order"
"""


def table() -> dict[str, np.ndarray]:
    """Columns of a healthy drive log."""
    torque = rig.drive_torque(COUNT)
    log = rig.drive_log(rig.drive_motion(torque), torque)
    return {
        "time": log.time.copy(),
        "motor_angle": log.motor_angle,
        "load_angle": log.load_angle,
        "motor_torque": torque,
    }


def reduced_table() -> dict[str, np.ndarray]:
    forcing = rig.reduced_forcing(COUNT)
    log = rig.reduced_log(rig.reduced_motion(forcing)[:, 0], forcing, noise=1e-3)
    return {"time": log.time, "dynamic_error": log.dynamic_error, "forcing": forcing}


def write_table(path: Path, columns: dict[str, np.ndarray]) -> Path:
    rows = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.12g")
    return path


def read_table(path: Path) -> dict[str, np.ndarray]:
    names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1, unpack=True), strict=True))


def write_drive(folder: Path, text: str = DRIVE) -> Path:
    path = folder / "drive.toml"
    path.write_text(text, encoding="utf-8")
    return path


def write_model(folder: Path, model: Model, **options) -> Path:
    noise = jnp.diag(jnp.asarray([4e-14, 1e-12])) if isinstance(model, TwoInertiaModel) else 1e-6 * jnp.eye(1)
    content = {"hold": "zero-order", "substeps": 2, "halo": 4, "noise": noise} | options
    path = folder / "model.json"
    path.write_text(to_json(StoredModel(model=model, **content)), encoding="utf-8")
    return path


def assert_one_line(capsys: pytest.CaptureFixture[str], *words: str):
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("hdjax: ")
    assert shown.err.count("\n") == 1, shown.err
    assert shown.err.endswith("\n")
    assert "Traceback" not in shown.err
    for word in words:
        assert word in shown.err
