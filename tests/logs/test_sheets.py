"""Spreadsheets: a table at any place of a workbook is found and read in full precision."""

from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from workbooks import workbook

from fitting.errors import InputError
from fitting.logs.read_table import read_table

COUNT = 30
ANGLE = np.random.default_rng(0).normal(size=COUNT) * 1e-7
WANTED = ("Time", "Motor", "Time (2)", "Torque")


def test_spreadsheet_table_is_found_and_read_in_full_precision(tmp_path: Path):
    pytest.importorskip("fastexcel", reason="needs the extra `xlsx`: fastexcel is not installed")
    path = tmp_path / "log.xlsx"
    rows: dict[int, dict[str, object]] = {
        3: {"B": "Recorded on rig 7"},
        5: dict(zip("BCDE", ("Time [s]", "Motor", "Time [s]", "Torque [N m]"), strict=True)),
    }
    for i in range(COUNT):
        rows[6 + i] = {"B": i * 1e-3, "C": float(ANGLE[i]), "D": i * 2e-3, "E": "overload" if i == 4 else 1.0 / (i + 3)}
    workbook(path, {1: {"A": "Nothing here"}}, rows)
    table = read_table(path, WANTED)
    assert table.names == ("column 1", "Time [s]", "Motor", "Time (2) [s]", "Torque [N m]")[-len(table.names) :]
    np.testing.assert_array_equal(table.columns["Motor"].values, ANGLE)
    np.testing.assert_array_equal(table.columns["Time (2)"].values, np.arange(COUNT) * 2e-3)
    torque = table.columns["Torque"]
    assert torque.unit == "N m" and torque.text_rows.tolist() == [4] and torque.text == "overload"
    known = np.delete(np.arange(COUNT), 4)
    np.testing.assert_array_equal(torque.values[known], 1.0 / (known + 3.0))


def test_workbook_without_a_table_is_refused(tmp_path: Path):
    pytest.importorskip("fastexcel", reason="needs the extra `xlsx`: fastexcel is not installed")
    path = tmp_path / "log.xlsx"
    workbook(path, {1: {"A": "Nothing"}, 2: {"A": "here"}})
    with pytest.raises(InputError, match="no sheet of the workbook holds a table"):
        read_table(path, WANTED)


@pytest.mark.parametrize("name", ["log.xlsx", "log.xls", "log.csv"])
def test_zip_archive_without_a_workbook_is_refused(tmp_path: Path, name: str):
    path = tmp_path / name
    with ZipFile(path, "w") as file:
        file.writestr("readme.txt", "nothing")
    with pytest.raises(InputError, match="zip archive"):
        read_table(path, WANTED)
