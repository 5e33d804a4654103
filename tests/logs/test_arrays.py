"""Reading of MATLAB, HDF5, parquet, MDF and NumPy files: nested and matrix columns, compressed and misnamed files."""

import gzip
import shutil
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
import scipy.io

from fitting.errors import InputError
from fitting.logs.read_table import read_table

A = np.arange(300.0)
B = A**2


def mat(folder: Path, **content) -> Path:
    scipy.io.savemat(folder / "log.mat", content)
    return folder / "log.mat"


def hdf5(folder: Path, content: dict) -> Path:
    with h5py.File(folder / "log.h5", "w") as file:
        for name, values in content.items():
            file[name] = values
    return folder / "log.h5"


def values(path: Path, *names: str) -> list[np.ndarray]:
    found = read_table(path, names)
    return [found.columns[name].values for name in names]


@pytest.mark.parametrize("names", [("run.x.a", "run.b"), ("run/x/a", "run/b"), ("a", "b")])
def test_fields_of_nested_structs_are_columns(tmp_path: Path, names: tuple[str, str]):
    path = mat(tmp_path, run={"x": {"a": A}, "b": B[:, None]}, other=np.ones((2, 2)))
    found = values(path, *names)
    np.testing.assert_array_equal(found, [A, B])
    assert set(read_table(path, ()).names) == {"run.x.a", "run.b", "other"}


def test_struct_array_elements_are_numbered_from_one(tmp_path: Path):
    signals = np.array([({"values": A},), ({"values": B},)], dtype=[("signals", object)])["signals"]
    path = mat(tmp_path, out={"time": A, "signals": signals})
    np.testing.assert_array_equal(values(path, "out.signals(2).values", "out.time"), [B, A])
    with pytest.raises(InputError, match="several datasets"):
        values(path, "values")


@pytest.mark.parametrize("make", [lambda f, m: mat(f, data=m), lambda f, m: hdf5(f, {"data": m})], ids=["mat", "hdf5"])
@pytest.mark.parametrize("transposed", [False, True])
def test_matrix_columns_are_addressed_by_index(tmp_path: Path, make, transposed: bool):
    matrix = np.stack([A, B], axis=1)
    path = make(tmp_path, matrix.T if transposed else matrix)
    np.testing.assert_array_equal(values(path, "data(:,1)", "data(:, 2)"), [A, B])
    for name, word in (("data(:,3)", "number"), ("data(:,0)", "number"), ("data", "data(:,1)")):
        with pytest.raises(InputError, match="vector") as error:
            values(path, name)
        assert word in str(error.value)


def test_struct_as_column_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"struct or group.*'run\.a'"):
        values(mat(tmp_path, run={"a": A}), "run")


def test_matlab_cell_as_column_is_refused(tmp_path: Path):
    cells = np.empty(2, dtype=object)
    cells[:] = [A, "text"]
    with pytest.raises(InputError, match="MATLAB's own"):
        values(mat(tmp_path, a=cells), "a")


def test_fields_of_hdf5_table_are_columns(tmp_path: Path):
    table = np.zeros(300, dtype=[("time", "f8"), ("count", "i4")])
    table["time"], table["count"] = A, B
    path = hdf5(tmp_path, {"rig/log": table})
    np.testing.assert_array_equal(values(path, "rig/log/time", "count"), [A, B])


def test_units_of_hdf5_datasets_are_read(tmp_path: Path):
    path = hdf5(tmp_path, {"a": A, "b": B, "c": B})
    with h5py.File(path, "a") as file:
        file["a"].attrs["unit"] = "deg"
        file["b"].attrs["Units"] = np.bytes_(b"N m")
        file["c"].attrs["unit"] = 3
    found = read_table(path, ("a", "b", "c")).columns
    assert [found[name].unit for name in "abc"] == ["deg", "N m", None]


