"""Logs of every format give the same signals, and what is wrong is told in one sentence."""

import re
from collections.abc import Callable
from pathlib import Path

import h5py
import hypothesis
import hypothesis.strategies as st
import numpy as np
import polars as pl
import pytest
import scipy.io

from fitting.errors import DataError, InputError
from fitting.logs.drive_file import DriveFile, read_drive_file
from fitting.logs.log import Log, read_log

N = 50.0
ROWS = 400
DRIVE = """
[drive]
name = "rig"
reduction_ratio = 50
motor_inertia = 5.26e-4
load_inertia = 5.0e-2
"""

Table = dict[str, np.ndarray]


def rig(rows: int = ROWS) -> Table:
    """A drive log with unrelated, reproducible numbers: reading does not look at physics."""
    rng = np.random.default_rng(0)
    load = np.cumsum(rng.normal(size=rows)) * 1e-3
    return {
        "time": 10.0 + np.arange(rows) * 5e-4,
        "motor_angle": N * (load + 1e-5 * rng.normal(size=rows)),
        "load_angle": load,
        "motor_torque": rng.normal(size=rows),
    }


def drive(folder: Path, text: str = DRIVE) -> DriveFile:
    path = folder / "drive.toml"
    path.write_text(text, encoding="utf-8")
    return read_drive_file(path)


def to_text(delimiter: str, decimal: str = ".", newline: str = "\n", head: str = "") -> Callable:
    def write(path: Path, table: Table) -> None:
        rows = zip(*table.values(), strict=True)
        lines = [delimiter.join(table)]
        lines += [delimiter.join(repr(float(v)).replace(".", decimal) for v in r) for r in rows]
        path.write_bytes((head + newline.join(lines) + newline).encode())

    return write


def to_savetxt(path: Path, table: Table) -> None:
    np.savetxt(path, np.column_stack(list(table.values())), header=" ".join(table), fmt="%.18g")


def to_mat5(path: Path, table: Table) -> None:
    scipy.io.savemat(path, dict(table))


def to_mat5_columns(path: Path, table: Table) -> None:
    scipy.io.savemat(path, {k: v[:, None] for k, v in table.items()}, do_compression=True)


def to_mat73(path: Path, table: Table) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in table.items():
            file[name] = values[None, :]
        file["#refs#/a"] = np.zeros(3)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def to_hdf5(path: Path, table: Table) -> None:
    with h5py.File(path, "w") as file:
        for name, values in table.items():
            file[name] = values


def to_hdf5_group(path: Path, table: Table) -> None:
    with h5py.File(path, "w") as file:
        for name, values in table.items():
            file[f"run/{name}"] = values[:, None]


def to_parquet(path: Path, table: Table) -> None:
    pl.DataFrame(table).write_parquet(path)


FORMATS: dict[str, tuple[str, Callable[[Path, Table], None]]] = {
    "csv": (".csv", to_text(",")),
    "csv-semicolon": (".csv", to_text(";")),
    "csv-decimal-comma": (".csv", to_text(";", decimal=",")),
    "csv-crlf-bom": (".CSV", to_text(",", newline="\r\n", head="\ufeff")),
    "csv-comments": (".csv", to_text(", ", head="# rig 7\n\n# second, run\n")),
    "tsv": (".tsv", to_text("\t")),
    "txt-savetxt": (".txt", to_savetxt),
    "mat5": (".mat", to_mat5),
    "mat5-columns": (".mat", to_mat5_columns),
    "mat73": (".mat", to_mat73),
    "hdf5": (".h5", to_hdf5),
    "hdf5-group": (".hdf5", to_hdf5_group),
    "parquet": (".parquet", to_parquet),
}


def one_sentence(error: pytest.ExceptionInfo[ValueError], *words: str) -> None:
    message = str(error.value)
    assert "\n" not in message and "Traceback" not in message
    for word in words:
        assert word in message, message


def save(folder: Path, table: Table, kind: str = "csv") -> Path:
    suffix, write = FORMATS[kind]
    path = folder / f"log{suffix}"
    write(path, table)
    return path


