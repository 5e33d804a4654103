"""Test logs of a torque-twist curve: the error on them, and that they do not influence the fit."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torque_cycles import cycles

from fitting.commands.main import main
from fitting.logs.drive_file import DriveFile, drive_of
from fitting.logs.log import Log
from fitting.quasi_static.results import fit_quasi_static_logs

LARGEST = 2.2e-3  # rad


def drive() -> DriveFile:
    return drive_of({"drive": {"name": "joint"}}, Path("drive"))


def other_log(**options: Any) -> Log:
    """A log of the same joint with another zero and other noise, beginning on another branch of the loop."""
    log = cycles(seed=7, **options).rows(300, 1000)
    return replace(log, name="other", dynamic_error=log.dynamic_error + 0.02)


def report(*test: Log, fitted: Log | None = None) -> dict[str, Any]:
    log = cycles() if fitted is None else fitted
    return fit_quasi_static_logs([log], drive(), test=test, progress=lambda message: None).content


@pytest.fixture(scope="module")
def fit_report() -> dict[str, Any]:
    """The report of a fit with a separate test log."""
    return report(other_log())


def test_error_on_a_test_log_equals_the_noise(fit_report: dict[str, Any]):
    errors = fit_report["before"]["rmse"]
    # Each is the rms of the noise of 200 blocks, which is known to 5 %.
    assert errors["test"] == pytest.approx(errors["training"], rel=0.2)
    assert [(log["name"], log["held_out"] > 0, log["test"] > 0) for log in fit_report["logs"]] == [
        ("log", True, False),
        ("other", False, True),
    ]
    assert "on test data by" in fit_report["summary"] and fit_report["before"]["rmse"]["test"] < 0.01 * LARGEST


def test_error_on_a_test_log_of_other_stiffness_is_reported(fit_report: dict[str, Any]):
    softer = other_log(spring=lambda x: 2.5e4 * x)
    assert report(softer)["before"]["rmse"]["test"] > 20 * fit_report["before"]["rmse"]["test"]


def test_test_logs_change_only_test_figures(fit_report: dict[str, Any]):
    test = other_log()
    noise = np.random.default_rng(0).normal(0.0, 1e-4, len(test))
    noisy, alone = report(replace(test, dynamic_error=test.dynamic_error + noise)), report()
    assert noisy["before"]["rmse"]["test"] > fit_report["before"]["rmse"]["test"]
    assert without_test_figures(noisy) == without_test_figures(fit_report) == without_test_figures(alone)


def without_test_figures(report: dict[str, Any]) -> dict[str, Any]:
    """A report without those entries that test logs may change."""
    before = report["before"]
    kept = {key: one for key, one in report.items() if key not in ("before", "health", "summary", "logs")}
    return kept | {"before": before | {"rmse": before["rmse"] | {"test": None}}}


def test_extrapolation_to_larger_torques_is_reported(fit_report: dict[str, Any]):
    small = cycles(largest=0.5 * LARGEST)
    (note,) = (note for note in report(other_log(), fitted=small)["cannot_tell"] if "extrapolates" in note)
    assert note.startswith(("4", "5"))  # percent: a triangle wave exceeds half of its amplitude half of the time
    assert not any("extrapolates" in note for note in fit_report["cannot_tell"])


@pytest.mark.usefixtures("own_cache")
def test_fit_command_accepts_test_logs(tmp_path: Path):
    for name, log in (("fitted", cycles()), ("test", other_log())):
        columns = np.stack([log.time, log.dynamic_error - 0.4, log.joint_torque], axis=1)
        np.savetxt(tmp_path / f"{name}.csv", columns, delimiter=",", header="time,twist,joint_torque", comments="")
    (tmp_path / "drive.toml").write_text('[drive]\nname = "joint"\n', encoding="utf-8")
    places = [
        "--test",
        str(tmp_path / "test.csv"),
        "--drive",
        str(tmp_path / "drive.toml"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert exit_code("fit", str(tmp_path), *places) == 2
    assert exit_code("fit", str(tmp_path / "fitted.csv"), *places) == 0
    told = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert told["before"]["rmse"]["test"] > 0
    assert "On test data" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def exit_code(*arguments: str) -> int:
    """The exit code of a command."""
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    return int(end.value.code or 0)
