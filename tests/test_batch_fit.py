"""Fits of all logs of a folder: one table, refusals of single logs, and resumption of interrupted runs."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest

import fitting.batch_fit
import rig
from fitting.batch_fit import Row, find_logs, fit_fleet, fleet_text, parameter_columns
from fitting.errors import DataError, InputError
from fitting.uncertainty.identifiability import Identifiability
from fitting.uncertainty.standard_errors import Estimate, Uncertainty
from fitting.validation.account import Account

COUNT = 1200
DRIVE = '[drive]\nname = "cells"\n[signals]\ntorque_hold = "zero-order"\n'


def write_log(path: Path, *, seed: int = 0, omega_0: float = rig.OMEGA_0) -> Path:
    forcing = rig.reduced_forcing(COUNT, seed=seed)
    motion = rig.reduced_motion(forcing, omega_0=omega_0)
    log = rig.reduced_log(motion[:, 0], forcing, noise=1e-3, seed=seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.stack([log.time, log.dynamic_error, forcing], axis=1)
    np.savetxt(path, rows, delimiter=",", header="time,dynamic_error,forcing", comments="", fmt="%.12g")
    return path


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    path = tmp_path / "all.toml"
    path.write_text(DRIVE, encoding="utf-8")
    return path


@pytest.fixture
def attempted_logs(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The logs of which a fit was attempted; all succeed at once."""
    seen: list[Path] = []

    def fit(log: Path, name: str, drive: Path) -> Row:
        seen.append(log)
        return {"log": name, "drive": str(drive), "state": "fitted", "message": ""}

    monkeypatch.setattr(fitting.batch_fit, "_fit_one", fit)
    return seen


def test_each_log_of_a_folder_is_fitted_separately(tmp_path: Path, drive: Path):
    frequencies = {"a.csv": 80.0, "deeper/b.csv": 100.0}
    for seed, (name, omega_0) in enumerate(frequencies.items()):
        write_log(tmp_path / "logs" / name, seed=seed, omega_0=omega_0)
    (tmp_path / "logs" / "bad.csv").write_text("time,dynamic_error\n0,1\n", encoding="utf-8")
    table = fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    rows = {row["log"]: row for row in table.iter_rows(named=True)}
    assert list(rows) == ["a.csv", "bad.csv", "deeper/b.csv"]
    for name, omega_0 in frequencies.items():
        row = rows[name]
        assert (row["state"], row["message"]) == ("fitted", "")
        assert abs(row["omega_0"] - omega_0) < 5 * row["omega_0_std"]
        assert row["omega_0_low"] < row["omega_0"] < row["omega_0_high"]
        assert row["omega_0_identifiable"] and row["omega_0_note"] == "" and row["omega_0_interval"] == "curvature"
        assert row["samples"] == COUNT
    assert rows["bad.csv"]["state"] == "refused"
    assert "bad.csv" in rows["bad.csv"]["message"]
    assert rows["bad.csv"]["omega_0"] is None
    assert rows["bad.csv"]["omega_0_note"] is None
    assert pl.read_parquet(tmp_path / "out" / "fleet.parquet").equals(table)
    assert "3 logs: 2 fitted, 1 refused" in fleet_text(table)


def test_finished_logs_are_not_fitted_again(tmp_path: Path, drive: Path, attempted_logs: list[Path]):
    logs = [write_log(tmp_path / "logs" / f"{i}.csv", seed=i) for i in range(3)]
    first = fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    assert sorted(attempted_logs) == logs
    attempted_logs.clear()
    assert fit_fleet(tmp_path / "logs", drive, tmp_path / "out").equals(first)
    assert not attempted_logs
    write_log(logs[1], seed=7)
    fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    assert attempted_logs == [logs[1]]
    attempted_logs.clear()
    drive.write_text(DRIVE + "# another file\n", encoding="utf-8")
    fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    assert sorted(attempted_logs) == logs


def test_interrupted_run_is_resumed(tmp_path: Path, drive: Path, monkeypatch: pytest.MonkeyPatch):
    logs = [write_log(tmp_path / "logs" / f"{i}.csv", seed=i) for i in range(4)]
    seen: list[Path] = []
    limit = 2

    def fit(log: Path, name: str, drive: Path) -> Row:
        if len(seen) == limit:
            raise KeyboardInterrupt
        seen.append(log)
        return {"log": name, "drive": str(drive), "state": "fitted", "message": ""}

    monkeypatch.setattr(fitting.batch_fit, "_fit_one", fit)
    # One log at a time.
    monkeypatch.setattr(fitting.batch_fit.os, "cpu_count", lambda: 1)
    with pytest.raises(KeyboardInterrupt):
        fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    assert not (tmp_path / "out" / "fleet.parquet").exists()
    limit = len(logs)
    table = fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    assert seen == logs
    assert len(table) == 4