def save_text(folder: Path, change: Callable[[list[list[str]]], None]) -> Path:
    """A CSV whose cells (header included) were changed."""
    table = rig()
    cells = [list(table)]
    cells += [[repr(float(v)) for v in row] for row in zip(*table.values(), strict=True)]
    change(cells)
    path = folder / "log.csv"
    path.write_text("\n".join(",".join(row) for row in cells) + "\n")
    return path


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_the_same_log(tmp_path: Path, kind: str) -> None:
    table = rig()
    log = read_log(save(tmp_path, table, kind), drive(tmp_path))
    assert (log.name, log.kind, len(log), log.findings) == ("log", "drive", ROWS, ())
    for name, values in table.items():
        np.testing.assert_array_equal(getattr(log, name), values)
    np.testing.assert_array_equal(log.dynamic_error, table["motor_angle"] / N - table["load_angle"])
    assert log.units == {"dynamic_error": "rad"}
    assert log.forcing is None and log.load_torque is None and log.temperature is None


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_tells_which_column_is_missing(tmp_path: Path, kind: str) -> None:
    table = rig()
    table["motor_torqe"] = table.pop("motor_torque")
    path = save(tmp_path, table, kind)
    with pytest.raises(InputError) as error:
        read_log(path, drive(tmp_path))
    one_sentence(error, str(path), "motor_torque", "did you mean", "motor_torqe", "[columns]")


def test_a_log_cannot_be_changed(tmp_path: Path) -> None:
    log = read_log(save(tmp_path, rig()), drive(tmp_path))
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
def test_units_and_signs(tmp_path: Path, kind: str) -> None:
    table = rig()
    stored = {
        "time": table["time"] * 1e3,
        "inc": -np.rint(table["motor_angle"] / (2 * np.pi) * 2**24),
        "deg": np.rad2deg(table["load_angle"]),
        "T": table["motor_torque"] * 1e3,
        "Tl": np.full(ROWS, 3.0),
        "oil": np.full(ROWS, 26.85),
        "v": np.full(ROWS, 60.0),
    }
    log = read_log(save(tmp_path, stored, kind), drive(tmp_path, DRIVE + UNITS))
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


def test_a_column_may_be_given_by_its_name_alone(tmp_path: Path) -> None:
    table = rig()
    table["T"] = table.pop("motor_torque")
    text = DRIVE + '[columns]\nmotor_torque = "T"\n'
    log = read_log(save(tmp_path, table), drive(tmp_path, text))
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
def test_a_unit_that_does_not_fit_is_refused(tmp_path: Path, signal: str, unit: str) -> None:
    text = DRIVE + f'[columns]\n{signal} = {{ unit = "{unit}" }}\n'
    path = save(tmp_path, rig())
    with pytest.raises(InputError) as error:
        read_log(path, drive(tmp_path, text))
    one_sentence(error, "drive.toml", signal, unit, "give [columns]")


def reduced(rows: int = ROWS) -> Table:
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
def test_reduced_log(tmp_path: Path, kind: str) -> None:
    table = reduced()
    log = read_log(save(tmp_path, table, kind), drive(tmp_path, REDUCED))
    assert log.kind == "reduced" and log.motor_angle is None and log.forcing is not None
    assert log.units == {"dynamic_error": "V", "forcing": "rad/s^2"}
    np.testing.assert_allclose(log.dynamic_error, table["V2"] * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(log.forcing, -np.deg2rad(table["V1"]), rtol=1e-14)
    np.testing.assert_allclose(log.time, np.arange(ROWS) * 1e-3, rtol=1e-15)


def test_reduced_log_needs_both_columns(tmp_path: Path) -> None:
    table = {"time": np.arange(ROWS) * 1.0, "dynamic_error": reduced()["V1"]}
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, table), drive(tmp_path, ""))
    one_sentence(error, "no column for forcing;")


@pytest.mark.parametrize("kind", ["mat5", "mat73", "hdf5", "hdf5-group"])
def test_scalar_fs_beside_the_data_is_the_sample_rate(tmp_path: Path, kind: str) -> None:
    path = save(tmp_path, reduced() | {"fs": np.array([250.0])}, kind)
    log = read_log(path, drive(tmp_path, REDUCED.replace("sample_rate = 1000.0", "")))
    assert log.time[1] == 1 / 250
    with pytest.raises(InputError) as error:
        read_log(path, drive(tmp_path, REDUCED))
    one_sentence(error, "1000 Hz", "250 Hz")


def test_no_time_at_all_is_refused(tmp_path: Path) -> None:
    text = REDUCED.replace("sample_rate = 1000.0", "")
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, reduced()), drive(tmp_path, text))
    one_sentence(error, "time", "sample_rate", "V1")


