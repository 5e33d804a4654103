"""Log files that can't be read: each is refused in one sentence."""

from pathlib import Path

import h5py
import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.io
from log_files import DRIVE, ROWS, drive_table, one_sentence, read_drive, save, save_text, sixty_examples

from fitting.errors import DataError, InputError
from fitting.logs.log import read_log


def test_columns_of_unequal_length_are_refused(tmp_path: Path) -> None:
    table = drive_table()
    table["load_angle"] = table["load_angle"][:-1]
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, table, "hdf5"), read_drive(tmp_path))
    one_sentence(error, "'load_angle'", "399", "400")


def test_ambiguous_dataset_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for name, values in drive_table().items():
            file[f"a/{name}"] = values
            file[f"b/{name}"] = 2 * values
    with pytest.raises(InputError) as error:
        read_log(path, read_drive(tmp_path))
    one_sentence(error, "several datasets", "a/", "b/")
    columns = "".join(f'{name} = "b/{name}"\n' for name in drive_table())
    log = read_log(path, read_drive(tmp_path, f"{DRIVE}\n[columns]\n{columns}"))
    np.testing.assert_array_equal(log.load_angle, 2 * drive_table()["load_angle"])


@pytest.mark.parametrize("value", [{"a": 1.0}, np.ones((ROWS, 2)), np.ones(ROWS) * 1j, "text"], ids=repr)
def test_column_that_is_not_a_real_vector_is_refused(tmp_path: Path, value: object) -> None:
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, drive_table() | {"motor_torque": value})
    with pytest.raises(InputError) as error:
        read_log(path, read_drive(tmp_path))
    one_sentence(error, str(path), "'motor_torque'", "vector")


def test_repeated_or_missing_header_is_refused(tmp_path: Path) -> None:
    def repeat(cells: list[list[str]]) -> None:
        cells[0][2] = "motor_angle"

    with pytest.raises(InputError) as error:
        read_log(save_text(tmp_path, repeat), read_drive(tmp_path))
    one_sentence(error, "'motor_angle'", "twice")
    with pytest.raises(InputError) as error:
        read_log(save_text(tmp_path, lambda cells: cells.__delitem__(0)), read_drive(tmp_path))
    one_sentence(error, "no header line")


def test_missing_stated_column_is_refused(tmp_path: Path) -> None:
    text = DRIVE + '[columns]\ntemperature = { column = "Time", unit = "degC" }\n'
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, drive_table()), read_drive(tmp_path, text))
    one_sentence(error, "'Time'", "did you mean 'time'?", "temperature", "the file has")


def test_long_list_of_columns_is_truncated(tmp_path: Path) -> None:
    table = {f"c{i}": np.zeros(ROWS) for i in range(20)}
    with pytest.raises(InputError) as error:
        read_log(save(tmp_path, table), read_drive(tmp_path))
    one_sentence(error, "c0,", "c11 and 8 more")


def test_unknown_format_and_missing_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "log.docx").touch()
    with pytest.raises(InputError) as error:
        read_log(tmp_path / "log.docx", read_drive(tmp_path))
    one_sentence(error, ".docx", ".parquet")
    with pytest.raises(InputError) as error:
        read_log(tmp_path / "none.csv", read_drive(tmp_path))
    one_sentence(error, "none.csv", "no such")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(InputError):
        read_log(tmp_path / "folder.csv", read_drive(tmp_path))


SUFFIXES = [".csv", ".tsv", ".txt", ".mat", ".h5", ".hdf5", ".parquet"]


FIRST_BYTES = {
    ".csv": b"time,motor_angle,load_angle,motor_torque\n",
    ".mat": b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM",
    ".h5": b"\x89HDF\r\n\x1a\n",
    ".parquet": b"PAR1",
}


@sixty_examples
@hypothesis.given(suffix=st.sampled_from(SUFFIXES), begun=st.booleans(), raw=st.binary(max_size=300))
def test_arbitrary_bytes_are_refused_in_one_sentence(tmp_path: Path, suffix: str, begun: bool, raw: bytes) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(FIRST_BYTES.get(suffix, b"") * begun + raw)
    with pytest.raises((InputError, DataError)) as error:
        read_log(path, read_drive(tmp_path))
    one_sentence(error, str(path))


@pytest.mark.parametrize("kind", ["csv", "mat5", "mat5-columns", "hdf5", "parquet"])
def test_damaged_files_are_read_or_refused_in_one_sentence(tmp_path: Path, kind: str) -> None:
    path = save(tmp_path, drive_table(), kind)
    whole, rng = path.read_bytes(), np.random.default_rng(3)
    ends = 0
    for trial in range(24):
        damaged = bytearray(whole[: rng.integers(len(whole))] if trial % 2 else whole)
        for place in rng.integers(len(damaged), size=8):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_log(path, read_drive(tmp_path))
        except (InputError, DataError) as error:
            assert "\n" not in str(error)
            ends += 1
    assert ends > 0
