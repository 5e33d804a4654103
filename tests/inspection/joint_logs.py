"""Logs of simulated drives with columns as robots, drives and loggers export them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from simulated_joint import Motion

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Shape:
    """How a log is exported.

    Attributes:
        columns: from a motion.
        signals: expected detections, from column to signal, unit (None: not stated, or SI) and sign.
        open: columns that hold a signal but must stay undetermined.
        ratio: expected reduction ratio, or None.
        joint: label of the joint that is inspected.
        time: expected time column, where it is not obvious.
    """

    columns: Callable[[Motion], Columns]
    signals: dict[str, tuple[str, str | None, int]]
    open: tuple[str, ...] = ()
    ratio: float | None = 100.0
    joint: str | None = None
    time: str | None = None


def _deg(values: np.ndarray) -> np.ndarray:
    return np.rad2deg(values)


def _rpm(values: np.ndarray) -> np.ndarray:
    return values * 30 / np.pi


def _counts(values: np.ndarray, bits: int) -> np.ndarray:
    return np.rint(values * 2**bits / (2 * np.pi))


def _smooth(seed: int, count: int) -> np.ndarray:
    """A slow unrelated channel."""
    random = np.random.default_rng(seed)
    return 35 + np.cumsum(random.normal(size=count)) * 0.01


def franka(motion: Motion) -> Columns:
    """Robot state with motor positions referred to the joint, link positions, and a joint torque sensor."""
    return {
        "time": motion.time,
        **{f"q[{j}]": motion.load_angle + j if j == 1 else np.full(motion.time.size, 0.1 * j) for j in range(7)},
        **{f"q_d[{j}]": motion.load_angle + j if j == 1 else np.full(motion.time.size, 0.1 * j) for j in range(7)},
        **{f"dq[{j}]": motion.load_velocity if j == 1 else np.zeros(motion.time.size) for j in range(7)},
        **{f"theta[{j}]": motion.motor_angle / 100 + j if j == 1 else np.full(motion.time.size, 0.1) for j in range(7)},
        **{f"tau_J[{j}]": motion.joint_torque if j == 1 else np.zeros(motion.time.size) for j in range(7)},
        **{f"tau_ext_hat_filtered[{j}]": 0.1 * motion.joint_torque for j in range(7)},
        **{f"O_T_EE[{k}]": np.full(motion.time.size, 0.3) for k in range(16)},
    }


def rtde(motion: Motion) -> Columns:
    """Cobot with one encoder a joint and motor currents."""
    n = motion.time.size
    still = np.zeros(n)
    return {
        "timestamp": 1000.0 + motion.time,
        **{f"target_q_{j}": motion.load_angle if j == 2 else still for j in range(6)},
        **{f"actual_q_{j}": motion.load_angle if j == 2 else still for j in range(6)},
        **{f"actual_qd_{j}": motion.load_velocity if j == 2 else still for j in range(6)},
        **{f"target_qdd_{j}": np.gradient(motion.load_velocity, motion.time) if j == 2 else still for j in range(6)},
        **{f"actual_current_{j}": motion.motor_torque / 0.1 if j == 2 else still for j in range(6)},
        **{f"target_moment_{j}": 100 * motion.motor_torque if j == 2 else still for j in range(6)},
        **{f"joint_temperatures_{j}": _smooth(j, n) for j in range(6)},
        "actual_main_voltage": _smooth(9, n),
    }


def numbered_joints(motion: Motion) -> Columns:
    """A cobot's log with encoders on both sides of each joint, in counts."""
    n = motion.time.size
    random = np.random.default_rng(5)
    columns: Columns = {"Timestamp": motion.time, "State": np.ones(n)}
    for j in range(1, 4):
        moves = j == 2
        jitter = np.rint(random.normal(size=n) * 3)
        columns[f"joint_angles_{j}"] = motion.load_angle if moves else np.full(n, 0.2 * j)
        columns[f"joint_velocity_{j}"] = motion.load_velocity if moves else np.zeros(n)
        columns[f"joint_torque_current_{j}"] = 100 * motion.motor_torque if moves else jitter
        columns[f"encoder_motorinc_{j}"] = _counts(motion.motor_angle if moves else np.zeros(n), 24) + jitter
        columns[f"encoder_loadinc_{j}"] = _counts(motion.load_angle if moves else np.zeros(n), 24) + jitter
        columns[f"target_joint_angles_{j}"] = motion.load_angle if moves else np.full(n, 0.2 * j)
    columns["pose_tx"], columns["twist_tx"], columns["wrench_fx"] = _smooth(1, n), _smooth(2, n), _smooth(3, n)
    return columns