def test_refused_log_is_tried_again(tmp_path: Path, drive: Path, monkeypatch: pytest.MonkeyPatch):
    """It may be accepted once a missing package is installed."""
    write_log(tmp_path / "logs" / "0.csv")

    def refuse(logs: list[Path], drive: Path, **how: bool):
        raise InputError(f"{logs[0]}: install it")

    with monkeypatch.context() as patched:
        patched.setattr(fitting.batch_fit, "read_rig", refuse)
        assert fit_fleet(tmp_path / "logs", drive, tmp_path / "out")["state"].to_list() == ["refused"]
    # The results may be in the folder of the logs.
    for _ in range(2):
        assert fit_fleet(tmp_path / "logs", drive, tmp_path / "logs")["state"].to_list() == ["fitted"]


def test_exception_in_one_fit_does_not_stop_the_others(tmp_path: Path, drive: Path, monkeypatch: pytest.MonkeyPatch):
    for i in range(2):
        write_log(tmp_path / "logs" / f"{i}.csv", seed=i)

    def broken(logs: list[Path], drive: Path, **how: bool):
        if logs[0].name == "0.csv":
            raise ZeroDivisionError("oops")
        raise DataError(f"{logs[0]}: no")

    monkeypatch.setattr(fitting.batch_fit, "read_rig", broken)
    table = fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    assert table["state"].to_list() == ["failed", "refused"]
    assert "ZeroDivisionError: oops" in table["message"][0]


def test_drive_file_beside_a_log_takes_precedence(tmp_path: Path, drive: Path, monkeypatch: pytest.MonkeyPatch):
    write_log(tmp_path / "logs" / "one" / "log.csv")
    own = tmp_path / "logs" / "one" / "drive.toml"
    own.write_text(DRIVE, encoding="utf-8")
    write_log(tmp_path / "logs" / "two" / "log.csv", seed=1)
    used: dict[str, Path] = {}

    def note(logs: list[Path], drive: Path, **how: bool):
        used[logs[0].parent.name] = drive
        raise DataError("no")

    monkeypatch.setattr(fitting.batch_fit, "read_rig", note)
    fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    assert used == {"one": own, "two": drive}


def test_corrupted_record_is_recomputed(tmp_path: Path, drive: Path, attempted_logs: list[Path]):
    write_log(tmp_path / "logs" / "0.csv")
    fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    (record,) = (tmp_path / "out" / "finished").iterdir()
    record.write_text("{", encoding="utf-8")
    attempted_logs.clear()
    fit_fleet(tmp_path / "logs", drive, tmp_path / "out")
    assert len(attempted_logs) == 1


def test_log_files_of_a_folder_are_found(tmp_path: Path):
    for name in ("b.CSV", "a.parquet", "c.csv.gz", "notes.md", ".hidden.csv", ".cache/c.csv", "out/old.csv"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    assert [p.name for p in find_logs(tmp_path, apart_from=tmp_path / "out")] == ["a.parquet", "b.CSV", "c.csv.gz"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no log files"):
        find_logs(tmp_path / "empty", apart_from=tmp_path / "out")


def test_unidentifiable_parameter_has_its_reason_in_the_table():
    """The reason is beside the flag, in the units of the log."""
    estimates = {
        "alpha": Estimate("alpha", 1.0, 2.0, 2.0, (-3.0, 5.0), "1/[x]^2", False),
        "mu": Estimate("mu", 1.0, 0.1, 0.1, (0.8, 1.2), "1/s", True),
    }
    nothing = np.zeros((0, 0))
    found = Identifiability({"alpha": "alpha is at most 5 1/[x]^2"}, (), (), {})
    account = Account(rig.reduced_model(), Uncertainty(estimates, nothing, nothing, nothing), (), (), (), found)
    columns = parameter_columns(account, {"dynamic_error": "V", "forcing": "A"})
    assert columns["alpha_note"] == "alpha is at most 5 1/V^2" and columns["mu_note"] == ""
    assert (columns["alpha_low"], columns["alpha_identifiable"]) == (-3.0, False)


@pytest.mark.slow
def test_dask_workers_give_the_same_table(tmp_path: Path, drive: Path):
    pytest.importorskip("distributed", reason="needs the extra `sweep`, which is not installed")
    for i in range(3):
        log = tmp_path / "logs" / f"{i}.csv"
        log.parent.mkdir(exist_ok=True)
        log.write_text(f"time,dynamic_error\n0,{i}\n", encoding="utf-8")
    done = []
    there = fit_fleet(tmp_path / "logs", drive, tmp_path / "a", workers=2, progress=lambda *now: done.append(now))
    here = fit_fleet(tmp_path / "logs", drive, tmp_path / "b")
    assert done == [(1, 3), (2, 3), (3, 3)]
    assert there["state"].to_list() == ["refused"] * 3
    assert there.drop("seconds").equals(here.drop("seconds"))


def test_unreachable_scheduler_is_reported(tmp_path: Path, drive: Path):
    pytest.importorskip("distributed", reason="needs the extra `sweep`, which is not installed")
    import dask

    write_log(tmp_path / "logs" / "a.csv")
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        with pytest.raises(InputError, match="no Dask scheduler answers at tcp://127.0.0.1:9"):
            fit_fleet(tmp_path / "logs", drive, tmp_path / "out", scheduler="tcp://127.0.0.1:9")
