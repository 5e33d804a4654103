"""The command line: imports, version, completion, and one line for invalid logs and arguments."""

import importlib.metadata
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from command_files import assert_one_line, reduced_table, table, write_drive, write_model, write_table
from invocation import run

import rig
from fitting.commands import main as command_line
from hdjax import hdc_40_050
from hdjax.effects.kinematic import KinematicHarmonic

pytestmark = pytest.mark.usefixtures("own_cache")


def changed(**changes: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    columns = table()
    return columns | {name: change(columns[name]) for name, change in changes.items()}


def renamed(old: str, new: str) -> dict[str, np.ndarray]:
    return {new if name == old else name: column for name, column in table().items()}


def swapped() -> dict[str, np.ndarray]:
    columns = table()
    return columns | {"motor_angle": columns["load_angle"], "load_angle": columns["motor_angle"]}


BAD_LOGS: dict[str, tuple[Callable[[], dict[str, np.ndarray]], int, Sequence[str]]] = {
    "missing column": (lambda: renamed("motor_torque", "current"), 2, ("motor_torque", "current")),
    "not a number": (lambda: changed(load_angle=lambda c: np.where(c > -9, np.nan, c)), 2, ("load_angle", "0 rows")),
    "time stands": (lambda: changed(time=np.zeros_like), 2, ("time", "is constant")),
    "time is no clock": (lambda: changed(time=lambda t: np.sin(1e6 * t)), 2, ("time", "runs backwards")),
    "other ratio": (lambda: changed(motor_angle=lambda m: 2.0 * m), 1, ("reduction_ratio", "correct the ratio")),
    "swapped sides": (swapped, 1, ("swapped",)),
    "no torque": (lambda: changed(motor_torque=np.zeros_like), 1, ("motor_torque",)),
    "no response": (lambda: changed(motor_angle=np.zeros_like, load_angle=np.zeros_like), 1, ("motor_angle",)),
    "too short": (lambda: {n: c[:150] for n, c in table().items()}, 1, ("150 rows", "200")),
    "mirrored": (lambda: changed(load_angle=np.negative), 1, ("sign = -1",)),
}


HEAVY = ("hdjax", "jax", "matplotlib", "numpy", "plotly", "polars", "scipy")


RUN_AND_PRINT_IMPORTS = """\
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
def test_version_and_help_import_no_numerical_package(arguments: Sequence[str]):
    program = RUN_AND_PRINT_IMPORTS.format(heavy=HEAVY)
    answer = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True)
    assert answer.stdout.strip()
    assert answer.stderr.split() == []


NEEDLESS = (
    *("asammdf", "blackjax", "dask", "distributed", "h5py", "jaxcont", "matplotlib", "pandas", "pint", "polars"),
    *("rich", "xarray", "zarr"),
    *("scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.stats"),
)


def test_fit_of_a_plain_log_imports_no_unnecessary_package(tmp_path: Path):
    log, drive = write_table(tmp_path / "log.csv", table()), write_drive(tmp_path)
    program = RUN_AND_PRINT_IMPORTS.format(heavy=NEEDLESS)
    command = [sys.executable, "-c", program, "fit", str(log), "--drive", str(drive), "--out", str(tmp_path / "out")]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "[Parameters]" in answer.stdout
    assert answer.stderr.split() == []


@pytest.mark.parametrize("start", [("-m", "hdjax"), ("-c", "from fitting.commands.main import main; main()")])
def test_version_option_prints_the_package_version(start: Sequence[str]):
    answer = subprocess.run([sys.executable, *start, "--version"], capture_output=True, text=True, check=True)
    assert answer.stdout.split() == [importlib.metadata.version("hdjax")]


def test_closed_output_pipe_is_not_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def broken(*arguments: object, **options: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(command_line, "app", broken)
    with (tmp_path / "shown").open("w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert run("--help") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("command", ["fit", "close-loop"])
@pytest.mark.parametrize(("columns", "code", "words"), BAD_LOGS.values(), ids=BAD_LOGS.keys())
def test_invalid_log_is_refused_in_one_line(
    command: str, columns, code: int, words, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
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
    "simulation without end": (("simulate", "--out", "out", "--duration", "inf"), ("--duration", "inf")),
    "noise that is no number": (("simulate", "--out", "out", "--noise", "nan"), ("--noise", "nan")),
    "report into a file": ((*FIT[:-1], "log.csv"), ("--out", "log.csv")),
    "report of a loop below a file": (("close-loop", *FIT[1:-1], "log.csv/below"), ("--out", "log.csv")),
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
    "speeds of a broken order": (
        ("speeds", "--model", "ripple.json"),
        ("ripple.json", "kinematic_harmonic"),
    ),
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
    "negative seed": (("simulate", "--out", "out", "--seed", "-1"), ("--seed", "-1")),
    "huge seed of a search": (("close-loop", *FIT[1:], "--seed", "99999999999"), ("--seed", "99999999999")),
    "log that is a folder": (("simulate", "--out", "."), ("--out", "folder")),
    "tables with an option": (("seed-tables", "--out", "out"), ("--out",)),
}


@pytest.mark.parametrize(("arguments", "words"), BAD_USE.values(), ids=BAD_USE.keys())
def test_invalid_arguments_are_refused_in_one_line(
    arguments, words, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / "log.csv", table())
    write_table(tmp_path / "log.xyz", table())
    write_table(tmp_path / "reduced.csv", reduced_table())
    write_drive(tmp_path)
    (tmp_path / "broken.toml").write_text("[drive\nname = 3", encoding="utf-8")
    (tmp_path / "typo.toml").write_text("[drive]\nreduction_ratoi = 50\n", encoding="utf-8")
    (tmp_path / "broken.json").write_text('{"schema": "hdjax-model/1"', encoding="utf-8")
    write_model(tmp_path, rig.reduced_model()).rename(tmp_path / "reduced.json")
    ripple = KinematicHarmonic(cosine=1e-4, n=2.5)
    write_model(tmp_path, rig.drive_model().with_effects(ripple)).rename(tmp_path / "ripple.json")
    write_model(tmp_path, rig.drive_model())
    before = sorted(p.name for p in tmp_path.iterdir() if p.name != "cache")
    assert run(*arguments) == 2
    assert_one_line(capsys, *words)
    assert sorted(p.name for p in tmp_path.iterdir() if p.name != "cache") == before


@pytest.mark.slow
def test_speeds_command_reports_the_resonant_band_of_the_preset(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert run("speeds", "--out", out) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "1840.8 rpm  primary resonance of 2 cycles per revolution" in shown.out
    assert sorted(p.name for p in out.iterdir()) == ["speeds.json", "speeds.png"]
    content = json.loads((out / "speeds.json").read_text(encoding="utf-8"))
    (band,) = content["avoid"]
    # The amplitude of an undamped linear drive is three errors where omega^2 differs by a third from omega_0^2.
    drive = hdc_40_050()
    centre = float(drive.omega_0) / 2.0 * 30.0 / np.pi
    edges = (band["start_rpm"], band["end_rpm"])
    assert edges == pytest.approx((centre * np.sqrt(2 / 3), centre * np.sqrt(4 / 3)), rel=1e-3)
    # Two motions exist where the peak lies more than 1.54 half-widths beside omega_0 (Nayfeh and Mook 1979): just so.
    peak = 0.375 * float(drive.alpha * drive.omega_0) * band["swing"] ** 2
    assert 1.0 < peak / (8.0 / (3.0 * np.sqrt(3.0)) * 0.5 * float(drive.mu)) < 1.2
    low, high = content["two_motions_rpm"]
    assert band["peak_rpm"] == pytest.approx(low, rel=1e-4) and 0.0 < high - low < 0.1


@pytest.mark.parametrize("options", [["--test", "b.csv", "c.csv"], ["--test", "b.csv", "--test", "c.csv"]])
def test_no_test_log_is_fitted(options: Sequence[str]):
    arguments = ["close-loop", "a.csv", *options, "--drive", "drive.toml", "--out", "report"]
    _, bound, _ = command_line.app.parse_args(arguments, exit_on_error=False, print_error=False)
    assert bound.args == ([Path("a.csv")],)
    assert bound.kwargs["test"] == (Path("b.csv"), Path("c.csv"))


def test_shell_completion_is_installed(tmp_path, monkeypatch):
    # The start-up file of the shell is changed as well.
    monkeypatch.setenv("HOME", str(tmp_path))
    script = tmp_path / "hdjax.bash"
    assert run("install-completion", "--shell", "bash", "--output", script) == 0
    assert {"close-loop", "--drive"} <= set(script.read_text(encoding="utf-8").replace("'", " ").split())
    assert str(script) in (tmp_path / ".bashrc").read_text(encoding="utf-8")


def test_system_error_without_a_file_is_told_in_its_own_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fails(*_: object, **__: object):
        raise OSError("no space is left")

    monkeypatch.setattr(command_line, "app", fails)
    assert run("inspect") == 2
    assert_one_line(capsys, "no space is left")
    monkeypatch.setattr(command_line, "app", lambda *_, **__: Path("/absent/a.csv").read_bytes())
    assert run("inspect") == 2
    assert_one_line(capsys, "/absent/a.csv: No such file")
