"""Time stamps in two columns (seconds and fractions): both are joined; fractions alone are unwrapped."""

from pathlib import Path

import numpy as np
import pytest

import rig
from fitting.errors import InputError
from fitting.logs.drive_file import read_drive_file
from fitting.logs.log import Log, read_log

COUNT = 3000
TORQUE = rig.drive_torque(COUNT)
LOG = rig.drive_log(rig.drive_motion(TORQUE), TORQUE)
STAMPS = np.rint((LOG.time + 0.9123) * 1e9).astype(np.int64)
SECONDS, REST = divmod(STAMPS, 1_000_000_000)
DRIVE = "[drive]\nreduction_ratio = 50\nmotor_inertia = 5.26e-4\nload_inertia = 5.0e-2\n"


def read(folder: Path, columns: str, **stamps: np.ndarray) -> Log:
    table = {**stamps, "motor_angle": LOG.motor_angle, "load_angle": LOG.load_angle, "motor_torque": TORQUE}
    rows = [",".join(repr(v.item()) for v in row) for row in zip(*table.values(), strict=True)]
    names = ",".join(table).replace("__", ".")
    (folder / "log.csv").write_text(names + "\n" + "\n".join(rows) + "\n", encoding="utf-8")
    (folder / "drive.toml").write_text(f"{DRIVE}[columns]\n{columns}\n", encoding="utf-8")
    return read_log(folder / "log.csv", read_drive_file(folder / "drive.toml"))


PAIRS = {
    "ROS 1": ("header__stamp__secs", "header__stamp__nsecs", 1),
    "ROS 2": ("header__stamp__sec", "header__stamp__nanosec", 1),
    "Unix": ("tv_sec", "tv_usec", 1000),
    "letters": ("time_s", "time_us", 1000),
    "alone": ("S", "NS", 1),
}


@pytest.mark.parametrize(("whole", "part", "scale"), PAIRS.values(), ids=PAIRS.keys())
@pytest.mark.parametrize("named", [0, 1])
def test_seconds_and_fractions_in_two_columns_are_joined(tmp_path: Path, whole: str, part: str, scale: int, named: int):
    name = (whole, part)[named].replace("__", ".")
    columns = {whole: SECONDS + 1_700_000_000, part: REST // scale}
    log = read(tmp_path, f'time = "{name}"', **columns)
    np.testing.assert_allclose(log.time, STAMPS * 1e-9, atol=1e-9 * scale)
    (finding,) = log.findings
    assert "two columns" in finding.what and "joined" in finding.consequence


def test_fraction_column_stated_in_the_drive_file_is_joined(tmp_path: Path):
    columns = {"a": SECONDS, "b": REST // 1_000_000}
    log = read(tmp_path, 'time = { column = "a", fraction = { column = "b", unit = "ms" } }', **columns)
    assert np.max(np.abs(log.time - STAMPS * 1e-9)) < 1.1e-3
    assert "two columns" in log.findings[0].what


def test_fractions_of_a_second_alone_are_unwrapped(tmp_path: Path):
    log = read(tmp_path, 'time = { column = "time_us", unit = "us" }', time_us=REST // 1000)
    np.testing.assert_allclose(log.time, STAMPS * 1e-9, atol=1e-6)
    (finding,) = log.findings
    assert "wraps" in finding.what and "unwrapped" in finding.consequence


def test_two_complete_time_columns_are_not_joined(tmp_path: Path):
    # Each column holds the complete time.
    log = read(tmp_path, 'time = { column = "t_us", unit = "us" }', t_s=LOG.time, t_us=np.rint(LOG.time * 1e6))
    np.testing.assert_allclose(log.time, LOG.time, atol=1e-6)
    assert log.findings == ()


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ('time = { column = "t_s", fraction = 3.5 }', ["time fraction", "number"]),
        ('time = { column = "t_s", fraction = { unit = 3, column = "b" } }', ["unit in [columns] time fraction"]),
        ('motor_angle = { fraction = "b" }', ["fraction", "motor_angle"]),
    ],
)
def test_invalid_fraction_column_is_refused(tmp_path: Path, columns: str, words: list[str]):
    with pytest.raises(InputError) as error:
        read(tmp_path, columns, t_s=LOG.time)
    for word in words:
        assert word in str(error.value)