def test_sample_rate_must_agree_with_stamps(tmp_path: Path) -> None:
    text = DRIVE + "[signals]\nsample_rate = 2.0\n"
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, rig()), drive(tmp_path, text))
    one_sentence(error, "0.0005 s", "2 Hz")


def test_time_of_day_becomes_seconds(tmp_path: Path) -> None:
    table = rig()
    stamps = pl.Series((table["time"] * 1e6).astype(np.int64)).cast(pl.Datetime("us"))
    path = tmp_path / "log.parquet"
    pl.DataFrame(table).with_columns(time=stamps).write_parquet(path)
    log = read_log(path, drive(tmp_path))
    np.testing.assert_allclose(log.time, table["time"], atol=1e-6)


def test_stated_reduced_columns_displace_the_angles(tmp_path: Path) -> None:
    table = rig() | {"dynamic_error": rig()["load_angle"], "forcing": rig()["motor_torque"]}
    path = save(tmp_path, table)
    assert read_log(path, drive(tmp_path)).kind == "drive"
    text = DRIVE + '[columns]\ndynamic_error = { unit = "rad" }\nforcing = "forcing"\n'
    assert read_log(path, drive(tmp_path, text)).kind == "reduced"


@pytest.mark.parametrize("key", ["reduction_ratio", "motor_inertia", "load_inertia"])
def test_drive_log_needs_the_drive(tmp_path: Path, key: str) -> None:
    text = re.sub(rf"{key} = .*\n", "", DRIVE)
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, rig()), drive(tmp_path, text))
    one_sentence(error, key, "drive.toml")


@pytest.mark.parametrize("value", [np.nan, np.inf, 9.96920996838687e36])
@pytest.mark.parametrize("kind", ["csv", "mat5", "hdf5", "parquet"])
def test_blank_outputs_have_no_weight_and_are_counted(tmp_path: Path, kind: str, value: float) -> None:
    table = rig()
    table["motor_angle"][[16, 99]] = value
    table["load_angle"][[99, 300]] = value
    log = read_log(save(tmp_path, table, kind), drive(tmp_path))
    assert log.trusted is not None
    np.testing.assert_array_equal(np.flatnonzero(~log.trusted), [16, 99, 300])
    assert np.isfinite(log.dynamic_error).all()
    first, second = log.findings
    assert "motor_angle is blank or not finite in 2 rows" in first.what and "row 17" in first.where
    assert first.severity == "warning" and "row 100" in second.where


@pytest.mark.parametrize("kind", ["csv", "hdf5"])
def test_blank_torque_is_unknown_torque(tmp_path: Path, kind: str) -> None:
    """White torque can't be bridged: the log ends before the blank and goes on behind it."""
    table = rig(1000)
    table["motor_torque"][500] = np.nan
    log = read_log(save(tmp_path, table, kind), drive(tmp_path))
    assert log.pieces == ((0, 500), (501, 1000))
    assert log.input_known is not None and not log.input_known[500] and log.input_known.sum() == 999
    (finding,) = log.findings
    assert "fitted as 2 stretches" in finding.consequence


def test_a_blank_stamp_of_steady_sampling_is_known_all_the_same(tmp_path: Path) -> None:
    table = rig()
    table["time"][[16, 99]] = np.nan
    log = read_log(save(tmp_path, table), drive(tmp_path))
    np.testing.assert_allclose(log.time, rig()["time"], rtol=1e-12)
    (finding,) = log.findings
    assert "2 stamps are blank" in finding.what and "row 17" in finding.where


def test_blank_cells_and_text_count_as_blank(tmp_path: Path) -> None:
    def spoil(cells: list[list[str]]) -> None:
        cells[5][1] = ""
        cells[7][2] = "overload"

    log = read_log(save_text(tmp_path, spoil), drive(tmp_path))
    assert log.trusted is not None
    np.testing.assert_array_equal(np.flatnonzero(~log.trusted), [4, 6])
    assert any("'overload'" in f.what and "row 7" in f.where for f in log.findings)


def test_a_column_of_text_is_refused(tmp_path: Path) -> None:
    def spoil(cells: list[list[str]]) -> None:
        for row in cells[100:200]:
            row[2] = "overload"

    with pytest.raises(InputError) as error:
        read_log(save_text(tmp_path, spoil), drive(tmp_path))
    one_sentence(error, "'load_angle'", "'overload'", "100 rows", "row 100", "mend")


