"""Logs with a time column for each signal: each signal is read on its own clock."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import rig
from fitting.errors import DataError, InputError
from fitting.estimation.experiment import experiment_from_log
from fitting.logs.drive_file import DriveFile, read_drive_file
from fitting.logs.log import Log, read_log

COUNT = 2000
TORQUE = rig.drive_torque(COUNT)
FINE = rig.drive_motion(np.repeat(TORQUE, 5), step=rig.STEP / 5, substeps=2)
TIME = np.arange(COUNT) * rig.STEP
MOTOR, LOAD = FINE[::5, 0], FINE[2::5, 1]
NAMES = ("Motor", "Load", "Torque")
DRIVE = """
[drive]
reduction_ratio = 50
motor_inertia = 5.26e-4
load_inertia = 5.0e-2
[signals]
torque_hold = "zero-order"
[columns]
time = "Time"
motor_angle = "Motor"
load_angle = "Load"
motor_torque = "Torque"
"""
Channel = tuple[np.ndarray, np.ndarray]


def drive(folder: Path, text: str = DRIVE) -> DriveFile:
    (folder / "drive.toml").write_text(text, encoding="utf-8")
    return read_drive_file(folder / "drive.toml")


def save(folder: Path, channels: Sequence[Channel], *, time_first: bool = True, time: str = "Time") -> Path:
    pairs = [(time, name) if time_first else (name, time) for name in NAMES]
    columns = [pair if time_first else pair[::-1] for pair in channels]
    flat = [column for pair in columns for column in pair]
    lines = [",".join(name for pair in pairs for name in pair)]
    for i in range(max(map(len, flat))):
        lines.append(",".join(repr(c[i].item()) if i < len(c) else "" for c in flat))
    (folder / "log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "log.csv"


def findings_text(log: Log) -> str:
    return " ".join(map(str, log.findings))


@pytest.mark.parametrize("time_first", [True, False])
def test_equal_time_columns_give_one_time_base(tmp_path: Path, time_first: bool):
    path = save(tmp_path, [(TIME, MOTOR), (TIME, FINE[::5, 1]), (TIME, TORQUE)], time_first=time_first)
    log = read_log(path, drive(tmp_path))
    np.testing.assert_array_equal(log.time, TIME)
    np.testing.assert_array_equal(log.motor_torque, TORQUE)
    assert log.trusted is None and log.pieces is None and "3 columns are called 'Time'" in findings_text(log)


def test_clocks_that_differ_by_rounding_give_one_time_base(tmp_path: Path):
    path = save(tmp_path, [(TIME, MOTOR), (TIME + 1e-9, FINE[::5, 1]), (TIME - 1e-9, TORQUE)])
    log = read_log(path, drive(tmp_path))
    np.testing.assert_allclose(log.time, TIME, atol=2e-9)
    assert log.trusted is None


def test_each_signal_is_read_on_its_own_clock(tmp_path: Path):
    late = TIME[::2] + 0.4 * rig.STEP
    path = save(tmp_path, [(TIME, MOTOR), (late, LOAD[::2]), (TIME, TORQUE)])
    log = read_log(path, drive(tmp_path))
    assert log.trusted is not None
    np.testing.assert_allclose(log.time[log.trusted], late, atol=1e-12)
    twist = FINE[2::10, 0] / rig.N - LOAD[::2]
    np.testing.assert_allclose(log.dynamic_error[log.trusted], twist, atol=1e-3 * np.std(twist))
    assert all(finding.severity == "note" for finding in log.findings)
    acting = experiment_from_log(log, hold="zero-order", N=rig.N).torque
    at = np.searchsorted(np.asarray(acting.knots), TIME[5:-5] + 0.7 * rig.STEP, side="right") - 1
    np.testing.assert_array_equal(np.asarray(acting.coefficients)[at, 0], TORQUE[5:-5])


def test_signals_that_come_in_turn_share_their_stamps(tmp_path: Path):
    """One row a message: rows of one instant hold different signals."""
    rows = ["Time,Motor,Load,Torque"]
    for t, motor, load, torque in np.stack([TIME, MOTOR, FINE[::5, 1], TORQUE], axis=1).tolist():
        rows += [f"{t!r},{motor!r},,{torque!r}", f"{t!r},,{load!r},"]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    log = read_log(tmp_path / "log.csv", drive(tmp_path))
    np.testing.assert_array_equal(log.time, TIME)
    np.testing.assert_array_equal(log.motor_angle, MOTOR)
    np.testing.assert_array_equal(log.load_angle, FINE[::5, 1])
    assert log.trusted is None and log.pieces is None


def test_blank_row_of_an_ordinary_log_gives_no_clocks(tmp_path: Path):
    """Of an instant that is logged already, beside a slow load encoder."""
    rows = ["Time,Motor,Load,Torque"]
    for i, (t, *values) in enumerate(np.stack([TIME, MOTOR, FINE[::5, 1], TORQUE], axis=1).tolist()):
        motor, load, torque = (repr(v) for v in values)
        rows.append(f"{t!r},{motor},{'' if i % 50 == 7 else load},{torque}")
        rows += [f"{t!r},,,"] if i == 400 else []
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    log = read_log(tmp_path / "log.csv", drive(tmp_path))
    np.testing.assert_array_equal(log.time, TIME)
    np.testing.assert_array_equal(log.motor_angle, MOTOR)


def test_only_the_time_common_to_all_signals_is_kept(tmp_path: Path):
    path = save(tmp_path, [(TIME[:1500], MOTOR[:1500]), (TIME[100:], FINE[::5, 1][100:]), (TIME, TORQUE)])
    log = read_log(path, drive(tmp_path))
    assert TIME[98] < log.time[0] <= TIME[100] and TIME[1499] <= log.time[-1] < TIME[1502]
    path = save(tmp_path, [(TIME, MOTOR), (TIME + 10.0, LOAD), (TIME, TORQUE)])
    with pytest.raises(DataError, match="before load_angle begins"):
        read_log(path, drive(tmp_path))


def test_rounded_stamps_of_each_clock_are_reconstructed(tmp_path: Path):
    rounded = np.round(TIME, 3)
    path = save(tmp_path, [(rounded, MOTOR), (rounded, FINE[::5, 1]), (rounded, TORQUE)])
    log = read_log(path, drive(tmp_path))
    np.testing.assert_allclose(np.diff(log.time), rig.STEP, rtol=1e-3)
    assert log.rate_std > 0 and "steady clock" in findings_text(log) and log.trusted is None


def test_data_frame_with_numbered_time_columns_is_read():
    import polars as pl

    names = ("Time", "Motor", "Time.1", "Load", "Time.2", "Torque")
    columns = (TIME, MOTOR, TIME[::2] + 0.4 * rig.STEP, LOAD[::2], TIME, TORQUE)
    padded = [np.pad(column, (0, COUNT - len(column)), constant_values=np.nan) for column in columns]
    frame = pl.DataFrame(dict(zip(names, padded, strict=True)))
    folder = Path("frame")
    log = read_log(folder, drive_file_of(DRIVE), table=frame)
    assert log.trusted is not None and abs(log.trusted.sum() - COUNT // 2) <= 2


def drive_file_of(text: str) -> DriveFile:
    import tomllib

    from fitting.logs.drive_file import drive_of

    return drive_of(tomllib.loads(text), Path("drive"))


def test_invalid_clock_columns_are_refused(tmp_path: Path):
    path = save(tmp_path, [(TIME, MOTOR), (TIME, LOAD), (TIME, TORQUE)])
    path.write_text(path.read_text(encoding="utf-8").replace("Load", "Motor", 1), encoding="utf-8")
    with pytest.raises(
        InputError, match=r"'Motor' appears twice; give .* its number, or the name 'Motor \(1\)' or 'Motor"
    ):
        read_log(path, drive(tmp_path))
    log = read_log(path, drive(tmp_path, DRIVE.replace('"Motor"', "2").replace('"Load"', '"Motor (2)"')))
    np.testing.assert_array_equal(log.load_angle, LOAD)
    still = save(tmp_path, [(TIME, MOTOR), (0 * TIME, LOAD), (TIME, TORQUE)])
    with pytest.raises(InputError, match=r"'Time \(2\)' is not a clock"):
        read_log(still, drive(tmp_path))
    restarted = np.concatenate([TIME[:1000], TIME[:1000]])
    again = save(tmp_path, [(TIME, MOTOR), (restarted, LOAD), (TIME, TORQUE)])
    with pytest.raises(InputError, match="clock of load_angle, restarts"):
        read_log(again, drive(tmp_path))


def test_prediction_uses_the_first_samples_of_each_output(tmp_path: Path):
    late = TIME[::2] + 0.4 * rig.STEP
    motor, load = MOTOR.copy(), LOAD[::2].copy()
    path = save(tmp_path, [(TIME, motor), (late, load), (TIME, TORQUE)])
    log = read_log(path, drive(tmp_path), outputs_until=50)
    assert log.outputs_until is not None and log.trusted is not None
    assert 48 <= log.trusted.sum() <= 50 and not log.trusted[log.outputs_until :].any()
    # Later outputs do not matter.
    motor[103:], load[51:] = 0.0, 0.0
    again = read_log(save(tmp_path, [(TIME, motor), (late, load), (TIME, TORQUE)]), drive(tmp_path), outputs_until=50)
    np.testing.assert_array_equal(again.dynamic_error[again.trusted], log.dynamic_error[log.trusted])
