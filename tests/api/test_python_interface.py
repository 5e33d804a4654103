"""The Python interface: `load`, `fit`, `close_loop`, `predict`, `compare`, and their results."""

import dataclasses
import functools
import json
import subprocess
import sys
from pathlib import Path

import jax
import matplotlib
import numpy as np
import polars as pl
import pytest
import torque_cycles

import fitting
import fitting.loop
import rig
from fitting import DataError, InputError
from fitting.api.drawing import draw
from fitting.report.plots import Plot
from hdjax.effects import GravityLoad, TorqueBias, TorqueGain

matplotlib.use("Agg")

COUNT = 1200
DRIVE = {
    "drive": {"name": "rig", "reduction_ratio": rig.N, "motor_inertia": rig.J_M, "load_inertia": rig.J_L},
    "signals": {"torque_hold": "zero-order"},
}


def drive_columns(*, seed: int = 0, count: int = COUNT, **physics) -> dict[str, np.ndarray]:
    """Columns of a simulated drive log by name."""
    torque = rig.drive_torque(count, seed=seed)
    log = rig.drive_log(rig.drive_motion(torque, **physics), torque, seed=seed)
    assert log.motor_angle is not None and log.load_angle is not None
    return {
        "time": log.time,
        "motor_angle": log.motor_angle,
        "load_angle": log.load_angle,
        "motor_torque": torque,
    }


@pytest.fixture(scope="module")
def fit_result() -> fitting.FitResult:
    return fitting.fit(fitting.load(drive_columns(), drive=DRIVE))


@pytest.fixture(scope="module")
def loop_result() -> fitting.LoopResult:
    data = fitting.load([drive_columns(seed=s, torque_bias=0.02) for s in (0, 1)], drive=DRIVE)
    few = functools.partial(fitting.loop.close_loop, catalogue=(TorqueBias, TorqueGain, GravityLoad))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting.loop, "close_loop", few)
        return fitting.close_loop(data, test="log 2")


def same_signals(one: fitting.Data, other: fitting.Data) -> bool:
    pairs = [(a, b) for name in drive_columns(count=50) for a, b in [(getattr(d.logs[0], name) for d in (one, other))]]
    return all(np.allclose(a, b, rtol=1e-12, atol=0) for a, b in pairs)


def test_logs_are_loaded_from_arrays_frames_and_files(tmp_path: Path):
    columns = drive_columns()
    by_name = fitting.load(columns, drive=DRIVE)
    assert by_name.kind == "drive" and by_name.table["rows"].to_list() == [COUNT]
    frame = pl.DataFrame(columns)
    path, drive = tmp_path / "run.csv", tmp_path / "drive.toml"
    frame.write_csv(path)
    drive.write_text(
        f'[drive]\nname = "rig"\nreduction_ratio = {rig.N}\nmotor_inertia = {rig.J_M}\nload_inertia = {rig.J_L}\n'
        '[signals]\ntorque_hold = "zero-order"\n'
    )
    assert same_signals(by_name, fitting.load(frame, drive=DRIVE))
    assert same_signals(by_name, fitting.load(path, drive=drive))
    several = fitting.load([frame, path], drive=drive)
    assert [log.name for log in several.logs] == ["log 1", "run"]


def test_pandas_frames_and_xarray_datasets_are_loaded():
    pandas, xarray = (pytest.importorskip(name, reason=f"{name} is not installed") for name in ("pandas", "xarray"))
    columns = drive_columns()
    by_name = fitting.load(columns, drive=DRIVE)
    assert same_signals(by_name, fitting.load(pandas.DataFrame(columns), drive=DRIVE))
    degrees = xarray.Dataset({name: ("sample", values) for name, values in columns.items()})
    degrees["load_angle"] = np.rad2deg(degrees["load_angle"])
    degrees["load_angle"].attrs["units"] = "deg"
    assert same_signals(by_name, fitting.load(degrees, drive=DRIVE))