def test_struct_arrays_and_cells_of_matlab_7_3_are_numbered_from_one(tmp_path: Path):
    path = tmp_path / "log.mat"
    with h5py.File(path, "w") as file:
        held = [file.create_dataset(f"#refs#/{name}", data=np.full((1, 4), float(k))) for k, name in enumerate("abc")]
        held[2].attrs["MATLAB_object_decode"] = np.int32(3)
        struct = file.create_group("#refs#/d")
        struct["x"] = np.full((1, 4), 5.0)
        references = np.array([[held[0].ref], [held[1].ref]], dtype=h5py.ref_dtype)
        file.create_dataset("out/signals/values", data=references)
        cell = file.create_dataset("out/parts", data=np.array([[struct.ref], [held[2].ref]], dtype=h5py.ref_dtype))
        cell.attrs["MATLAB_class"] = np.bytes_("cell")
    first, second, inner = values(path, "out/signals(1)/values", "out.signals(2).values", "out/parts(1)/x")
    assert (first.tolist(), second.tolist(), inner.tolist()) == ([0.0] * 4, [1.0] * 4, [5.0] * 4)
    with pytest.raises(InputError, match=r"'out/parts\(2\)' is a table or object of MATLAB's own"):
        values(path, "out/parts(2)")


def test_sample_time_of_iddata_has_its_unit(tmp_path: Path):
    fields = {"OutputData": np.zeros((9, 2)), "InputData": np.zeros(9), "Ts": 0.5, "TimeUnit": "milliseconds"}
    scipy.io.savemat(tmp_path / "z.mat", {"z": fields})
    assert read_table(tmp_path / "z.mat", ["InputData"]).sample_rate == 2000.0


@pytest.mark.parametrize(("unit", "rate"), [("milliseconds", 2000.0), ("parsecs", None)])
@pytest.mark.parametrize("stored", ["text", "attribute", "MATLAB"])
def test_sample_time_in_hdf5_has_its_unit(tmp_path: Path, stored: str, unit: str, rate: float | None):
    path = hdf5(tmp_path, {"a": A, "Ts": 0.5})
    with h5py.File(path, "a") as file:
        if stored == "attribute":
            file.attrs["TimeUnit"] = unit
        elif stored == "text":
            file["TimeUnit"] = unit
        else:
            char = file.create_dataset("TimeUnit", data=np.array([[ord(c)] for c in unit], dtype=np.uint16))
            char.attrs["MATLAB_class"] = np.bytes_("char")
    assert read_table(path, ["a"]).sample_rate == rate
    if stored == "MATLAB":
        with pytest.raises(InputError, match="'TimeUnit' is text"):
            read_table(path, ["TimeUnit"])


def test_attribute_of_a_group_gives_the_sample_rate(tmp_path: Path):
    path = hdf5(tmp_path, {"run/a": np.arange(4.0)})
    with h5py.File(path, "a") as file:
        file.attrs["sampling_rate"] = 500.0
    assert read_table(path, ["a"]).sample_rate == 500.0


@pytest.mark.parametrize(("name", "value", "rate"), [("fs", 2000.0, 2000.0), ("Ts", 5e-4, 2000.0), ("fs", -1.0, None)])
def test_scalar_sample_rate_or_step_gives_the_sample_rate(tmp_path: Path, name: str, value: float, rate: float | None):
    for path in (mat(tmp_path, run={"a": A}, **{name: value}), hdf5(tmp_path, {"run/a": A, f"run/{name}": value})):
        assert read_table(path, ("a",)).sample_rate == (None if rate is None else pytest.approx(rate))


@pytest.mark.parametrize("kind", ["csv", "mat", "h5", "parquet"])
def test_compressed_and_misnamed_files_are_read(tmp_path: Path, kind: str):
    frame = pl.DataFrame({"a": A, "b": B})
    plain = tmp_path / f"log.{kind}"
    if kind == "csv":
        frame.write_csv(plain)
    elif kind == "parquet":
        frame.write_parquet(plain)
    else:
        (mat if kind == "mat" else lambda folder, **c: hdf5(folder, c))(tmp_path, a=A, b=B)
    packed = tmp_path / f"other.{kind}.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    np.testing.assert_array_equal(values(packed, "a", "b"), [A, B])
    if kind == "csv":
        # A logger that opens its file again appends a further part.
        whole = plain.read_bytes()
        packed.write_bytes(gzip.compress(whole[:100]) + gzip.compress(whole[100:]))
        np.testing.assert_array_equal(values(packed, "a", "b"), [A, B])
    if kind != "csv":
        # The format follows from the first bytes.
        odd = Path(shutil.copy(plain, tmp_path / "log.dat"))
        np.testing.assert_array_equal(values(odd, "a", "b"), [A, B])
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(InputError, match="too early|cannot be read"):
        values(packed, "a")


