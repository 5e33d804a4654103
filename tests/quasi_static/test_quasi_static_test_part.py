"""Test data of quasi-static logs: the error of the model on data that were not fitted."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import slow_joints
from slow_joints import RATIO, slow_joint

from fitting.errors import DataError
from fitting.logs.drive_file import DriveFile, read_drive_file
from fitting.logs.log import Log
from fitting.quasi_static.results import close_quasi_static_loop
from fitting.search_options import SearchOptions

NOISE = 4e-6
LONG: dict[str, Any] = {"cycles": 6.0, "rows": 4000, "twist_noise": NOISE}


@pytest.fixture(scope="module")
def drive_file(tmp_path_factory: pytest.TempPathFactory) -> DriveFile:
    path = Path(tmp_path_factory.mktemp("drive")) / "drive.toml"
    path.write_text(
        f'[drive]\nname = "joint"\nreduction_ratio = {RATIO}\n[columns]\ntwist = "x"\njoint_torque = "torque"\n'
    )
    return read_drive_file(path)


def report(drive_file: DriveFile, log: Log, *test: Log) -> dict[str, Any]:
    told = close_quasi_static_loop([log], drive_file, test=test, search=SearchOptions(), progress=lambda message: None)
    return told.content


EFFECTS: dict[str, tuple[slow_joints.Effect, dict[str, Any]]] = {
    "ripple": (slow_joints.ripple(3e-5, 2), {"moves": "both ways"}),
    "sliders": (slow_joints.sliders(1e-4), {}),
    "relaxation": (slow_joints.relaxation(0.3, 0.4), {"kind": "triangle"}),
}


def long_log(name: str, **options: Any) -> Log:
    effect, motion = EFFECTS[name]
    return slow_joint([effect], **LONG, **motion, **options)[0]


@pytest.fixture(scope="module")
def report_of(drive_file: DriveFile) -> Callable[[str], dict[str, Any]]:
    """Reports of single long logs by the name of their effect; they must not be changed."""
    return cache(lambda name: report(drive_file, long_log(name)))


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("named", [False, True])
def test_identified_effect_predicts_test_data_to_the_noise(
    name: str, named: bool, drive_file: DriveFile, report_of: Callable[[str], dict[str, Any]]
):
    # A separate log has another zero, and begins at another point of the cycle.
    other = replace(long_log(name, seed=5).rows(700, 4000), name="other")
    found = report(drive_file, long_log(name), other) if named else report_of(name)
    assert found["decision"] == "effect_found" and found["judged_on"] == "test"
    before, after = (found[stage]["rmse"]["test"] for stage in ("before", "after"))
    # The rest of the error is the torque's noise.
    assert after < 1.5 * NOISE < 0.3 * before
    assert [log["test"] > 0 for log in found["logs"]] == ([False, True] if named else [True])


def test_friction_is_judged_on_a_log_whose_joint_did_not_move(drive_file: DriveFile):
    moving, _ = slow_joint(moves="both ways", friction=slow_joints.coulomb(4.0), **LONG)
    held = replace(slow_joint(**LONG, seed=5)[0], name="held")
    found = report(drive_file, moving, held)
    assert "motor_friction" in {e["family"] for e in found["after"]["effects"]}
    assert np.isfinite(found["after"]["rmse"]["test"])


def test_test_log_must_have_the_signals_of_the_others(drive_file: DriveFile):
    log = long_log("ripple")
    with pytest.raises(DataError, match="has no motor_angle"):
        report(drive_file, log, replace(log, name="other", motor_angle=None))


def test_scrambled_test_data_change_only_test_figures(
    drive_file: DriveFile, report_of: Callable[[str], dict[str, Any]]
):
    log = long_log("ripple")
    scrambled = log.dynamic_error.copy()
    border = len(log) - round(0.2 * len(log))
    scrambled[border:] = np.random.default_rng(0).permutation(scrambled[border:])
    one, other = deepcopy(report_of("ripple")), report(drive_file, replace(log, dynamic_error=scrambled))
    assert one["before"]["rmse"].pop("test") < other["before"]["rmse"].pop("test")
    assert one["after"]["rmse"].pop("test") < other["after"]["rmse"].pop("test")
    for found in (one, other):
        del found["health"], found["summary"]
    assert one == other


def test_short_log_has_no_error_on_test_data(drive_file: DriveFile):
    found = report(drive_file, slow_joint([slow_joints.sliders(1e-4)], cycles=1.6)[0])
    assert found["decision"] == "effect_found" and found["judged_on"] == "selection"
    assert found["after"]["rmse"]["test"] is None and found["logs"][0]["test"] == 0
    assert any("too short to set test data aside" in note for note in found["cannot_tell"])


def test_log_that_ends_at_rest_is_fitted_whole(drive_file: DriveFile):
    """Rests are not scored, since each has a level of its own."""
    log, _ = slow_joint(moves="one way", cycles=5.0)
    found = report(drive_file, log)
    assert found["judged_on"] == "selection" and found["logs"][0]["samples"] == len(log)


def test_extrapolation_to_larger_torques_is_reported(drive_file: DriveFile):
    small, _ = slow_joint(**LONG)
    large = replace(slow_joint(**LONG, largest=90.0)[0], name="large")
    told = [note for note in report(drive_file, small, large)["cannot_tell"] if "extrapolates" in note]
    assert len(told) == 1


def test_report_lists_every_rule_with_its_outcome(report_of: Callable[[str], dict[str, Any]]):
    found = report_of("sliders")
    names = {check["name"] for check in found["rules"]}
    assert {"least_gain", "significance", "excess", "explained"} <= names
    assert all(check["outcome"] in ("holds", "fails") and check["statistic"] is not None for check in found["rules"])
