"""Checks of both angles: reduction ratio, columns, signs, units and wrapping."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked_logs import ROWS, STEP, N, angles, drive_file, drive_log, only_finding

import joints
from fitting.drive_data import ready_log
from fitting.errors import DataError
from fitting.logs.checks import examine, refuse_unfit
from fitting.logs.drive_file import read_drive_file
from fitting.logs.log import read_log


@pytest.mark.parametrize("ratio", [100.0, 49.0, 25.0, 160.0])
def test_wrong_reduction_ratio_is_refused(ratio: float) -> None:
    finding = only_finding(examine(drive_log(), drive_file(ratio)), "refusal", f"is {ratio:g} but")
    assert "the angles give 50.0" in finding.what and "[drive]" in finding.consequence


def test_ratio_for_the_other_fixed_gear_member_is_refused() -> None:
    """The ratio is N if the flexspline turns, and N + 1 if the circular spline turns."""
    log = drive_log(swing=6.0)
    motor, load = angles(log)
    log = replace(log, motor_angle=motor * 101 / N)
    only_finding(examine(log, drive_file(100.0)), "refusal", "is 100 but the angles give 101.0")
    small = drive_log(swing=0.6)
    motor, load = angles(small)
    small = replace(small, motor_angle=motor * 101 / N)
    only_finding(examine(small, drive_file(100.0)), "warning", "is 100 but the angles give 101.0", "twists the gear")
    assert examine(log, drive_file(101.0)) == ()


def test_swapped_angle_columns_are_refused() -> None:
    motor, load = angles(drive_log())
    log = replace(drive_log(), motor_angle=load, load_angle=motor)
    only_finding(examine(log, drive_file()), "refusal", "swapped", "[columns]")
    log = replace(drive_log(), motor_angle=load, load_angle=-motor)
    only_finding(examine(log, drive_file()), "refusal", "swapped")


def test_angle_with_opposite_sign_is_refused() -> None:
    motor, _ = angles(drive_log())
    log = replace(drive_log(), motor_angle=-motor)
    only_finding(examine(log, drive_file()), "refusal", "sign = -1")


@pytest.mark.parametrize(
    ("motor_factor", "load_factor", "words"),
    [
        (180 / np.pi, 1.0, ["motor_angle looks like degrees"]),
        (1.0, 180 / np.pi, ["load_angle looks like degrees"]),
        (1 / N, 1.0, ["one side", 'unit = "50 rad"']),
    ],
)
def test_wrong_unit_of_an_angle_is_refused(motor_factor: float, load_factor: float, words: list[str]) -> None:
    motor, load = angles(drive_log())
    log = replace(drive_log(), motor_angle=motor * motor_factor, load_angle=load * load_factor)
    # With N = 50, no other fault has the factor of degrees on the load side within the tolerance.
    only_finding(examine(log, drive_file()), "refusal", *words)


def test_locked_load_is_not_reported_as_wrong_ratio() -> None:
    motor, load = angles(drive_log(swing=2e-3))
    noise = 1e-7 * np.random.default_rng(1).normal(size=ROWS)
    locked = replace(drive_log(), motor_angle=motor, load_angle=noise)
    assert examine(locked, drive_file()) == ()
    yielding = replace(drive_log(), motor_angle=motor, load_angle=0.3 * load)
    only_finding(examine(yielding, drive_file()), "warning", "unless it was locked")


@pytest.mark.parametrize(("swing", "severity"), [(0.02, "warning"), (1.0, "refusal")])
def test_load_angle_lag_is_refused_only_over_a_large_swing(swing: float, severity: str) -> None:
    """The load lags by 3 %: a possible twist over a small swing, and an impossible one over a large swing."""
    motor, load = angles(drive_log(swing=swing))
    log = replace(drive_log(), motor_angle=motor, load_angle=0.97 * load)
    only_finding(examine(log, drive_file()), severity, "is 50 but")


def test_motion_beyond_the_antiresonance_is_not_reported_as_wrong_ratio() -> None:
    """At a frequency above the antiresonance the load moves in antiphase to the motor."""
    time = np.arange(ROWS) * STEP
    log = replace(
        drive_log(),
        motor_angle=N * 2.0 * np.sin(385 * time),
        load_angle=-0.8 * np.sin(385 * time),
        dynamic_error=2.8 * np.sin(385 * time),
    )
    only_finding(examine(log, drive_file()), "warning", "the twist spans 5.6 rad")


def test_wrapped_load_angle_is_refused() -> None:
    log = drive_log(swing=1.0)
    motor, load = angles(log)
    wrapped = (load * 4 + np.pi) % (2 * np.pi) - np.pi
    findings = examine(replace(log, load_angle=wrapped, motor_angle=4 * motor), drive_file())
    assert findings[0].severity == "refusal" and "wrapped" in findings[0].consequence


def test_wrapped_motor_angle_without_a_load_angle_is_refused() -> None:
    log = drive_log(swing=0.2)
    motor, _ = angles(log)
    wrapped = (motor + np.pi) % (2 * np.pi) - np.pi
    (finding,) = examine(replace(log, motor_angle=wrapped, load_angle=None, dynamic_error=None), drive_file())
    assert finding.severity == "refusal" and "wrapped" in finding.consequence


@pytest.mark.parametrize("ratio", [100, 49])
def test_wrong_ratio_of_a_practice_log_is_refused(tmp_path: Path, shared: Path, ratio: int) -> None:
    case = shared / "logs/kinematic_2-7"
    text = (case / "drive.toml").read_text().replace("ratio = 50", f"ratio = {ratio}")
    (tmp_path / "drive.toml").write_text(text)
    drive = read_drive_file(tmp_path / "drive.toml")
    log = read_log(case / "train_1.csv", drive)
    with pytest.raises(DataError, match=f"is {ratio} but the angles give 50.0"):
        refuse_unfit(examine(log, drive), log)


@pytest.mark.parametrize(
    ("ratio", "sign", "refused"), [(121, -1, False), (101, -1, True), (120, -1, False), (121, 1, True)]
)
def test_wrong_ratio_or_sign_of_lara8_joint_2_is_refused(
    tmp_path: Path, shared: Path, ratio: int, sign: int, refused: bool
) -> None:
    (tmp_path / "drive.toml").write_text(f"""
    [drive]
    reduction_ratio = {ratio}
    motor_inertia = 1e-4
    load_inertia = 12.0
    [columns]
    time = "Timestamp"
    motor_angle = {{ column = "encoder_motorinc_2", unit = "rev / 16777216" }}
    load_angle = {{ column = "encoder_loadinc_2", unit = "rev / 16777216" }}
    motor_torque = {{ column = "joint_torque_current_2", unit = "N m / 121", sign = {sign} }}
    """)
    drive = read_drive_file(tmp_path / "drive.toml")
    log = ready_log(shared / "data/lara8/ML2_jogging_joint_mass.csv", drive)
    findings = examine(log, drive)
    assert any("jitters" in finding.what for finding in findings)
    # Both encoders are absolute and have no common zero.
    assert any("off zero" in finding.what for finding in findings)
    assert any(finding.severity == "refusal" for finding in findings) == refused


def test_soft_spring_is_not_reported_as_wrong_ratio():
    # The slowest motion of this log is a fifth of the antiresonance.
    joint = joints.with_friction(joints.drawn(0), 0.2, 0.2)
    log = joints.log_of(joint)
    assert not [f for f in examine(log, drive_file(joint.N)) if "the angles give" in f.what]
    (refused,) = [f for f in examine(log, drive_file(1.2 * joint.N)) if "the angles give" in f.what]
    assert refused.severity == "refusal"


@pytest.mark.parametrize(
    ("twist", "stated", "severity"),
    [(0.04, None, None), (0.2, None, "warning"), (0.2, 0.5, None), (0.2, 0.3, "refusal"), (3.5, None, "refusal")],
)
def test_twist_beyond_that_of_gears(twist: float, stated: float | None, severity: str | None):
    """Nothing else contradicts a wrong column whose motion is unrelated to the other angle's."""
    motor, load = angles(drive_log())
    wobble = twist * np.sin(np.arange(ROWS) ** 1.5 * 1e-2)
    log = replace(drive_log(), load_angle=load - wobble, dynamic_error=motor / N - load + wobble)
    findings = [f for f in examine(log, replace(drive_file(), largest_twist=stated)) if f.where == "twist"]
    assert [f.severity for f in findings] == ([] if severity is None else [severity])


