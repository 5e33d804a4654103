"""Drive files proposed by `inspect`: readable as written, and sufficient for a fit once open lines are filled in."""

import re
import tomllib
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from joint_logs import SHAPES
from simulated_joint import Motion, simulated

import fitting
from fitting.inspection import settling
from fitting.logs.drive_file import read_drive_file

FILLED = {"motor_inertia": "3e-4", "load_inertia": "1.2", "reduction_ratio": "100", "sample_rate": "1000"}


@pytest.fixture(scope="module")
def motion() -> Motion:
    return simulated(count=3000)


def fill_in(text: str) -> str:
    """Replace the open lines of a drive file by the drive's values."""
    for key, number in FILLED.items():
        text = re.sub(rf"^# {key} = \S+  # FILL IN.*$", f"{key} = {number}", text, flags=re.MULTILINE)
    return text


@pytest.mark.parametrize("name", SHAPES)
def test_drive_file_holds_the_detected_signals(name: str, motion: Motion, tmp_path: Path):
    found = fitting.inspect(SHAPES[name].columns(motion), joint=SHAPES[name].joint)
    path = found.save(tmp_path / "drive.toml")
    drive = read_drive_file(path)
    told = {s: g for s, g in found.inspection.joint.signals.items() if s in drive.columns}
    for signal, guess in told.items():
        place = drive.columns[signal]
        assert (place.column, place.unit, place.sign) == (guess.column, guess.unit, float(guess.sign))
    # A current needs its torque constant; all other detected signals are written.
    assert set(found.inspection.joint.signals) - set(told) <= {"motor_current"}
    # Each value to fill in has a line.
    assert all(key.split()[-1].strip("'") in path.read_text(encoding="utf-8") for key in found.unknown)


READ_AT_ONCE = {"twist and joint torque": "quasi-static", "input and output": "reduced"}
READ_WHEN_FILLED = ("own names", "symbols of papers", "German PLC", "degrees that nobody states", "an angle that wraps")


@pytest.mark.parametrize("name", [*READ_AT_ONCE, *READ_WHEN_FILLED])
def test_log_is_read_with_its_proposed_drive_file(name: str, motion: Motion, tmp_path: Path):
    columns = SHAPES[name].columns(motion)
    found = fitting.inspect(columns)
    text = found.drive_file()
    if name in READ_AT_ONCE:
        assert found.unknown == {}
    else:
        assert set(found.unknown) == {"[drive] motor_inertia", "[drive] load_inertia"}
        text = fill_in(text)
    (tmp_path / "drive.toml").write_text(text, encoding="utf-8")
    data = fitting.load(columns, tmp_path / "drive.toml")
    assert data.kind == READ_AT_ONCE.get(name, "drive")
    if data.kind == "drive":
        log = data.logs[0]
        assert log.motor_angle is not None and log.motor_torque is not None
        # Units and signs are correct: the checks pass, and the twist is that of the simulation.
        data.rig(other_holds=False)
        twist = motion.motor_angle / 100 - motion.load_angle
        error = log.dynamic_error - log.dynamic_error.mean() - (twist - twist.mean())
        assert np.std(error) < 1e-3 * np.std(twist)


@pytest.mark.slow
def test_fit_with_a_proposed_drive_file_recovers_the_stiffness(tmp_path: Path):
    columns = SHAPES["German PLC"].columns(simulated(count=1200))
    (tmp_path / "drive.toml").write_text(fill_in(fitting.inspect(columns).drive_file()), encoding="utf-8")
    fit = fitting.fit(fitting.load(columns, tmp_path / "drive.toml"))
    values = dict(zip(fit.parameters["parameter"], fit.parameters["value"], strict=True))
    assert abs(values["K"] / 2e4 - 1) < 0.02


@settings(max_examples=15)
@given(st.lists(st.text(min_size=1, max_size=12), min_size=3, max_size=3, unique=True))
def test_arbitrary_column_names_are_valid_in_the_drive_file(names: list[str]):
    motion = simulated(count=800)
    channels = {"motor_angle": motion.motor_angle, "load_angle": motion.load_angle, "motor_torque": motion.motor_torque}
    renamed = {f"{n}_{signal}": v for n, (signal, v) in zip(names, channels.items(), strict=True)}
    found = fitting.inspect({"time": motion.time} | renamed)
    tables = tomllib.loads(found.drive_file())
    assert tables["columns"].items() >= found.drive["columns"].items()


def test_percent_as_unit_is_left_to_be_filled_in(motion: Motion):
    columns = {"t": motion.time, "motor angle [deg]": np.rad2deg(motion.motor_angle)}
    columns |= {"output angle [deg]": np.rad2deg(motion.load_angle), "motor torque [%]": 100 * motion.motor_torque}
    found = fitting.inspect(columns)
    assert "motor_torque" not in found.drive["columns"]
    assert "the size of one '%'" in found.unknown["[columns] motor_torque"]
    assert '# motor_torque = { column = "motor torque", unit = "..." }  # FILL IN' in found.drive_file()


