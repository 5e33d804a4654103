"""Drive files, sweep and design files, and models and a report as earlier versions wrote them."""

import json

INERTIAS = "motor_inertia = 5.26e-4\nload_inertia = 5.0e-2\n"


def drive(hold: str | None = "zero-order", *, columns: str = "", ratio: float = 50, inertias: str = INERTIAS) -> str:
    """A drive file.

    Args:
        hold: what the torque does between samples; not stated where None.
        columns: lines of `[columns]`.
        ratio: the reduction ratio that is stated.
        inertias: lines that state them.
    """
    stated = f'[signals]\ntorque_hold = "{hold}"\n' if hold else ""
    return f'[drive]\nname = "rig"\nreduction_ratio = {ratio:g}\n{inertias}{stated}[columns]\n{columns}'


_LARA_RATIOS = {2: 121, 3: 101, 5: 101}
_LARA_SIGNS = {2: -1, 3: 1, 5: 1}


def _lara(joint: int) -> str:
    """The drive file of a cobot's joint, for a quasi-static log."""
    angle = '{{ column = "encoder_{side}inc_{joint}", unit = "rev / 16777216" }}'
    return (
        f"[drive]\nreduction_ratio = {_LARA_RATIOS[joint]}\n[columns]\n"
        f'time = "Timestamp"\nmotor_angle = {angle.format(side="motor", joint=joint)}\n'
        f"load_angle = {angle.format(side='load', joint=joint)}\n"
        f'joint_torque = {{ column = "joint_torque_current_{joint}", sign = {_LARA_SIGNS[joint]} }}\n'
    )


_UNITS = """\
time = { column = "time", unit = "ms" }
motor_angle = { column = "enc_m", sign = -1, offset = 3.5 }
load_angle = { column = "enc_l", unit = "deg" }
motor_torque = { column = "torque", unit = "mN m" }
"""

DRIVES = {
    "drive": drive(),
    "drive_linear": drive("linear"),
    "drive_cubic": drive("cubic"),
    "drive_band": drive("band-limited"),
    "drive_no_hold": drive(None),
    "drive_units": drive(columns=_UNITS),
    "drive_celsius": drive(columns='temperature = { column = "temperature", unit = "degC" }\n'),
    "drive_wrong_ratio": drive(ratio=100),
    "drive_no_inertia": drive(inertias=""),
    "drive_unknown_key": drive(inertias=INERTIAS + "colour = 3\n"),
    "drive_not_toml": "[drive\nreduction_ratio = 50\n",
    "reduced": '[signals]\ntorque_hold = "zero-order"\n[columns]\ndynamic_error = { unit = "V", column = "y" }\n'
    'forcing = { unit = "V", column = "u" }\n',
    "static": "[drive]\nrated_torque = 54.0\n",
    "silverbox": '[signals]\nsample_rate = 610.3515625\ntorque_hold = "band-limited"\n[columns]\n'
    'dynamic_error = { column = "V2", unit = "V" }\nforcing = { column = "V1", unit = "V" }\n',
    "bouc_wen": '[columns]\ndynamic_error = { column = "multisine/y", unit = "mm" }\n'
    'forcing = { column = "u", unit = "N" }\n',
    **{f"lara_{joint}": _lara(joint) for joint in _LARA_RATIOS},
}
"""Drive files by the name of the file."""

_PREAMBLE = "[drive]\nalpha = 50.0\nB_sp = 0.2\n[forcing]\namplitude = 2.0\n"
SWEEPS = {
    "sweep_steady": _PREAMBLE + "[axes]\nK = { from = 6e3, to = 9e3, points = 5 }\n"
    '"forcing.omega" = { from = 250.0, to = 500.0, points = 40 }\n'
    '[sweep]\nresponse = "steady"\noutputs = ["amplitude", "peak", "harmonics"]\ntolerance = 1e-6\n',
    "sweep_transient": _PREAMBLE + "omega = 300.0\n[axes]\nK = { from = 6e3, to = 9e3, points = 40 }\n"
    '[sweep]\nresponse = "transient"\nduration = 0.3\nwindows = 10\noutputs = ["peak", "settling_time"]\n'
    "tolerance = 1e-6\n",
    "sweep_sample": _PREAMBLE + "omega = 300.0\n[effects.quadratic_stiffness]\nk2 = 0.5\n"
    '[sample]\npoints = 64\nrule = "sobol"\n[sample.ranges]\nK = { from = 6e3, to = 9e3 }\n'
    'B_sp = { from = 0.02, to = 2.0, spacing = "log" }\n'
    '[sweep]\nresponse = "transient"\nperiods = 10\nwindows = 5\noutputs = ["peak"]\ntolerance = 1e-4\n',
    "sweep_unknown_key": _PREAMBLE + "mass = 3.0\n[axes]\nK = [6e3, 7e3]\n",
}
"""Sweep files by the name of the file."""

