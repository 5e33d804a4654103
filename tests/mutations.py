"""Logs and drive files with random faults: bytes, columns, units, types, sizes and shapes."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from mutated_files import Random, Table, damage, write

import rig
from fitting.logs.drive_file import SIGNALS

ROWS = 600
DRIVE = {
    "drive": {"name": '"rig"', "reduction_ratio": "50", "motor_inertia": "5.26e-4", "load_inertia": "5.0e-2"},
    "signals": {"torque_hold": '"zero-order"'},
    "columns": {},
}


def healthy(seed: int) -> Table:
    """Columns of a valid drive log or, for every fifth seed, of a reduced log; the caller may write in them."""
    return {name: column.copy() for name, column in _healthy(seed).items()}


@functools.cache
def _healthy(seed: int) -> Table:
    if seed % 5 == 4:
        forcing = rig.reduced_forcing(ROWS, seed=seed)
        log = rig.reduced_log(rig.reduced_motion(forcing)[:, 0], forcing, noise=1e-3, seed=seed)
        return {"time": log.time, "dynamic_error": log.dynamic_error, "forcing": forcing}
    torque = rig.drive_torque(ROWS, seed=seed)
    log = rig.drive_log(rig.drive_motion(torque), torque, seed=seed)
    return {
        "time": log.time,
        "motor_angle": log.motor_angle,
        "load_angle": log.load_angle,
        "motor_torque": torque,
    }


def _some(random: Random, table: Table) -> str:
    return str(random.choice(list(table)))


def _places(random: Random, table: Table) -> np.ndarray:
    return random.integers(0, ROWS, int(random.choice([1, 5, 60, 300])))


def _put(random: Random, table: Table) -> None:
    value = random.choice([np.nan, np.inf, -np.inf, 0.0, 1e300, -1e300, 1e-300, 1e12, -1.0, 9.96920996838687e36])
    table[_some(random, table)][_places(random, table)] = value


def _scale(random: Random, table: Table) -> None:
    factors = [0.0, -1.0, 1e3, 1e-3, 57.3, 1e9, 1e-9, 1e200, 1e-200, 1e308, np.inf, np.nan, 50.0]
    table[_some(random, table)] *= random.choice(factors)


def _shift(random: Random, table: Table) -> None:
    table[_some(random, table)] += random.choice([1.0, -0.03, 1e6, 1.7e9, 1.7e18, 1e300])


def _constant(random: Random, table: Table) -> None:
    table[_some(random, table)][:] = random.choice([0.0, 1.0, np.nan, 1e300])


def _swap(random: Random, table: Table) -> None:
    a, b = _some(random, table), _some(random, table)
    table[a], table[b] = table[b], table[a]


def _drop_column(random: Random, table: Table) -> None:
    del table[_some(random, table)]


def _rename(random: Random, table: Table) -> None:
    odd = ["", " ", "a,b", "a\nb", '"', "tïme", "x" * 500, "1", "nan", "time", "motor_angle [deg]", "\x1b[31m", "a/b"]
    name = _some(random, table)
    table[str(random.choice(odd))] = table.pop(name)


def _wrap(random: Random, table: Table) -> None:
    name, span = _some(random, table), random.choice([2 * np.pi, 1.0, 360.0, 0.01])
    table[name] = np.mod(table[name], span)


def _round(random: Random, table: Table) -> None:
    name = _some(random, table)
    step = random.choice([1e-3, 1e-6, 1.0, 1e-2]) * max(float(np.ptp(table[name])), 1e-300)
    table[name] = np.rint(table[name] / step) * step


def _clip(random: Random, table: Table) -> None:
    name = _some(random, table)
    table[name] = np.clip(table[name], *np.sort(random.choice(table[name], 2)))


def _rows(random: Random, table: Table) -> None:
    """Remove, repeat, shuffle or reverse rows, or remove nearly all."""
    count = len(next(iter(table.values()), np.zeros(0)))
    order = np.arange(count)
    how = int(random.integers(7))
    if how == 0:
        order = np.delete(order, random.integers(0, max(1, count), 9) % max(1, count)) if count else order
    elif how == 1:
        order = np.sort(np.concatenate([order, order[::7]]))
    elif how == 2:
        order = random.permutation(order)
    elif how == 3:
        order = order[::-1]
    elif how == 4:
        order = order[: int(random.choice([0, 1, 2, 199, 201]))]
    elif how == 5:
        order = np.concatenate([order, order])
    else:
        order = np.delete(order, slice(count // 3, count // 2))
    for name in table:
        table[name] = table[name][order[order < len(table[name])]]


def _jitter(random: Random, table: Table) -> None:
    if "time" in table:
        step = np.median(np.abs(np.diff(table["time"]))) if len(table["time"]) > 1 else 1.0
        table["time"] = table["time"] + step * random.choice([0.1, 0.6, 3.0, 100.0]) * random.normal(
            size=len(table["time"])
        )


def _clock(random: Random, table: Table) -> None:
    if "time" in table:
        ticks = table["time"] * random.choice([1.0, 1e3, 1e6]) + random.choice([0.0, 65536 - 100, 2.0**32 - 1e5])
        table["time"] = np.mod(ticks, random.choice([65536.0, 2.0**32, 2.0**16 * 1e-3]))


def _hold(random: Random, table: Table) -> None:
    """A channel that is refreshed in some rows only."""
    fresh = random.uniform(size=ROWS) < random.choice([0.02, 0.1, 0.5, 0.9])
    name = _some(random, table)
    table[name] = table[name][np.maximum.accumulate(np.where(fresh, np.arange(ROWS), 0))]


def _coarse(random: Random, table: Table) -> None:
    if "time" in table:
        quantum = random.choice([1e-3, 0.01, 0.1, 1.0, 1e-7])
        table["time"] = np.floor((table["time"] + random.choice([0.0, 1.7e9])) / quantum) * quantum


def _split(random: Random, table: Table) -> None:
    """Time stamps in two columns, or their fractions alone."""
    if "time" in table:
        whole = np.floor(table["time"])
        table["time_ns"] = np.rint((table.pop("time") - whole) * 1e9)
        if random.random() < 0.7:
            table["time_s"] = whole


def _single(random: Random, table: Table) -> None:
    with np.errstate(all="ignore"):
        name = _some(random, table)
        table[name] = table[name].astype(random.choice(["f4", "i4", "i2", "?", "u8"])).astype(float)


COLUMNS: tuple[Callable[[Random, Table], None], ...] = (
    _put,
    _scale,
    _shift,
    _constant,
    _swap,
    _drop_column,
    _rename,
    _wrap,
    _round,
    _clip,
    _rows,
    _jitter,
    _clock,
    _hold,
    _coarse,
    _split,
    _single,
)


def drive_text(random: Random, spoilt: bool, columns: Mapping[str, str] = {}) -> bytes:
    """A drive file, with random faults where `spoilt`."""
    content = {table: dict(keys) for table, keys in (DRIVE | {"columns": dict(columns)}).items()}
    odd = [
        "1e400",
        "-1",
        "0",
        "nan",
        "inf",
        "true",
        '""',
        '"a\\nb"',
        "[1, 2]",
        "{ a = 1 }",
        "0x" + "f" * 6000,
        "1979-05-27",
        '"5 kg m^2"',
        '"9**9**9"',
        '"rev / 16777216"',
        '{ column = "time", unit = "deg" }',
        '{ unit = "9^9^9^9" }',
        '{ column = "", sign = -1 }',
        '{ column = "motor_angle", unit = "1e-300 rad" }',
        "{ offset = 1e300 }",
        '{ column = "motor_torque", unit = "mN m", sign = -1, offset = 3 }',
        '{ time = "time" }',
        '"time"',
        '{ unit = "ms" }',
        "3",
        "0",
        "{ column = 2, time = 1 }",
        '{ column = "time_ns", unit = "ns" }',
        '{ fraction = "time_ns" }',
        '"column 99"',
    ]
    keys = ["reduction_ratio", "motor_inertia", "load_inertia", "name", "torque_hold", "sample_rate", "nonsense"]
    keys += ["time", "motor_angle", "load_angle", "motor_torque", "temperature", "motor_velocity", "forcing"]
    for _ in range(int(random.choice([1, 1, 3])) if spoilt else 0):
        key = str(random.choice(keys))
        table = "columns" if keys.index(key) > 6 else "signals" if keys.index(key) in (4, 5) else "drive"
        table = str(random.choice(list(content))) if random.random() < 0.1 else table
        content[table][key] = str(random.choice(odd))
    lines = []
    for table, entries in content.items():
        lines += [f"[{table}]", *(f"{k} = {v}" for k, v in entries.items())]
    raw = bytearray("\n".join(lines).encode())
    if spoilt and random.random() < 0.2:
        for place in random.integers(0, len(raw), 3):
            raw[place] = int(random.integers(256))
    if spoilt and random.random() < 0.03:
        raw += b"\nx = " + b"[" * 5000
    return bytes(raw)


def spoilt_case(seed: int, folder: Path) -> tuple[Path, Path]:
    """Write a log and a drive file with random faults."""
    random = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    table = healthy(int(random.integers(20)))
    with np.errstate(all="ignore"):
        for _ in range(int(random.choice([0, 1, 1, 2, 4]))):
            change = COLUMNS[int(random.integers(len(COLUMNS)))]
            if table and all(len(c) == ROWS for c in table.values()):
                change(random, table)
        log = write(random, table, folder)
    if random.random() < 0.2:
        log = damage(random, log)
    drive = folder / "drive.toml"
    # A field of a topic has its full name.
    named = {name: f'"/{name}/data"' for name in table if name in SIGNALS[1:]} if log.suffix == ".mcap" else {}
    named |= {"time": '"time_ns"'} if "time_ns" in table else {}
    drive.write_bytes(drive_text(random, random.random() < 0.25, named))
    return log, drive