@pytest.mark.parametrize(
    ("head", "words"),
    [(b"PK\x03\x04", "zip archive"), (b"\x89MCAP0\r\n", "MCAP|mcap"), (b"\x1f\x8b", "cannot be read")],
)
def test_unsupported_formats_are_refused_by_their_first_bytes(tmp_path: Path, head: bytes, words: str):
    path = tmp_path / ("log.csv.gz" if head == b"\x1f\x8b" else "log.csv")
    path.write_bytes(head + bytes(100))
    with pytest.raises(InputError, match=words):
        values(path, "a")


def test_parquet_column_types_are_converted_to_numbers(tmp_path: Path):
    path = tmp_path / "log.parquet"
    frame = pl.DataFrame({"a": A, "s": [f"{v:.1f}" for v in A], "n": [[1.0]] * 300, "on": A > 5})
    frame.with_columns(
        t=(pl.col("a") * 1e6).cast(pl.Duration("us")), c=pl.col("s").cast(pl.Categorical), w=pl.time(12, 0, 1)
    ).write_parquet(path)
    a, s, on, t, c, w = values(path, "a", "s", "on", "t", "c", "w")
    for found in (s, t, c):
        np.testing.assert_array_equal(found, a)
    assert on.sum() == 294 and (w == 43201).all()
    with pytest.raises(InputError, match="of type List"):
        values(path, "n")


def test_mdf_without_asammdf_is_refused_with_the_extra_to_install(tmp_path: Path):
    try:
        import asammdf  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        path = tmp_path / "log.mf4"
        path.write_bytes(b"MDF     4.10    " + bytes(100))
        with pytest.raises(InputError, match=r'pip install "hdjax\[mdf\]"'):
            values(path, "a")


def test_mdf_channels_keep_their_own_time_stamps(tmp_path: Path):
    asammdf = pytest.importorskip("asammdf", reason="needs the extra mdf")
    path = tmp_path / "log.mf4"
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(A, A * 1e-3, name="angle", unit="deg")])
        file.append([asammdf.Signal(B[::2].astype("i4"), A[::2] * 1e-3, name="torque", unit="Nm")])
        file.append([asammdf.Signal(B, A * 1e-3, name="twice"), asammdf.Signal(A, A * 1e-3, name="twice")])
        file.save(path)
    found = read_table(path, ("angle", "torque", "time")).columns
    assert set(found) == {"angle", "torque"} and found["torque"].unit == "Nm"
    np.testing.assert_array_equal(found["angle"].values, A)
    np.testing.assert_allclose(found["torque"].time, A[::2] * 1e-3)
    with pytest.raises(InputError, match="several channels"):
        values(path, "twice")


def test_arrays_of_npz_file_are_columns(tmp_path: Path):
    stamps = np.datetime64("2026-11-28T12:00:00", "us") + np.arange(len(A)).astype("timedelta64[ms]")
    np.savez(tmp_path / "log.npz", t=stamps, a=A, data=np.stack([A, B], axis=1))
    table = read_table(tmp_path / "log.npz", ("t", "a", "data(:,2)", "column 0", "column 2", "column 9"))
    assert table.names == ("t", "a", "data") and not {"column 0", "column 9"} & set(table.columns)
    for name, expected in (("a", A), ("column 2", A), ("data(:,2)", B)):
        np.testing.assert_array_equal(table.columns[name].values, expected)
    assert table.columns["t"].unit == "s"
    np.testing.assert_allclose(np.diff(table.columns["t"].values), 1e-3, atol=1e-6)


def test_matrix_and_structured_array_of_npy_file_are_columns(tmp_path: Path):
    np.save(tmp_path / "matrix.npy", np.stack([A, B], axis=1))
    np.testing.assert_array_equal(values(tmp_path / "matrix.npy", "column 1", "column 2"), [A, B])
    made = np.zeros(len(A), dtype=[("a", "f8"), ("b", "f4")])
    made["a"], made["b"] = A, A
    np.save(tmp_path / "fields.npy", made)
    np.testing.assert_array_equal(values(tmp_path / "fields.npy", "a", "b"), [A, A])
    shutil.copy(tmp_path / "fields.npy", tmp_path / "log.csv")
    np.testing.assert_array_equal(values(tmp_path / "log.csv", "b"), [A])


def test_pickled_objects_in_npy_file_are_refused(tmp_path: Path):
    np.save(tmp_path / "log.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="objects of Python"):
        read_table(tmp_path / "log.npy", ("a",))
