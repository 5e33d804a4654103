"""Logs of one drive: unique names, and one kind."""

from pathlib import Path

import mutations
import numpy as np
import pytest

from fitting.drive_data import read_rig
from fitting.errors import DataError, InputError


def write(folder: Path, name: str, seed: int, *, warm: bool = False) -> Path:
    folder.mkdir(exist_ok=True)
    table = mutations.healthy(seed)
    if warm:
        table["temperature"] = np.linspace(293.0, 303.0, mutations.ROWS)
    lines = [",".join(table), *(",".join(f"{v:.12g}" for v in row) for row in zip(*table.values(), strict=True))]
    (folder / name).write_text("\n".join(lines), encoding="utf-8")
    return folder / name


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    path = tmp_path / "drive.toml"
    path.write_bytes(mutations.drive_text(None, spoilt=False))
    return path


def test_logs_of_equal_name_get_distinct_names(tmp_path: Path, drive: Path):
    paths = [
        write(tmp_path / "a", "run.csv", 0),
        write(tmp_path / "b", "run.csv", 1),
        write(tmp_path / "b", "other.csv", 2),
    ]
    found = read_rig([*paths, paths[1]], drive)
    names = ["a/run", "b/run", "other", "b/run (2)"]
    assert [log.name for log in found.logs] == names
    assert list(found.findings) == names
    assert [e.name for e in found.experiments["linear"]] == names


def test_numbers_of_names_are_those_of_no_file(tmp_path: Path, drive: Path):
    paths = [write(tmp_path / "a", name, i) for i, name in enumerate(("run (2).csv", "run.csv"))]
    names = [log.name for log in read_rig([*paths, paths[1], paths[1]], drive).logs]
    assert names == ["run (2)", "a/run", "a/run (2)", "a/run (3)"]


def test_logs_of_two_kinds_are_refused(tmp_path: Path, drive: Path):
    with pytest.raises(InputError, match="can't be fitted together"):
        read_rig([write(tmp_path, "a.csv", 0), write(tmp_path, "b.csv", 4)], drive)


def test_temperature_counts_only_where_all_logs_have_one(tmp_path: Path, drive: Path):
    """An effect of temperature could not be simulated along the other logs."""
    warm, other = (write(tmp_path, f"{name}.csv", i, warm=True) for i, name in enumerate(("warm", "other")))
    bare = write(tmp_path, "bare.csv", 2)
    found = read_rig([warm], drive, test=[other])
    assert all(e.temperature is not None for some in (found.experiments, found.test) for e in some["linear"])
    assert not any("temperature" in str(finding) for some in found.findings.values() for finding in some)
    for found in (read_rig([warm], drive, test=[bare]), read_rig([warm, bare], drive, test=[other])):
        assert all(e.temperature is None for some in (found.experiments, found.test) for e in some["linear"])
        told = {name: [f.what for f in some if f.where == "temperature"] for name, some in found.findings.items()}
        assert told.pop("bare") == []
        assert all(what == ["bare has none"] for what in told.values())


def test_test_log_that_is_unfit_is_refused(tmp_path: Path, drive: Path):
    fitted, test = write(tmp_path, "a.csv", 0), write(tmp_path, "b.csv", 1)
    name, *rows = test.read_text(encoding="utf-8").splitlines()
    mirrored = [",".join([t, m, str(-float(load)), torque]) for t, m, load, torque in (row.split(",") for row in rows)]
    test.write_text("\n".join([name, *mirrored]), encoding="utf-8")
    with pytest.raises(DataError, match=r"b\.csv: .* sign = -1"):
        read_rig([fitted], drive, test=[test])
