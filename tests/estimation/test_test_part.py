"""Test data are used by the final figures only."""

import functools
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import fitting.loop
import rig
from fitting.commands.run_fit import close_loop_on_logs
from fitting.drive_data import read_rig
from fitting.estimation.test_part import parted
from fitting.logs.drive_file import read_drive_file
from fitting.logs.log import read_log
from fitting.search_options import SearchOptions
from hdjax.effects import CATALOGUE, Effect, MotorFriction, TorqueBias

COUNT, TEST = 1500, 300
OUTPUTS = ("motor_angle", "load_angle")
DRIVE = f"""
[drive]
reduction_ratio = {rig.N}
motor_inertia = {rig.J_M}
load_inertia = {rig.J_L}

[signals]
torque_hold = "zero-order"
"""


def write_logs(folder: Path, scrambled: bool, offset: float = 0.0) -> tuple[Path, Path]:
    """Write a log of a drive with motor friction; if scrambled, its last fifth of outputs is permuted."""
    torque = rig.drive_torque(COUNT)
    log = rig.drive_log(rig.drive_motion(torque, motor_friction=(0.03, 0.05)), torque)
    order = np.arange(COUNT)
    if scrambled:
        order[-TEST:] = np.random.default_rng(0).permutation(order[-TEST:])
    columns = {name: getattr(log, name)[order] for name in OUTPUTS}
    columns["load_angle"] = columns["load_angle"] + offset
    table = pl.DataFrame({"time": log.time, "motor_torque": torque} | columns)
    path, drive = folder / "log.csv", folder / "drive.toml"
    table.write_csv(path, float_precision=17)
    drive.write_text(DRIVE)
    return path, drive


def without_test(found: dict) -> dict:
    """A report without test figures, health of logs and computing time."""
    kept = {k: v for k, v in found.items() if k not in ("health", "seconds", "summary", "extrapolation")}
    for stage in ("before", "after"):
        for parts in (kept[stage]["rmse"], kept[stage]["rmse_motor_angle"], *kept[stage]["rmse_of_outputs"].values()):
            for part in ("test", "validation"):
                parts.pop(part, None)
    return kept


@pytest.mark.parametrize(
    "catalogue", [(MotorFriction, TorqueBias), pytest.param(CATALOGUE, marks=pytest.mark.slow)], ids=["few", "all"]
)
def test_scrambled_test_data_change_only_the_test_figures(
    catalogue: Sequence[type[Effect]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    close_loop = functools.partial(fitting.loop.close_loop, catalogue=catalogue)
    monkeypatch.setattr(fitting.loop, "close_loop", close_loop)
    found = []
    for scrambled in (False, True):
        folder = tmp_path / str(scrambled)
        folder.mkdir()
        path, drive = write_logs(folder, scrambled)
        close_loop_on_logs([path], drive, folder / "out", SearchOptions(max_effects=1))
        found.append(json.loads((folder / "out" / "report.json").read_text()))
    plain, scrambled = found
    assert plain["judged_on"] == "test" and plain["logs"][0]["test"] == TEST
    assert scrambled["after"]["rmse"]["test"] > 10 * plain["after"]["rmse"]["test"] > 0
    assert without_test(plain) == without_test(scrambled)
    models = [(tmp_path / str(s) / "out" / "model.json").read_bytes() for s in (False, True)]
    assert models[0] == models[1]


def test_both_parts_of_a_log_share_one_zero_of_twist(tmp_path: Path):
    path, drive = write_logs(tmp_path, False, offset=0.3)
    drive_file = read_drive_file(drive)
    whole = read_log(path, drive_file)
    known, test = parted(whole, drive_file)
    assert test is not None and len(known) == COUNT - TEST and len(test) == TEST
    assert known.zero == test.zero == pytest.approx(-0.3, abs=1e-4)
    np.testing.assert_allclose(test.dynamic_error + test.zero, whole.dynamic_error[-TEST:], rtol=0, atol=1e-12)


def test_short_log_has_no_test_data(tmp_path: Path):
    path, drive = write_logs(tmp_path, False)
    drive_file = read_drive_file(drive)
    short = read_log(path, drive_file).rows(0, 400)
    known, test = parted(short, drive_file)
    assert len(known) == 400 and test is None


def test_log_whose_stretches_the_border_would_shorten_too_much_has_no_test_data(tmp_path: Path):
    path, drive = write_logs(tmp_path, False)
    drive_file = read_drive_file(drive)
    whole = replace(read_log(path, drive_file).rows(0, 520), pieces=((250, 520),))
    known, test = parted(whole, drive_file)
    assert (len(known), known.pieces, test) == (520, ((250, 520),), None)


def test_log_named_as_test_data_is_used_whole(tmp_path: Path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    path, drive = write_logs(tmp_path / "one", False)
    other, _ = write_logs(tmp_path / "two", False)
    found = read_rig([path], drive, test=[other])
    assert [(e.name, len(e)) for e in found.experiments["zero-order"]] == [("one/log", COUNT)]
    assert [(e.name, len(e)) for e in found.test["zero-order"]] == [("two/log", COUNT)]