@pytest.mark.parametrize("unit", ["ustep", "V"])
def test_angle_in_a_unit_that_is_none_is_left_to_be_filled_in(unit: str, motion: Motion):
    columns = {"t": motion.time, f"motor_angle [{unit}]": motion.motor_angle, "load_angle": motion.load_angle}
    found = fitting.inspect(columns | {"motor_torque": motion.motor_torque})
    assert "motor_angle" not in found.drive["columns"]
    assert f"the size of one '{unit}', such as \"0.27 rad\"" in found.unknown["[columns] motor_angle"]
    # The range is told in the unit of the log.
    assert found.excitations[0].ranges["motor_angle"][2] == unit


def test_temperature_in_degrees_celsius_is_told_in_kelvin(motion: Motion):
    columns = SHAPES["own names"].columns(motion) | {"Temperature [°C]": np.linspace(20.0, 30.0, motion.time.size)}
    low, high, unit = fitting.inspect(columns).excitations[0].ranges["temperature"]
    assert (low, high, unit) == (pytest.approx(293.15), pytest.approx(303.15), "K")


def test_log_with_columns_of_one_name_is_read_with_its_drive_file(motion: Motion, tmp_path: Path):
    log = tmp_path / "log.csv"
    rows = np.column_stack([motion.time, motion.motor_angle, motion.load_angle, motion.motor_torque])
    np.savetxt(log, rows, delimiter=",", header="Time,Position,Position,Torque", comments="")
    found = fitting.inspect(log)
    assert all(finding.severity != "refusal" for finding in found.findings[0])
    (tmp_path / "drive.toml").write_text(fill_in(found.drive_file()), encoding="utf-8")
    (read,) = fitting.load(log, tmp_path / "drive.toml").logs
    np.testing.assert_allclose(read.motor_angle, motion.motor_angle, atol=1e-12)
    np.testing.assert_allclose(read.load_angle, motion.load_angle, atol=1e-12)


def test_counter_that_wraps_at_16_bits_does_not_tell_its_revolution(motion: Motion):
    counts = np.mod(np.rint(motion.motor_angle * 4096 / (2 * np.pi)) + 7000, 65536)
    columns = {"t": motion.time, "motor_enc": counts, "load_angle": motion.load_angle, "tau": motion.motor_torque}
    found = fitting.inspect(columns)
    assert found.inspection.joint.signals["motor_angle"].unit in (None, "rev / 4096")


def test_assumed_unit_is_told_with_its_rivals_if_there_are_any(motion: Motion, monkeypatch: pytest.MonkeyPatch):
    counts = np.rint(motion.motor_angle * 16384 / (2 * np.pi))
    columns = {"t": motion.time, "motor_enc": counts, "load_angle": motion.load_angle, "tau": motion.motor_torque}

    def doubts() -> tuple[str, ...]:
        return fitting.inspect(columns).inspection.joint.signals["motor_angle"].doubts

    assert doubts() == ("rev / 16384 is assumed, rev / 8192 or rev / 65536 or rev / 4096 is possible",)
    monkeypatch.setattr(settling, "_NOTED", 1.0)
    assert doubts() == ("rev / 16384 is assumed",)


def test_stamps_in_two_columns_are_written_and_read(motion: Motion, tmp_path: Path):
    stamps = {"Time": 1.7e9 + np.floor(motion.time + 0.3), "Time (2)": np.rint(np.mod(motion.time + 0.3, 1.0) * 1e6)}
    table = stamps | {"motor_pos": motion.motor_angle, "link_pos": motion.load_angle, "torque": motion.motor_torque}
    text = fitting.inspect(table).drive_file()
    assert 'time = { column = "Time", unit = "s", fraction = { column = "Time (2)", unit = "us" } }' in text
    (tmp_path / "drive.toml").write_text(fill_in(text), encoding="utf-8")
    (log,) = fitting.load(table, drive=tmp_path / "drive.toml").logs
    np.testing.assert_allclose(np.diff(log.time), 1e-3, rtol=1e-9)


@pytest.mark.parametrize(("motor", "load", "times"), [("load", "motor", 100), ("motor", "load", 57.3 / 25)])
def test_load_angle_that_moves_farther_than_the_motor_angle_is_told(
    motor: str, load: str, times: float, motion: Motion
):
    # Swapped columns, and a load angle in degrees behind a ratio of 25.
    angles = {"motor": motion.motor_angle, "load": motion.load_angle}
    if motor == "motor":
        angles = {"motor": motion.motor_angle / 4, "load": np.rad2deg(motion.load_angle)}
    columns = {"time": motion.time, "motor_angle [rad]": angles[motor], "load_angle [rad]": angles[load]}
    found = fitting.inspect(columns | {"motor_torque [N m]": motion.motor_torque})
    (refusal,) = found.findings[0]
    assert refusal.severity == "refusal" and "swapped" in refusal.consequence
    assert float(refusal.what.split()[4]) == pytest.approx(times, rel=0.01)
    assert "# reduction_ratio = ...  # FILL IN" in found.drive_file()


def test_guessed_sign_of_a_current_is_that_of_the_health_check(motion: Motion):
    columns = {"time": motion.time, "motor_angle [rad]": motion.motor_angle, "motor_current [A]": -motion.motor_torque}
    found = fitting.inspect(columns)
    assert "sign = -1, torque_constant" in found.drive_file()
    assert not [finding for finding in found.findings[0] if finding.severity == "refusal"]
