"""Inertias and torque constant of the drive file: values, tolerances and "fit"; and the motor current as torque."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import joints
from fitting.commands.main import main
from fitting.drive_data import read_rig
from fitting.errors import InputError
from fitting.logs.drive_file import drive_of
from fitting.stored_model import read_model
from hdjax.drive import Prior

JOINT = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, rms=0.05)
CONSTANT = 0.12
SIGNALS = '[signals]\ntorque_hold = "zero-order"\n'


def write_log_and_drive_file(folder: Path, drive: str, columns: str = "") -> tuple[Path, Path]:
    log, file = joints.log_of(JOINT, count=2000), folder / "drive.toml"
    assert log.motor_angle is not None and log.load_angle is not None and log.motor_torque is not None
    table = np.stack([log.time, log.motor_angle, log.load_angle, 1e3 * log.motor_torque / CONSTANT], axis=1)
    np.savetxt(folder / "log.csv", table, delimiter=",", header="time,motor_angle,load_angle,iq", comments="")
    file.write_text(f"[drive]\nreduction_ratio = 50\n{drive}\n{SIGNALS}[columns]\n{columns}\n", encoding="utf-8")
    return folder / "log.csv", file


def test_motor_current_is_converted_by_the_torque_constant(tmp_path: Path):
    current = f'motor_current = {{ column = "iq", unit = "mA", torque_constant = "{CONSTANT} N m/A" }}'
    log, file = write_log_and_drive_file(tmp_path, "motor_inertia = 4e-5\nload_inertia = 0.2", current)
    rig = read_rig([log], file)
    truth = joints.torque_of(JOINT, count=2000)
    np.testing.assert_allclose(rig.logs[0].motor_torque, truth[: len(rig.logs[0])], rtol=1e-12, atol=1e-15)
    assert not rig.model.drive.priors


def test_tolerances_of_the_drive_file_become_priors(tmp_path: Path):
    drive = 'motor_inertia = { value = "0.4 kg cm^2", tolerance = "5 %" }\nload_inertia = "fit"'
    current = 'motor_current = { column = "iq", unit = "mA", torque_constant = { value = 0.12, tolerance = 0.03 } }'
    log, file = write_log_and_drive_file(tmp_path, drive, current)
    rig = read_rig([log], file)
    motor, load, constant = rig.model.drive.priors
    assert motor == Prior("J_m", pytest.approx(4e-5), pytest.approx(0.05))
    assert load.path == "J_l" and math.isinf(load.tolerance)
    assert constant == Prior("k_T", 1.0, pytest.approx(0.03))


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"drive": {"motor_inertia": {"tolerance": "5 %"}}}, "needs a value"),
        ({"drive": {"motor_inertia": {"value": 1.0, "tolerance": "5"}}}, "tolerance"),
        ({"drive": {"motor_inertia": {"value": 1.0, "tolerance": "much %"}}}, "tolerance"),
        ({"drive": {"motor_inertia": {"value": 1.0, "tolerance": -0.1}}}, "tolerance"),
        ({"drive": {"motor_inertia": {"value": -1.0, "tolerance": 0.1}}}, "positive"),
        ({"drive": {"motor_inertia": {"value": 1.0, "tolerence": 0.1}}}, "did you mean 'tolerance'"),
        ({"drive": {"reduction_ratio": "fit"}}, "reduction_ratio"),
        ({"columns": {"motor_current": "iq"}}, "torque_constant"),
        ({"columns": {"motor_current": {"column": "iq", "torque_constant": "strong"}}}, "torque_constant"),
        ({"columns": {"motor_current": {"torque_constant": 0.1}, "motor_torque": "T"}}, "both"),
        ({"columns": {"motor_torque": {"column": "T", "torque_constant": 0.1}}}, "torque_constant"),
    ],
)
def test_invalid_prior_or_torque_constant_is_refused_in_one_sentence(tables, words):
    with pytest.raises(InputError, match=words) as refused:
        drive_of(tables, Path("drive.toml"))
    assert "\n" not in str(refused.value)


def test_report_and_stored_model_hold_the_priors(tmp_path: Path, own_cache):
    drive = 'motor_inertia = { value = 4.4e-5, tolerance = "10 %" }\nload_inertia = "fit"'
    current = f'motor_current = {{ column = "iq", unit = "mA", torque_constant = {CONSTANT} }}'
    log, file = write_log_and_drive_file(tmp_path, drive, current)
    with pytest.raises(SystemExit, match="^0$"):
        main(["fit", str(log), "--drive", str(file), "--out", str(tmp_path / "out")])
    report = json.loads((tmp_path / "out/report.json").read_text(encoding="utf-8"))
    known = report["before"]["parameters"]
    assert known["J_m"]["prior"] == {"value": 4.4e-5, "tolerance": 0.1}
    assert known["J_l"]["prior"] == {"value": None, "tolerance": None} and known["K"]["prior"] is None
    assert known["J_m"]["value"] == pytest.approx(JOINT.J_m, rel=0.01)
    assert any(note.startswith("J_m has a prior of") for note in report["cannot_tell"])
    stored = read_model(tmp_path / "out/model.json").model
    assert [p.path for p in stored.drive.priors] == ["J_m", "J_l"] and math.isinf(stored.drive.priors[1].tolerance)
