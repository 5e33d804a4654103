"""Verdicts, tables and reference methods of the study on cases with known answers."""

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="the study needs the extra `benchmark`")

from undeclared.black_box import black_box_error
from undeclared.greedy_bic import greedy_bic
from undeclared.logs import Table as Log
from undeclared.tally import tables, verdict


def result(truth: list[str], said: list[str], *, ties: tuple[str, ...] = (), decision: str = "", **more) -> dict:
    estimate = {"value": 7070.0, "std": 50.0, "ci95": [6970.0, 7170.0]}
    case = {
        "families": truth,
        "base": {"K": 7000.0, "alpha": 2000.0, "B_sp": 0.3},
        "undefined": [],
        "noise": 1e-6,
        "own_error": 0.0,
        "coloured": False,
        "name": "case-0",
        "torque_noise": 0.0,
        "detection_limits": [100.0],
    }
    return {
        "case": case | more.pop("case", {}),
        "leave_out": False,
        "error": None,
        "families": said,
        "decision": decision or ("effect_found" if said else "model_sufficient"),
        "unknown_beside": False,
        "ties": list(ties),
        "all_ties": list(ties),
        "before": {"K": estimate | {"value": 7700.0, "ci95": [7600.0, 7800.0]}},
        "after": {"K": estimate},
        "held_out": {"before": 5e-6, "after": 1.1e-6},
        "seconds": 60.0,
    } | more


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        (result(["backlash"], ["backlash", "creep"]), "right"),
        (result(["backlash"], ["creep"]), "wrong"),
        (result(["backlash"], ["creep"], ties=("backlash",)), "tied"),
        (result(["backlash"], []), "missed"),
        (result(["backlash"], [], decision="unexplained"), "unexplained"),
        (result(["backlash"], ["backlash"], error="refused: no"), "error"),
        (result([], []), "right"),
        (result([], ["creep"]), "false alarm"),
        (result([], [], decision="unexplained"), "false alarm"),
        (result(["unknown"], [], decision="unexplained"), "right"),
        (result(["unknown"], ["unknown"]), "right"),
        (result(["unknown"], ["creep"]), "wrong"),
        (result(["creep"], ["backlash"], leave_out=True), "wrong"),
        (result(["creep"], ["backlash"], ties=("hysteresis",), leave_out=True), "tied"),
        (result(["creep"], ["backlash"], unknown_beside=True, leave_out=True), "tied"),
        (result(["creep"], ["backlash"], decision="unexplained", leave_out=True), "right"),
        (result(["creep"], [], leave_out=True), "missed"),
    ],
)
def test_verdict_compares_named_families_with_the_truth(case: dict, expected: str):
    assert verdict(case) == expected


def test_tables_count_known_results():
    results = [
        result(["backlash"], ["backlash"]),
        result(["backlash"], ["creep"]),
        result(["creep"], ["backlash"], ties=("creep",), case={"detection_limits": [3.0]}),
        result([], []),
        result([], ["creep"], case={"coloured": True}),
        result(["creep", "backlash"], ["backlash"], ties=("creep",)),
        result(["creep", "cogging"], ["cogging", "creep"]),
        result(["creep"], [], decision="unexplained", leave_out=True),
    ]
    told = {table.title: table for table in tables(results)}
    confusion = told["First family named (rows: truth)"].rows
    assert confusion[0] == ("backlash", "1", "0", "creep 1")
    assert confusion[1] == ("creep", "0", "1", "")
    assert confusion[2][1].startswith("66.7 % (2 of 3;")
    strengths = [row[:4] for row in told["Hidden effect, by strength"].rows]
    assert strengths == [
        ("up to 20 detection limits", "0", "1", "0"),
        ("up to 1000 detection limits", "1", "0", "1"),
        ("all", "1", "1", "1"),
    ]
    # Clopper and Pearson's interval for 1 of 2 is 1.3 to 98.7 %: (1 - p)^2 = 0.975 at its end.
    assert told["Clean cases: false alarms"].rows[-1] == ("all", "50.0 % (1 of 2; 1.3 to 98.7 %)", "creep 1")
    pairs = dict(told["Pairs of effects"].rows)
    assert pairs["both named"].startswith("50.0 %") and pairs["both named or tied"].startswith("100.0 %")
    assert told["Family left out of the catalogue"].rows[0][:2] == ("creep", "1")
    errors = {row[0]: row[1:] for row in told["Held-out free-run error over noise"].rows}
    assert errors["one effect"] == ("5", "5", "1.1", "1.1", "1", "1", "1.1", "1.1")
    bias = told["Bias of the base parameters"].rows
    assert bias[0][:6] == ("K", "before", "+14", "14", "+10 %", "10 %") and bias[0][6].startswith("0.0 %")
    assert bias[1][:6] == ("K", "after", "+1.4", "1.4", "+1 %", "1 %") and bias[1][6].startswith("100.0 %")
    assert all("|" in table.text(markdown=True) for table in told.values())


