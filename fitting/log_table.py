"""The raw columns of a log file, in the file's own names and units, whatever its format."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fitting.errors import InputError

# Scalars that MATLAB and HDF5 users keep beside the data.
_RATE_NAMES = ("fs", "Fs", "sample_rate")
_BLANK_WORDS = ("", "nan", "na", "n/a", "null", "none")


@dataclass(frozen=True, eq=False)
class RawColumn:
    """One column as numbers.

    Attributes:
        values: float64, (n,), NaN where the file has nothing or text.
        bad_row: Index of the first row that holds text, or None.
        bad_text: That text.
    """

    values: np.ndarray
    bad_row: int | None = None
    bad_text: str = ""


@dataclass(frozen=True, eq=False)
class LogTable:
    """What one file holds of what was asked for.

    Attributes:
        names: All columns of the file.
        columns: The asked columns that the file has, by the name asked for.
        sample_rate: Hz, a scalar `fs` beside the data (MAT and HDF5 only), or None.
    """

    names: tuple[str, ...]
    columns: dict[str, RawColumn] = field(default_factory=dict)
    sample_rate: float | None = None


def read_table(path: Path, wanted: Iterable[str]) -> LogTable:
    """The wanted columns of a log file.

    Args:
        path: CSV, TSV, TXT, MAT (v5 to v7.3), HDF5 or Parquet, told by the suffix.
        wanted: Names of columns; those that the file lacks are left out of the answer.

    Returns:
        The columns as float64 vectors.

    Raises:
        InputError: The file is missing, corrupt or of no known format, or a wanted column is
            not a vector of numbers.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"{path}: the format '{path.suffix}' is not known; save the log as one of {', '.join(_READERS)}"
        )
    if not path.is_file():
        raise InputError(f"{path}: there is no such log file; check the path")
    try:
        return reader(path, tuple(dict.fromkeys(wanted)))
    except InputError:
        raise
    except (Exception, pl.exceptions.PanicException) as error:
        # Readers of binary formats meet corrupt bytes with whatever exception is at hand.
        reason = " ".join(str(error).split())[:200].rstrip(". ") or type(error).__name__
        raise InputError(
            f"{path}: the file cannot be read as {path.suffix[1:].upper()}, export it again or mend it: {reason}"
        ) from error


def _read_text(path: Path, wanted: tuple[str, ...]) -> LogTable:
    lines = _decode(path).splitlines()
    first = next((i for i, line in enumerate(lines) if not _is_remark(line)), None)
    if first is None:
        raise InputError(f"{path}: the file is empty; export the log again")
    remarks, lines = lines[:first], lines[first:]
    delimiter = max(",;\t", key=lines[0].count)
    if delimiter not in lines[0] and len(lines[0].split()) > 1:
        delimiter = " "
        lines = [" ".join(line.split()) for line in lines]
    cells = lines[0].split(delimiter)
    if all(_is_number(cell) for cell in cells):
        lines.insert(0, _remarked_header(path, remarks, delimiter, len(cells)))
    source = "\n".join(lines).encode()
    options: dict[str, Any] = {
        "separator": delimiter,
        "comment_prefix": "#",
        "infer_schema": False,
    }
    header = pl.read_csv(BytesIO(source), n_rows=0, **options).columns
    place = {name.strip(): name for name in header}
    for name in wanted:
        if f"{name}_duplicated_0" in place:
            raise InputError(f"{path}: the column '{name}' appears twice; rename one of the two")
    found = [name for name in wanted if name in place]
    frame = pl.read_csv(BytesIO(source), columns=[place[n] for n in found], **options)
    columns = {n: _column_from_text(frame[place[n]], delimiter) for n in found}
    return LogTable(tuple(place), columns)


def _decode(path: Path) -> str:
    raw = path.read_bytes()
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = raw.decode("utf-16")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("latin-1")
    if "\0" in text:
        raise InputError(f"{path}: the file is not text; export the log again or mend its suffix")
    return text


def _is_remark(line: str) -> bool:
    return line.strip() == "" or line.lstrip().startswith("#")


def _remarked_header(path: Path, remarks: list[str], delimiter: str, width: int) -> str:
    """Header from the last remark before the first row, where numpy.savetxt puts it."""
    remarks = [line.strip().lstrip("#").strip() for line in remarks if line.strip()]
    header = remarks[-1] if remarks else ""
    if delimiter == " ":
        header = " ".join(header.split())
    if len(header.split(delimiter)) != width or _is_number(header.split(delimiter)[0]):
        raise InputError(f"{path}: the file has no header line; write the {width} column names into its first line")
    return header


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().strip('"').replace(",", ".") or "nan")
    except ValueError:
        return False
    return True


