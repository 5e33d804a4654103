"""One case through the loop: what it said of it, and how wrong it was, as one JSON object."""

import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from fitting.drive_data import Rig, experiments, read_rig, ready_log
from fitting.errors import DataError
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_run import free_run
from fitting.estimation.initial_states import WINDOW
from fitting.files import finite
from fitting.logs.drive_file import DriveFile, read_drive_file
from fitting.loop import close_loop
from fitting.outcome import Loop
from fitting.report import report_dict
from fitting.search_options import SearchOptions
from hdjax import Model, SimulationError
from hdjax.effects import CATALOGUE
from undeclared.black_box import black_box_error
from undeclared.drawing import LOGS
from undeclared.greedy_bic import greedy_bic
from undeclared.hidden import EQUAL
from undeclared.logs import read_tables
from undeclared.sindy import sindy_error, sindy_is_there


def run_case(
    folder: Path, answer: dict, *, leave_out: bool, seed: int, baselines: bool, thorough: bool = False
) -> dict:
    """The loop, and the baselines where asked for, on a case's logs.

    Args:
        folder: with the logs and drive.toml.
        answer: what answer.json says.
        leave_out: whether the hidden families, and those with the same equations, are taken out of the catalogue.
        seed: of the loop.
        baselines: whether to run these too.
        thorough: whether every form is refitted.

    Returns:
        JSON's numbers, strings and nulls only. What goes wrong is told in `error`, and the study goes on.
    """
    hidden = frozenset(answer["families"])
    without = hidden | {EQUAL[family] for family in hidden & EQUAL.keys()} if leave_out else frozenset()
    begun = time.perf_counter()
    result: dict[str, Any] = {"case": answer, "leave_out": leave_out, "error": None}
    try:
        result |= _loop(folder, without, seed, thorough)
    except (DataError, SimulationError) as error:
        result["error"] = f"refused: {error}"
    except Exception:
        # A crash is a finding of the study, to be counted and looked at; the next cases are not to blame.
        result["error"] = traceback.format_exc()
    result["seconds"] = time.perf_counter() - begun
    if baselines:
        result["baselines"] = _baselines(folder, answer)
    return finite(result)


def _loop(folder: Path, without: frozenset[str], seed: int, thorough: bool) -> dict:
    drive = folder / "drive.toml"
    first, second, last = (folder / f"{name}.csv" for name in LOGS)
    rig = read_rig([first, second], drive, test=[last])
    loop = _close(rig, without, seed, thorough)
    report = report_dict(loop, units=rig.logs[0].units)
    drive_file = read_drive_file(drive)
    effects = report["after"]["effects"]
    ties = [a for a in report["alternatives"] if not a["separable"]]
    first = effects[0]["name"] if effects else None
    held_out = {
        stage: held_out_error(loop, model, folder, drive_file)
        for stage, model in (("before", loop.before.model), ("after", loop.after.model))
    }
    return {
        "decision": report["decision"],
        "families": [e["family"] for e in effects],
        "names": [e["name"] for e in effects],
        "p_values": [e["p_value"] for e in effects],
        "gains": [e["gain"] for e in effects],
        "dropped": report["dropped"],
        "ties": sorted({a["family"] for a in ties if a["instead_of"] == first}),
        "all_ties": sorted({a["family"] for a in ties}),
        "unknown_beside": report["unknown_remains"],
        "noise": report["noise"]["dynamic_error"],
        "torque_noise": report["noise"]["torque"],
        "before": report["before"]["parameters"],
        "after": report["after"]["parameters"],
        "effect_parameters": [e["parameters"] for e in effects],
        "rmse": {stage: report[stage]["rmse"] for stage in ("before", "after")},
        "held_out": held_out,
        "forms_tried": report["forms_tried"],
        "laps": report["seconds"],
        "evidence": report["evidence"],
    }


def _close(rig: Rig, without: frozenset[str], seed: int, thorough: bool) -> Loop:
    """The loop as the command line runs it, or with families taken out of the catalogue."""
    offered = rig.experiments
    if "input_delay" in without:
        # Another hold of the torque is a form of this family too.
        offered = {hold: e for hold, e in offered.items() if hold == rig.hold}
    catalogue = tuple(form for form in CATALOGUE if form.family not in without)
    search = SearchOptions(seed=seed, thorough=thorough)
    return close_loop(rig.model, offered, hold=rig.hold, catalogue=catalogue, search=search)


def held_out_error(loop: Loop, model: Model, folder: Path, drive_file: DriveFile) -> float:
    """Rms error [rad] of a free run along the held-out log, as `hdjax predict` makes it.

    The outputs are used in the first WINDOW samples only, which are not counted.
    """
    path = folder / f"{LOGS[2]}.csv"
    log = ready_log(path, drive_file, outputs_until=WINDOW)
    (ready,) = experiments(log, drive_file, loop.hold)
    (run,) = free_run(
        model,
        [Stretch(ready, 0, len(ready))],
        covariance=loop.noise,
        halo=loop.setting.halo,
        substeps=loop.after_substeps,
    )
    rows = slice(None) if ready.rows is None else ready.rows
    measured = read_tables(folder)[2].x
    error = (run.predicted[rows] + log.zero - measured)[WINDOW:]
    return float(np.sqrt(np.mean(error**2))) if np.isfinite(error).all() else np.inf


def _baselines(folder: Path, answer: dict) -> dict:
    """They are told the natural frequency, which a user would read off the logs."""
    tables = read_tables(folder)
    drive, base = answer["drive"], answer["base"]
    omega_0 = float(np.sqrt(base["K"] * (1 / (drive["N"] ** 2 * drive["J_m"]) + 1 / drive["J_l"])))
    begun = time.perf_counter()
    found: dict[str, Any] = {"greedy_bic": greedy_bic(tables[:2], omega_0)}
    found["greedy_bic_seconds"] = time.perf_counter() - begun
    begun = time.perf_counter()
    found["black_box"] = black_box_error(tables, omega_0)
    found["black_box_seconds"] = time.perf_counter() - begun
    if sindy_is_there():
        begun = time.perf_counter()
        found["sindy"], found["sindy_terms"] = sindy_error(tables, omega_0)
        found["sindy_seconds"] = time.perf_counter() - begun
    return found
