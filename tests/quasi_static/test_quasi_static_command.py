"""`hdjax fit` and `close-loop` on quasi-static logs: the files that are written, and one sentence per refusal."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from invocation import run
from torque_cycles import FRICTION, K1, cycles, line, no_friction, sliders

from fitting.logs.drive_file import read_drive_file
from fitting.logs.log import read_log
from fitting.quasi_static.fit import fit_quasi_static
from fitting.quasi_static.preparation import prepare
from fitting.stored_model import StoredModel, to_json
from hdjax import TwoInertiaModel, hdc_40_050

DRIVE = "[drive]\nrated_torque = 54.0\n"


pytestmark = pytest.mark.usefixtures("own_cache")


def table(**options) -> dict[str, np.ndarray]:
    log = cycles(line, **({"rows": 400, "largest": 1e-3} | options))
    assert log.joint_torque is not None
    return {"time": log.time, "twist": log.dynamic_error - 0.4, "joint_torque": log.joint_torque}


def write(folder: Path, columns: dict[str, np.ndarray], drive: str = DRIVE) -> tuple[Path, Path]:
    log, file = folder / "log.csv", folder / "drive.toml"
    np.savetxt(
        log, np.stack(list(columns.values()), 1), delimiter=",", header=",".join(columns), comments="", fmt="%.12g"
    )
    file.write_text(drive, encoding="utf-8")
    return log, file


def refuse_constant(name: str) -> float:
    raise AssertionError(f"{name} in JSON")


def test_fit_writes_and_prints_the_report(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log, drive = write(tmp_path, table())
    assert run("fit", log, "--drive", drive, "--out", tmp_path / "out") == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["report.html", "report.json"]
    report = json.loads((tmp_path / "out/report.json").read_text(), parse_constant=refuse_constant)
    assert report["schema"] == "hdjax-report/1" and report["kind"] == "quasi-static"
    assert report["decision"] == "fit_only"
    parameters = report["before"]["parameters"]
    assert set(parameters["K"]) >= {"value", "std", "ci95", "unit", "identifiable"}
    assert parameters["K"]["ci95"][0] < K1 < parameters["K"]["ci95"][1]
    assert parameters["K"]["unit"] == "N m/rad"
    assert parameters["lost_motion"]["value"] == pytest.approx(2 * 0.04 * 54 / K1, rel=0.02)
    # The cycles reach 34 N m, so that figures at rated torque and beyond knees are unknown.
    for name in ("K2", "K3", "hysteresis_loss"):
        assert parameters[name]["value"] is None and not parameters[name]["identifiable"]
        assert any(name in note for note in report["cannot_tell"])
    assert report["before"]["rmse"]["validation"] > 0
    page = (tmp_path / "out/report.html").read_text()
    assert "Plotly.newPlot" in page and "<script src" not in page and "http-equiv" in page
    text = capsys.readouterr().out
    assert "straight line" in text and "hysteresis_width" in text and "Report:" in text


def test_lost_motion_without_rated_torque_is_unknown(tmp_path: Path) -> None:
    log, drive = write(tmp_path, table(), "")
    assert run("fit", log, "--drive", drive, "--out", tmp_path / "out") == 0
    parameters = json.loads((tmp_path / "out/report.json").read_text())["before"]["parameters"]
    assert parameters["lost_motion"]["value"] is None and "rated_torque" in parameters["lost_motion"]["reason"]


def test_blank_rows_are_left_out_and_reported(tmp_path: Path) -> None:
    columns = table()
    blank = np.arange(400) % 50 == 7
    # A value filled in and counted as measured would be far from the curve.
    columns["joint_torque"] = np.where(blank, np.nan, columns["joint_torque"])
    columns["twist"] = np.where(np.roll(blank, 1), np.nan, columns["twist"])
    log, drive = write(tmp_path, columns)
    assert run("fit", log, "--drive", drive, "--out", tmp_path / "out") == 0
    report = json.loads((tmp_path / "out/report.json").read_text())
    low, high = report["before"]["parameters"]["K"]["ci95"]
    assert low < K1 < high
    assert any("8 rows" in finding["what"] for finding in report["health"])


ANGLES = '[drive]\nreduction_ratio = 100\n[columns]\njoint_torque = "torque"\n'


def angles(turn: float = 0.0) -> dict[str, np.ndarray]:
    """Both angles of a joint that turns by `turn` [rad] at constant speed beside its twist."""
    columns = table()
    joint = turn * np.linspace(0.0, 1.0, 400)
    return {
        "time": columns["time"],
        "motor_angle": 100.0 * (joint + columns["twist"]),
        "load_angle": joint,
        "torque": columns["joint_torque"],
    }


@pytest.mark.parametrize(
    ("columns", "drive"),
    [
        (table(), ""),
        ({("dynamic_error" if k == "twist" else k): v for k, v in table().items()}, ""),
        (angles(), ANGLES),
        ({k: v for k, v in table().items() if k != "time"}, ""),
        (
            {"time": table()["time"], "load_angle": -table()["twist"], "tau": table()["joint_torque"]},
            '[columns]\njoint_torque = "tau"\n',
        ),
        (
            table() | {"twist": np.rad2deg(table()["twist"]) * 60, "joint_torque": -1e3 * table()["joint_torque"]},
            '[columns]\ntwist = { unit = "arcmin" }\njoint_torque = { unit = "mN m", sign = -1 }\n',
        ),
    ],
    ids=["twist", "dynamic error", "both angles", "no time", "locked motor", "other units"],
)
def test_equivalent_columns_give_the_same_log(tmp_path: Path, columns: dict[str, np.ndarray], drive: str) -> None:
    path, file = write(tmp_path, columns, drive)
    log = read_log(path, read_drive_file(file))
    assert log.kind == "quasi-static"
    np.testing.assert_allclose(log.dynamic_error, table()["twist"], rtol=0, atol=1e-11)
    np.testing.assert_allclose(log.joint_torque, table()["joint_torque"], rtol=1e-10)


def test_rows_at_rest_of_a_moving_joint_are_left_out_and_reported(tmp_path: Path) -> None:
    columns = angles()
    joint = np.interp(np.arange(400), [0, 80, 399], [0.0, 0.0, 2.0])
    columns |= {"motor_angle": columns["motor_angle"] + 100 * joint, "load_angle": columns["load_angle"] + joint}
    path, file = write(tmp_path, columns, ANGLES)
    drive = read_drive_file(file)
    data = prepare([read_log(path, drive)], drive)
    assert data.motion == ("one way",)
    # The speed is smoothed over several rows.
    assert 310 <= len(data.logs[0]) <= 325
    assert any("left out" in finding.consequence for finding in data.findings["log"])


def reversed_twist() -> dict[str, np.ndarray]:
    return table() | {"twist": -table()["twist"]}


@pytest.mark.parametrize(
    ("columns", "drive", "code", "words"),
    [
        (reversed_twist(), "", 1, "sign = -1"),
        (table() | {"twist": 180 / np.pi * table()["twist"] * 60}, "", 1, "arcmin"),
        (angles(turn=2.0), ANGLES.replace("100", "90"), 1, "reduction_ratio"),
        (angles(), ANGLES.replace("reduction_ratio = 100", ""), 2, "reduction_ratio"),
        (table() | {"joint_torque": np.full(400, 3.0)}, "", 1, "joint_torque"),
        (table() | {"joint_torque": np.random.default_rng(1).normal(size=400)}, "", 1, "does not follow"),
        (table() | {"twist": np.full(400, 1e-3)}, "", 1, "dynamic_error"),
        (table(), '[columns]\njoint_torque = { unit = "rad" }\n', 2, "joint_torque"),
        (table(), '[columns]\njoint_torque = "torqe"\n', 2, "torqe"),
        (table(), "[drive]\nrated_torque = -5\n", 2, "rated_torque"),
        ({"time": table()["time"], "joint_torque": table()["joint_torque"]}, "", 2, "motor_angle"),
    ],
)
def test_invalid_quasi_static_log_is_refused_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture, columns: dict[str, np.ndarray], drive: str, code: int, words: str
) -> None:
    log, file = write(tmp_path, columns, drive)
    assert run("fit", log, "--drive", file, "--out", tmp_path / "out") == code
    message = capsys.readouterr().err
    assert words in message and message.count("\n") == 1 and "Traceback" not in message
    assert not (tmp_path / "out").exists()


def test_close_loop_writes_and_prints_the_hysteresis(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log, drive = write(tmp_path, table(friction=sliders, rows=1000, twist_noise=1e-6))
    assert run("close-loop", log, "--drive", drive, "--out", tmp_path / "out") == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["report.html", "report.json"]
    report = json.loads((tmp_path / "out/report.json").read_text(), parse_constant=refuse_constant)
    assert report["schema"] == "hdjax-report/1" and report["kind"] == "quasi-static"
    assert report["decision"] == "effect_found"
    (effect,) = report["after"]["effects"]
    assert effect["family"] == "hysteresis" and effect["p_value"] <= 0.01 and 0 < effect["validation_gain"] < 1
    width = effect["parameters"]["hysteresis.width"]
    assert width["unit"] == "rad" and width["ci95"][0] < 2 * FRICTION / K1 < width["ci95"][1]
    assert width["arcmin"]["value"] == pytest.approx(np.rad2deg(width["value"]) * 60)
    assert report["after"]["rmse"]["validation"] < report["before"]["rmse"]["validation"]
    assert set(report["before"]["parameters"]["K"]) >= {"value", "std", "ci95", "unit", "identifiable"}
    assert [step["added"] for step in report["steps"]][0] is None
    friction = next(one for one in report["alternatives"] if one["family"] == "motor_friction")
    assert friction["separable"] is False and friction["separating_experiment"]
    page = (tmp_path / "out/report.html").read_text()
    assert "Plotly.newPlot" in page and "<script src" not in page and "evidence-hysteresis" in page
    text = capsys.readouterr().out
    assert "effect_found" in text and "hysteresis.width" in text and "arcmin" in text and "TIE" in text


def test_close_loop_reports_that_the_linear_curve_suffices(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log, drive = write(tmp_path, table(friction=no_friction, rows=1000))
    assert run("close-loop", log, "--drive", drive, "--out", tmp_path / "out") == 0
    report = json.loads((tmp_path / "out/report.json").read_text(), parse_constant=refuse_constant)
    assert report["decision"] == "model_sufficient" and report["after"]["effects"] == []
    assert "suffices" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("columns", "options", "code", "words"),
    [
        (reversed_twist(), [], 1, "sign = -1"),
        (table() | {"twist": np.full(400, 1e-3)}, [], 1, "dynamic_error"),
        (table(), ["--max-effects", "-1"], 2, "--max-effects"),
        (table(), ["--next-experiment"], 2, "quasi-static"),
    ],
)
def test_close_loop_refuses_invalid_input_in_one_sentence(
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    columns: dict[str, np.ndarray],
    options: list[str],
    code: int,
    words: str,
) -> None:
    log, file = write(tmp_path, columns, "")
    assert run("close-loop", log, "--drive", file, "--out", tmp_path / "out", *options) == code
    message = capsys.readouterr().err
    assert words in message and message.count("\n") == 1 and "Traceback" not in message
    assert not (tmp_path / "out").exists()


def test_fit_refuses_draws_for_a_quasi_static_log(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log, drive = write(tmp_path, table())
    assert run("fit", log, "--drive", drive, "--out", tmp_path / "out", "--posterior") == 2
    assert "quasi-static log has no draws" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_predict_refuses_a_quasi_static_log_and_names_fit(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log, drive = write(tmp_path, table())
    model = tmp_path / "model.json"
    stored = StoredModel(TwoInertiaModel(hdc_40_050()), "zero-order", 2, 4, jnp.diag(jnp.asarray([4e-14, 1e-12])))
    model.write_text(to_json(stored), encoding="utf-8")
    assert run("predict", model, log, "--drive", drive, "--out", tmp_path / "prediction.csv") == 2
    message = capsys.readouterr().err
    assert "hdjax fit" in message and message.count("\n") == 1
    assert not (tmp_path / "prediction.csv").exists()


def test_logs_of_two_kinds_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log, drive = write(tmp_path, table())
    other = tmp_path / "reduced.csv"
    values = table()
    np.savetxt(
        other,
        np.stack([values["time"], values["twist"], values["joint_torque"]], 1),
        delimiter=",",
        header="time,dynamic_error,forcing",
        comments="",
    )
    assert run("fit", log, other, "--drive", drive, "--out", tmp_path / "out") == 2
    assert "quasi-static and reduced" in capsys.readouterr().err


def lara_drive(joint: int, ratio: int, sign: int) -> str:
    return f"""
