"""Reading of public measured logs."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from log_files import read_drive

from fitting.logs.log import Log, read_log


def read_shared(folder: Path, log: Path, text: str) -> Log:
    return read_log(log, read_drive(folder, text))


def test_silverbox_log_is_read_as_a_reduced_log(tmp_path: Path, shared: Path) -> None:
    text = """
    [signals]
    sample_rate = 610.3515625
    torque_hold = "band-limited"
    [columns]
    dynamic_error = { column = "V2", unit = "V" }
    forcing = { column = "V1", unit = "V" }
    """
    path = shared / "data/silverbox/silverbox_estimation.mat"
    log = read_shared(tmp_path, path, text)
    assert len(log) == 65062 and log.units == {"dynamic_error": "V", "forcing": "V"}
    assert log.time[-1] == pytest.approx(65061 / 610.3515625)
    held = scipy.io.loadmat(path)
    np.testing.assert_array_equal(log.dynamic_error, held["V2"][0])


def test_bouc_wen_benchmark_is_read_as_a_reduced_log(tmp_path: Path, shared: Path) -> None:
    text = """
    [columns]
    dynamic_error = { column = "multisine/y", unit = "mm" }
    forcing = { column = "u", unit = "N" }
    """
    log = read_shared(tmp_path, shared / "data/bouc_wen/estimation.h5", text)
    assert len(log) == 40960 and log.units == {"dynamic_error": "m", "forcing": "N"}
    assert log.time[1] == 1 / 750


def test_lara8_log_is_read_as_a_drive_log(tmp_path: Path, shared: Path) -> None:
    text = """
    [drive]
    reduction_ratio = 121
    motor_inertia = 1e-4
    load_inertia = 1.0
    [columns]
    time = "Timestamp"
    motor_angle = { column = "encoder_motorinc_2", unit = "rev / 16777216" }
    load_angle = { column = "encoder_loadinc_2", unit = "rev / 16777216" }
    motor_torque = { column = "joint_torque_current_2", unit = "N m / 121" }
    """
    log = read_shared(tmp_path, shared / "data/lara8/ML2_jogging_joint_mass.csv", text)
    assert len(log) == 988 and log.load_angle is not None
    assert np.median(np.diff(log.time)) == pytest.approx(0.004, rel=0.01)
    assert np.ptp(log.load_angle) == pytest.approx(0.399, rel=0.01)
    # The twist is some arc minutes where the joint moves by 23 degrees.
    assert np.ptp(log.dynamic_error) < 2e-3
