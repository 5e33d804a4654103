"""The commands `fit`, `simulate` and `predict`: the files that they write, and what `predict` refuses."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from command_files import (
    COUNT,
    assert_one_line,
    read_table,
    reduced_table,
    table,
    write_drive,
    write_model,
    write_table,
)
from invocation import run

import rig
from fitting.estimation.initial_states import WINDOW
from hdjax.effects.thermal import ThermalStiffness

pytestmark = pytest.mark.usefixtures("own_cache")


def test_predict_needs_outputs_in_the_window_and_torque_throughout(tmp_path: Path):
    columns = table()
    columns["motor_angle"][WINDOW:] = np.nan
    columns["load_angle"][WINDOW:] = np.nan
    log = write_table(tmp_path / "log.csv", columns)
    out = tmp_path / "predicted.csv"
    model = write_model(tmp_path, rig.drive_model())
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 0
    found = read_table(out)
    assert list(found) == ["time", "dynamic_error", "motor_angle"]
    whole = table()
    x = whole["motor_angle"] / rig.N - whole["load_angle"]
    noise = np.hypot(rig.MOTOR_NOISE / rig.N, rig.LOAD_NOISE)
    np.testing.assert_allclose(found["time"], whole["time"], atol=1e-12)
    assert np.sqrt(np.mean((found["dynamic_error"] - x) ** 2)) < 2 * noise
    columns["motor_torque"][WINDOW + 5 : WINDOW + 40] = np.nan
    broken = write_table(tmp_path / "broken.csv", columns)
    other = tmp_path / "other.csv"
    assert run("predict", model, broken, "--drive", write_drive(tmp_path), "--out", other) == 1
    assert not other.exists()


def test_predict_keeps_rows_and_zero_of_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A dropped sample is interpolated and the zero is added again: the file has the rows and twist of the log."""
    columns = {name: np.delete(column, 300) for name, column in table().items()}
    columns["load_angle"] = columns["load_angle"] - 1.5
    log, out = write_table(tmp_path / "log.csv", columns), tmp_path / "predicted.csv"
    model = write_model(tmp_path, rig.drive_model())
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 0
    assert "off zero" in capsys.readouterr().err
    found = read_table(out)
    np.testing.assert_allclose(found["time"], columns["time"], atol=1e-12)
    x = columns["motor_angle"] / rig.N - columns["load_angle"]
    # The zero follows from the median of fifty samples; the interpolated torque has an error of 0.5 %.
    assert np.sqrt(np.mean((found["dynamic_error"] - x) ** 2)) < 0.1 * np.std(x)


def test_simulate_and_predict_use_a_given_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    stiffness = 6000.0
    model = write_model(tmp_path, rig.drive_model(K=stiffness))
    log, out = tmp_path / "new" / "log.csv", tmp_path / "new" / "predicted.csv"
    duration = COUNT * rig.STEP
    simulation = ("simulate", "--model", model, "--out", log, "--duration", duration, "--frequency-end", "110")
    assert run(*simulation) == 0
    assert str(log) in capsys.readouterr().out
    columns = read_table(log)
    assert list(columns) == ["time", "motor_angle", "load_angle", "motor_torque"]
    assert columns["time"].size == COUNT
    # The simulation agrees with the rig's own equations under the same torque.
    motion = rig.drive_motion(columns["motor_torque"], stiffness=stiffness)
    np.testing.assert_allclose(columns["motor_angle"], motion[:, 0], atol=1e-6 * np.max(np.abs(motion[:, 0])))
    np.testing.assert_allclose(columns["load_angle"], motion[:, 1], atol=1e-6 * np.max(np.abs(motion[:, 1])))
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 0
    assert str(out) in capsys.readouterr().out
    x = motion[:, 0] / rig.N - motion[:, 1]
    predicted = read_table(out)["dynamic_error"]
    # The initial state follows from fifty samples without noise.
    np.testing.assert_allclose(predicted, x, atol=2e-3 * np.max(np.abs(x)))
    # A model of another stiffness does not predict the log.
    blunt = write_model(tmp_path, rig.drive_model())
    assert run("predict", blunt, log, "--drive", write_drive(tmp_path), "--out", out) == 0
    assert np.max(np.abs(read_table(out)["dynamic_error"] - x)) > 0.1 * np.max(np.abs(x))


def test_diverged_prediction_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    model = write_model(tmp_path, rig.drive_model(alpha=-1e9))
    log = write_table(tmp_path / "log.csv", table())
    out = tmp_path / "predicted.csv"
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 1
    assert_one_line(capsys, str(log), "diverges")
    assert not out.exists()


def test_posterior_without_blackjax_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    log = write_table(tmp_path / "log.csv", table())
    assert run("fit", log, "--drive", write_drive(tmp_path), "--out", tmp_path / "out", "--posterior") == 2
    assert_one_line(capsys, "--posterior", "pip install 'hdjax[posterior]'")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("blackjax") is None, reason="needs blackjax, the extra `posterior`")
def test_fit_writes_posterior_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log = write_table(tmp_path / "log.csv", reduced_table())
    drive = write_drive(tmp_path, '[signals]\ntorque_hold = "zero-order"\n')
    out = tmp_path / "out"
    assert run("fit", log, "--drive", drive, "--out", out, "--posterior") == 0
    shown = capsys.readouterr()
    assert shown.err == "" and "[Posterior]" in shown.out
    assert sorted(p.name for p in out.iterdir()) == ["model.json", "posterior.parquet", "report.html", "report.json"]
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    draws = pl.read_parquet(out / "posterior.parquet")
    estimate = report["before"]["parameters"]["omega_0"]
    assert draws["omega_0"].mean() == pytest.approx(estimate["value"], abs=estimate["std"])
    assert len(draws) == report["posterior"]["chains"] * report["posterior"]["draws"]


@pytest.mark.slow
def test_predict_reproduces_the_fitted_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log = write_table(tmp_path / "log.csv", reduced_table())
    drive = write_drive(tmp_path, '[signals]\ntorque_hold = "zero-order"\n')
    out = tmp_path / "out"
    assert run("fit", log, "--drive", drive, "--out", out) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert sorted(p.name for p in out.iterdir()) == ["model.json", "report.html", "report.json"]
    parameters = json.loads((out / "report.json").read_text(encoding="utf-8"))["before"]["parameters"]
    assert parameters["omega_0"]["value"] == pytest.approx(rig.OMEGA_0, rel=0.01)
    predicted = tmp_path / "predicted.csv"
    assert run("predict", out / "model.json", log, "--drive", drive, "--out", predicted) == 0
    error = read_table(predicted)["dynamic_error"] - reduced_table()["dynamic_error"]
    assert np.sqrt(np.mean(error**2)) < 2e-3


def test_predict_without_the_temperature_of_a_thermal_model_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    warm = rig.drive_model().with_effects(ThermalStiffness(k_T=-1e-3, T_0=300.0))
    model, out = write_model(tmp_path, warm), tmp_path / "predicted.csv"
    log = write_table(tmp_path / "log.csv", table())
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 2
    message = capsys.readouterr().err
    assert "log.csv: there is no temperature, on which thermal_stiffness" in message and "[columns]" in message
    assert not out.exists()
    log = write_table(tmp_path / "log.csv", table() | {"temperature": np.linspace(295.0, 310.0, COUNT)})
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 0
