"""Reading of logs: signals, units, signs and time are the same from every format."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from log_files import DRIVE, FORMATS, ROWS, N, Table, drive_table, one_sentence, read_drive, save, save_text

import fitting
from fitting.errors import InputError
from fitting.logs.log import read_log


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_the_same_log(tmp_path: Path, kind: str) -> None:
    table = drive_table()
    log = read_log(save(tmp_path, table, kind), read_drive(tmp_path))
    assert (log.name, log.kind, len(log), log.findings) == ("log", "drive", ROWS, ())
    for name, values in table.items():
        np.testing.assert_array_equal(getattr(log, name), values)
    np.testing.assert_array_equal(log.dynamic_error, table["motor_angle"] / N - table["load_angle"])
    assert log.units == {"dynamic_error": "rad"}
    assert log.forcing is None and log.load_torque is None and log.temperature is None


@pytest.mark.parametrize("kind", FORMATS)
def test_missing_column_is_named_in_every_format(tmp_path: Path, kind: str) -> None:
    table = drive_table()
    table["motor_torqe"] = table.pop("motor_torque")
    path = save(tmp_path, table, kind)
    with pytest.raises(InputError) as error:
        read_log(path, read_drive(tmp_path))
    one_sentence(error, str(path), "motor_torque", "did you mean", "motor_torqe", "[columns]")


def test_signals_of_a_log_are_read_only(tmp_path: Path) -> None:
    log = read_log(save(tmp_path, drive_table()), read_drive(tmp_path))
    with pytest.raises(ValueError, match="read-only"):
        log.twist[0] = 1.0


UNITS = """
[columns]
time = { unit = "ms" }
motor_angle = { column = "inc", unit = "rev / 16777216", sign = -1 }
load_angle = { column = "deg", unit = "deg" }
motor_torque = { column = "T", unit = "mN m" }
load_torque = { column = "Tl", unit = "Nm", sign = -1 }
temperature = { column = "oil", unit = "degC" }
motor_velocity = { column = "v", unit = "rpm" }
"""


@pytest.mark.parametrize("kind", ["csv", "mat5", "parquet"])
def test_units_and_signs_of_columns_are_converted(tmp_path: Path, kind: str) -> None:
    table = drive_table()
    stored = {
        "time": table["time"] * 1e3,
        "inc": -np.rint(table["motor_angle"] / (2 * np.pi) * 2**24),
        "deg": np.rad2deg(table["load_angle"]),
        "T": table["motor_torque"] * 1e3,
        "Tl": np.full(ROWS, 3.0),
        "oil": np.full(ROWS, 26.85),
        "v": np.full(ROWS, 60.0),
    }
    log = read_log(save(tmp_path, stored, kind), read_drive(tmp_path, DRIVE + UNITS))
    assert log.motor_angle is not None and log.load_angle is not None
    assert log.motor_torque is not None and log.load_torque is not None
    assert log.temperature is not None and log.motor_velocity is not None
    np.testing.assert_allclose(log.time, table["time"], rtol=1e-14)
    # Half a count of rounding.
    np.testing.assert_allclose(log.motor_angle, table["motor_angle"], atol=np.pi / 2**24)
    np.testing.assert_allclose(log.load_angle, table["load_angle"], rtol=1e-14)
    np.testing.assert_allclose(log.motor_torque, table["motor_torque"], rtol=1e-14)
    np.testing.assert_allclose(log.load_torque, -3.0)
    np.testing.assert_allclose(log.temperature, 300.0, rtol=1e-14)
    np.testing.assert_allclose(log.motor_velocity, 2 * np.pi, rtol=1e-14)


def test_column_may_be_mapped_by_its_name_only(tmp_path: Path) -> None:
    table = drive_table()
    table["T"] = table.pop("motor_torque")
    text = DRIVE + '[columns]\nmotor_torque = "T"\n'
    log = read_log(save(tmp_path, table), read_drive(tmp_path, text))
    np.testing.assert_array_equal(log.motor_torque, table["T"])


@pytest.mark.parametrize(
    ("signal", "unit"),
    [
        ("motor_torque", "rad"),
        ("motor_angle", "N m"),
        ("motor_angle", "count"),
        ("motor_angle", "1"),
        ("motor_angle", "furlongs per fortnight"),
        ("load_angle", "(("),
        ("load_angle", "rev / 0"),
        ("time", "Hz"),
    ],
)
def test_unit_of_another_quantity_is_refused(tmp_path: Path, signal: str, unit: str) -> None:
    text = DRIVE + f'[columns]\n{signal} = {{ unit = "{unit}" }}\n'
    path = save(tmp_path, drive_table())
    with pytest.raises(InputError) as error:
        read_log(path, read_drive(tmp_path, text))
    one_sentence(error, "drive.toml", signal, unit, "give [columns]")


def reduced_table(rows: int = ROWS) -> Table:
    rng = np.random.default_rng(1)
    return {"V1": rng.normal(size=rows), "V2": rng.normal(size=rows)}


REDUCED = """
[signals]
sample_rate = 1000.0
torque_hold = "band-limited"
[columns]
dynamic_error = { column = "V2", unit = "mV" }
forcing = { column = "V1", unit = "deg/s^2", sign = -1 }
"""


@pytest.mark.parametrize("kind", ["csv", "mat5", "mat73", "hdf5-group", "parquet"])
def test_reduced_log_is_converted_to_base_units(tmp_path: Path, kind: str) -> None:
    table = reduced_table()
    log = read_log(save(tmp_path, table, kind), read_drive(tmp_path, REDUCED))
    assert log.kind == "reduced" and log.motor_angle is None and log.forcing is not None
    assert log.units == {"dynamic_error": "V", "forcing": "rad/s^2"}
    np.testing.assert_allclose(log.dynamic_error, table["V2"] * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(log.forcing, -np.deg2rad(table["V1"]), rtol=1e-14)
    np.testing.assert_allclose(log.time, np.arange(ROWS) * 1e-3, rtol=1e-15)


def test_reduced_log_without_a_forcing_is_refused(tmp_path: Path) -> None:
    table = {"time": np.arange(ROWS) * 1.0, "dynamic_error": reduced_table()["V1"]}
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, table), read_drive(tmp_path, ""))
    one_sentence(error, "no column for forcing;")


@pytest.mark.parametrize("kind", ["mat5", "mat73", "hdf5", "hdf5-group"])
def test_scalar_fs_beside_the_data_is_the_sample_rate(tmp_path: Path, kind: str) -> None:
    path = save(tmp_path, reduced_table() | {"fs": np.array([250.0])}, kind)
    log = read_log(path, read_drive(tmp_path, REDUCED.replace("sample_rate = 1000.0", "")))
    assert log.time[1] == 1 / 250
    with pytest.raises(InputError) as error:
        read_log(path, read_drive(tmp_path, REDUCED))
    one_sentence(error, "1000 Hz", "250 Hz")


def test_log_without_time_or_sample_rate_is_refused(tmp_path: Path) -> None:
    text = REDUCED.replace("sample_rate = 1000.0", "")
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, reduced_table()), read_drive(tmp_path, text))
    one_sentence(error, "time", "sample_rate", "V1")


def test_stated_sample_rate_is_used_where_the_stamps_are_no_clock_or_inexact(tmp_path: Path) -> None:
    """Stamps since 1970 in single precision stand still; counted up in single precision, they run at another rate."""
    drive = read_drive(tmp_path, DRIVE + "[signals]\nsample_rate = 2000\n")
    single = np.full(ROWS, 5e-4, dtype=np.float32)
    single[0] = 1000.0
    for stamps, words in ((np.full(ROWS, np.float32(1.7e9)), "not a clock"), (np.cumsum(single), "2048 Hz")):
        log = read_log(save(tmp_path, drive_table() | {"time": stamps.astype(float)}), drive)
        np.testing.assert_allclose(np.diff(log.time), 5e-4, rtol=1e-9)
        assert words in log.findings[-1].what


def test_sample_rate_that_contradicts_the_time_stamps_is_refused(tmp_path: Path) -> None:
    text = DRIVE + "[signals]\nsample_rate = 2.0\n"
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, drive_table()), read_drive(tmp_path, text))
    one_sentence(error, "0.0005 s", "2 Hz")


def test_datetime_stamps_are_converted_to_seconds(tmp_path: Path) -> None:
    table = drive_table()
    stamps = pl.Series((table["time"] * 1e6).astype(np.int64)).cast(pl.Datetime("us"))
    path = tmp_path / "log.parquet"
    pl.DataFrame(table).with_columns(time=stamps).write_parquet(path)
    log = read_log(path, read_drive(tmp_path))
    np.testing.assert_allclose(log.time, table["time"], atol=1e-6)


def test_stated_reduced_columns_take_precedence_over_the_angles(tmp_path: Path) -> None:
    table = drive_table() | {"dynamic_error": drive_table()["load_angle"], "forcing": drive_table()["motor_torque"]}
    path = save(tmp_path, table)
    assert read_log(path, read_drive(tmp_path)).kind == "drive"
    text = DRIVE + '[columns]\ndynamic_error = { unit = "rad" }\nforcing = "forcing"\n'
    assert read_log(path, read_drive(tmp_path, text)).kind == "reduced"


@pytest.mark.parametrize("key", ["reduction_ratio", "motor_inertia", "load_inertia"])
def test_drive_log_without_ratio_or_inertia_is_refused(tmp_path: Path, key: str) -> None:
    text = re.sub(rf"{key} = .*\n", "", DRIVE)
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, drive_table()), read_drive(tmp_path, text))
    one_sentence(error, key, "drive.toml")


def test_unit_row_applies_unless_the_drive_file_states_a_unit(tmp_path: Path) -> None:
    path = save_text(tmp_path, lambda cells: cells.insert(1, ["ms", "deg", "mrad", "mNm"]))
    log = read_log(path, read_drive(tmp_path))
    table = drive_table()
    assert log.motor_angle is not None and log.load_angle is not None and log.motor_torque is not None
    np.testing.assert_allclose(log.time, table["time"] * 1e-3)
    np.testing.assert_allclose(log.motor_angle, np.deg2rad(table["motor_angle"]))
    np.testing.assert_allclose(log.load_angle, table["load_angle"] * 1e-3)
    np.testing.assert_allclose(log.motor_torque, table["motor_torque"] * 1e-3)
    assert log.findings == ()
    log = read_log(path, read_drive(tmp_path, DRIVE + '[columns]\nmotor_angle = { unit = "rad" }\n'))
    np.testing.assert_array_equal(log.motor_angle, table["motor_angle"])
    (finding,) = log.findings
    assert "'deg'" in finding.what and "'rad'" in finding.what


@pytest.mark.parametrize("values", [np.full(ROWS, np.nan), np.zeros(7)], ids=["empty", "short"])
@pytest.mark.parametrize("signal", ["temperature", "load_torque"])
def test_useless_optional_column_is_left_out_unless_it_is_named(
    tmp_path: Path, signal: str, values: np.ndarray
) -> None:
    columns: dict[str, Any] = drive_table() | {signal: values}
    np.savez(tmp_path / "log.npz", **columns)
    log = read_log(tmp_path / "log.npz", read_drive(tmp_path))
    assert getattr(log, signal) is None and len(log) == ROWS
    assert [(f.severity, f.where) for f in log.findings] == [("note", signal)]
    with pytest.raises(InputError):
        read_log(tmp_path / "log.npz", read_drive(tmp_path, DRIVE + f'[columns]\n{signal} = "{signal}"\n'))


def test_short_velocity_that_is_only_checked_is_left_out(tmp_path: Path) -> None:
    columns: dict[str, Any] = drive_table() | {"motor_velocity": np.zeros(7)}
    np.savez(tmp_path / "log.npz", **columns)
    log = read_log(tmp_path / "log.npz", read_drive(tmp_path))
    assert log.motor_velocity is None and [f.where for f in log.findings] == ["motor_velocity"]


@pytest.mark.parametrize("kind", ["csv", "parquet", "frame"])
def test_explanation_in_a_name_stated_in_full_is_no_unit(tmp_path: Path, kind: str) -> None:
    table: dict[str, Any] = drive_table()
    table["torque (commanded)"] = table.pop("motor_torque")
    columns = '[columns]\nmotor_torque = "{}"\n'
    log = pl.DataFrame(table) if kind == "frame" else save(tmp_path, table, kind)
    drive = read_drive(tmp_path, DRIVE + columns.format("torque (commanded)"))
    np.testing.assert_array_equal(fitting.load(log, drive).logs[0].input, table["torque (commanded)"])
    with pytest.raises(InputError, match="'commanded' is not understood"):
        fitting.load(log, read_drive(tmp_path, DRIVE + columns.format("torque")))
