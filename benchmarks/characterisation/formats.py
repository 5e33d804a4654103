"""Tables written in every format of a log."""

import gzip
import importlib.util
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import scipy.io

Columns = dict[str, np.ndarray]

_MATLAB_HEADER = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 ."
_MATLAB_BLOCK = 512


def delimited(columns: Columns, delimiter: str = ",") -> str:
    """Text with a header; blank cells where a number is not finite."""
    rows = [delimiter.join(columns)]
    for row in np.stack(list(columns.values()), axis=1).tolist():
        rows.append(delimiter.join(f"{value:.12g}" if np.isfinite(value) else "" for value in row))
    return "\n".join(rows) + "\n"


def write_csv(path: Path, columns: Columns) -> None:
    """Write comma-separated values."""
    path.write_text(delimited(columns), encoding="utf-8")


def write_packed_csv(path: Path, columns: Columns) -> None:
    """Write comma-separated values, packed by gzip without a date."""
    path.write_bytes(gzip.compress(delimited(columns).encode(), mtime=0))


def write_tsv(path: Path, columns: Columns, units: dict[str, str]) -> None:
    """Write tab-separated values with decimal commas, comments above and units in the header."""
    named = {f"{name} [{units[name]}]": values for name, values in columns.items()}
    text = "# bench 3\n# exported\n" + delimited(named, "\t")
    path.write_text(text.replace(".", ","), encoding="utf-8")


def write_mat(path: Path, columns: Columns) -> None:
    """Write a struct `run` in MATLAB's format 5."""
    scipy.io.savemat(path, {"run": {name: values[:, None] for name, values in columns.items()}})


def write_mat73(path: Path, columns: Columns, sample_rate: float) -> None:
    """Write variables in MATLAB's format 7.3, with a scalar `fs` in place of the time."""
    with h5py.File(path, "w", userblock_size=_MATLAB_BLOCK) as file:
        for name, values in columns.items():
            if name != "time":
                file.create_dataset(name, data=values[None, :]).attrs["MATLAB_class"] = np.bytes_("double")
        file.create_dataset("fs", data=np.array([[sample_rate]])).attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(_MATLAB_HEADER.ljust(124) + b"\x00\x02IM")


def write_hdf5(path: Path, columns: Columns, units: dict[str, str]) -> None:
    """Write datasets of a group `run`, each with its unit as an attribute."""
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"run/{name}", data=values).attrs["units"] = units[name]


def write_parquet(path: Path, columns: Columns) -> None:
    """Write Parquet."""
    pl.DataFrame(columns).write_parquet(path)


def write_mdf(path: Path, columns: Columns) -> bool:
    """Write MDF 4 where asammdf is installed.

    Returns:
        Whether it is.
    """
    if importlib.util.find_spec("asammdf") is None:
        return False
    from asammdf import MDF, Signal  # pyright: ignore[reportMissingImports]

    time = columns["time"]
    with MDF(version="4.10") as file:
        file.append([Signal(v, time, name=name) for name, v in columns.items() if name != "time"])
        file.save(path, overwrite=True)
    return True
