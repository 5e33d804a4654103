"""Tables written as files of every format with random faults of that format, and damage of random bytes."""

import gzip
import json
from importlib.util import find_spec
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import scipy.io
from workbooks import workbook

Table = dict[str, np.ndarray]
Random = np.random.Generator


def _text(random: Random, table: Table) -> bytes:
    delimiter = str(random.choice([",", ";", "\t", "|", " "]))
    comma = delimiter != "," and random.random() < 0.4
    count = max((len(c) for c in table.values()), default=0)
    if "time" in table and random.random() < 0.1:
        # A time column before each signal.
        pairs = [(("time", table["time"]), (name, values)) for name, values in table.items() if name != "time"]
        names, columns = zip(*(column for pair in pairs for column in pair), strict=True) if pairs else ((), ())
    else:
        names, columns = tuple(table), tuple(table.values())
    after = str(random.choice([" sec", "ms", " N m"])) if random.random() < 0.1 else ""
    lines = [delimiter.join(names)]
    if random.random() < 0.2:
        lines.append(delimiter.join(str(random.choice(["s", "rad", "deg", "N m", "?", "1"])) for _ in names))
    for i in range(count):
        cells = [f"{c[i]:.9g}" if i < len(c) else "" for c in columns]
        cells = [cells[0] + after, *cells[1:]] if cells else cells
        lines.append(delimiter.join(c.replace(".", ",") if comma else c for c in cells))
    for _ in range(int(random.choice([0, 0, 1, 5, 50]))):
        odd = ["", "#", ",,,,,,", "overload", '"', "\x00", "1;2;3", "1" * 400, "é", "12:00:00", "'", "\t" * 50]
        lines.insert(int(random.integers(0, len(lines) + 1)), str(random.choice(odd)))
    ending = str(random.choice(["\n", "\r\n", "\r", delimiter + "\n"]))
    return (ending.join(lines) + ending).encode(
        str(random.choice(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1"])), errors="replace"
    )


def _shape(random: Random, values: np.ndarray) -> object:
    kind = int(random.integers(12))
    shapes: dict[int, object] = {
        0: values[None, :],
        1: values[:, None],
        2: np.stack([values, values], axis=1),
        3: values.astype(complex),
        4: values.astype("f4"),
        5: "text",
        6: {"a": {"b": values}},
        7: values[: len(values) // 2],
        8: np.zeros((0, 3)),
    }
    return shapes.get(kind, values)


def _mat(random: Random, table: Table, path: Path) -> None:
    held = {
        k if k.isascii() and k.isidentifier() and not k.startswith("_") else f"v{i}": v
        for i, (k, v) in enumerate(table.items())
    }
    content: dict[str, object] = {k[:31]: _shape(random, v) if random.random() < 0.2 else v for k, v in held.items()}
    if random.random() < 0.3:
        for _ in range(int(random.choice([1, 3, 20]))):
            content = {"nest": content}
    scipy.io.savemat(path, content | {"fs": float(random.choice([2000.0, 0.0, np.nan, 1e300]))})


def _hdf5(random: Random, table: Table, path: Path) -> None:
    group = "/".join(["g"] * int(random.choice([0, 0, 1, 40])))
    with h5py.File(path, "w") as file:
        for i, (name, values) in enumerate(table.items()):
            value = _shape(random, values) if random.random() < 0.2 else values
            plain = "".join(c for c in name if c.isalnum() or c == "_") or f"v{i}"
            place = f"{group}/{plain[:60]}" if group else plain[:60]
            if not isinstance(value, dict) and place not in file:
                file[place] = value
                file[place].attrs["unit"] = str(random.choice(["", "", "", "", "rad", "bogus", "9**9**9"]))


def _lvm(random: Random, table: Table) -> bytes:
    """A LabVIEW measurement file, with random lines of its header left out."""
    decimal = str(random.choice([".", ","]))
    head = ["LabVIEW Measurement", "Separator\tTab", f"Decimal_Separator\t{decimal}"]
    head += [f"X_Columns\t{random.choice(['One', 'Multi', 'No'])}", "***End_of_Header***", ""]
    section = ["Channels\t3", "Y_Unit_Label\trad\trad\tNm", f"Delta_X\t0{decimal}0005", "***End_of_Header***"]
    lines = [line for line in (*head, *section) if random.random() < 0.95]
    lines.append("\t".join([*table, "Comment"]))
    for row in zip(*table.values(), strict=False):
        lines.append("\t".join(f"{value:.9g}".replace(".", decimal) for value in row))
        if random.random() < 0.002:
            lines += [*section, "\t".join(table)]
    return "\r\n".join(lines).encode("latin-1", errors="replace")


def _numpy(random: Random, table: Table, path: Path) -> None:
    held = {f"v{i}" if "/" in k or "\0" in k or k == "file" else k: v for i, (k, v) in enumerate(table.items())}
    shaped = {k: np.asarray(_shape(random, v)) if random.random() < 0.1 else v for k, v in held.items()}
    np.savez(path, **shaped)


def _sheet(random: Random, table: Table, path: Path) -> None:
    first = int(random.integers(1, 6))
    letters = "ABCDEFGHIJKL"[int(random.integers(3)) :]
    names = {n: "".join(c for c in n if c.isalnum() or c in "_ ")[:60] for n in table}
    rows: dict[int, dict[str, object]] = {first: dict(zip(letters, names.values(), strict=False))}
    for i, row in enumerate(zip(*table.values(), strict=False)):
        cells = ((c, float(v)) for c, v in zip(letters, row, strict=False))
        rows[first + 1 + i] = {c: v if np.isfinite(v) else "n/a" for c, v in cells}
    workbook(path, {1: {"A": "nothing"}}, rows)


def _mcap(random: Random, table: Table, path: Path) -> None:
    from mcap.writer import Writer  # pyright: ignore[reportMissingImports]

    with path.open("wb") as file:
        out = Writer(file)
        out.start()
        schema = out.register_schema("any", "jsonschema", b"{}")
        encoding = "json" if random.random() < 0.95 else "protobuf"
        topics = {name: out.register_channel(f"/{name}", encoding, schema) for name in table}
        for i in range(max(map(len, table.values()), default=0)):
            for name, values in table.items():
                if i < len(values) and random.random() < 0.999:
                    value = float(values[i]) if np.isfinite(values[i]) else None
                    when = 1_700_000_000_000_000_000 + i * 500_000
                    out.add_message(topics[name], when, json.dumps({"data": value}).encode(), when)
        out.finish()


WRITERS = {"mat": _mat, "h5": _hdf5, "npz": _numpy}
"""Writers of binary formats."""
if find_spec("fastexcel"):
    WRITERS["xlsx"] = _sheet
if find_spec("mcap") and find_spec("rosbags"):
    WRITERS["mcap"] = _mcap


def write(random: Random, table: Table, folder: Path) -> Path:
    """Write a log file of a random format."""
    kind = str(random.choice(["csv", "csv", "csv", "tsv", "txt", "lvm", "csv.gz", "parquet", *WRITERS]))
    path = folder / f"log.{kind}"
    if kind in WRITERS:
        WRITERS[kind](random, table, path)
        return path
    if kind == "lvm":
        path.write_bytes(_lvm(random, table))
    elif kind == "parquet":
        count = min((len(c) for c in table.values()), default=0)
        pl.DataFrame({k: v[:count] for k, v in table.items()}).write_parquet(path)
    else:
        raw = _text(random, table)
        path.write_bytes(gzip.compress(raw) if kind.endswith("gz") else raw)
    return path


def damage(random: Random, path: Path) -> Path:
    """Change, remove or insert bytes of a file, or change its suffix."""
    raw = bytearray(path.read_bytes())
    how = int(random.integers(6))
    if how == 0 and raw:
        for place in random.integers(0, len(raw), int(random.choice([1, 10, 200]))):
            raw[place] = int(random.integers(256))
    elif how == 1:
        raw = raw[: int(random.integers(0, len(raw) + 1))]
    elif how == 2:
        place = int(random.integers(0, len(raw) + 1))
        raw[place:place] = random.bytes(int(random.choice([1, 100, 5000])))
    elif how == 3:
        raw = raw[int(random.integers(0, len(raw) + 1)) :]
    elif how == 4:
        raw = bytearray(random.bytes(int(random.choice([0, 1, 2000]))))
    path.write_bytes(bytes(raw))
    if how == 5:
        path = path.rename(
            path.with_name(
                f"log{random.choice(['.csv', '.mat', '.h5', '.parquet', '.gz', '.xyz', '', '.npz', '.xlsx', '.mcap'])}"
            )
        )
    return path