[drive]
reduction_ratio = {ratio}
[columns]
time = "Timestamp"
motor_angle = {{ column = "encoder_motorinc_{joint}", unit = "rev / 16777216" }}
load_angle = {{ column = "encoder_loadinc_{joint}", unit = "rev / 16777216" }}
joint_torque = {{ column = "joint_torque_current_{joint}", sign = {sign} }}
"""


# Measured drives: intervals must cover the slope read from the torque-twist plot. For joint 3 it is the mean
# stiffness of the curve that the authors of the data use, over the same torques (48 100 N m/rad).
@pytest.mark.parametrize(
    ("joint", "ratio", "sign", "motion", "ruler"),
    [(2, 121, -1, "held", 108e3), (3, 101, 1, "one way", 48.1e3), (5, 101, 1, "held", 12e3)],
)
def test_stiffness_intervals_of_measured_joints_cover_the_graphical_value(
    shared: Path, tmp_path: Path, joint: int, ratio: int, sign: int, motion: str, ruler: float
) -> None:
    file = tmp_path / "drive.toml"
    file.write_text(lara_drive(joint, ratio, sign), encoding="utf-8")
    drive = read_drive_file(file)
    data = prepare([read_log(shared / "data/lara8/ML1_validate.csv", drive)], drive)
    assert data.motion == (motion,)
    fit = fit_quasi_static(data.logs, hysteresis=motion == "held")
    low, high = fit.known["linear"]["K"].ci95 or (0.0, 0.0)
    assert low < ruler < high and high < 3 * low
    # One cycle with coloured residuals does not determine a nonlinearity.
    assert fit.chosen == "linear"
