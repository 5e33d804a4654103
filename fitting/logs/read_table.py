"""Raw columns of a log file of any format, with the file's names and units."""

import gzip
import zipfile
from collections.abc import Callable, Iterable
from io import BytesIO
from pathlib import Path

from fitting.errors import InputError
from fitting.logs.arrays import read_hdf5, read_mat, read_numpy
from fitting.logs.mdf import read_mdf
from fitting.logs.raw_table import RawTable
from fitting.logs.ros import read_bag, read_mcap
from fitting.logs.text import read_text

SHEET_SUFFIXES = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods")
# Largest unpacked size; a larger file is a mistake or an attack.
_LARGEST = 2 << 30


def format_suffix(path: Path) -> str:
    """The suffix of a log's format, also if packed by gzip."""
    return path.with_suffix("").suffix.lower() if path.suffix.lower() == ".gz" else path.suffix.lower()


def read_table(path: Path, wanted: Iterable[str]) -> RawTable:
    """The wanted columns of a log file.

    Args:
        path: CSV, TSV, TXT, DAT, LVM, MAT (v5 to v7.3), HDF5, Parquet, MDF4, NPY, NPZ, a spreadsheet, MCAP or a ROS
            bag, recognised by the first bytes where possible, else by the suffix; also packed by gzip.
        wanted: Names of columns; those that the file lacks are omitted.

    Returns:
        The columns as float64 vectors.

    Raises:
        InputError: The file is missing, corrupt or of no known format, or a wanted column is
            not a vector of numbers.
    """
    suffix = format_suffix(path)
    known = _READERS.get(suffix)
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: this is no file; give the log file itself")
    if not path.exists():
        if known is None:
            raise _unknown(path, suffix)
        raise InputError(f"{path}: there is no such log file; check the path")
    kind = suffix[1:].upper()
    try:
        source: Path | BytesIO = _unpacked(path) if path.suffix.lower() == ".gz" else path
        head = source.getvalue()[:1024] if isinstance(source, BytesIO) else _head(path)
        kind, reader = next((found for magic, found in _MAGIC.items() if head.startswith(magic)), (kind, known))
        if reader is None:
            raise _unknown(path, suffix)
        return reader(path, source, tuple(dict.fromkeys(wanted)))
    except InputError:
        raise
    except OSError as error:
        if error.strerror:
            raise InputError(f"{path}: the log cannot be read ({error.strerror}); check its permissions") from error
        raise _unreadable(path, kind, error) from error
    except BaseException as error:
        # Readers of binary formats raise arbitrary exceptions on corrupt bytes; that of polars is not an `Exception`.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise _unreadable(path, kind, error) from error


def _unknown(path: Path, suffix: str) -> InputError:
    return InputError(f"{path}: the format '{suffix}' is not known; save the log as one of {', '.join(_READERS)}")


def _unreadable(path: Path, kind: str, error: BaseException) -> InputError:
    reason = " ".join(str(error).split())[:200].rstrip(". ") or type(error).__name__
    return InputError(f"{path}: the file cannot be read as {kind}, export it again or repair it: {reason}")


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1024)


def _unpacked(path: Path) -> BytesIO:
    try:
        with gzip.open(path) as file:
            found = file.read(_LARGEST + 1)
    except EOFError as error:
        raise InputError(f"{path}: the packed file ends too early; copy it again") from error
    if len(found) > _LARGEST:
        raise InputError(f"{path}: the log is larger than {_LARGEST >> 30} GiB when unpacked; cut it into shorter ones")
    return BytesIO(found)


def _text(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    return read_text(path, source.getvalue() if isinstance(source, BytesIO) else source.read_bytes(), wanted)


def _parquet(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    # Imported here: most logs are text.
    from fitting.logs.parquet import read_parquet

    return read_parquet(path, source, wanted)


def _sheets(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    from fitting.logs.sheets import read_sheets

    return read_sheets(path, source, wanted)


def _zip(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """Read a zip archive: NumPy's archive or a spreadsheet."""
    with zipfile.ZipFile(source) as archive:
        inside = archive.namelist()
    if isinstance(source, BytesIO):
        source.seek(0)
    if "xl/workbook.xml" in inside or "xl/workbook.bin" in inside or "content.xml" in inside:
        return _sheets(path, source, wanted)
    if inside and all(name.endswith(".npy") for name in inside):
        return read_numpy(path, source, wanted)
    raise InputError(f"{path}: this is a zip archive; unpack it and give the log that is inside")


Reader = Callable[[Path, Path | BytesIO, tuple[str, ...]], RawTable]
_READERS: dict[str, Reader] = {
    ".csv": _text,
    ".tsv": _text,
    ".txt": _text,
    ".dat": _text,
    ".asc": _text,
    ".lvm": _text,
    ".mat": read_mat,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".parquet": _parquet,
    ".mf4": read_mdf,
    ".mdf": read_mdf,
    ".npz": read_numpy,
    ".npy": read_numpy,
    ".mcap": read_mcap,
    ".bag": read_bag,
    ".db3": read_bag,
    **dict.fromkeys(SHEET_SUFFIXES, _sheets),
}
_MAGIC: dict[bytes, tuple[str, Reader]] = {
    b"\x89HDF\r\n\x1a\n": ("HDF5", read_hdf5),
    b"PAR1": ("Parquet", _parquet),
    b"MATLAB ": ("MAT", read_mat),
    b"MDF     ": ("MDF", read_mdf),
    b"\x89MCAP0\r\n": ("MCAP", read_mcap),
    b"#ROSBAG V2": ("ROS bag", read_bag),
    b"SQLite format 3": ("ROS bag", read_bag),
    b"\x93NUMPY": ("NPY", read_numpy),
    b"PK\x03\x04": ("zip archive", _zip),
    b"\xd0\xcf\x11\xe0": ("spreadsheet", _sheets),
}
LOG_SUFFIXES = tuple(_READERS)
"""Suffixes of log files."""