def _column_from_text(text: pl.Series, delimiter: str) -> RawColumn:
    text = text.cast(pl.String).str.strip_chars()
    if delimiter != "," and not text.str.contains(".", literal=True).any():
        text = text.str.replace(",", ".", literal=True)
    values = text.cast(pl.Float64, strict=False)
    blank = text.is_null() | text.str.to_lowercase().is_in(_BLANK_WORDS)
    bad = (values.is_null() & ~blank.fill_null(value=True)).arg_true()
    numbers = values.fill_null(float("nan")).to_numpy().astype(np.float64)
    if bad.len() == 0:
        return RawColumn(numbers)
    return RawColumn(numbers, int(bad[0]), str(text[int(bad[0])])[:40])


def _read_parquet(path: Path, wanted: tuple[str, ...]) -> LogTable:
    names = tuple(pl.read_parquet_schema(path))
    found = [name for name in wanted if name in names]
    frame = pl.read_parquet(path, columns=found, use_statistics=False)
    return LogTable(names, {n: _column_from_series(path, frame[n]) for n in found})


def _column_from_series(path: Path, series: pl.Series) -> RawColumn:
    if series.dtype == pl.String:
        return _column_from_text(series, ",")
    if series.dtype.is_temporal() and isinstance(series.dtype, pl.Datetime | pl.Duration):
        ticks = series.cast(pl.Int64).cast(pl.Float64)
        per_second = {"ms": 1e3, "us": 1e6, "ns": 1e9}[series.dtype.time_unit or "us"]
        return RawColumn(ticks.fill_null(float("nan")).to_numpy() / per_second)
    if not (series.dtype.is_numeric() or series.dtype == pl.Boolean):
        raise _not_numbers(path, series.name, f"is of type {series.dtype}")
    values = series.cast(pl.Float64).fill_null(float("nan")).to_numpy()
    return RawColumn(np.array(values, dtype=np.float64))


def _read_mat(path: Path, wanted: tuple[str, ...]) -> LogTable:
    # Imported here because they cost as much as all the rest of a CSV user's start.
    import h5py
    import scipy.io

    if h5py.is_hdf5(path):
        return _read_hdf5(path, wanted)
    names = tuple(name for name, _, _ in scipy.io.whosmat(path))
    asked = [name for name in (*wanted, *_RATE_NAMES) if name in names]
    held = scipy.io.loadmat(path, variable_names=asked) if asked else {}
    columns = {n: RawColumn(_vector(path, n, held[n])) for n in wanted if n in held}
    return LogTable(names, columns, _rate(held.get))


def _read_hdf5(path: Path, wanted: tuple[str, ...]) -> LogTable:
    import h5py

    with h5py.File(path, "r") as file:
        names: list[str] = []

        def note(name: str, item: object) -> None:
            # "#refs#" is where MATLAB v7.3 keeps the insides of its cells.
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                names.append(name)

        file.visititems(note)
        place = {asked: _dataset_path(path, asked, names) for asked in wanted}
        columns: dict[str, RawColumn] = {}
        rate: float | None = None
        for asked, dataset in place.items():
            if dataset is None:
                continue
            columns[asked] = RawColumn(_vector(path, dataset, _item(file, dataset)))
            beside = dataset.rpartition("/")[0]
            prefix = f"{beside}/" if beside else ""
            rate = rate or _rate(lambda name, at=prefix: _item(file, at + name) if at + name in names else None)
    return LogTable(tuple(names), columns, rate)


def _item(file: Any, name: str) -> Any:
    return file[name][()]


def _dataset_path(path: Path, asked: str, names: list[str]) -> str | None:
    """The dataset of that path, or the only one with that last name."""
    plain = asked.strip("/")
    if plain in names:
        return plain
    leaves = [name for name in names if name.rpartition("/")[2] == plain]
    if len(leaves) > 1:
        raise InputError(
            f"{path}: '{asked}' is the name of several datasets ({', '.join(leaves[:6])}); "
            "give the full path of one of them in [columns] of the drive file"
        )
    return leaves[0] if leaves else None


def _vector(path: Path, name: str, data: Any) -> np.ndarray:
    array = np.asarray(data)
    if array.dtype.names is not None or array.dtype.kind not in "biuf":
        raise _not_numbers(path, name, "is a struct, text or complex")
    if array.size != max(array.shape, default=1):
        raise _not_numbers(path, name, f"has shape {array.shape}")
    return array.reshape(-1).astype(np.float64)


def _not_numbers(path: Path, name: str, what: str) -> InputError:
    return InputError(f"{path}: the column '{name}' {what}, where a plain vector of numbers is needed; save it as one")


def _rate(get: Callable[[str], Any]) -> float | None:
    for name in _RATE_NAMES:
        value = get(name)
        if value is None:
            continue
        array = np.asarray(value)
        if array.size == 1 and array.dtype.kind in "iuf" and 0 < array.item() < np.inf:
            return float(array.item())
    return None


_READERS: dict[str, Callable[[Path, tuple[str, ...]], LogTable]] = {
    ".csv": _read_text,
    ".tsv": _read_text,
    ".txt": _read_text,
    ".mat": _read_mat,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
    ".parquet": _read_parquet,
}
LOG_SUFFIXES = tuple(_READERS)
"""How the names of log files end."""
