"""Channels of different rates and clocks on one time base; the torque keeps its inter-sample behaviour."""

from pathlib import Path

import h5py
import numpy as np
import pytest

import rig
from fitting.errors import DataError, InputError
from fitting.estimation.experiment import experiment_from_log
from fitting.logs.drive_file import DriveFile, read_drive_file
from fitting.logs.log import read_log

COUNT = 4000
DRIVE = """
[drive]
reduction_ratio = 50
motor_inertia = 5.26e-4
load_inertia = 5.0e-2
"""
TIME = np.arange(COUNT) * rig.STEP
TORQUE = rig.drive_torque(COUNT)
MOTION = rig.drive_motion(TORQUE)


def drive(folder: Path, columns: str = "") -> DriveFile:
    path = folder / "drive.toml"
    path.write_text(f"{DRIVE}\n[columns]\n{columns}", encoding="utf-8")
    return read_drive_file(path)


def groups(folder: Path, **channels: tuple[np.ndarray, np.ndarray]) -> Path:
    """An HDF5 file with a group and a clock for each channel."""
    path = folder / "log.h5"
    with h5py.File(path, "w") as file:
        for name, (time, values) in channels.items():
            file[f"{name}/t"], file[f"{name}/{name}"] = time, values
    return path


CLOCKS = "\n".join(
    f'{name} = {{ column = "{name}", time = "{name}/t" }}' for name in ("motor_angle", "load_angle", "motor_torque")
)


def test_slow_torque_is_held_between_its_own_samples(tmp_path: Path):
    slow = slice(None, None, 4)
    path = groups(
        tmp_path,
        motor_angle=(TIME, MOTION[:, 0]),
        load_angle=(TIME, MOTION[:, 1]),
        motor_torque=(TIME[slow], TORQUE[slow]),
    )
    log = read_log(path, drive(tmp_path, CLOCKS))
    np.testing.assert_array_equal(log.time, TIME)
    np.testing.assert_array_equal(log.motor_angle, MOTION[:, 0])
    assert log.input_known is not None and log.pieces == ((0, COUNT - 3),)
    np.testing.assert_array_equal(np.flatnonzero(log.input_known), np.arange(0, COUNT, 4))
    experiment = experiment_from_log(log, hold="zero-order", N=rig.N)
    # A slow torque is held from one of its own samples to the next.
    held = np.repeat(TORQUE[slow], 4)
    np.testing.assert_array_equal(np.asarray(experiment.torque.coefficients)[:-4, 0], held[:-4])
    assert (np.asarray(experiment.torque.coefficients)[:-4, 1:] == 0).all()


@pytest.mark.parametrize("hold", ["linear", "cubic"])
def test_slow_torque_is_interpolated_between_its_own_samples(tmp_path: Path, hold: str):
    slow = slice(None, None, 5)
    columns = np.full((COUNT, 4), np.nan)
    columns[:, 0], columns[:, 1], columns[:, 2] = TIME, MOTION[:, 0], MOTION[:, 1]
    columns[slow, 3] = TORQUE[slow]
    path = tmp_path / "log.csv"
    rows = [",".join("" if np.isnan(v) else f"{v:.17g}" for v in row) for row in columns]
    path.write_text("time,motor_angle,load_angle,motor_torque\n" + "\n".join(rows) + "\n", encoding="utf-8")
    log = read_log(path, drive(tmp_path))
    assert [f for f in log.findings if f.severity != "note"] == []
    torque = experiment_from_log(log, hold=hold, N=rig.N).torque
    knots, coefficients = np.asarray(torque.knots), np.asarray(torque.coefficients)
    at = np.linspace(TIME[0], TIME[-6], 3001)
    piece = np.searchsorted(knots, at, side="right") - 1
    found = np.polynomial.polynomial.polyval(at - knots[piece], coefficients[piece].T, tensor=False)
    if hold == "linear":
        expected = np.interp(at, TIME[slow], TORQUE[slow])
    else:
        from scipy.interpolate import CubicSpline

        # The last row has no torque of its own; the nearest one is held.
        own = np.append(TIME[slow], TIME[-1]), np.append(TORQUE[slow], TORQUE[slow][-1])
        expected = CubicSpline(*own)(at)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_angles_sampled_at_different_times_give_the_dynamic_error(tmp_path: Path):
    torque = rig.drive_torque(COUNT)
    fine = rig.drive_motion(np.repeat(torque, 2), step=rig.STEP / 2)
    time = np.arange(2 * COUNT) * rig.STEP / 2
    even, odd = slice(0, None, 2), slice(1, None, 2)
    path = groups(
        tmp_path,
        motor_angle=(time[even], fine[even, 0]),
        load_angle=(time[odd], fine[odd, 1]),
        motor_torque=(time[even], torque),
    )
    log = read_log(path, drive(tmp_path, CLOCKS))
    (finding,) = [f for f in log.findings if "different times" in f.what]
    assert finding.severity in ("note", "warning")
    assert log.trusted is not None and abs(log.trusted.sum() - COUNT) <= 2
    x = fine[:, 0] / rig.N - fine[:, 1]
    known = np.isin(np.arange(len(log.time)), np.flatnonzero(log.trusted))
    np.testing.assert_allclose(log.dynamic_error[known], x[known], atol=0.01 * np.std(x))


