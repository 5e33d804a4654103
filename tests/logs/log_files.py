"""Log files of every format and drive files for the tests of reading."""

from collections.abc import Callable
from pathlib import Path

import h5py
import hypothesis
import numpy as np
import polars as pl
import pytest
import scipy.io

from fitting.logs.drive_file import DriveFile, read_drive_file

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


def drive_table(rows: int = ROWS) -> Table:
    """Columns of a drive log with unrelated, reproducible numbers: reading does not depend on physics."""
    rng = np.random.default_rng(0)
    load = np.cumsum(rng.normal(size=rows)) * 1e-3
    return {
        "time": 10.0 + np.arange(rows) * 5e-4,
        "motor_angle": N * (load + 1e-5 * rng.normal(size=rows)),
        "load_angle": load,
        "motor_torque": rng.normal(size=rows),
    }


def read_drive(folder: Path, text: str = DRIVE) -> DriveFile:
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
    table = drive_table()
    cells = [list(table)]
    cells += [[repr(float(v)) for v in row] for row in zip(*table.values(), strict=True)]
    change(cells)
    path = folder / "log.csv"
    path.write_text("\n".join(",".join(row) for row in cells) + "\n")
    return path


sixty_examples = hypothesis.settings(
    max_examples=60,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
)