_DESIGN = """\
[drive]
J_l = 0.8
B_sp = 5.0
[variables]
N = { from = 30, to = 160, spacing = "log" }
size = { from = 14, to = 65, spacing = "log" }
[objective.effort]
measure = "motor_torque"
acceleration = 8.0
load_torque = 20.0
[objective.wind]
measure = "static_twist"
torque = 20.0
weight = 1e4
[limits.motor_speed]
load_speed = 1.5
at_most = 90.0
[search]
starts = 2
points = 3
"""
_RESPONSE = """\
[drive]
alpha = 1e4
[forcing]
amplitude = 0.05
[variables]
B_sp = { from = 0.05, to = 5.0, spacing = "log" }
[objective.peak_error]
slow = 200.0
fast = 500.0
[objective.loss]
slow = 200.0
fast = 500.0
weight = 1e-3
[search]
starts = 2
points = 3
"""
_REPORT = """\
[variables]
B_sp = { from = 0.05, to = 5.0, spacing = "log" }
[objective.settling_time]
torque = 5.0
band = 1e-5
[robust]
report = "old_report"
draws = 4
[search]
starts = 2
points = 3
"""
DESIGNS = {
    "design_closed": _DESIGN + "[robust]\nspread = { J_l = 0.2 }\ndraws = 16\nshare = 0.25\n",
    "design_infeasible": _DESIGN.replace("at_most = 90.0", "at_most = 20.0"),
    "design_response": _RESPONSE,
    "design_report": _REPORT,
}
"""Design files by the name of the file."""


def _model(kind: str, base: dict[str, float], effects: list[dict]) -> dict:
    outputs = 1 if kind == "reduced" else 2
    return {
        "schema": "hdjax-model/1",
        "kind": kind,
        "drive": base,
        "effects": effects,
        "torque_hold": "zero-order",
        "substeps": 2,
        "halo": 0,
        "noise_covariance": [[1e-12 if i == j else 0.0 for j in range(outputs)] for i in range(outputs)],
    }


_BASE = {"N": 50.0, "J_m": 5.26e-4, "J_l": 0.05, "K": 7160.0, "alpha": 4000.0, "B_sp": 0.3}
_KINEMATIC = {"cos_1": 0.0, "sin_1": 0.0, "cos_2": 1.2e-4, "sin_2": -9e-5, "cos_4": 0.0, "sin_4": 0.0}
_LEARNED = {
    "name": "learned_mesh_torque",
    "parameters": {f"c_{i}": 0.1 * (i + 1) for i in range(5)},
    "axes": [{"variable": "x", "largest": 1e-3}],
    "mixing": [[float(i == j) for j in range(5)] for i in range(5)],
}
_REDUCED = {"mu": 6.2, "omega_0": 385.5, "alpha": 4e-3, "gain": 1.9011e4}


def _estimate(value: float, std: float, unit: str) -> dict:
    return {"value": value, "std": std, "ci95": [value - 2 * std, value + 2 * std], "unit": unit, "identifiable": True}


_PARAMETERS = {
    "K": _estimate(7160.0, 30.0, "N m/rad"),
    "alpha": _estimate(4000.0, 100.0, "rad^-2"),
    "B_sp": _estimate(0.3, 0.01, "N m s/rad"),
}
_OLD_REPORT = {
    "schema": "hdjax-report/1",
    "version": "0.1.0",
    "name": "rig",
    "decision": "fit_only",
    "before": {"effects": [], "parameters": _PARAMETERS, "correlations": [{"between": ["K", "alpha"], "value": -0.9}]},
    "after": {"effects": [], "parameters": {}, "correlations": []},
}

DOCUMENTS = {
    "old_model.json": json.dumps(_model("two-inertia", _BASE, [])),
    "old_kinematic.json": json.dumps(
        _model("two-inertia", _BASE, [{"name": "kinematic_error", "parameters": _KINEMATIC}])
    ),
    "old_learned.json": json.dumps(_model("two-inertia", _BASE, [_LEARNED])),
    "old_reduced.json": json.dumps(
        _model("reduced", _REDUCED, [{"name": "quadratic_stiffness", "parameters": {"k2": 0.02}}])
    ),
    "broken_model.json": json.dumps(_model("two-inertia", {"N": 50.0}, [])),
    "old_report/model.json": json.dumps(_model("two-inertia", _BASE, [])),
    "old_report/report.json": json.dumps(_OLD_REPORT),
}
"""Files of version 0.1.0, by path."""
