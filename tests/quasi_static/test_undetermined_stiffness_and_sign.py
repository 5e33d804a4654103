"""Quasi-static logs with a large twist, or with little information on the stiffness or the sign of the torque."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from slow_joints import RATIO, slow_joint
from torque_cycles import cycles, line

from fitting.errors import DataError
from fitting.logs.drive_file import DriveFile
from fitting.logs.log import Log
from fitting.quasi_static.attribution import Held, is_determined, is_within
from fitting.quasi_static.content import report_dict
from fitting.quasi_static.fit import fit_quasi_static
from fitting.quasi_static.loop import catalogue, close_loop
from fitting.quasi_static.loop_content import loop_report
from fitting.quasi_static.points import points_of
from fitting.quasi_static.preparation import prepare
from fitting.quasi_static.test_part import Parted
from fitting.quasi_static.twist_model import strengths_of
from fitting.quasi_static.unseen_logs import UnseenLogs

SOFT = 120.0


def drive_file(**known) -> DriveFile:
    return DriveFile(Path("drive.toml"), "joint", RATIO, None, None, None, None, {}, **known)


def soft_spring(twist: float) -> Log:
    log = cycles(lambda x: SOFT * x, lambda x: np.zeros_like(x), largest=twist, twist_noise=1e-4, torque_noise=0.02)
    return replace(log, dynamic_error=log.dynamic_error - 0.4)


def large_twist_is_reported(log: Log, **known) -> bool:
    data = prepare([log], drive_file(**known))
    return any("strain-wave gears" in finding.what for finding in data.findings["log"])


def test_large_twist_is_fitted_with_a_warning():
    log = soft_spring(0.15)
    assert large_twist_is_reported(log)
    found = fit_quasi_static(prepare([log], drive_file()).logs)
    stiffness = found.known[found.chosen]["K"]
    assert stiffness.ci95 is not None and stiffness.ci95[0] < SOFT < stiffness.ci95[1]


def test_largest_twist_of_the_drive_file_sets_the_limit():
    log = soft_spring(0.15)
    assert not large_twist_is_reported(log, largest_twist=0.5)
    assert not large_twist_is_reported(cycles(line))
    with pytest.raises(DataError, match=r"largest_twist of 0\.2 rad"):
        prepare([log], drive_file(largest_twist=0.2))
    with pytest.raises(DataError, match="full turn"):
        prepare([soft_spring(4.0)], drive_file())
    assert not large_twist_is_reported(soft_spring(4.0), largest_twist=10.0)


def drifting_joint(sign: float) -> Log:
    """A joint that moves one way under a nearly constant torque, while the encoders drift with the angle."""
    log, _ = slow_joint(
        [lambda motion: -6e-6 * motion.motor + 5e-5 * np.cos(motion.motor) + 2e-5 * np.cos(0.05 * motion.motor)],
        moves="one way",
        cycles=2.0,
        largest=1.0,
        twist_noise=2e-6,
        torque_noise=0.05,
    )
    assert log.joint_torque is not None
    return replace(log, joint_torque=sign * log.joint_torque)


@pytest.mark.parametrize("seed", range(3))
def test_wrong_torque_sign_is_refused_beside_a_large_kinematic_error(seed):
    """The kinematic error moves the twist more than the torque does."""
    log, _ = slow_joint(
        [lambda motion: 2e-5 * motion.motor + 1e-3 * np.cos(motion.motor)], moves="one way", cycles=6.0, seed=seed
    )
    assert log.joint_torque is not None
    prepare([log], drive_file())
    with pytest.raises(DataError, match="sign = -1"):
        prepare([replace(log, joint_torque=-log.joint_torque)], drive_file())


def findings_text(log: Log) -> str:
    return " ".join(finding.what for finding in prepare([log], drive_file(), at_rest=True).findings["log"])


def test_wrong_torque_sign_is_reported_where_the_logs_hardly_determine_it():
    assert "seems to fall" not in findings_text(drifting_joint(1.0))
    try:
        assert "seems to fall" in findings_text(drifting_joint(-1.0))
    except DataError as refused:
        assert "sign = -1" in str(refused)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_undetermined_stiffness_is_not_stated_in_the_summary(sign):
    log, motion = slow_joint(
        [lambda m: -4e-5 * m.motor + 3e-4 * np.cos(0.02 * m.motor)],
        moves="one way",
        kind="triangle",
        cycles=5.0,
        largest=0.1,
        torque_noise=0.3,
    )
    assert log.joint_torque is not None
    log = replace(log, joint_torque=20.0 + sign * log.joint_torque)
    steady = prepare([log], drive_file(), at_rest=True)
    fit = fit_quasi_static(steady.logs, hysteresis=False)
    report = report_dict(steady, fit, UnseenLogs.of([], drive_file()))
    assert not report["before"]["parameters"]["K"]["identifiable"]
    assert "do not determine a stiffness" in report["summary"] and "N m/rad" not in report["summary"]
    loop = close_loop(points_of(steady.logs, [motion], RATIO))
    told = loop_report(Parted(steady, loop.held.points, ()), loop)
    for account in (told["before"], told["after"]):
        stiffness = account["parameters"].get("K", {"value": None})["value"]
        assert stiffness is None or stiffness > 0
    for effect in told["after"]["effects"]:
        assert any(one["identifiable"] for one in effect["parameters"].values())


def test_time_constant_at_an_end_of_its_range_is_not_determined():
    log, motion = slow_joint(cycles=4.0)
    points = points_of([log], [motion], RATIO)
    creep = next(form for form in catalogue(points) if form.family == "creep")
    low, high = creep.range
    assert is_within(creep, 0.5 * (low + high))
    assert not is_within(creep, high) and not is_within(creep, low)


def test_creep_larger_than_the_elastic_twist_is_not_determined():
    """A twist that follows the torque with a lag of most of a cycle, and hardly at once."""
    log, motion = slow_joint(cycles=4.0, twist_noise=1e-6, torque_noise=0.05)
    assert log.joint_torque is not None
    slow = lfilter([0.004], [1.0, -0.996], log.joint_torque)
    points = points_of([replace(log, dynamic_error=log.joint_torque / 4e5 + slow / 2e4)], [motion], RATIO)
    held = Held.of(points)
    creep = next(form for form in catalogue(points) if form.family == "creep")
    trial = held.attempt(((creep, np.array([np.log(1.0), 0.0])),))
    assert strengths_of(points, trial.model, creep)["share"].value > 1.0
    assert not is_determined(points, trial.model, creep)