def test_diverged_prediction_counts_as_infinite_error():
    cases = [result(["creep"], ["creep"], held_out={"before": 5e-6, "after": None}) for _ in range(3)]
    (errors,) = [t for t in tables(cases) if t.title.startswith("Held-out")]
    assert errors.rows[0][3:5] == ("inf", "inf")


def test_held_out_error_is_relative_to_that_of_the_true_equations():
    """The true equations err by 3 times the noise, because their initial state is estimated."""
    case = result(["backlash"], ["backlash"], case={"own_error": 3e-6}, held_out={"before": 9e-6, "after": 3.2e-6})
    (errors,) = [t for t in tables([case]) if t.title.startswith("Held-out")]
    assert errors.rows[0][5::2] == ("3.16", "1.01")


def linear_log(bias: float, seed: int) -> Log:
    """A linear drive in closed form between samples (matrix exponential), with 3e-7 rad of noise."""
    from scipy.linalg import expm

    random = np.random.default_rng(seed)
    n, j_m, j_l, k, b, dt, count = 50.0, 5e-4, 5e-2, 7000.0, 0.6, 1e-3, 4000
    row = np.array([1 / n, 0, -1, 0]) * k + np.array([0, 1 / n, 0, -1]) * b
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1
    a[1, :4], a[3, :4], a[1, 4] = -row / (n * j_m), row / j_l, 1 / j_m
    step = expm(a * dt)
    torque = np.repeat(random.normal(size=count // 4), 4) * 0.2
    torque -= torque.mean()
    y = np.zeros((count, 5))
    # The motor turns both ways; otherwise a bias is confounded with friction.
    y[0, :4] = 0.0, -60.0, 0.0, -60.0 / n
    for i in range(count - 1):
        y[i, 4] = torque[i] + bias
        y[i + 1] = step @ y[i]
    noise = 3e-7 * random.normal(size=(count, 2))
    columns = {
        "time": dt * np.arange(count),
        "motor_angle": y[:, 0] + n * noise[:, 0],
        "load_angle": y[:, 2] + noise[:, 1],
        "motor_torque": torque,
    }
    return Log(columns, n, j_m, j_l, dt)


OMEGA_0 = float(np.sqrt(7000 * (1 / (50**2 * 5e-4) + 1 / 5e-2)))


def test_greedy_bic_identifies_a_torque_bias():
    assert greedy_bic([linear_log(0.02, 0), linear_log(0.02, 1)], OMEGA_0)[0] == "torque_sensor"


def test_black_box_predicts_a_linear_drive():
    logs = [linear_log(0.0, seed) for seed in range(3)]
    assert black_box_error(logs, OMEGA_0) < 0.1 * np.std(logs[2].x)


def test_study_rig_does_not_import_the_tested_packages():
    """The rig shares no code with the tested packages: only the files that run or re-evaluate cases import them."""
    folder = Path(__file__).parents[2] / "benchmarks" / "undeclared"
    allowed = {"trial.py", "run.py", "replay.py"}
    told = {f.name for f in folder.glob("*.py") if re.search(r"(from|import) (hdjax|fitting)\b", f.read_text())}
    assert told == allowed
