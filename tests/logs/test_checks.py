"""Each mix-up of a log is found, told once, and absent from healthy logs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import joints
import rig
from fitting.drive_data import ready_log
from fitting.errors import DataError
from fitting.logs.checks import examine, refuse_unfit
from fitting.logs.drive_file import ColumnMap, DriveFile, read_drive_file
from fitting.logs.findings import Finding
from fitting.logs.log import Log, read_log

N = 50.0
ROWS = 4000
STEP = 5e-4


def drive_file(ratio: float | None = N, columns: dict[str, ColumnMap] | None = None) -> DriveFile:
    return DriveFile(Path("drive.toml"), "rig", ratio, 5e-4, 5e-2, "zero-order", None, columns or {})


def drive_log(swing: float = 0.3) -> Log:
    """A free drive: a slow swing [rad] that both sides share, and a twist of 0.3 mrad."""
    rng = np.random.default_rng(5)
    time = np.arange(ROWS) * STEP
    twist = 3e-4 * np.sin(2 * np.pi * 40 * time + 0.3) + 1e-6 * rng.normal(size=ROWS)
    load = swing * np.sin(2 * np.pi * 0.8 * time) + swing * 0.2 * time
    load += 1e-7 * rng.normal(size=ROWS)
    return Log(
        name="log",
        path=Path("log.csv"),
        kind="drive",
        time=time,
        motor_angle=N * (load + twist),
        load_angle=load,
        motor_torque=rng.normal(size=ROWS),
        load_torque=None,
        temperature=None,
        dynamic_error=twist,
        forcing=None,
        units={"dynamic_error": "rad"},
    )


def reduced_log() -> Log:
    rng = np.random.default_rng(6)
    time = np.arange(ROWS) * STEP
    return replace(
        drive_log(),
        kind="reduced",
        motor_angle=None,
        load_angle=None,
        motor_torque=None,
        dynamic_error=np.sin(90 * time) + 1e-3 * rng.normal(size=ROWS),
        forcing=rng.normal(size=ROWS),
        units={"dynamic_error": "V", "forcing": "V"},
    )


def angles(log: Log) -> tuple[np.ndarray, np.ndarray]:
    assert log.motor_angle is not None and log.load_angle is not None
    return log.motor_angle, log.load_angle


def only(findings: tuple[Finding, ...], severity: str, *words: str) -> Finding:
    assert len(findings) == 1, [str(finding) for finding in findings]
    assert findings[0].severity == severity
    for word in words:
        assert word in str(findings[0])
    return findings[0]


@pytest.mark.parametrize("log", [drive_log(), drive_log(3.0), reduced_log()])
def test_healthy_logs_have_no_findings(log: Log) -> None:
    findings = examine(log, drive_file())
    assert findings == ()
    refuse_unfit(findings, log)


def test_only_refusals_raise_and_the_first_is_told() -> None:
    log = drive_log()
    note, warning = (Finding(s, "seen", "there", "so") for s in ("note", "warning"))
    refuse_unfit([note, warning], log)
    first, second = (Finding("refusal", what, "there", "so mend it") for what in ("one", "two"))
    with pytest.raises(DataError) as error:
        refuse_unfit([note, first, second], log)
    assert str(error.value) == "log.csv: there: one; so mend it"
    assert str(note) == "note: there: seen; so"


def test_findings_of_the_reader_come_first() -> None:
    seen = Finding("note", "seen", "there", "so")
    log = replace(drive_log(), findings=(seen,), motor_torque=np.zeros(ROWS))
    assert examine(log, drive_file())[0] == seen
    assert len(examine(log, drive_file())) == 2


@pytest.mark.parametrize("ratio", [100.0, 49.0, 25.0, 160.0])
def test_wrong_ratio(ratio: float) -> None:
    finding = only(examine(drive_log(), drive_file(ratio)), "refusal", f"is {ratio:g} but")
    assert "the angles give 50.0" in finding.what and "[drive]" in finding.consequence


def test_ratio_of_the_other_member_of_the_gear_held_still() -> None:
    """N and N + 1 part a drive whose flexspline turns from one whose circular spline turns."""
    log = drive_log(swing=6.0)
    motor, load = angles(log)
    log = replace(log, motor_angle=motor * 101 / N)
    only(examine(log, drive_file(100.0)), "refusal", "is 100 but the angles give 101.0")
    assert examine(log, drive_file(101.0)) == ()


def test_swapped_columns() -> None:
    motor, load = angles(drive_log())
    log = replace(drive_log(), motor_angle=load, load_angle=motor)
    only(examine(log, drive_file()), "refusal", "swapped", "[columns]")
    log = replace(drive_log(), motor_angle=load, load_angle=-motor)
    only(examine(log, drive_file()), "refusal", "swapped")


def test_opposite_sign() -> None:
    motor, _ = angles(drive_log())
    log = replace(drive_log(), motor_angle=-motor)
    only(examine(log, drive_file()), "refusal", "sign = -1")


@pytest.mark.parametrize(
    ("motor_factor", "load_factor", "words"),
    [
        (180 / np.pi, 1.0, ["motor_angle looks like degrees"]),
        (1.0, 180 / np.pi, ["load_angle looks like degrees"]),
        (1 / N, 1.0, ["one side", 'unit = "50 rad"']),
    ],
)
def test_units_of_angles(motor_factor: float, load_factor: float, words: list[str]) -> None:
    motor, load = angles(drive_log())
    log = replace(drive_log(), motor_angle=motor * motor_factor, load_angle=load * load_factor)
    # Degrees on the load side with N = 50 come within the tolerance of nothing else.
    only(examine(log, drive_file()), "refusal", *words)


def test_a_locked_load_is_no_wrong_ratio() -> None:
    motor, load = angles(drive_log(swing=2e-3))
    noise = 1e-7 * np.random.default_rng(1).normal(size=ROWS)
    locked = replace(drive_log(), motor_angle=motor, load_angle=noise)
    assert examine(locked, drive_file()) == ()
    yielding = replace(drive_log(), motor_angle=motor, load_angle=0.3 * load)
    only(examine(yielding, drive_file()), "warning", "unless it was locked")


@pytest.mark.parametrize(("swing", "severity"), [(0.02, "warning"), (1.0, "refusal")])
def test_slow_torque_that_twists_the_gear_is_no_wrong_ratio(swing: float, severity: str) -> None:
    """The load stays behind by 3 %, which over a small swing is a twist that gears bear, over a large one none."""
    motor, load = angles(drive_log(swing=swing))
    log = replace(drive_log(), motor_angle=motor, load_angle=0.97 * load)
    only(examine(log, drive_file()), severity, "is 50 but")


def test_a_resonance_is_no_wrong_ratio() -> None:
    """At one frequency past the antiresonance the load moves against the motor, rightly."""
    time = np.arange(ROWS) * STEP
    log = replace(
        drive_log(),
        motor_angle=N * 2.0 * np.sin(385 * time),
        load_angle=-0.8 * np.sin(385 * time),
        dynamic_error=2.8 * np.sin(385 * time),
    )
    assert examine(log, drive_file()) == ()


@pytest.mark.parametrize("value", [0.0, 2.5])
def test_constant_torque(value: float) -> None:
    log = replace(drive_log(), motor_torque=np.full(ROWS, value))
    findings = examine(log, drive_file())
    only(findings, "refusal", f"motor_torque is {value:g}", "does not excite")
    with pytest.raises(DataError, match="motor_torque"):
        refuse_unfit(findings, log)
    braked = replace(log, load_torque=np.random.default_rng(2).normal(size=ROWS))
    only(examine(braked, drive_file()), "warning", "load torque")


def test_reduced_log_without_excitation_or_response() -> None:
    log = replace(reduced_log(), forcing=np.zeros(ROWS))
    only(examine(log, drive_file(None)), "refusal", "forcing is 0")
    log = replace(reduced_log(), dynamic_error=np.ones(ROWS))
    only(examine(log, drive_file(None)), "refusal", "dynamic_error never changes")


def test_stuck_angles() -> None:
    still = np.full(ROWS, 0.7)
    log = replace(drive_log(), load_angle=still)
    only(examine(log, drive_file()), "warning", "load_angle never changes")
    findings = examine(replace(log, motor_angle=still), drive_file())
    assert [finding.severity for finding in findings] == ["refusal", "refusal"]


def test_clipped_channels() -> None:
    smooth = np.sin(60 * drive_log().time) + 0.01 * np.random.default_rng(0).normal(size=ROWS)
    log = replace(drive_log(), motor_torque=np.minimum(smooth, 0.8))
    only(examine(log, drive_file()), "warning", "motor_torque", "at 0.8", "clipped")


@pytest.mark.parametrize("levels", [2, 3, 7])
def test_switched_torque_is_not_clipped(levels: int) -> None:
    steps = np.random.default_rng(0).integers(levels, size=ROWS // 8).repeat(8) - 1.0
    log = replace(drive_log(), motor_torque=steps)
    assert not [f for f in examine(log, drive_file()) if f.severity != "note"]


def test_pulses_that_rest_at_zero_are_not_clipped() -> None:
    pulses = np.maximum(np.sin(60 * drive_log().time), 0.0)
    assert examine(replace(drive_log(), motor_torque=pulses), drive_file()) == ()


@pytest.mark.parametrize(("name", "step"), [("load_angle", 1e-4), ("motor_angle", 5e-3)])
def test_quantised_angles(name: str, step: float) -> None:
    log = drive_log()
    values = np.rint(getattr(log, name) / step) * step
    finding = only(examine(replace(log, **{name: values}), drive_file()), "note", name)
    assert f"{step:g} rad apart" in finding.what


def test_fine_counts_are_not_worth_a_note() -> None:
    log = drive_log()
    motor, load = angles(log)
    count = 2 * np.pi / 2**24
    log = replace(log, motor_angle=np.rint(motor / count) * count)
    log = replace(log, load_angle=np.rint(load / count) * count)
    assert examine(log, drive_file()) == ()


def test_wrapped_angle() -> None:
    log = drive_log(swing=1.0)
    motor, load = angles(log)
    wrapped = (load * 4 + np.pi) % (2 * np.pi) - np.pi
    findings = examine(replace(log, load_angle=wrapped, motor_angle=4 * motor), drive_file())
    assert findings[0].severity == "refusal" and "wrapped" in findings[0].consequence


def test_jitter_is_noted() -> None:
    log = drive_log()
    jitter = 0.1 * STEP * np.random.default_rng(4).uniform(-1, 1, size=ROWS)
    only(examine(replace(log, time=log.time + jitter), drive_file()), "note", "jitters by 8")
    slight = replace(log, time=log.time + 0.01 * jitter)
    assert examine(slight, drive_file()) == ()


@pytest.mark.parametrize("side", ["motor", "load"])
@pytest.mark.parametrize(
    ("factor", "severity", "word"),
    [
        (1.0, None, ""),
        (1.05, "warning", "time base"),
        (1e-3, "refusal", "time base"),
        (1e3, "refusal", "time base"),
        (0.02, "warning", '"50 rad/s"'),
        (50.0, "warning", '"rad/s / 50"'),
        (-1.0, "warning", "sign = -1"),
        (60 / (2 * np.pi), "warning", "rpm"),
        (180 / np.pi, "warning", "deg/s"),
    ],
)
def test_velocity_against_time_base(side: str, factor: float, severity: str | None, word: str) -> None:
    log = drive_log()
    angle = getattr(log, f"{side}_angle")
    log = replace(log, **{f"{side}_velocity": factor * np.gradient(angle, log.time)})
    findings = examine(log, drive_file())
    if severity is None:
        assert findings == ()
    else:
        only(findings, severity, f"{side}_velocity", word)


@pytest.mark.parametrize(("factor", "severity"), [(1.0, None), (0.02, "warning"), (1e-3, "refusal")])
def test_velocity_of_the_motor_alone_against_time_base(factor: float, severity: str | None) -> None:
    log = drive_log()
    motor, _ = angles(log)
    alone = replace(log, load_angle=None, dynamic_error=None, motor_velocity=factor * np.gradient(motor, log.time))
    findings = examine(alone, drive_file())
    assert [finding.severity for finding in findings] == ([] if severity is None else [severity])


def test_a_wrapped_angle_of_the_motor_alone_is_refused() -> None:
    log = drive_log(swing=0.2)
    motor, _ = angles(log)
    wrapped = (motor + np.pi) % (2 * np.pi) - np.pi
    (finding,) = examine(replace(log, motor_angle=wrapped, load_angle=None, dynamic_error=None), drive_file())
    assert finding.severity == "refusal" and "wrapped" in finding.consequence


def test_a_velocity_with_holes_over_a_gap() -> None:
    log = drive_log()
    motor, _ = angles(log)
    velocity = np.gradient(motor, log.time)
    velocity[::9] = np.nan
    kept = np.delete(np.arange(ROWS), np.arange(1000, 2000))
    columns = {k: v[kept] for k, v in vars(log).items() if isinstance(v, np.ndarray)}
    assert examine(replace(log, **columns, motor_velocity=velocity[kept]), drive_file()) == ()


@pytest.fixture(scope="module")
def moving() -> Log:
    """A simulated log, whose torque makes its motion."""
    torque = rig.drive_torque(ROWS)
    return rig.drive_log(rig.drive_motion(torque), torque)


RIG = DriveFile(Path("drive.toml"), "rig", rig.N, rig.J_M, rig.J_L, "zero-order", None, {})


@pytest.mark.parametrize(
    ("changes", "severity", "words"),
    [
        ({}, None, []),
        ({"motor_torque": -1.0}, "refusal", ["against the motion", "sign = -1"]),
        ({"motor_torque": 1e3}, "refusal", ['"mN m"']),
        ({"motor_torque": 50.0}, "refusal", ["output side", '"N m / 50"']),
        ({"motor_torque": 0.02}, "refusal", ["too small by the ratio"]),
        ({"motor_angle": 180 / np.pi, "load_angle": 180 / np.pi}, "refusal", ["both angles look like degrees"]),
        ({"motor_angle": -1.0, "load_angle": -1.0}, "refusal", ["or both angles"]),
        ({"time": 1e3}, "refusal", ["milliseconds", '"ms"']),
        ({"motor_torque": 1 / 7.0}, "warning", ["6.99 times as much", "motor_inertia"]),
        ({"motor_torque": 1.5}, None, []),
    ],
)
def test_torque_against_the_motion_that_it_makes(moving: Log, changes: dict, severity: str | None, words: list[str]):
    log = replace(moving, **{name: factor * getattr(moving, name) for name, factor in changes.items()})
    findings = examine(log, RIG)
    if severity is None:
        assert findings == ()
    else:
        only(findings, severity, *words)


@pytest.mark.parametrize(
    "physics", [{"motor_friction": (0.1, 0.5)}, {"gravity": 20.0}, {"torque_bias": 0.1}, {"mesh_friction": (2.0, 1e-3)}]
)
def test_hidden_physics_is_no_mix_up(physics: dict):
    torque = rig.drive_torque(ROWS)
    assert examine(rig.drive_log(rig.drive_motion(torque, **physics), torque), RIG) == ()


def test_spikes_of_an_input_are_told_and_kept() -> None:
    smooth = np.sin(60 * drive_log().time)
    smooth[[700, 1200]] += 3.0
    only(
        examine(replace(drive_log(), motor_torque=smooth), drive_file()), "note", "2 samples", "motor_torque", "row 701"
    )


SPOILERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "nan": lambda values: np.full_like(values, np.nan),
    "zero": np.zeros_like,
    "swapped": lambda values: -3 * values,
}


@pytest.mark.parametrize("spoil", SPOILERS.values(), ids=SPOILERS)
@pytest.mark.parametrize("until", [1, 50, 1000])
def test_unknown_outputs_are_not_looked_at(spoil: Callable[[np.ndarray], np.ndarray], until: int) -> None:
    log = replace(drive_log(), outputs_until=until)
    spoilt = {}
    for name in ("motor_angle", "load_angle", "dynamic_error"):
        values = getattr(log, name).copy()
        values[until:] = spoil(values[until:])
        spoilt[name] = values
    assert examine(replace(log, **spoilt), drive_file()) == examine(log, drive_file())


def test_the_practice_logs_are_healthy(shared: Path) -> None:
    cases = sorted((shared / "logs").glob("*/drive.toml"))
    assert cases
    for case in cases:
        drive = read_drive_file(case)
        for path in sorted(case.parent.glob("*.csv")):
            assert examine(ready_log(path, drive), drive) == (), path


@pytest.mark.parametrize("ratio", [100, 49])
def test_wrong_ratio_on_a_practice_log(tmp_path: Path, shared: Path, ratio: int) -> None:
    case = shared / "logs/kinematic_2-7"
    text = (case / "drive.toml").read_text().replace("ratio = 50", f"ratio = {ratio}")
    (tmp_path / "drive.toml").write_text(text)
    drive = read_drive_file(tmp_path / "drive.toml")
    log = read_log(case / "train_1.csv", drive)
    with pytest.raises(DataError, match=f"is {ratio} but the angles give 50.0"):
        refuse_unfit(examine(log, drive), log)


@pytest.mark.parametrize(("ratio", "refused"), [(121, False), (101, True), (120, False)])
def test_lara8_joint_2(tmp_path: Path, shared: Path, ratio: int, refused: bool) -> None:
    (tmp_path / "drive.toml").write_text(f"""
    [drive]
    reduction_ratio = {ratio}
    motor_inertia = 1e-4
    load_inertia = 1.0
    [columns]
    time = "Timestamp"
    motor_angle = {{ column = "encoder_motorinc_2", unit = "rev / 16777216" }}
    load_angle = {{ column = "encoder_loadinc_2", unit = "rev / 16777216" }}
    motor_torque = {{ column = "joint_torque_current_2", unit = "N m / 121" }}
    """)
    drive = read_drive_file(tmp_path / "drive.toml")
    log = ready_log(shared / "data/lara8/ML2_jogging_joint_mass.csv", drive)
    findings = examine(log, drive)
    assert any("jitters" in finding.what for finding in findings)
    # Both encoders are absolute and were never zeroed together.
    assert any("off zero" in finding.what for finding in findings)
    assert any(finding.severity == "refusal" for finding in findings) == refused


def test_a_soft_spring_is_no_wrong_ratio():
    # The slowest motion of this log is a fifth of the antiresonance.
    joint = joints.with_friction(joints.drawn(0), 0.2, 0.2)
    log = joints.log_of(joint)
    assert not [f for f in examine(log, drive_file(joint.N)) if "the angles give" in f.what]
    (refused,) = [f for f in examine(log, drive_file(1.2 * joint.N)) if "the angles give" in f.what]
    assert refused.severity == "refusal"