def test_a_unit_row_is_followed_unless_the_drive_file_knows_better(tmp_path: Path) -> None:
    path = save_text(tmp_path, lambda cells: cells.insert(1, ["ms", "deg", "mrad", "mNm"]))
    log = read_log(path, drive(tmp_path))
    table = rig()
    assert log.motor_angle is not None and log.load_angle is not None and log.motor_torque is not None
    np.testing.assert_allclose(log.time, table["time"] * 1e-3)
    np.testing.assert_allclose(log.motor_angle, np.deg2rad(table["motor_angle"]))
    np.testing.assert_allclose(log.load_angle, table["load_angle"] * 1e-3)
    np.testing.assert_allclose(log.motor_torque, table["motor_torque"] * 1e-3)
    assert log.findings == ()
    log = read_log(path, drive(tmp_path, DRIVE + '[columns]\nmotor_angle = { unit = "rad" }\n'))
    np.testing.assert_array_equal(log.motor_angle, table["motor_angle"])
    (finding,) = log.findings
    assert "'deg'" in finding.what and "'rad'" in finding.what


def test_blank_rows_at_the_ends_are_left_out_and_counted(tmp_path: Path) -> None:
    def pad(cells: list[list[str]]) -> None:
        cells[1:1] = [["", "", "", ""]] * 2
        cells.extend([[""] * 4] * 3)

    log = read_log(save_text(tmp_path, pad), drive(tmp_path))
    np.testing.assert_array_equal(log.motor_angle, rig()["motor_angle"])
    (finding,) = log.findings
    assert "2 blank rows before" in finding.what and "3 after" in finding.what


def test_a_gap_parts_the_log(tmp_path: Path) -> None:
    table = rig(1000)
    table["time"][300:] += 0.25
    table["time"][950:] += 0.1
    log = read_log(save(tmp_path, table), drive(tmp_path))
    assert log.pieces == ((0, 300), (300, 950))
    (finding,) = log.findings
    assert finding.severity == "warning" and "row 301" in finding.where
    assert "0.2505 s" in finding.what and "50 rows between gaps" in finding.consequence


def test_a_log_of_gaps_is_refused(tmp_path: Path) -> None:
    table = rig(1000)
    table["time"] += 0.25 * (np.arange(1000) // 100)
    with pytest.raises(DataError) as error:
        read_log(save(tmp_path, table), drive(tmp_path))
    one_sentence(error, "9 gaps", "no stretch of 200 rows")


def test_too_short(tmp_path: Path) -> None:
    with pytest.raises(DataError) as error:
        read_log(save(tmp_path, rig(199)), drive(tmp_path))
    one_sentence(error, "199 rows", "200")
    assert len(read_log(save(tmp_path, rig(200)), drive(tmp_path))) == 200


def test_columns_must_be_equally_long(tmp_path: Path) -> None:
    table = rig()
    table["load_angle"] = table["load_angle"][:-1]
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, table, "hdf5"), drive(tmp_path))
    one_sentence(error, "'load_angle'", "399", "400")


def test_predict_does_not_look_at_later_outputs(tmp_path: Path) -> None:
    full = read_log(save(tmp_path, rig()), drive(tmp_path))

    def spoil(cells: list[list[str]]) -> None:
        for number, row in enumerate(cells[51:]):
            row[1] = ["", "nan", "withheld", "1e9"][number % 4]
            row[2] = ""

    path = save_text(tmp_path, spoil)
    log = read_log(path, drive(tmp_path), outputs_until=50)
    assert len(log) == ROWS and log.outputs_until == 50
    np.testing.assert_array_equal(log.dynamic_error[:50], full.dynamic_error[:50])
    np.testing.assert_array_equal(log.motor_torque, full.motor_torque)
    np.testing.assert_array_equal(log.time, full.time)
    assert log.trusted is not None and log.trusted[:50].all() and not log.trusted[50:].any()
    assert np.isfinite(log.dynamic_error).all() and log.findings == ()
    # Another 1e9 there is as good as any.
    assert np.ptp(log.dynamic_error[50:]) == 0
    with pytest.raises(InputError) as error:
        read_log(path, drive(tmp_path))
    one_sentence(error, "'motor_angle'", "'withheld'")


def test_predict_still_needs_the_inputs(tmp_path: Path) -> None:
    table = rig()
    table["motor_torque"][300:330] = np.nan
    with pytest.raises(DataError) as error:
        read_log(save(tmp_path, table), drive(tmp_path), outputs_until=50)
    one_sentence(error, "motor_torque", "throughout")


