"""Log folders as a user has them, with the answer beside."""

import json
from pathlib import Path

import numpy as np

from undeclared.drawing import LOGS, Drawn, stream, substeps_of
from undeclared.mechanism import Mechanism
from undeclared.predictability import own_error

ROOM = 25.0
"""The reference temperature [degC]."""


def record(drawn: Drawn, folder: Path) -> dict:
    """Write the three logs, drive.toml and answer.json.

    Returns:
        What answer.json says.
    """
    folder.mkdir(parents=True, exist_ok=True)
    random = stream(drawn.case.seed, drawn.case.name + "/noise")
    braked = any(np.any(run.excitation.brake) for run in drawn.runs)
    heated = any(np.any(run.warm) for run in drawn.runs)
    torque_noise = 0.0
    if drawn.case.noisy_torque:
        torque_noise = float(random.uniform(0.01, 0.05) * np.std(drawn.runs[0].torque))
    errors = []
    for name, run in zip(LOGS, drawn.runs, strict=True):
        readings = drawn.encoders.read(run.readings, random)
        wrong = readings - run.readings
        errors.append(wrong[:, 0] / drawn.base.ratio - wrong[:, 1])
        columns = {
            "time": drawn.dt * np.arange(len(readings)),
            "motor_angle": readings[:, 0],
            "load_angle": readings[:, 1],
            "motor_torque": run.torque,
        }
        if torque_noise:
            columns["motor_torque"] = run.torque + torque_noise * random.normal(size=len(readings))
        if braked:
            columns["load_torque"] = run.excitation.brake
        if heated:
            columns["temperature"] = ROOM + run.warm
        table = np.column_stack(list(columns.values()))
        np.savetxt(folder / f"{name}.csv", table, fmt="%.10g", delimiter=",", header=",".join(columns), comments="")
    (folder / "drive.toml").write_text(_drive_file(drawn.base, heated), encoding="utf-8")
    answer = _answer(drawn, float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))) | {"torque_noise": torque_noise}
    (folder / "answer.json").write_text(json.dumps(answer, indent=1) + "\n", encoding="utf-8")
    return answer


def _drive_file(base: Mechanism, heated: bool) -> str:
    text = (
        f'[drive]\nname = "rig"\nreduction_ratio = {base.ratio:g}\nmotor_inertia = {base.motor_inertia:.12g}\n'
        f'load_inertia = {base.load_inertia:.12g}\n\n[signals]\ntorque_hold = "zero-order"\n'
    )
    return text + ('\n[columns]\ntemperature = { column = "temperature", unit = "degC" }\n' if heated else "")


def _answer(drawn: Drawn, noise: float) -> dict:
    base = drawn.base
    undefined = sorted({name for form in drawn.case.forms for name in form.undefined})
    return {
        "name": drawn.case.name,
        "seed": drawn.case.seed,
        "families": [form.family for form in drawn.case.forms],
        "forms": [form.name for form in drawn.case.forms],
        "strengths": list(drawn.strengths),
        "detection_limits": list(drawn.detectable),
        "faint": drawn.case.faint,
        "base": {"K": base.k1, "alpha": base.k3 / base.k1, "B_sp": base.c1},
        "undefined": undefined,
        "drive": {"N": base.ratio, "J_m": base.motor_inertia, "J_l": base.load_inertia},
        "hidden": {k: np.asarray(v).tolist() for k, v in drawn.changes.items() if "teeth" not in k},
        "excitation": [run.excitation.kind for run in drawn.runs],
        "sampling_rate": 1 / drawn.dt,
        "noise": noise,
        "own_error": _own_error(drawn),
        "coloured": drawn.encoders.memory > 0,
    }


def _own_error(drawn: Drawn) -> float:
    """Of the free run along the held-out log."""
    run = drawn.runs[-1]
    return own_error(
        run.mechanism,
        run.states[0, :4],
        run.torque,
        drawn.encoders,
        stream(drawn.case.seed, drawn.case.name + "/start"),
        dt=drawn.dt,
        substeps=substeps_of(drawn.dt),
        brake=run.excitation.brake,
        warm=run.warm,
    )