@pytest.mark.parametrize("resolution", ["s", "ms"])
def test_dates_of_any_resolution_are_stamps(resolution: str):
    columns = drive_columns()
    seconds = np.arange(len(columns["time"])).astype(f"timedelta64[{resolution}]")
    stamps = np.datetime64("2026-11-28T12:00:00", resolution) + seconds
    found = fitting.load(columns | {"time": stamps}, drive=DRIVE).logs[0]
    step = float(np.timedelta64(1, resolution) / np.timedelta64(1, "s"))
    # A double holds a quarter of a microsecond beside the seconds since 1970.
    assert np.mean(np.diff(found.time)) == pytest.approx(step, rel=1e-5)


def test_units_in_column_names_are_converted():
    columns = drive_columns()
    named = {("load_angle [mrad]" if n == "load_angle" else n): v for n, v in columns.items()}
    named["load_angle [mrad]"] = 1e3 * named["load_angle [mrad]"]
    assert same_signals(fitting.load(columns, drive=DRIVE), fitting.load(named, drive=DRIVE))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"motor_torque": None}, "motor_torque"),
        ({"load_angle": np.zeros((COUNT, 2))}, "has 2 dimensions"),
        ({"load_angle": np.array([1.0, "a"] * (COUNT // 2), dtype=object)}, "load_angle"),
    ],
    ids=["absent", "matrix", "mixed"],
)
def test_invalid_table_is_refused_with_the_name_of_the_log(change: dict, says: str):
    columns = {name: value for name, value in (drive_columns() | change).items() if value is not None}
    with pytest.raises((InputError, DataError), match=says) as told:
        fitting.load(columns, drive=DRIVE)
    assert "log 1" in str(told.value)


def test_fit_result_gives_table_text_plots_and_report(fit_result: fitting.FitResult, tmp_path: Path):
    table = fit_result.parameters
    stiffness = table.row(by_predicate=pl.col("parameter") == "K", named=True)
    assert stiffness["low"] < rig.K < stiffness["high"] and stiffness["unit"] == "N m/rad"
    assert "K" in fit_result.summary() and str(fit_result) == fit_result.summary()
    assert "<table" in fit_result._repr_html_()
    assert repr(fit_result).startswith("FitResult(") and fit_result.report["summary"] in repr(fit_result)
    for name in fit_result.plots:
        fit_result.plot(name)
        matplotlib.pyplot.close("all")
    with pytest.raises(ValueError, match="prediction-0"):
        fit_result.plot("no such picture")
    folder = fit_result.save(tmp_path / "report")
    stored = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert stored["before"]["parameters"] == fit_result.to_dict()["before"]["parameters"]


def test_names_are_escaped_in_notebooks(fit_result: fitting.FitResult):
    named = dataclasses.replace(fit_result.told, content=fit_result.report | {"name": "a <b> & c"})
    assert "<b>a &lt;b&gt; &amp; c</b>: " in dataclasses.replace(fit_result, told=named)._repr_html_()


def test_surface_is_drawn_over_its_axes():
    heat = {"type": "heatmap", "x": [0.0, 0.5, 1.0], "y": [2.0, 4.0], "z": [[1.0, None, -3.0], [0.0, 1.0, 2.0]]}
    axes = draw(Plot("surface", "found", "", "", {"data": [heat], "layout": {}}))
    # Cells extend to half of a step on either side.
    assert axes.get_xlim() == pytest.approx((-0.25, 1.25)) and axes.get_ylim() == pytest.approx((1.0, 5.0))
    assert axes.collections[0].get_clim() == (-3.0, 3.0)


def test_loop_result_names_the_missing_effect(loop_result: fitting.LoopResult):
    assert loop_result.decision == "effect_found"
    assert loop_result.effects["family"].to_list() == ["torque_sensor"]
    assert set(loop_result.rmse) == {"training", "selection", "test"}
    assert {"statistic", "threshold"} <= set(loop_result.rules.columns)
    assert loop_result.effect_parameters.height > 0
    axes = loop_result.plot("prediction")
    assert [place.get_xlabel() for place in axes][-1] == "time [s]"
    matplotlib.pyplot.close("all")


def test_prediction_uses_only_the_first_samples_of_the_outputs(loop_result: fitting.LoopResult, tmp_path: Path):
    unseen = drive_columns(seed=5, torque_bias=0.02)
    blank = unseen | {n: np.where(np.arange(COUNT) < 50, unseen[n], np.nan) for n in ("motor_angle", "load_angle")}
    known = fitting.predict(loop_result, fitting.load(unseen, drive=DRIVE))
    guessed = fitting.predict(loop_result, fitting.load(blank, drive=DRIVE, outputs_until=50))
    assert np.allclose(known.run.predicted, guessed.run.predicted, rtol=1e-9, atol=1e-15)
    assert known.is_judged and known.run.rmse < 5e-6
    assert not guessed.is_judged and "no measured output" in guessed.summary()
    np.testing.assert_allclose(
        known.run.measured[50:], (unseen["motor_angle"] / rig.N - unseen["load_angle"])[50:] - known.zero, atol=1e-12
    )
    late = unseen | {"load_angle": unseen["load_angle"] + 1e-3 * (np.arange(COUNT) >= 100)}
    wrong = fitting.predict(loop_result, fitting.load(late, drive=DRIVE)).run
    assert wrong.rmse == pytest.approx(1e-3 * np.sqrt(1 - 100 / COUNT), rel=0.02)
    folder = loop_result.save(tmp_path / "report")
    again = fitting.predict(folder / "model.json", fitting.load(unseen, drive=DRIVE))
    assert np.allclose(again.run.predicted, known.run.predicted, rtol=1e-6, atol=1e-12)
    assert pl.read_csv(again.save(tmp_path / "prediction.csv")).height == COUNT


def test_compare_tabulates_the_error_of_each_model(fit_result: fitting.FitResult, loop_result: fitting.LoopResult):
    data = fitting.load(drive_columns(seed=6, torque_bias=0.02), drive=DRIVE)
    table = fitting.compare({"without": fit_result, "with": loop_result}, data).table
    without, with_it = table["rmse"].to_list()
    assert with_it < 0.5 * without


def test_fitted_model_is_simulated_under_a_given_torque(loop_result: fitting.LoopResult):
    assert loop_result.model is not None
    times = rig.STEP * np.arange(200)
    motion = loop_result.model.simulate(np.full(200, 0.1), times)
    assert motion.dynamic_error.shape == (200,) and np.isfinite(motion.dynamic_error).all()


def test_named_test_log_is_test_data_throughout(loop_result: fitting.LoopResult):
    counted = {log["name"]: (log["training"] + log["selection"], log["test"]) for log in loop_result.report["logs"]}
    assert counted == {"log 1": (COUNT, 0), "log 2": (0, COUNT)}


def test_test_logs_are_selected_by_name(loop_result: fitting.LoopResult):
    data = fitting.load([drive_columns(), drive_columns(seed=1)], drive=DRIVE)
    assert [log.name for log in data.with_test("log 2").test] == ["log 2"]
    with pytest.raises(InputError, match="no log 'log 9'"):
        fitting.close_loop(data, test="log 9")
    with pytest.raises(InputError, match="leave one"):
        data.with_test(["log 1", "log 2"])


def test_quasi_static_logs_use_the_same_functions(tmp_path: Path):
    log = torque_cycles.cycles(torque_cycles.line, torque_cycles.no_friction)
    columns = {"time": log.time, "twist": log.dynamic_error, "joint_torque": log.joint_torque}
    data = fitting.load(columns, drive={"drive": {"name": "joint"}})
    assert data.kind == "quasi-static"
    found = fitting.fit(data)
    assert found.model is None and "K" in found.parameters["parameter"].to_list()
    assert {path.name for path in found.save(tmp_path / "report").iterdir()} == {"report.html", "report.json"}
    with pytest.raises(InputError, match="quasi-static"):
        fitting.predict(found, data)
    with pytest.raises(InputError, match="quasi-static"):
        found.with_next_experiment()
    both = fitting.load(columns, drive={"drive": {"name": "joint"}}, test=columns)
    assert fitting.fit(both).rmse["test"] > 0
    assert fitting.close_loop(both).report["judged_on"] == "test"


def test_single_precision_is_refused_with_the_remedy():
    data = fitting.load(drive_columns(), drive=DRIVE)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match="jax_enable_x64"):
            fitting.fit(data)
    finally:
        jax.config.update("jax_enable_x64", True)


def test_package_import_does_not_load_jax():
    code = "import sys, fitting; print(fitting.__version__, 'jax' in sys.modules, sorted(dir(fitting))[:2])"
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert "False" in told
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = fitting.nothing  # pyright: ignore[reportAttributeAccessIssue]
