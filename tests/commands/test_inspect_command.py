"""The commands `hdjax inspect` and `hdjax init`."""

from pathlib import Path

import numpy as np
import pytest
from invocation import run

from fitting.logs.drive_file import read_drive_file


def write_slow_log(path: Path, *, twist: str = "deflection", rows: int = 2000) -> Path:
    """Write a log of slow torque cycles on a spring with little friction."""
    time = np.arange(rows) / 100.0
    angle = 2e-3 * np.sin(0.5 * time)
    torque = 2e4 * angle + 2.0 * np.sign(np.cos(0.5 * time))
    noise = np.random.default_rng(0).normal(size=(2, rows))
    table = np.stack([1e3 * time, angle + 1e-6 * noise[0], torque + 0.05 * noise[1]], axis=1)
    header = f"time [ms];{twist} [rad];joint torque [N m]"
    np.savetxt(path, table, delimiter=";", header=header, comments="", fmt="%.9g")
    return path


def test_log_without_drive_file_is_fitted_after_init(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log, drive = write_slow_log(tmp_path / "run.csv"), tmp_path / "drive.toml"
    assert run("init", log, "--out", drive) == 0
    told = capsys.readouterr().out
    assert f"Drive file: {drive}" in told and "hdjax close-loop" in told and "Fill in" not in told
    assert read_drive_file(drive).columns["time"].unit == "ms"
    assert run("fit", log, "--drive", drive, "--out", tmp_path / "report") == 0
    assert (tmp_path / "report" / "report.json").exists()


def test_init_overwrites_a_drive_file_only_by_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log, drive = write_slow_log(tmp_path / "run.csv"), tmp_path / "drive.toml"
    drive.write_text("mine", encoding="utf-8")
    assert run("init", log, "--out", drive) == 2
    assert "--force" in capsys.readouterr().err and drive.read_text(encoding="utf-8") == "mine"
    assert run("init", log, "--out", drive, "--force") == 0
    assert "deflection" in drive.read_text(encoding="utf-8")
    assert run("init", log, "--out", tmp_path) == 2
    assert "is a folder" in capsys.readouterr().err


def test_logs_with_the_same_columns_are_inspected_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for name in ("a.csv", "b.csv"):
        write_slow_log(tmp_path / name)
    write_slow_log(tmp_path / "c.csv", twist="windup")
    (tmp_path / "notes.pdf").write_bytes(b"no log")
    assert run("inspect", tmp_path) == 0
    told = capsys.readouterr().out
    assert told.count("What a fit of such a log can determine:") == 2
    assert all(str(tmp_path / name) in told for name in ("a.csv", "b.csv", "c.csv"))
    assert run("init", tmp_path / "a.csv", tmp_path / "c.csv", "--out", tmp_path / "drive.toml") == 2
    assert "its columns are not those of" in capsys.readouterr().err
    assert not (tmp_path / "drive.toml").exists()


def test_files_of_a_folder_that_are_no_logs_are_told_and_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "notes.txt").write_text("a long day\n", encoding="utf-8")
    (folder / "._run.csv").write_bytes(b"\x00\x05\x16\x07")
    assert run("inspect", folder) == 2
    assert "no log" in capsys.readouterr().err
    write_slow_log(folder / "run.csv")
    assert run("inspect", folder) == 0
    told = capsys.readouterr()
    assert "run.csv: 2000 rows" in told.out
    assert told.err.startswith(f"hdjax: {folder / 'notes.txt'}: ") and told.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("inspect", "absent.csv"), ("absent.csv", "there is no such log file")),
        (("inspect", "empty"), ("empty", "no log")),
        (("inspect", "run.csv", "--joint", "3"), ("there is no joint '3'", "one drive")),
        (("inspect", "words.csv"), ("words.csv",)),
        (("init", "run.csv"), ("--out",)),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_invalid_arguments_are_refused_in_one_sentence(
    arguments: tuple[str, ...],
    words: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    write_slow_log(tmp_path / "run.csv")
    (tmp_path / "empty").mkdir()
    (tmp_path / "words.csv").write_text("name,note\nTom,good\nAnn,bad\n", encoding="utf-8")
    assert run(*arguments) == 2
    told = capsys.readouterr().err
    assert told.startswith("hdjax: ") and told.count("\n") == 1
    assert all(word in told for word in words)