def test_spike_of_an_encoder_is_no_wide_twist():
    log = drive_log()
    twist = log.twist.copy()
    twist[77] = 9.0
    spiky = replace(log, dynamic_error=twist, trusted=np.arange(ROWS) != 77)
    assert not [f for f in examine(spiky, drive_file()) if f.where == "twist"]


@pytest.mark.parametrize("motor", ["motor_angle", "motor_velocity"])
@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1.0, ""),
        (-1.0, "sign = -1"),
        (N, "referred to one side"),
        (30 / np.pi, '"rpm"'),
        (180 / np.pi, '"deg/s"'),
        (1.7, "correct the ratio"),
        (N**2, "swapped"),
    ],
)
def test_load_velocity_is_compared_with_the_motor(motor: str, factor: float, words: str):
    """The integral of a velocity drifts with its zero error."""
    log = drive_log(swing=1.0)
    angle, load = angles(log)
    seen = {"motor_angle": angle, "motor_velocity": np.gradient(angle, log.time) + 0.3}
    log = replace(log, motor_angle=None, load_angle=None, dynamic_error=None)
    log = replace(log, **{motor: seen[motor]}, load_velocity=factor * (np.gradient(load, log.time) - 0.02))
    found = [f for f in examine(log, drive_file()) if f.where.startswith("load_velocity")]
    assert [f.severity for f in found] == (["refusal"] if words else [])
    assert not words or words in str(found[0])
