"""Outputs to which a drive log is fitted, and the findings where an angle is missing."""

from pathlib import Path

import numpy as np
import pytest

import joints
from fitting.drive_data import base_model, ready_log, together
from fitting.errors import InputError
from fitting.logs.drive_file import read_drive_file
from fitting.logs.log import Log, read_log
from hdjax.dynamics import BOTH_ANGLES

JOINT = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, rms=0.05)
DRIVE = "[drive]\nreduction_ratio = 50\nmotor_inertia = 4e-5\nload_inertia = 0.2\nlargest_twist = 0.5\n"
ALL = joints.log_of_sensors(JOINT, joints.SENSORS, count=600)


def read(folder: Path, columns: dict[str, str], text: str = DRIVE, **options) -> Log:
    """Write some signals under given column names, and read the log."""
    values = {"time": ALL.time} | {name: getattr(ALL, signal) for name, signal in columns.items()}
    head = ",".join(values)
    np.savetxt(folder / "log.csv", np.stack([*values.values()], 1), "%.12g", ",", header=head, comments="")
    (folder / "drive.toml").write_text(text)
    return read_log(folder / "log.csv", read_drive_file(folder / "drive.toml"), **options)


def named(*signals: str) -> dict[str, str]:
    return {signal: signal for signal in signals}


@pytest.mark.parametrize(
    ("signals", "outputs"),
    [
        (("motor_angle",), ("motor_angle",)),
        (("motor_velocity",), ("motor_velocity",)),
        (("motor_angle", "motor_velocity"), ("motor_angle",)),
        (("motor_angle", "load_velocity"), ("motor_angle", "load_velocity")),
        (("motor_velocity", "load_velocity"), ("motor_velocity", "load_velocity")),
        (("motor_angle", "joint_torque"), ("motor_angle", "joint_torque")),
        (("motor_angle", "load_angle", "motor_velocity", "joint_torque"), ("motor_angle", "load_angle")),
    ],
)
def test_fitted_outputs_follow_from_the_logged_columns(
    tmp_path: Path, signals: tuple[str, ...], outputs: tuple[str, ...]
):
    log = read(tmp_path, named("motor_torque", *signals))
    assert log.kind == "drive" and log.outputs == outputs
    measured = base_model(read_drive_file(tmp_path / "drive.toml"), log).measured
    assert measured == (BOTH_ANGLES if len(outputs) == 2 and outputs[1] == "load_angle" else outputs)
    assert (log.dynamic_error is None) == ("load_angle" not in outputs)


def test_missing_load_angle_is_reported_with_a_likely_column(tmp_path: Path):
    log = read(tmp_path, named("motor_torque", "motor_angle"))
    assert [f.severity for f in log.findings] == ["note"] and "no load_angle" in log.findings[0].what
    log = read(tmp_path, named("motor_torque", "motor_angle") | {"q_link": "load_angle"})
    assert log.findings[0].severity == "warning" and "'q_link' could be load_angle" in log.findings[0].consequence


def test_missing_motor_torque_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no column for motor_torque") as error:
        read(tmp_path, named("motor_angle", "load_velocity"))
    assert "load_angle" not in str(error.value)


def test_outputs_after_the_known_samples_are_masked(tmp_path: Path):
    columns = named("motor_torque", "motor_angle", "joint_torque")
    log = read(tmp_path, columns, outputs_until=50)
    assert log.trusted is not None and log.trusted.sum() == 50
    assert np.ptp(log.joint_torque[50:]) == 0.0 and np.ptp(log.motor_angle[50:]) == 0.0
    ready = ready_log(tmp_path / "log.csv", read_drive_file(tmp_path / "drive.toml"), outputs_until=50)
    assert ready.dynamic_error is None and ready.zero == 0.0


def test_log_with_twist_and_joint_torque_is_quasi_static(tmp_path: Path):
    columns = named("motor_torque", "joint_torque") | {"twist": "load_angle"}
    assert read(tmp_path, columns).kind == "quasi-static"


@pytest.mark.parametrize("stated", [False, True])
def test_both_angles_replace_a_twist_that_is_not_stated(tmp_path: Path, stated: bool):
    columns = named("joint_torque", "motor_angle", "load_angle") | {"twist": "load_velocity"}
    text = DRIVE + ('[columns]\ntwist = "twist"\n' if stated else "")
    log = read(tmp_path, columns, text)
    assert log.kind == "quasi-static" and (log.motor_angle is None) == stated
    twist = ALL.load_velocity if stated else ALL.motor_angle / JOINT.N - ALL.load_angle
    np.testing.assert_allclose(log.twist, twist, atol=1e-9)


def test_single_number_under_a_usual_name_is_no_signal(tmp_path: Path):
    values = {"time": ALL.time} | {name: getattr(ALL, name) for name in ("motor_angle", "load_angle", "motor_torque")}
    np.savez(tmp_path / "log.npz", temperature=23.5, **values)
    (tmp_path / "drive.toml").write_text(DRIVE)
    log = read_log(tmp_path / "log.npz", read_drive_file(tmp_path / "drive.toml"))
    assert log.temperature is None and len(log) == 600


def test_logs_with_different_outputs_are_not_fitted_together(tmp_path: Path):
    logs = [
        read(tmp_path, named("motor_torque", "motor_angle", *more))
        for more in (("load_angle",), ("load_velocity",), ())
    ]
    for other in logs[1:]:
        with pytest.raises(InputError, match=r"it has motor_angle.* where .* has motor_angle and load_angle"):
            together([logs[0], other])
