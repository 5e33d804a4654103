"""The logs and files that the commands read, generated from fixed seeds."""

import hashlib
import math
from pathlib import Path

import numpy as np

from characterisation.formats import (
    Columns,
    delimited,
    write_csv,
    write_hdf5,
    write_mat,
    write_mat73,
    write_mdf,
    write_packed_csv,
    write_parquet,
    write_tsv,
)
from characterisation.simulator import Plant, held, multisine, simulate, smooth
from characterisation.texts import DESIGNS, DOCUMENTS, DRIVES, SWEEPS

RATE = 2000.0
COUNT = 4000
NOISE = 1e-6
"""Rms noise of the load angle, and of the motor angle at the output, each [rad]."""

_DT = 1.0 / RATE
_SI = {"time": "s", "motor_angle": "rad", "load_angle": "rad", "motor_torque": "N m"}


def write_inputs(folder: Path) -> str:
    """Write all inputs.

    Args:
        folder: where to; made where it is missing.

    Returns:
        A fingerprint of the text files. It tells whether two runs read the same numbers.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "fleet").mkdir(exist_ok=True)
    (folder / "old_report").mkdir(exist_ok=True)
    for names in (DRIVES, SWEEPS, DESIGNS):
        for name, text in names.items():
            (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    for name, text in DOCUMENTS.items():
        (folder / name).write_text(text, encoding="utf-8")
    base = drive_log(Plant(), seed=1)
    _write_formats(folder, base)
    _write_drive_logs(folder, base)
    _write_quasi_static(folder)
    _write_bad(folder, base)
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".csv", ".tsv", ".toml", ".json"):
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


def drive_log(
    plant: Plant,
    *,
    seed: int,
    rms: float = 0.4,
    hold: str = "zero-order",
    load: np.ndarray | None = None,
    load_nodes: np.ndarray | None = None,
    count: int = COUNT,
) -> Columns:
    """A log of both angles and the motor torque.

    Args:
        plant: the drive.
        seed: of torque and noise.
        rms: of the torque's sum of sines [N m].
        hold: what the torque does between samples.
        load: torque on the load at the samples [N m], held by zero order; it becomes a column.
        load_nodes: torque on the load at the nodes of each interval, which no column tells.
        count: samples.
    """
    signal = multisine(rms, count * _DT, seed)
    time = _DT * np.arange(count)
    torque = signal(time)
    nodes = smooth(signal, count, _DT) if hold == "band-limited" else held(torque, hold)
    acting = load_nodes if load is None else held(load)
    angles = simulate(plant, _DT, nodes, acting)
    random = np.random.default_rng(1000 + seed)
    motor = angles[:, 0] + plant.ratio * NOISE * random.normal(size=count)
    columns = {"time": time, "motor_angle": motor, "load_angle": angles[:, 1] + NOISE * random.normal(size=count)}
    return columns | {"motor_torque": torque} | ({} if load is None else {"load_torque": load})


def _write_formats(folder: Path, base: Columns) -> None:
    write_csv(folder / "base.csv", base)
    write_packed_csv(folder / "base.csv.gz", base)
    write_tsv(folder / "base.tsv", base, _SI)
    write_mat(folder / "base_5.mat", base)
    write_mat73(folder / "base_73.mat", base, RATE)
    degrees = base | {"load_angle": np.rad2deg(base["load_angle"])}
    write_hdf5(folder / "base.h5", degrees, _SI | {"load_angle": "deg"})
    write_parquet(folder / "base.parquet", base)
    write_mdf(folder / "base.mf4", base)
    units = {
        "time": 1e3 * base["time"],
        "enc_m": 3.5 - base["motor_angle"],
        "enc_l": np.rad2deg(base["load_angle"]),
        "torque": 1e3 * base["motor_torque"],
    }
    write_csv(folder / "units.csv", units)


def _write_drive_logs(folder: Path, base: Columns) -> None:
    time = base["time"]
    write_csv(folder / "other.csv", drive_log(Plant(), seed=2))
    write_csv(folder / "small.csv", drive_log(Plant(cubic=0.1), seed=3, rms=0.02))
    for hold in ("linear", "cubic", "band-limited"):
        write_csv(folder / f"hold_{hold}.csv", drive_log(Plant(), seed=4, hold=hold))
    brake = -0.6 * (np.floor(time / 0.25) % 3)
    write_csv(folder / "brake.csv", drive_log(Plant(), seed=5, load=brake))
    for i, seed in enumerate((6, 7), start=1):
        write_csv(folder / f"kinematic_{i}.csv", drive_log(Plant(kinematic=(1.2e-4, -0.9e-4)), seed=seed))
        line = smooth(lambda t, start=seed: 0.3 * np.cos(2 * np.pi * 9.0 * t + start), COUNT, _DT)
        write_csv(folder / f"disturbed_{i}.csv", drive_log(Plant(), seed=20 + seed, load_nodes=line))
    warm = drive_log(Plant(stiffening=lambda t: 1.0 - 2e-3 * 10.0 * (t - 1.0)), seed=8)
    write_csv(folder / "warm.csv", warm | {"temperature": 25.0 + 10.0 * (time - 1.0)})
    wavy = Plant(mesh=lambda x, v: 0.3 * math.sin(x / 4e-5))
    write_csv(folder / "wavy.csv", drive_log(wavy, seed=9))
    write_csv(folder / "ugly.csv", _ugly(base))
    write_csv(folder / "gap.csv", {name: np.delete(v, slice(1500, 1700)) for name, v in base.items()})
    for name, columns in (("plain", base), ("bent", drive_log(Plant(mesh=lambda x, v: 1.5e5 * x * abs(x)), seed=10))):
        write_csv(folder / f"reduced_{name}.csv", _reduced(columns))
    for i, seed in enumerate((11, 12), start=1):
        write_csv(folder / f"fleet/joint_{i}.csv", drive_log(Plant(stiffness=7000.0 + 500.0 * i), seed=seed))
    (folder / "fleet/broken.csv").write_text("time,motor_angle\n0,1\n", encoding="utf-8")


def _ugly(base: Columns) -> Columns:
    """A log with gaps, blank cells, spikes and a row that was written twice."""
    found = {name: values.copy() for name, values in base.items()}
    found["load_angle"][200:203] = np.nan
    found["motor_angle"][900] += 0.5
    found["load_angle"][1200] -= 0.01
    for name in found:
        kept = np.delete(found[name], [*range(2000, 2300), 600, 3100])
        found[name] = np.insert(kept, 50, kept[50])
    return found


def _reduced(columns: Columns) -> Columns:
    """A reduced log in volts: 1000 V/rad and 2 V/(N m)."""
    twist = columns["motor_angle"] / 50.0 - columns["load_angle"]
    return {"time": columns["time"], "y": 1e3 * twist, "u": 2.0 * columns["motor_torque"]}


def _write_quasi_static(folder: Path) -> None:
    """Slow cycles of torque against twist: three slopes and a slider, and a straight line alone."""
    rows = 2000
    time = 0.01 * np.arange(rows)
    twist = 2.2e-3 * 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 3.0 * np.arange(rows) / rows))
    bent = np.sign(twist) * np.interp(np.abs(twist), [0.0, 5e-4, 1.28e-3, 1.0], [0.0, 15.0, 50.1, 59950.0])
    borne, friction = 0.0, []
    for step in np.diff(twist, prepend=0.0).tolist():
        borne = min(4.0, max(-4.0, borne + 3e5 * step))
        friction.append(borne)
    random = np.random.default_rng(13)
    noisy = twist + 4e-6 * random.normal(size=rows)
    for name, torque in (("cycles", bent + np.array(friction)), ("line", 3e4 * twist)):
        measured = torque + 0.3 * random.normal(size=rows)
        write_csv(folder / f"{name}.csv", {"time": time, "twist": noisy, "joint_torque": measured})


def _write_bad(folder: Path, base: Columns) -> None:
    """Logs that must be refused."""
    bad = {
        "bad_column": {name: values for name, values in base.items() if name != "load_angle"},
        "bad_nan": base | {"motor_torque": np.full(COUNT, np.nan)},
        "bad_blank_angle": base | {"load_angle": np.where(np.arange(COUNT) % 40 > 0, np.nan, base["load_angle"])},
        "bad_torque_unit": base | {"motor_torque": 1e3 * base["motor_torque"]},
        "bad_degrees": base | {name: np.rad2deg(base[name]) for name in ("motor_angle", "load_angle")},
        "bad_sides": base | {"motor_angle": base["load_angle"], "load_angle": base["motor_angle"]},
        "bad_sign": base | {"load_angle": -base["load_angle"]},
        "bad_milliseconds": base | {"time": 1e3 * base["time"]},
        "bad_constant": base | {"motor_torque": np.full(COUNT, 0.1)},
        "bad_short": {name: values[:60] for name, values in base.items()},
    }
    for name, columns in bad.items():
        write_csv(folder / f"{name}.csv", columns)
    (folder / "bad_empty.csv").write_text("", encoding="utf-8")
    (folder / "bad_header.csv").write_text(",".join(base) + "\n", encoding="utf-8")
    (folder / "bad_cut.h5").write_bytes((folder / "base.h5").read_bytes()[:3000])
    (folder / "bad_text.csv").write_text(delimited(base).replace("\n0.001,", "\nabc,", 1), encoding="utf-8")
    (folder / "bad_format.xyz").write_text(delimited(base), encoding="utf-8")
    (folder / "bad_mdf.mf4").write_bytes(b"MDF     4.10    " + bytes(200))
