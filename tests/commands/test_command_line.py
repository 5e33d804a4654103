"""What a user types: one sentence and an exit code where it can't be done, and a file where it can."""

import importlib.metadata
import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

import rig
from fitting.commands import main as command_line
from fitting.commands.main import main
from fitting.estimation.free_run import WINDOW
from fitting.stored_model import StoredModel, to_json
from hdjax import Model, TwoInertiaModel, hdc_40_050
from hdjax.effects.thermal import ThermalStiffness

COUNT = 600
DRIVE = """\
[drive]
name = "rig"
reduction_ratio = 50
motor_inertia = 5.26e-4
load_inertia = 5.0e-2
[signals]
torque_hold = "zero-order"
"""


pytestmark = pytest.mark.usefixtures("own_cache")


def run(*arguments: object) -> int:
    """The exit code of a command."""
    try:
        main([str(a) for a in arguments])
    except SystemExit as end:
        return 0 if end.code is None else int(end.code)
    return 0


def table() -> dict[str, np.ndarray]:
    """Columns of a healthy drive log."""
    torque = rig.drive_torque(COUNT)
    log = rig.drive_log(rig.drive_motion(torque), torque)
    return {
        "time": log.time.copy(),
        "motor_angle": log.motor_angle,
        "load_angle": log.load_angle,
        "motor_torque": torque,
    }


def reduced_table() -> dict[str, np.ndarray]:
    forcing = rig.reduced_forcing(COUNT)
    log = rig.reduced_log(rig.reduced_motion(forcing)[:, 0], forcing, noise=1e-3)
    return {"time": log.time, "dynamic_error": log.dynamic_error, "forcing": forcing}


def write_table(path: Path, columns: dict[str, np.ndarray]) -> Path:
    rows = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.12g")
    return path


def read_table(path: Path) -> dict[str, np.ndarray]:
    names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1, unpack=True), strict=True))


def write_drive(folder: Path, text: str = DRIVE) -> Path:
    path = folder / "drive.toml"
    path.write_text(text, encoding="utf-8")
    return path


def write_model(folder: Path, model: Model, **options) -> Path:
    noise = jnp.diag(jnp.asarray([4e-14, 1e-12])) if isinstance(model, TwoInertiaModel) else 1e-6 * jnp.eye(1)
    content = {"hold": "zero-order", "substeps": 2, "halo": 4, "noise": noise} | options
    path = folder / "model.json"
    path.write_text(to_json(StoredModel(model=model, **content)), encoding="utf-8")
    return path


def spoiled(**changes: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    columns = table()
    return columns | {name: change(columns[name]) for name, change in changes.items()}


def renamed(old: str, new: str) -> dict[str, np.ndarray]:
    return {new if name == old else name: column for name, column in table().items()}


def swapped() -> dict[str, np.ndarray]:
    columns = table()
    return columns | {"motor_angle": columns["load_angle"], "load_angle": columns["motor_angle"]}


BAD_LOGS: dict[str, tuple[Callable[[], dict[str, np.ndarray]], int, Sequence[str]]] = {
    "missing column": (lambda: renamed("motor_torque", "current"), 2, ("motor_torque", "current")),
    "not a number": (lambda: spoiled(load_angle=lambda c: np.where(c > -9, np.nan, c)), 2, ("load_angle", "0 rows")),
    "time stands": (lambda: spoiled(time=np.zeros_like), 2, ("time", "is constant")),
    "time is no clock": (lambda: spoiled(time=lambda t: np.sin(1e6 * t)), 2, ("time", "runs backwards")),
    "other ratio": (lambda: spoiled(motor_angle=lambda m: 2.0 * m), 1, ("reduction_ratio", "correct the ratio")),
    "swapped sides": (swapped, 1, ("swapped",)),
    "no torque": (lambda: spoiled(motor_torque=np.zeros_like), 1, ("motor_torque",)),
    "no response": (lambda: spoiled(motor_angle=np.zeros_like, load_angle=np.zeros_like), 1, ("motor_angle",)),
    "too short": (lambda: {n: c[:150] for n, c in table().items()}, 1, ("150 rows", "200")),
    "mirrored": (lambda: spoiled(load_angle=np.negative), 1, ("sign = -1",)),
}


HEAVY = ("hdjax", "jax", "matplotlib", "numpy", "plotly", "polars", "scipy")
ANSWER_AND_TELL = """\
import sys
from fitting.commands.main import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert not end.code, end.code
print(*(name for name in {heavy!r} if name in sys.modules), file=sys.stderr)
"""


@pytest.mark.parametrize(
    "arguments",
    [("--version",), ("--help",), ("fit", "--help"), ("inspect", "--help"), ("speeds", "--help"), ("sweep", "--help")],
    ids=" ".join,
)
def test_what_needs_no_computation_imports_nothing_for_it(arguments: Sequence[str]):
    program = ANSWER_AND_TELL.format(heavy=HEAVY)
    answer = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True)
    assert answer.stdout.strip()
    assert answer.stderr.split() == []