def test_pause_of_the_quicker_encoder_is_not_interpolated(tmp_path: Path):
    torque = rig.drive_torque(COUNT)
    fine = rig.drive_motion(np.repeat(torque, 4), step=rig.STEP / 4)
    time = np.arange(4 * COUNT) * rig.STEP / 4
    motor = np.r_[0 : 2 * COUNT : 2, 2 * COUNT + 400 : 4 * COUNT : 2]
    path = groups(
        tmp_path,
        motor_angle=(time[motor], fine[motor, 0]),
        load_angle=(time[1::4], fine[1::4, 1]),
        motor_torque=(time[::4], torque),
    )
    log = read_log(path, drive(tmp_path, CLOCKS))
    assert log.trusted is not None and log.dynamic_error is not None
    x, known = fine[:, 0] / rig.N - fine[:, 1], np.flatnonzero(log.trusted)
    places = np.rint(log.time[known] / (rig.STEP / 4)).astype(int)
    np.testing.assert_allclose(log.dynamic_error[known], x[places], atol=0.01 * np.std(x))
    assert not np.any((places > 2 * COUNT) & (places < 2 * COUNT + 396))


def test_slow_angles_sampled_at_different_times_are_refused(tmp_path: Path):
    time = np.arange(COUNT) * 0.02
    rough = np.random.default_rng(0).normal(size=COUNT)
    path = groups(
        tmp_path,
        motor_angle=(time, rig.N * rough),
        load_angle=(time + 0.01, rough),
        motor_torque=(time, TORQUE),
    )
    with pytest.raises(DataError, match="different times and too slowly"):
        read_log(path, drive(tmp_path, CLOCKS))


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (CLOCKS.replace('"load_angle/t"', '"load_angle/tt"'), ["'load_angle/tt'", "did you mean"]),
        (CLOCKS.replace(', time = "load_angle/t"', ""), ["load_angle", "no time column of its own"]),
        (CLOCKS.replace('"load_angle/t"', '"still"'), ["still", "not a clock"]),
        (CLOCKS.replace('"load_angle/t"', '"short"'), ["load_angle", "one stamp a sample"]),
    ],
)
def test_invalid_clock_of_a_signal_is_refused(tmp_path: Path, columns: str, words: list[str]):
    path = groups(
        tmp_path, motor_angle=(TIME, MOTION[:, 0]), load_angle=(TIME, MOTION[:, 1]), motor_torque=(TIME, TORQUE)
    )
    with h5py.File(path, "a") as file:
        file["still"], file["short"] = 0 * TIME, TIME[:-1]
    with pytest.raises(InputError) as error:
        read_log(path, drive(tmp_path, columns))
    for word in words:
        assert word in str(error.value)
