"""Sign and unit of the torque, where only the motor's motion was logged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import joints
import rig
from fitting.logs.checks import examine
from fitting.logs.drive_file import DriveFile
from fitting.logs.findings import Finding
from fitting.logs.log import Log

JOINT = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=2000.0, B_sp=2.0, coulomb=0.02, viscous=2e-4, rms=0.1)
COUNT = 3000


def drive(*, stated: bool = True, tolerances: dict[str, float] | None = None) -> DriveFile:
    J_m, J_l = (JOINT.J_m, JOINT.J_l) if stated else (None, None)
    return DriveFile(
        Path("drive.toml"), "joint", JOINT.N, J_m, J_l, "zero-order", None, {}, tolerances=tolerances or {}
    )


def log_of(torque: np.ndarray, signal: str = "motor_angle", joint: joints.Joint = JOINT) -> Log:
    """A log of one signal of the motor under a torque."""
    motion = joints.motion_of(joint, torque)
    log = rig.log_of_angles(motion[:, 0], motion[:, 1], torque, ratio=joint.N, step=joints.STEP, name="log")
    none = {"motor_angle": None, "load_angle": None, "dynamic_error": None}
    noisy = motion[:, 0] + 1e-4 * np.random.default_rng(0).normal(size=COUNT)
    return replace(log, **(none | {signal: noisy if signal == "motor_angle" else motion[:, 2]}))


def refusals(log: Log, drive_file: DriveFile) -> list[Finding]:
    return [f for f in examine(log, drive_file) if f.where.startswith("motor_torque against")]


@pytest.fixture(scope="module", params=["motor_angle", "motor_velocity"])
def moving(request: pytest.FixtureRequest) -> Log:
    """A joint that is shaken below its antiresonance, with friction of a fifth of the torque."""
    return log_of(rig.multisine(COUNT, joints.STEP, rms=JOINT.rms, low=0.5, high=6.0), request.param)


@pytest.mark.parametrize(
    ("changes", "stated", "free"),
    [
        ({}, "", ""),
        ({"motor_torque": -1.0}, "against its torque", "against its torque"),
        ({"motor_torque": 1e3}, '"mN m"', ""),
        ({"motor_torque": 50.0}, '"N m / 50"', ""),
        ({"motor_torque": 1 / 50.0}, '"50 N m"', ""),
        ({"motor_torque": 1.5}, "", ""),
    ],
)
def test_sign_and_unit_of_a_torque_on_the_motor_alone(moving: Log, changes: dict[str, float], stated: str, free: str):
    log = replace(moving, **{name: factor * getattr(moving, name) for name, factor in changes.items()})
    files = [(drive(), stated), (drive(stated=False), free), (drive(tolerances={"k_T": np.inf}), free)]
    for drive_file, words in files:
        found = refusals(log, drive_file)
        assert [f.severity for f in found] == (["refusal"] if words else [])
        assert not words or words in str(found[0])


@pytest.mark.parametrize(("factor", "severity"), [(-1.0, ["refusal"]), (1.0, [])])
def test_sign_of_a_torque_in_a_log_with_a_gap(moving: Log, factor: float, severity: list[str]):
    signal = "motor_angle" if moving.motor_angle is not None else "motor_velocity"
    seen = getattr(moving, signal) + 40.0 * (np.arange(COUNT) >= 1600) * (signal == "motor_angle")
    torque = factor * moving.motor_torque
    log = replace(moving, motor_torque=torque, pieces=((0, 1500), (1600, COUNT)), **{signal: seen})
    assert [f.severity for f in refusals(log, drive())] == severity


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["one", "two", "band", "slow and one", "through"])
def test_a_load_that_moves_against_the_motor_is_no_wrong_sign(kind: str, seed: int):
    """Between antiresonance and resonance the motor accelerates against its torque, rightly."""
    random = np.random.default_rng(seed)
    joint = replace(JOINT, J_m=JOINT.J_m / 2, coulomb=0.002, viscous=1e-5)
    antiresonance = np.sqrt(joint.K / joint.J_l) / (2 * np.pi)
    time = joints.STEP * np.arange(COUNT)
    low, high = 1.05 * antiresonance, 0.95 * joint.omega_0 / (2 * np.pi)
    one, other = (np.sin(2 * np.pi * f * time) for f in random.uniform(low, high, size=2))
    torque = {
        "one": one,
        "two": one + other,
        "band": rig.multisine(COUNT, joints.STEP, rms=1.0, low=low, high=high, seed=seed),
        "slow and one": one + random.uniform(0.1, 1.0) * np.sin(2 * np.pi * 0.5 * time),
        "through": rig.multisine(COUNT, joints.STEP, rms=1.0, low=0.5, high=high, seed=seed),
    }[kind]
    assert refusals(log_of(0.1 * torque, joint=joint), drive()) == []


@pytest.mark.parametrize("motion", ["motor_angle", "motor_velocity"])
@pytest.mark.parametrize(
    ("factor", "words"),
    [(1.0, ""), (1.5, ""), (-1.0, "sign = -1"), (1e3, '"mN m"'), (1 / 50.0, '"50 N m"'), (100.0, "reduction_ratio")],
)
def test_sign_and_unit_of_a_joint_torque(motion: str, factor: float, words: str):
    """What the motor's torque leaves, beside its friction and inertia, is the joint torque."""
    log = joints.log_of_sensors(JOINT, (motion, "joint_torque"), count=COUNT)
    log = replace(log, joint_torque=factor * log.joint_torque)
    for stated in (True, False):
        found = [f for f in examine(log, drive(stated=stated)) if f.where == "joint_torque"]
        assert [f.severity for f in found] == (["refusal"] if words else [])
        assert not words or words in str(found[0])


@pytest.fixture(scope="module", params=[(0.06, 1e-4), (0.02, 1e-3)])
def braked(request: pytest.FixtureRequest) -> Log:
    """Both angles of a joint whose motor's friction takes most of its torque."""
    coulomb, viscous = request.param
    joint = replace(JOINT, coulomb=coulomb, viscous=viscous)
    return joints.log_of_sensors(joint, ("motor_angle", "load_angle"), count=COUNT)


@pytest.mark.parametrize(
    ("factor", "words"), [(1.0, ""), (1.8, ""), (-1.0, "sign = -1"), (1e3, "motor_torque"), (100.0, "motor_torque")]
)
def test_torque_is_checked_where_friction_dominates(braked: Log, factor: float, words: str):
    (found, *more) = refusals(replace(braked, motor_torque=factor * braked.motor_torque), drive()) or (None,)
    assert (found is None) == (not words) and not more
    assert found is None or (found.severity == "refusal" and words in str(found))