def test_a_bare_dataset_name_must_be_unique(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for name, values in rig().items():
            file[f"a/{name}"] = values
            file[f"b/{name}"] = 2 * values
    with pytest.raises(InputError) as error:
        read_log(path, drive(tmp_path))
    one_sentence(error, "several datasets", "a/", "b/")
    columns = "".join(f'{name} = "b/{name}"\n' for name in rig())
    log = read_log(path, drive(tmp_path, f"{DRIVE}\n[columns]\n{columns}"))
    np.testing.assert_array_equal(log.load_angle, 2 * rig()["load_angle"])


@pytest.mark.parametrize("value", [{"a": 1.0}, np.ones((ROWS, 2)), np.ones(ROWS) * 1j, "text"], ids=repr)
def test_what_is_no_vector_is_refused(tmp_path: Path, value: object) -> None:
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, rig() | {"motor_torque": value})
    with pytest.raises(InputError) as error:
        read_log(path, drive(tmp_path))
    one_sentence(error, str(path), "'motor_torque'", "vector")


def test_repeated_and_absent_headers(tmp_path: Path) -> None:
    def repeat(cells: list[list[str]]) -> None:
        cells[0][2] = "motor_angle"

    with pytest.raises(InputError) as error:
        read_log(save_text(tmp_path, repeat), drive(tmp_path))
    one_sentence(error, "'motor_angle'", "twice")
    with pytest.raises(InputError) as error:
        read_log(save_text(tmp_path, lambda cells: cells.__delitem__(0)), drive(tmp_path))
    one_sentence(error, "no header line")


def test_a_stated_column_must_be_there(tmp_path: Path) -> None:
    text = DRIVE + '[columns]\ntemperature = { column = "Time", unit = "degC" }\n'
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, rig()), drive(tmp_path, text))
    one_sentence(error, "'Time'", "did you mean 'time'?", "temperature", "the file has")


def test_long_listings_are_cut(tmp_path: Path) -> None:
    table = {f"c{i}": np.zeros(ROWS) for i in range(20)}
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, table), drive(tmp_path))
    one_sentence(error, "c0,", "c11 and 8 more")


def test_unknown_format_and_missing_file(tmp_path: Path) -> None:
    (tmp_path / "log.docx").touch()
    with pytest.raises(InputError) as error:
        read_log(tmp_path / "log.docx", drive(tmp_path))
    one_sentence(error, ".docx", ".parquet")
    with pytest.raises(InputError) as error:
        read_log(tmp_path / "none.csv", drive(tmp_path))
    one_sentence(error, "none.csv", "no such")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(InputError):
        read_log(tmp_path / "folder.csv", drive(tmp_path))


SUFFIXES = [".csv", ".tsv", ".txt", ".mat", ".h5", ".hdf5", ".parquet"]
FIRST_BYTES = {
    ".csv": b"time,motor_angle,load_angle,motor_torque\n",
    ".mat": b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM",
    ".h5": b"\x89HDF\r\n\x1a\n",
    ".parquet": b"PAR1",
}
anywhere = hypothesis.settings(
    max_examples=60,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
)


@anywhere
@hypothesis.given(suffix=st.sampled_from(SUFFIXES), begun=st.booleans(), raw=st.binary(max_size=300))
def test_any_bytes_are_refused_politely(tmp_path: Path, suffix: str, begun: bool, raw: bytes) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(FIRST_BYTES.get(suffix, b"") * begun + raw)
    with pytest.raises((InputError, DataError)) as error:
        read_log(path, drive(tmp_path))
    one_sentence(error, str(path))


@pytest.mark.parametrize("kind", ["csv", "mat5", "mat5-columns", "hdf5", "parquet"])
def test_damaged_files_are_refused_politely(tmp_path: Path, kind: str) -> None:
    path = save(tmp_path, rig(), kind)
    whole, rng = path.read_bytes(), np.random.default_rng(3)
    ends = 0
    for trial in range(24):
        damaged = bytearray(whole[: rng.integers(len(whole))] if trial % 2 else whole)
        for place in rng.integers(len(damaged), size=8):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_log(path, drive(tmp_path))
        except (InputError, DataError) as error:
            assert "\n" not in str(error)
            ends += 1
    assert ends > 0


GOOD = """
[drive]
name = "rig"
reduction_ratio = 50
motor_inertia = "5.26 g m^2"
load_inertia = "500 kg cm^2"
[signals]
torque_hold = "linear"
sample_rate = "2 kHz"
[columns]
motor_angle = { column = "a", unit = "deg", sign = -1 }
time = "t"
"""