NEEDLESS = (
    *("asammdf", "blackjax", "dask", "distributed", "h5py", "jaxcont", "matplotlib", "pandas", "pint", "polars"),
    *("rich", "xarray", "zarr"),
    *("scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.stats"),
)


def test_a_fit_of_a_plain_log_imports_no_more_than_it_needs(tmp_path: Path):
    log, drive = write_table(tmp_path / "log.csv", table()), write_drive(tmp_path)
    program = ANSWER_AND_TELL.format(heavy=NEEDLESS)
    command = [sys.executable, "-c", program, "fit", str(log), "--drive", str(drive), "--out", str(tmp_path / "out")]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "[Parameters]" in answer.stdout
    assert answer.stderr.split() == []


@pytest.mark.parametrize("start", [("-m", "hdjax"), ("-c", "from fitting.commands.main import main; main()")])
def test_the_version_is_that_of_the_package(start: Sequence[str]):
    answer = subprocess.run([sys.executable, *start, "--version"], capture_output=True, text=True, check=True)
    assert answer.stdout.split() == [importlib.metadata.version("hdjax")]


def test_a_reader_that_leaves_early_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def broken(*arguments: object, **options: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(command_line, "app", broken)
    with (tmp_path / "shown").open("w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert run("--help") == 0
    assert capsys.readouterr().err == ""


def assert_one_line(capsys: pytest.CaptureFixture[str], *words: str):
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("hdjax: ")
    assert shown.err.count("\n") == 1, shown.err
    assert shown.err.endswith("\n")
    assert "Traceback" not in shown.err
    for word in words:
        assert word in shown.err


@pytest.mark.parametrize("command", ["fit", "close-loop"])
@pytest.mark.parametrize(("columns", "code", "words"), BAD_LOGS.values(), ids=BAD_LOGS.keys())
def test_bad_logs(command: str, columns, code: int, words, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log = write_table(tmp_path / "log.csv", columns())
    out = tmp_path / "out"
    assert run(command, log, "--drive", write_drive(tmp_path), "--out", out) == code
    assert_one_line(capsys, str(log), *words)
    assert not out.exists()


FIT = ("fit", "log.csv", "--drive", "drive.toml", "--out", "out")
BAD_USE: dict[str, tuple[Sequence[str], Sequence[str]]] = {
    "missing log": (("fit", "absent.csv", "--drive", "drive.toml", "--out", "out"), ("absent.csv",)),
    "missing drive file": (("fit", "log.csv", "--drive", "absent.toml", "--out", "out"), ("absent.toml",)),
    "no log": (("fit", "--drive", "drive.toml", "--out", "out"), ()),
    "no drive file": (("fit", "log.csv", "--out", "out"), ("--drive",)),
    "no out": (("fit", "log.csv", "--drive", "drive.toml"), ("--out",)),
    "unknown option": (("fit", "log.csv", "--drive", "drive.toml", "--out", "out", "--fast"), ("--fast",)),
    "unknown subcommand": (("calibrate", "log.csv"), ("calibrate",)),
    "broken drive file": (("fit", "log.csv", "--drive", "broken.toml", "--out", "out"), ("broken.toml", "TOML")),
    "unknown key": (("fit", "log.csv", "--drive", "typo.toml", "--out", "out"), ("reduction_ratoi", "did you mean")),
    "draws of a folder": (
        ("fit", ".", "--drive", "drive.toml", "--out", "out", "--posterior"),
        ("--posterior", "folder"),
    ),
    "unknown format": (("fit", "log.xyz", "--drive", "drive.toml", "--out", "out"), ("log.xyz",)),
    "negative number of effects": (
        ("close-loop", "log.csv", "--drive", "drive.toml", "--out", "out", "--max-effects", "-1"),
        ("--max-effects",),
    ),
    "number that is none": (
        ("close-loop", "log.csv", "--drive", "drive.toml", "--out", "out", "--max-effects", "many"),
        ("many",),
    ),
    "logs of different kinds": (
        ("fit", "log.csv", "reduced.csv", "--drive", "drive.toml", "--out", "out"),
        ("log.csv",),
    ),
    "broken model": (("predict", "broken.json", "log.csv", "--drive", "drive.toml", "--out", "out"), ("broken.json",)),
    "missing model": (("predict", "absent.json", "log.csv", "--drive", "drive.toml", "--out", "out"), ("absent.json",)),
    "reduced log, drive model": (
        ("predict", "model.json", "reduced.csv", "--drive", "drive.toml", "--out", "out"),
        ("reduced.csv", "model.json"),
    ),
    "unknown preset": (("simulate", "--out", "out", "--preset", "HFUC"), ("HFUC", "HDC-40-050")),
    "no rate": (("simulate", "--out", "out", "--rate", "0"), ("--rate",)),
    "no line in the band": (
        ("simulate", "--out", "out", "--frequency", "10", "--frequency-end", "10.01", "--duration", "0.55"),
        ("--frequency",),
    ),
    "folder that is a file": (
        ("simulate", "--out", "log.csv/out.csv", "--duration", "0.05", "--forcing", "harmonic"),
        ("log.csv",),
    ),
    "negative stiffness": (("amplitudes", "--K", "-1"), ("--K", "-1")),
    "cubic coefficient that is no number": (("amplitudes", "--alpha", "nan"), ("--alpha", "nan")),
    "endless torque": (("amplitudes", "--motor-torque", "inf"), ("--motor-torque", "inf")),
    "torques that cancel": (("amplitudes", "--motor-torque", "0"), ("--motor-torque", "cancel")),
    "negative frequency": (("amplitudes", "--omega", "100", "-5"), ("--omega", "-5")),
    "no frequency": (("amplitudes", "--omega", "--alpha", "1"), ("--omega",)),
    "no such drive": (("amplitudes", "--preset", "HFUC"), ("HFUC", "HDC-40-050")),
    "no such model": (("amplitudes", "--model", "absent.json"), ("absent.json",)),
    "amplitudes of a broken model": (("amplitudes", "--model", "broken.json"), ("broken.json",)),
    "stiffness of a reduced model": (("amplitudes", "--model", "reduced.json", "--K", "1"), ("reduced.json", "--K")),
    "pictures into a file": (("amplitudes", "--out", "log.csv"), ("--out", "log.csv")),
    "speeds into a file": (("speeds", "--out", "log.csv/below"), ("--out", "log.csv")),
    "negative damping": (("speeds", "--B_sp", "-0.1"), ("--B_sp", "-0.1")),
    "speeds of a reduced model": (("speeds", "--model", "reduced.json"), ("reduced.json", "two inertias")),
    "speeds of a broken model": (("speeds", "--model", "broken.json"), ("broken.json",)),
    "speeds without a range": (("speeds", "--slowest", "500", "--fastest", "500"), ("--slowest", "--fastest")),
    "speed without end": (("speeds", "--fastest", "inf"), ("--fastest", "inf")),
    "speed beyond everything": (("speeds", "--fastest", "1e6"), ("--fastest", "36817")),
    "speed below zero": (("speeds", "--slowest", "-3"), ("--slowest", "-3")),
    "kinematic error that is no number": (("speeds", "--kinematic-error", "nan"), ("--kinematic-error",)),
    "limit of nothing": (("speeds", "--limit", "0"), ("--limit",)),
    "next experiment of no length": ((*FIT, "--next-experiment", "--duration", "0.001"), ("--duration", "0.1 s")),
    "next experiment without torque": (
        ("close-loop", *FIT[1:], "--next-experiment", "--largest-torque", "-1"),
        ("--largest-torque", "-1"),
    ),
    "next experiment of a folder": (
        ("fit", ".", *FIT[2:], "--next-experiment"),
        ("--next-experiment", "name its logs"),
    ),
    "speed of a reduced log": (
        ("fit", "reduced.csv", *FIT[2:], "--next-experiment", "--largest-speed", "3"),
        ("--largest-speed", "no motor"),
    ),
    "limits of no experiment": ((*FIT, "--largest-torque", "1"), ("--largest-torque", "--next-experiment")),
    "tables with an option": (("seed-tables", "--out", "out"), ("--out",)),
}


@pytest.mark.parametrize(("arguments", "words"), BAD_USE.values(), ids=BAD_USE.keys())
def test_bad_use(arguments, words, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / "log.csv", table())
    write_table(tmp_path / "log.xyz", table())
    write_table(tmp_path / "reduced.csv", reduced_table())
    write_drive(tmp_path)
    (tmp_path / "broken.toml").write_text("[drive\nname = 3", encoding="utf-8")
    (tmp_path / "typo.toml").write_text("[drive]\nreduction_ratoi = 50\n", encoding="utf-8")
    (tmp_path / "broken.json").write_text('{"schema": "hdjax-model/1"', encoding="utf-8")
    write_model(tmp_path, rig.reduced_model()).rename(tmp_path / "reduced.json")
    write_model(tmp_path, rig.drive_model())
    before = sorted(p.name for p in tmp_path.iterdir() if p.name != "cache")
    assert run(*arguments) == 2
    assert_one_line(capsys, *words)
    assert sorted(p.name for p in tmp_path.iterdir() if p.name != "cache") == before


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


def test_predict_keeps_the_rows_and_the_zero_of_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A dropped sample is bridged inside, and an encoder's offset put back: the file has the log's own rows and x."""
    columns = {name: np.delete(column, 300) for name, column in table().items()}
    columns["load_angle"] = columns["load_angle"] - 1.5
    log, out = write_table(tmp_path / "log.csv", columns), tmp_path / "predicted.csv"
    model = write_model(tmp_path, rig.drive_model())
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 0
    assert "off zero" in capsys.readouterr().err
    found = read_table(out)
    np.testing.assert_allclose(found["time"], columns["time"], atol=1e-12)
    x = columns["motor_angle"] / rig.N - columns["load_angle"]
    # The zero is known from the median of fifty samples of motion, and the bridged torque to half a percent.
    assert np.sqrt(np.mean((found["dynamic_error"] - x) ** 2)) < 0.1 * np.std(x)


def test_simulate_and_predict_a_model_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
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
    # What was simulated is what the rig's own equations say of the same torque.
    motion = rig.drive_motion(columns["motor_torque"], stiffness=stiffness)
    np.testing.assert_allclose(columns["motor_angle"], motion[:, 0], atol=1e-6 * np.max(np.abs(motion[:, 0])))
    np.testing.assert_allclose(columns["load_angle"], motion[:, 1], atol=1e-6 * np.max(np.abs(motion[:, 1])))
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 0
    assert str(out) in capsys.readouterr().out
    x = motion[:, 0] / rig.N - motion[:, 1]
    predicted = read_table(out)["dynamic_error"]
    # The start is known from fifty samples without noise.
    np.testing.assert_allclose(predicted, x, atol=2e-3 * np.max(np.abs(x)))
    # Another drive would not do.
    blunt = write_model(tmp_path, rig.drive_model())
    assert run("predict", blunt, log, "--drive", write_drive(tmp_path), "--out", out) == 0
    assert np.max(np.abs(read_table(out)["dynamic_error"] - x)) > 0.1 * np.max(np.abs(x))


def test_a_prediction_that_leaves_the_numbers_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    model = write_model(tmp_path, rig.drive_model(alpha=-1e9))
    log = write_table(tmp_path / "log.csv", table())
    out = tmp_path / "predicted.csv"
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 1
    assert_one_line(capsys, str(log), "diverges")
    assert not out.exists()


def test_draws_without_the_extra_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    log = write_table(tmp_path / "log.csv", table())
    assert run("fit", log, "--drive", write_drive(tmp_path), "--out", tmp_path / "out", "--posterior") == 2
    assert_one_line(capsys, "--posterior", "pip install 'hdjax[posterior]'")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("blackjax") is None, reason="needs blackjax, the extra `posterior`")
def test_fit_with_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
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
def test_fit_then_predict(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
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


@pytest.mark.slow
def test_speeds_to_avoid_of_the_preset(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert run("speeds", "--out", out) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "1840.8 rpm  primary resonance of 2 cycles per revolution" in shown.out
    assert sorted(p.name for p in out.iterdir()) == ["speeds.json", "speeds.png"]
    content = json.loads((out / "speeds.json").read_text(encoding="utf-8"))
    (band,) = content["avoid"]
    # Undamped and linear, the swing is three errors where omega^2 differs from omega_0^2 by a third of it.
    centre = float(hdc_40_050().omega_0) / 2.0 * 30.0 / np.pi
    edges = (band["start_rpm"], band["end_rpm"])
    assert edges == pytest.approx((centre * np.sqrt(2 / 3), centre * np.sqrt(4 / 3)), rel=1e-3)
    assert content["two_motions_rpm"] is None


def test_predict_asks_for_the_temperature_that_a_model_depends_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    warm = rig.drive_model().with_effects(ThermalStiffness(k_T=-1e-3, T_0=300.0))
    model, out = write_model(tmp_path, warm), tmp_path / "predicted.csv"
    log = write_table(tmp_path / "log.csv", table())
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 2
    message = capsys.readouterr().err
    assert "log.csv: there is no temperature, on which thermal_stiffness" in message and "[columns]" in message
    assert not out.exists()
    log = write_table(tmp_path / "log.csv", table() | {"temperature": np.linspace(295.0, 310.0, COUNT)})
    assert run("predict", model, log, "--drive", write_drive(tmp_path), "--out", out) == 0


def test_shell_completion_is_installed(tmp_path, monkeypatch):
    # The start-up file of the shell is written to as well.
    monkeypatch.setenv("HOME", str(tmp_path))
    script = tmp_path / "hdjax.bash"
    assert run("install-completion", "--shell", "bash", "--output", script) == 0
    assert {"close-loop", "--drive"} <= set(script.read_text(encoding="utf-8").replace("'", " ").split())
    assert str(script) in (tmp_path / ".bashrc").read_text(encoding="utf-8")
