"""Logs as named arrays: MATLAB files of all versions, HDF5 and NumPy files."""

import re
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from fitting.errors import InputError
from fitting.logs.raw_table import RawColumn, RawTable, not_numbers
from fitting.logs.units import UnitError, convert

# Names of scalar sample rates beside the data in MATLAB and HDF5 files.
_RATE_NAMES = ("fs", "Fs", "FS", "sample_rate", "sampling_rate", "sampling_frequency", "SampleRate")
_STEP_NAMES = ("Ts", "dt", "sample_time")
_STEP_UNIT = "TimeUnit"
_UNIT_NAMES = ("unit", "units", "Unit", "Units")
_DEEPEST = 12


def read_mat(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """The wanted vectors of a MATLAB file.

    Args:
        path: for messages.
        source: the data to read.
        wanted: names such as "T", "run.T", "logs(2).T" or "data(:,3)"; the last part alone where it is unique.
    """
    # Imported here: they take as long as all other imports for a CSV file.
    import scipy.io

    if _is_hdf5(source):
        return read_hdf5(path, source, wanted)
    held = scipy.io.loadmat(source, simplify_cells=True)
    arrays: dict[str, Any] = {}
    for name, value in held.items():
        if not name.startswith("__"):
            _flatten(name, value, arrays, _DEEPEST)
    return _table(path, arrays, wanted, ".", lambda name: arrays[name], lambda name: None)


def _is_hdf5(source: Path | BytesIO) -> bool:
    """Whether a file is HDF5; MATLAB puts 512 bytes of its own before it."""
    with source.open("rb") if isinstance(source, Path) else BytesIO(source.getvalue()[:4096]) as file:
        head = file.read(4096)
    return any(head[at : at + 8] == b"\x89HDF\r\n\x1a\n" for at in (0, 512, 1024, 2048))


def read_hdf5(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """The wanted datasets of an HDF5 file.

    Args:
        path: for messages.
        source: the data to read.
        wanted: paths such as "run/T", "run/table/T" (a field of a compound dataset), "run/data(:,3)", or of MATLAB's
            struct arrays and cells "logs(2)/T" and "data(2)"; the last part alone where it is unique.
    """
    import h5py

    with h5py.File(source, "r") as file:
        held: dict[str, tuple[Any, str | None]] = {}
        rates: dict[str, tuple[Any, str | None]] = {}

        def note(name: str, item: Any, depth: int = 0) -> None:
            # MATLAB v7.3 stores what cells and struct arrays refer to under "#refs#".
            if name.startswith("#") or depth > _DEEPEST:
                return
            if isinstance(item, h5py.Group):
                keys = [key for key in (*_RATE_NAMES, *_STEP_NAMES, _STEP_UNIT) if key in item.attrs]
                rates.update({f"{name}/{key}".lstrip("/"): (item.attrs[key], None) for key in keys})
                if depth:
                    item.visititems(lambda inner, of: note(f"{name}/{inner}", of, depth))
            elif h5py.check_ref_dtype(item.dtype) is not None:
                group, _, leaf = name.rpartition("/")
                cell = item.attrs.get("MATLAB_class") == b"cell" or not group
                for i, reference in enumerate(item[()].ravel()):
                    if reference:
                        at = f"{name}({i + 1})" if cell else f"{group}({i + 1})/{leaf}"
                        note(at, file[reference], depth + 1)
            else:
                fields = item.dtype.names or (None,)
                held.update({name if f is None else f"{name}/{f}": (item, f) for f in fields})

        note("", file)
        file.visititems(note)
        held |= {name: rate for name, rate in rates.items() if name not in held}

        def load(name: str) -> Any:
            item, field = held[name]
            if not isinstance(item, h5py.Dataset):
                return item
            if item.attrs.get("MATLAB_empty", 0):
                return np.zeros(0)
            if "MATLAB_object_decode" in item.attrs:
                raise not_numbers(path, name, "is a table or object of MATLAB's own", "save its columns as vectors")
            if item.attrs.get("MATLAB_class") == b"char":
                return "".join(map(chr, np.ravel(item[()])))
            return item[()] if field is None else item[field]

        def unit(name: str) -> str | None:
            attributes = getattr(held[name][0], "attrs", {})
            return _text(next((attributes[a] for a in _UNIT_NAMES if a in attributes), None))

        return _table(path, held, wanted, "/", load, unit)


def read_numpy(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """The wanted vectors of a NumPy file.

    Args:
        path: for messages.
        source: the data to read.
        wanted: names of arrays (NPZ), of the fields of a structured array, or "data(:,3)"; in a file of one matrix
            "column 3".
    """
    try:
        loaded = np.load(source, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            arrays = {"data": loaded}
        else:
            with loaded:
                arrays = dict(loaded)
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        raise InputError(f"{path}: the file holds objects of Python; save arrays of numbers in it") from error
    held: dict[str, Any] = {}
    for name, array in arrays.items():
        if array.dtype.names is None:
            held[name] = array
        for field in array.dtype.names or ():
            held[field if len(arrays) == 1 else f"{name}/{field}"] = array[field]
    return _table(path, held, wanted, "/", lambda name: held[name], lambda name: None)


def _text(value: object) -> str | None:
    value = np.asarray(value).reshape(-1)[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    value = value.decode("utf-8", errors="replace") if isinstance(value, bytes) else value
    return value.strip() or None if isinstance(value, str) else None


def _flatten(name: str, value: Any, arrays: dict[str, Any], deepest: int) -> None:
    """Name members of structs "outer.inner", and those of struct arrays "outer(1).inner"."""
    if deepest == 0:
        return
    if isinstance(value, Mapping):
        for key, inner in value.items():
            _flatten(f"{name}.{key}", inner, arrays, deepest - 1)
        return
    items = value if isinstance(value, list) or _is_cell(value) else ()
    structs = [
        (i, item) for i, item in enumerate(np.ravel(np.asarray(items, dtype=object))) if isinstance(item, Mapping)
    ]
    for i, item in structs:
        _flatten(f"{name}({i + 1})", item, arrays, deepest - 1)
    if not structs:
        arrays[name] = value


def _is_cell(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind == "O"


def _table(
    path: Path,
    held: Mapping[str, Any],
    wanted: tuple[str, ...],
    parting: str,
    load: Callable[[str], Any],
    unit: Callable[[str], str | None],
) -> RawTable:
    """The wanted columns of named arrays, and a sample rate stored with them."""
    columns: dict[str, RawColumn] = {}
    rate: float | None = None
    for asked in wanted:
        name, column = _place(path, asked, held, parting)
        if name is None:
            continue
        array = np.asarray(load(name))
        stamps = array.dtype.kind in "mM"
        columns[asked] = RawColumn(_vector(path, asked, array, column), "s" if stamps else unit(name))
        beside = name.rpartition(parting)[0]
        around = [beside + parting if beside else "", ""]
        rate = rate or _rate(lambda key, at=around: next((load(a + key) for a in at if a + key in held), None))
    return RawTable(tuple(held), columns, rate)


def _place(path: Path, asked: str, held: Mapping[str, Any], parting: str) -> tuple[str | None, int | None]:
    """The array of that name, or the only one with that last name; and its column, counted from zero."""
    if asked in held:
        return asked, None
    # By number: of one matrix, or of the arrays in order.
    number = re.fullmatch(r"column ([0-9]{1,4})", asked)
    names = list(held)
    if number and len(names) == 1:
        return names[0], int(number[1]) - 1
    if number:
        return dict(enumerate(names, start=1)).get(int(number[1])), None
    match = re.fullmatch(r"(.*)\(\s*:\s*,\s*([0-9]{1,6})\s*\)", asked)
    plain, column = (match[1], int(match[2]) - 1) if match else (asked, None)
    plain = plain.strip("/")
    for form in (plain, plain.replace(".", parting), plain.replace("/", parting)):
        if form in held:
            return form, column
    leaves = [name for name in held if name.rpartition(parting)[2] == plain]
    if len(leaves) > 1:
        raise InputError(
            f"{path}: '{asked}' is the name of several datasets ({', '.join(leaves[:6])}); "
            "give the full path of one of them in [columns] of the drive file"
        )
    inside = [name for name in held if name.startswith(plain + parting)]
    if inside and not leaves:
        raise not_numbers(path, plain, "is a struct or group", f"name what is inside, such as '{inside[0]}'")
    return (leaves[0], column) if leaves else (None, None)


def _vector(path: Path, name: str, data: Any, column: int | None) -> np.ndarray:
    if type(data).__name__ in ("MatlabOpaque", "MatlabFunction") or _is_cell(data):
        raise not_numbers(path, name, "is a cell, table or object of MATLAB's own", "store it with double()")
    array = _seconds(np.asarray(data))
    if array.dtype.names is not None or array.dtype.kind not in "biuf":
        kind = "a struct" if array.dtype.names else "text" if array.dtype.kind in "SUO" else "complex"
        raise not_numbers(path, name, f"is {kind}")
    if column is not None:
        # MATLAB v7.3 keeps its matrices transposed; the long side is time.
        array = array.T if array.ndim == 2 and array.shape[1] > array.shape[0] else array
        if array.ndim != 2 or not 0 <= column < array.shape[1]:
            raise not_numbers(
                path, name, f"is not there, since the shape is {array.shape}", "correct the column's number"
            )
        array = array[:, column]
    if array.size != max(array.shape, default=1):
        raise not_numbers(path, name, f"has shape {array.shape}", f'pick a column as "{name}(:,1)"')
    return array.reshape(-1).astype(np.float64)


def _seconds(array: np.ndarray) -> np.ndarray:
    """Dates (since 1970) and durations in seconds; other arrays unchanged."""
    if array.dtype.kind not in "mM":
        return array
    whole = array.astype(f"{array.dtype.kind}8[ns]")
    return np.where(np.isnat(whole), np.nan, whole.astype(np.int64) * 1e-9)


def _rate(get: Callable[[str], Any]) -> float | None:
    for name in (*_RATE_NAMES, *_STEP_NAMES):
        array = np.asarray(get(name))
        if array.size == 1 and array.dtype.kind in "iuf" and 0 < array.item() < np.inf:
            value = float(array.item())
            return value if name in _RATE_NAMES else _rate_of_step(value, _text(get(_STEP_UNIT)))
    return None


def _rate_of_step(step: float, unit: str | None) -> float | None:
    """Samples per second; None where the unit is not known."""
    try:
        return 1.0 / (step * float(convert(np.array(1.0), unit or "s", "s")))
    except UnitError:
        return None
