"""Logs of test data of a torque-twist curve: by how much it errs on them, and that it does not look at them."""

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


def other(**options: Any) -> Log:
    """A log of the same joint, with another zero and other noise, that begins on another branch of the loop."""
    log = cycles(seed=7, **options).rows(300, 1000)
    return replace(log, name="other", dynamic_error=log.dynamic_error + 0.02)


def report(*test: Log, fitted: Log | None = None) -> dict[str, Any]:
    log = cycles() if fitted is None else fitted
    return fit_quasi_static_logs([log], drive(), test=test, progress=lambda message: None).content


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    """The report of a fit whose test data is the other log."""
    return report(other())


def test_a_curve_errs_on_another_log_by_the_noise(found: dict[str, Any]):
    errors = found["before"]["rmse"]
    # Each is the noise of some 200 blocks, whose rms is known to 5 %.
    assert errors["test"] == pytest.approx(errors["training"], rel=0.2)
    assert [(log["name"], log["held_out"] > 0, log["test"] > 0) for log in found["logs"]] == [
        ("log", True, False),
        ("other", False, True),
    ]
    assert "on test data by" in found["summary"] and found["before"]["rmse"]["test"] < 0.01 * LARGEST


def test_what_the_curve_gets_wrong_on_another_log_is_told(found: dict[str, Any]):
    softer = other(spring=lambda x: 2.5e4 * x)
    assert report(softer)["before"]["rmse"]["test"] > 20 * found["before"]["rmse"]["test"]


def test_test_logs_change_nothing_but_test_figures(found: dict[str, Any]):
    test = other()
    noise = np.random.default_rng(0).normal(0.0, 1e-4, len(test))
    noisy, alone = report(replace(test, dynamic_error=test.dynamic_error + noise)), report()
    assert noisy["before"]["rmse"]["test"] > found["before"]["rmse"]["test"]
    assert without_test(noisy) == without_test(found) == without_test(alone)


def without_test(report: dict[str, Any]) -> dict[str, Any]:
    """A report without what test logs may change."""
    before = report["before"]
    kept = {key: one for key, one in report.items() if key not in ("before", "health", "summary", "logs")}
    return kept | {"before": before | {"rmse": before["rmse"] | {"test": None}}}


def test_torques_beyond_the_fitted_ones_are_told(found: dict[str, Any]):
    small = cycles(largest=0.5 * LARGEST)
    (note,) = (note for note in report(other(), fitted=small)["cannot_tell"] if "extrapolates" in note)
    assert note.startswith(("4", "5"))  # per cent: a triangle is above half of its amplitude half of the time
    assert not any("extrapolates" in note for note in found["cannot_tell"])


@pytest.mark.usefixtures("own_cache")
def test_fit_takes_test_logs_on_the_command_line(tmp_path: Path):
    for name, log in (("fitted", cycles()), ("test", other())):
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
    assert code_of("fit", str(tmp_path), *places) == 2
    assert code_of("fit", str(tmp_path / "fitted.csv"), *places) == 0
    told = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert told["before"]["rmse"]["test"] > 0
    assert "On test data" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def code_of(*arguments: str) -> int:
    """The exit code of a command."""
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    return int(end.value.code or 0)