def test_drive_file(tmp_path: Path) -> None:
    read = drive(tmp_path, GOOD)
    assert read.name == "rig" and read.reduction_ratio == 50 and read.torque_hold == "linear"
    assert read.motor_inertia == pytest.approx(5.26e-3, rel=1e-14)
    assert read.load_inertia == pytest.approx(0.05, rel=1e-14)
    assert read.sample_rate == pytest.approx(2000.0)
    place = read.columns["motor_angle"]
    assert (place.column, place.unit, place.sign) == ("a", "deg", -1.0)
    assert read.column_of("time").column == "t"
    assert read.column_of("load_angle").column == "load_angle"


def test_an_empty_drive_file_states_nothing(tmp_path: Path) -> None:
    read = drive(tmp_path, "")
    assert read.name == "drive" and read.columns == {}
    assert read.reduction_ratio is None and read.torque_hold is None and read.sample_rate is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[drive]", "[drives]", ["'drives'", "did you mean 'drive'?"]),
        ("reduction_ratio", "reducton_ratio", ["did you mean 'reduction_ratio'?"]),
        ("reduction_ratio = 50", "reduction_ratio = 0", ["reduction_ratio", "positive"]),
        ("reduction_ratio = 50", "reduction_ratio = true", ["reduction_ratio", "True"]),
        ("reduction_ratio = 50", "reduction_ratio = nan", ["reduction_ratio"]),
        ("reduction_ratio = 50", "reduction_ratio = [50]", ["reduction_ratio"]),
        ('"5.26 g m^2"', "-1.0", ["motor_inertia", "kg m^2"]),
        ('"5.26 g m^2"', '"5.26 g m"', ["motor_inertia", "does not measure"]),
        ('"5.26 g m^2"', '"heavy"', ["motor_inertia", "not understood"]),
        ('"linear"', '"zero order"', ["torque_hold", "did you mean 'zero-order'?"]),
        ('"linear"', "1", ["torque_hold"]),
        ('"2 kHz"', "inf", ["sample_rate"]),
        ('name = "rig"', "name = 7", ["name"]),
        ("motor_angle =", "motor_angel =", ["'motor_angel'", "did you mean 'motor_angle'?"]),
        ("sign = -1", "sign = 2", ["sign", "1 or -1"]),
        ("sign = -1", "sgn = -1", ["'sgn'", "did you mean 'sign'?"]),
        ('unit = "deg"', "unit = 3", ["unit", "string"]),
        ('column = "a"', "column = 0", ["column", "number from 1 on"]),
        ('column = "a"', "column = 3.5", ["column", "string"]),
        ('time = "t"', "time = -3", ["time", "number from 1 on"]),
        ("[columns]", "[columns", ["TOML"]),
        ("[drive]", "signals = 3\n[drive]", ["TOML"]),
        ("[signals]", "[other]", ["'other'"]),
    ],
)
def test_drive_file_mistakes(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in GOOD
    with pytest.raises(InputError) as error:
        drive(tmp_path, GOOD.replace(old, new))
    one_sentence(error, "drive.toml", *words)


def test_tables_must_be_tables(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        drive(tmp_path, "drive = 3")
    one_sentence(error, "[drive]")


def test_missing_drive_file(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        read_drive_file(tmp_path / "no.toml")
    one_sentence(error, "no.toml", "--drive")
    with pytest.raises(InputError):
        read_drive_file(tmp_path)


@anywhere
@hypothesis.given(raw=st.binary(max_size=100) | st.text(max_size=100).map(str.encode))
def test_any_bytes_as_drive_file(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "drive.toml"
    path.write_bytes(raw)
    try:
        read_drive_file(path)
    except InputError as error:
        assert "\n" not in str(error)


def read_shared(folder: Path, log: Path, text: str) -> Log:
    return read_log(log, drive(folder, text))


def test_silverbox(tmp_path: Path, shared: Path) -> None:
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


def test_bouc_wen(tmp_path: Path, shared: Path) -> None:
    text = """
    [columns]
    dynamic_error = { column = "multisine/y", unit = "mm" }
    forcing = { column = "u", unit = "N" }
    """
    log = read_shared(tmp_path, shared / "data/bouc_wen/estimation.h5", text)
    assert len(log) == 40960 and log.units == {"dynamic_error": "m", "forcing": "N"}
    assert log.time[1] == 1 / 750


def test_lara8(tmp_path: Path, shared: Path) -> None:
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
