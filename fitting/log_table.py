"""The raw columns of a log file, in the file's own names and units, whatever its format."""

import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
import polars as pl

from fitting.array_log import read_hdf5, read_mat
from fitting.errors import InputError
from fitting.mdf_log import read_mdf
from fitting.raw_table import RawColumn, RawTable, column_from_text, not_numbers
from fitting.text_log import read_text

# A packed file of more than this is no log of a drive but a mistake, or a trap.
_LARGEST = 2 << 30


def read_table(path: Path, wanted: Iterable[str]) -> RawTable:
    """The wanted columns of a log file.

    Args:
        path: CSV, TSV, TXT, DAT, MAT (v5 to v7.3), HDF5, Parquet or MDF4, told by the first bytes where they say it and
            by the suffix otherwise; also packed by gzip.
        wanted: Names of columns; those that the file lacks are left out of the answer.

    Returns:
        The columns as float64 vectors.

    Raises:
        InputError: The file is missing, corrupt or of no known format, or a wanted column is
            not a vector of numbers.
    """
    suffix = path.with_suffix("").suffix.lower() if path.suffix.lower() == ".gz" else path.suffix.lower()
    known = _READERS.get(suffix)
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: this is no file; give the log file itself")
    if not path.exists():
        if known is None:
            raise _unknown(path, suffix)
        raise InputError(f"{path}: there is no such log file; check the path")
    try:
        source: Path | BytesIO = _unpacked(path) if path.suffix.lower() == ".gz" else path
        head = source.getvalue()[:1024] if isinstance(source, BytesIO) else _head(path)
        reader = next((r for magic, r in _MAGIC.items() if head.startswith(magic)), known)
        if reader is None:
            raise _unknown(path, suffix)
        return reader(path, source, tuple(dict.fromkeys(wanted)))
    except InputError:
        raise
    except OSError as error:
        if error.strerror:
            raise InputError(f"{path}: the log cannot be read ({error.strerror}); check its permissions") from error
        raise _unreadable(path, suffix, error) from error
    except (Exception, pl.exceptions.PanicException) as error:
        # Readers of binary formats meet corrupt bytes with whatever exception is at hand.
        raise _unreadable(path, suffix, error) from error


def _unknown(path: Path, suffix: str) -> InputError:
    return InputError(f"{path}: the format '{suffix}' is not known; save the log as one of {', '.join(_READERS)}")


def _unreadable(path: Path, suffix: str, error: BaseException) -> InputError:
    reason = " ".join(str(error).split())[:200].rstrip(". ") or type(error).__name__
    return InputError(f"{path}: the file cannot be read as {suffix[1:].upper()}, export it again or mend it: {reason}")


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1024)


def _unpacked(path: Path) -> BytesIO:
    unpacker = zlib.decompressobj(wbits=31)
    found = unpacker.decompress(path.read_bytes(), _LARGEST)
    if unpacker.unconsumed_tail:
        raise InputError(f"{path}: the log is larger than {_LARGEST >> 30} GiB when unpacked; cut it into shorter ones")
    if not unpacker.eof:
        raise InputError(f"{path}: the packed file ends too early; copy it again")
    return BytesIO(found)


def _text(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    return read_text(path, source.getvalue() if isinstance(source, BytesIO) else source.read_bytes(), wanted)


def _parquet(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    with _quiet():
        names = tuple(pl.read_parquet_schema(source))
        found = [name for name in wanted if name in names]
        frame = pl.read_parquet(source, columns=found, use_statistics=False)
    return RawTable(names, {n: _column_from_series(path, frame[n]) for n in found})


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep off the terminal what Rust writes there of corrupt bytes, before it raises."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _column_from_series(path: Path, series: pl.Series) -> RawColumn:
    kind = series.dtype
    if kind in (pl.String, pl.Categorical, pl.Enum):
        return column_from_text(series.cast(pl.String), comma_parts_cells=False)
    if isinstance(kind, pl.Datetime | pl.Duration | pl.Time):
        per_second = 1e9 if isinstance(kind, pl.Time) else {"ms": 1e3, "us": 1e6, "ns": 1e9}[kind.time_unit or "us"]
        seconds = series.to_physical().cast(pl.Float64) / per_second
        return RawColumn(seconds.fill_null(float("nan")).to_numpy().astype(np.float64), unit="s")
    if not (kind.is_numeric() or kind == pl.Boolean):
        raise not_numbers(path, series.name, f"is of type {kind}")
    values = series.cast(pl.Float64).fill_null(float("nan")).to_numpy()
    return RawColumn(np.array(values, dtype=np.float64))


def _mcap(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    raise InputError(
        f"{path}: MCAP files hold messages of many encodings, which this program does not decode; "
        "export the joint's topics as CSV or Parquet"
    )


def _zip(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    raise InputError(f"{path}: this is a zip archive or a spreadsheet; unpack it or save the table as CSV")


Reader = Callable[[Path, Path | BytesIO, tuple[str, ...]], RawTable]
_READERS: dict[str, Reader] = {
    ".csv": _text,
    ".tsv": _text,
    ".txt": _text,
    ".dat": _text,
    ".asc": _text,
    ".mat": read_mat,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".parquet": _parquet,
    ".mf4": read_mdf,
    ".mdf": read_mdf,
}
_MAGIC: dict[bytes, Reader] = {
    b"\x89HDF\r\n\x1a\n": read_hdf5,
    b"PAR1": _parquet,
    b"MATLAB ": read_mat,
    b"MDF     ": read_mdf,
    b"\x89MCAP0\r\n": _mcap,
    b"PK\x03\x04": _zip,
}
LOG_SUFFIXES = tuple(_READERS)
"""How the names of log files end."""