SHAPES: dict[str, Shape] = {
    "own names": Shape(
        lambda s: {
            "time": s.time,
            "motor_angle": s.motor_angle,
            "load_angle": s.load_angle,
            "motor_torque": s.motor_torque,
        },
        {
            "motor_angle": ("motor_angle", "rad", 1),
            "load_angle": ("load_angle", "rad", 1),
            "motor_torque": ("motor_torque", None, 1),
        },
    ),
    "symbols of papers": Shape(
        lambda s: {"t": s.time, "theta_m": s.motor_angle, "theta_l": s.load_angle, "T_m": s.motor_torque},
        {
            "theta_m": ("motor_angle", "rad", 1),
            "theta_l": ("load_angle", "rad", 1),
            "T_m": ("motor_torque", None, 1),
        },
    ),
    "degrees in the names": Shape(
        lambda s: {
            "time_ms": 1e3 * s.time,
            "theta_motor_deg": _deg(s.motor_angle),
            "theta_link_deg": _deg(s.load_angle),
            "omega_motor_rpm": _rpm(s.motor_velocity),
            "tau_motor_Nm": s.motor_torque,
        },
        {
            "theta_motor_deg": ("motor_angle", "deg", 1),
            "theta_link_deg": ("load_angle", "deg", 1),
            "omega_motor_rpm": ("motor_velocity", "rpm", 1),
            "tau_motor_Nm": ("motor_torque", "N m", 1),
        },
    ),
    "units in brackets": Shape(
        lambda s: {
            "Time [ms]": 1e3 * s.time,
            "Motor Position [rad]": s.motor_angle,
            "Output Position [deg]": _deg(s.load_angle),
            "Motor Speed [rpm]": _rpm(s.motor_velocity),
            "Motor Current [A]": s.motor_torque / 0.12,
            "Winding Temperature [degC]": _smooth(0, s.time.size),
        },
        {
            "Motor Position": ("motor_angle", "rad", 1),
            "Output Position": ("load_angle", "deg", 1),
            "Motor Speed": ("motor_velocity", "rpm", 1),
            "Motor Current": ("motor_current", "A", 1),
            "Winding Temperature": ("temperature", "degC", 1),
        },
    ),
    "units in words and capitals": Shape(
        lambda s: {
            "Time [Sec]": s.time,
            "Motor Angle [Degrees]": _deg(s.motor_angle),
            "Load Position [DEG]": _deg(s.load_angle),
            "Motor Speed [RPM]": _rpm(s.motor_velocity),
            "Torque [Newton-meters]": s.motor_torque,
        },
        {
            "Motor Angle": ("motor_angle", "Degrees", 1),
            "Load Position": ("load_angle", "DEG", 1),
            "Motor Speed": ("motor_velocity", "RPM", 1),
            "Torque": ("motor_torque", "Newton-meters", 1),
        },
    ),
    "degrees that nobody states": Shape(
        lambda s: {
            "t": s.time,
            "q_motor": _deg(s.motor_angle),
            "q_load": _deg(s.load_angle),
            "dq_motor": s.motor_velocity,
            "tau": s.motor_torque,
        },
        {
            "q_motor": ("motor_angle", "deg", 1),
            "q_load": ("load_angle", "deg", 1),
            "dq_motor": ("motor_velocity", "rad/s", 1),
            "tau": ("motor_torque", None, 1),
        },
    ),
    "German PLC": Shape(
        lambda s: {
            "Zeit [ms]": 1e3 * s.time,
            "Motorwinkel [°]": _deg(s.motor_angle),
            "Abtriebswinkel [°]": -_deg(s.load_angle),
            "Motordrehzahl [1/min]": _rpm(s.motor_velocity),
            "Motordrehmoment [Nm]": s.motor_torque,
            "Schleppfehler [°]": 0.01 * _smooth(1, s.time.size),
        },
        {
            "Motorwinkel": ("motor_angle", "°", 1),
            "Abtriebswinkel": ("load_angle", "°", -1),
            "Motordrehzahl": ("motor_velocity", "1/min", 1),
            "Motordrehmoment": ("motor_torque", "Nm", 1),
        },
    ),
    "LabVIEW": Shape(
        lambda s: {
            "X_Value": s.time,
            "Encoder Motor": s.motor_angle,
            "Encoder Load": s.load_angle,
            "Torque": s.motor_torque,
            "Untitled": _smooth(4, s.time.size),
        },
        {
            "Encoder Motor": ("motor_angle", "rad", 1),
            "Encoder Load": ("load_angle", "rad", 1),
            "Torque": ("motor_torque", None, 1),
        },
        time="X_Value",
    ),
    "ROS bag of a joint": Shape(
        lambda s: {
            "%time": 1.6e18 + np.rint(1e9 * s.time),
            "field.header.seq": np.arange(s.time.size, dtype=float),
            "field.motor_position": s.motor_angle,
            "field.link_position": s.load_angle,
            "field.motor_velocity": s.motor_velocity,
            "field.effort": s.motor_torque,
        },
        {
            "field.motor_position": ("motor_angle", "rad", 1),
            "field.link_position": ("load_angle", "rad", 1),
            "field.motor_velocity": ("motor_velocity", "rad/s", 1),
            "field.effort": ("motor_torque", None, 1),
        },
        time="%time",
    ),
    "ROS joint states": Shape(
        lambda s: {
            "/joint_states/header/stamp": 1.6e9 + s.time,
            "/joint_states/joint_a1/position": s.load_angle,
            "/joint_states/joint_a1/velocity": s.load_velocity,
            "/joint_states/joint_a1/effort": 100 * s.motor_torque,
            "/joint_states/joint_a2/position": np.zeros(s.time.size),
            "/joint_states/joint_a2/velocity": np.zeros(s.time.size),
            "/joint_states/joint_a2/effort": np.zeros(s.time.size),
        },
        {},
        open=("/joint_states/joint_a1/position",),
        ratio=None,
        joint="1",
    ),
    "RTDE of a cobot": Shape(
        rtde,
        {"actual_current_2": ("motor_current", None, 1), "joint_temperatures_2": ("temperature", None, 1)},
        open=("actual_q_2",),
        ratio=None,
        joint="2",
    ),
    "robot state with joint torque": Shape(
        franka,
        {
            "q[1]": ("load_angle", "rad", 1),
            "theta[1]": ("motor_angle", "rad", 1),
            "tau_J[1]": ("joint_torque", None, 1),
        },
        ratio=1.0,
        joint="1",
    ),
    "counts on both sides": Shape(
        numbered_joints,
        {
            "encoder_motorinc_2": ("motor_angle", "rev / 16777216", 1),
            "encoder_loadinc_2": ("load_angle", "rev / 16777216", 1),
            "joint_velocity_2": ("load_velocity", "rad/s", 1),
        },
        joint="2",
    ),
    "MATLAB struct": Shape(
        lambda s: {
            "logsout.motor_angle.Values.Time": s.time,
            "logsout.motor_angle.Values.Data": s.motor_angle,
            "logsout.load_angle.Values.Data": s.load_angle,
            "logsout.torque.Values.Data": s.motor_torque,
        },
        {
            "logsout.motor_angle.Values.Data": ("motor_angle", "rad", 1),
            "logsout.load_angle.Values.Data": ("load_angle", "rad", 1),
            "logsout.torque.Values.Data": ("motor_torque", None, 1),
        },
    ),
    "servo drive": Shape(
        lambda s: {
            "Time / ms": 1e3 * s.time,
            "Axis 1.ActPos / deg": _deg(s.motor_angle),
            "Axis 1.SetPos / deg": _deg(s.motor_angle) + 0.01,
            "Axis 1.ActVelo / rpm": _rpm(s.motor_velocity),
            "Axis 1.ActCurrent / A": s.motor_torque / 0.3,
        },
        {"Axis 1.ActCurrent / A": ("motor_current", "A", 1)},
        open=("Axis 1.SetPos / deg", "Axis 1.ActPos / deg"),
        ratio=None,
    ),
    "channels without names": Shape(
        lambda s: {
            "ch1": s.time,
            "ch2": s.motor_torque,
            "ch3": s.load_angle,
            "ch4": s.motor_velocity,
            "ch5": s.motor_angle,
        },
        {
            "ch3": ("load_angle", "rad", 1),
            "ch4": ("motor_velocity", "rad/s", 1),
            "ch5": ("motor_angle", "rad", 1),
            "ch2": ("motor_torque", None, 1),
        },
        time="ch1",
    ),
    "twist and joint torque": Shape(
        lambda s: {
            "time": s.time,
            "deflection": s.motor_angle / 100 - s.load_angle,
            "joint_torque": -s.joint_torque,
        },
        {"deflection": ("twist", None, 1), "joint_torque": ("joint_torque", None, -1)},
        ratio=None,
    ),
    "series elastic actuator": Shape(
        lambda s: {
            "time": s.time,
            "motorPosition": s.motor_angle,
            "linkPosition": s.load_angle,
            "motorVelocity": s.motor_velocity,
            "linkVelocity": s.load_velocity,
            "motorCurrent": s.motor_torque / 0.2,
            "jointTorque": s.joint_torque,
            "motorTemperature": _smooth(0, s.time.size),
            "positionReference": s.load_angle,
        },
        {
            "motorPosition": ("motor_angle", "rad", 1),
            "linkPosition": ("load_angle", "rad", 1),
            "motorVelocity": ("motor_velocity", "rad/s", 1),
            "linkVelocity": ("load_velocity", "rad/s", 1),
            "motorCurrent": ("motor_current", None, 1),
            "jointTorque": ("joint_torque", None, 1),
            "motorTemperature": ("temperature", None, 1),
        },
    ),
    "an angle that wraps": Shape(
        lambda s: {
            "t": s.time,
            "motor_pos": np.mod(_deg(s.motor_angle), 360.0),
            "link_pos": _deg(s.load_angle),
            "torque": s.motor_torque,
        },
        {
            "motor_pos": ("motor_angle", "deg", 1),
            "link_pos": ("load_angle", "deg", 1),
            "torque": ("motor_torque", None, 1),
        },
    ),
    "motor side alone": Shape(
        lambda s: {"time": s.time, "motor_pos_rad": s.motor_angle, "motor_torque_Nm": s.motor_torque},
        {
            "motor_pos_rad": ("motor_angle", "rad", 1),
            "motor_torque_Nm": ("motor_torque", "N m", 1),
        },
        ratio=None,
    ),
    "input and output": Shape(
        lambda s: {"t": s.time, "u": s.joint_torque, "y": s.motor_angle / 100 - s.load_angle},
        {"u": ("forcing", None, 1), "y": ("dynamic_error", None, 1)},
        ratio=None,
    ),
    "inputs and outputs of a robot": Shape(
        lambda s: {
            "time_train": s.time,
            **{f"u_train(:,{j})": s.motor_torque if j == 2 else _smooth(j, s.time.size) for j in range(1, 4)},
            **{f"y_train(:,{j})": _deg(s.motor_angle) if j == 2 else _smooth(-j % 9, s.time.size) for j in range(1, 4)},
        },
        {"u_train(:,2)": ("motor_torque", None, 1)},
        open=("y_train(:,2)",),
        ratio=None,
        joint="2",
        time="time_train",
    ),
    "seconds and nanoseconds without telling names": Shape(
        lambda s: {
            "stamp": 1.7e9 + np.floor(s.time + 0.3),
            "stamp2": np.rint(np.mod(s.time + 0.3, 1.0) * 1e9),
            "motor_pos": s.motor_angle,
            "link_pos": s.load_angle,
            "torque": s.motor_torque,
        },
        {
            "motor_pos": ("motor_angle", "rad", 1),
            "link_pos": ("load_angle", "rad", 1),
            "torque": ("motor_torque", None, 1),
        },
        time="stamp",
    ),
    "a scope that calls each clock Name": Shape(
        lambda s: {
            "Name": s.time * 1e3,
            "Axis1.ActPos": s.motor_angle,
            "Name (2)": s.time * 1e3,
            "Axis1.ActTorque": s.motor_torque,
            "Name (3)": s.time * 1e3,
            "Load.Pos": s.load_angle,
        },
        {
            "Axis1.ActPos": ("motor_angle", "rad", 1),
            "Load.Pos": ("load_angle", "rad", 1),
            "Axis1.ActTorque": ("motor_torque", None, 1),
        },
        time="Name",
    ),
    "MATLAB's iddata": Shape(
        lambda s: {
            "t": s.time,
            "z.InputData": s.motor_torque,
            "z.OutputData(:,1)": s.motor_angle,
            "z.OutputData(:,2)": s.load_angle,
        },
        {
            "z.InputData": ("motor_torque", None, 1),
            "z.OutputData(:,1)": ("motor_angle", "rad", 1),
            "z.OutputData(:,2)": ("load_angle", "rad", 1),
        },
    ),
    "nothing that is a drive": Shape(
        lambda s: {f"sensor{k}": _smooth(k, s.time.size) for k in range(4)} | {"humidity": _smooth(7, s.time.size)},
        {},
        open=tuple(f"sensor{k}" for k in range(4)),
        ratio=None,
    ),
}
"""Exports of one motion of the same drive, with ratio 100."""
