"""`hdjax design`: valid and invalid design files, and parameter draws from the report of a fit."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from invocation import run

from fitting.commands.design_file import read_design_file
from fitting.commands.parameter_draws import drawn_from_report, spread_around
from fitting.errors import DataError, InputError
from fitting.stored_model import StoredModel, to_json
from hdjax import TwoInertiaModel, hdc_40_050
from hdjax.design import MEASURES

pytestmark = pytest.mark.usefixtures("own_cache")

GOOD = """
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
[robust]
spread = { J_l = 0.2 }
draws = 16
share = 0.25
[search]
starts = 2
points = 3
"""


def write_design_file(folder: Path, text: str) -> Path:
    path = folder / "spec.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_design_command_writes_the_confirmed_best_design(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run("design", write_design_file(tmp_path, GOOD), "--out", tmp_path / "out") == 0
    found = json.loads((tmp_path / "out" / "design.json").read_text())
    assert found["schema"] == "hdjax-design/1" and found["confirmed"] and found["feasible"]
    best = found["best"]
    # The motor's speed limits the ratio to 90/1.5; nothing limits the size of the gear.
    assert best["values"] == {"N": pytest.approx(60.0, rel=1e-6), "size": pytest.approx(65.0)}
    assert best["at_bound"] == {"size": "high"} and best["bound_multipliers"]["size"] > 0.0
    assert best["multipliers"]["motor_speed"] > 0.0
    # The torque rises with the load's inertia, which alone is drawn.
    assert best["measures"]["effort"]["worst"] > best["measures"]["effort"]["expected"]
    assert found["draws"] == 16 and len(found["starts"]) == 2
    assert (tmp_path / "out" / "design.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert "Best design" in said and "Confirmed: none of 9 designs" in said and "at its high bound" in said


def test_infeasible_design_is_reported_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    text = GOOD.replace("at_most = 90.0", "at_most = 20.0")
    assert run("design", write_design_file(tmp_path, text), "--out", tmp_path / "out", "--no-plot") == 1
    told = capsys.readouterr()
    assert "no design that was found meets all limits" in told.err and "MISSED by 125 %" in told.out
    assert not json.loads((tmp_path / "out" / "design.json").read_text())["feasible"]


BAD = {
    "no such file": (None, "can't be read"),
    "not TOML": ("[drive", "not a TOML file"),
    "unknown section": (GOOD + "[extra]\n", "[extra] is not known"),
    "unknown preset": (GOOD.replace("J_l = 0.8", 'preset = "X"'), "preset must be one of HDC-40-050"),
    "negative inertia": (GOOD.replace("J_l = 0.8", "J_l = -1.0"), "[drive] J_l must be between 0 and 1e+06"),
    "unknown effect": (GOOD + "[effects.magic]\n", "[effects.magic] is not an effect"),
    "no variables": (GOOD.replace("N = {", "# ").replace("size = {", "# "), "[variables] must name"),
    "falling range": (GOOD.replace("from = 30", "from = 300"), "range that rises"),
    "unknown variable": (GOOD.replace("N = {", "Q = {"), "`Q` is no parameter of this drive"),
    "no end": (GOOD.replace("from = 30, ", ""), "[variables.N] must have `from`"),
    "unknown measure": (GOOD.replace('"motor_torque"', '"torque"'), "measure must be one of peak_error"),
    "missing number": (GOOD.replace("acceleration = 8.0", ""), "[objective.effort] must have `acceleration`"),
    "stray number": (GOOD.replace("acceleration =", "speed = 1\nacceleration ="), "[objective.effort] speed"),
    "text for a number": (GOOD.replace("= 8.0", '= "fast"'), "acceleration must be a number, but is 'fast'"),
    "a limit without a side": (GOOD.replace("at_most = 90.0", ""), "one of `at_most` and `at_least`"),
    "both sources": (GOOD.replace("spread =", 'report = "x"\nspread ='), "model.json"),
    "neither source": (GOOD.replace("spread = { J_l = 0.2 }", ""), "one of `report`"),
    "a spread of nothing": (GOOD.replace("J_l = 0.2", "alpha_2 = 0.2"), "alpha_2 is not known"),
    "a wide spread": (GOOD.replace("J_l = 0.2", "J_l = 3.0"), "J_l must be between 0 and 1"),
    "half a start": (GOOD.replace("starts = 2", "starts = 2.5"), "starts must be a whole number"),
    "wide": (GOOD + "width = 2.0\n", "width must be above 0 and at most 1"),
    "criterion": (GOOD.replace("share = 0.25", 'criterion = "best"'), "criterion must be one of expected, worst"),
    "a range beyond physics": (
        GOOD.replace('N = { from = 30, to = 160, spacing = "log" }', "N = { from = -30, to = 160 }"),
        "`N` must stay between 0",
    ),
    "no damping": (
        GOOD.replace("B_sp = 5.0", "B_sp = 0.0").replace('"static_twist"', '"settling_time"\nband = 1e-5'),
        "`settling_time` needs damping",
    ),
    "no torque": (
        GOOD.replace('measure = "static_twist"\ntorque = 20.0', 'measure = "peak_error"\nslow = 1.0\nfast = 2.0'),
        "`peak_error` needs a torque",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_invalid_design_file_is_refused_in_one_sentence(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    text, message = BAD[name]
    path = tmp_path / "spec.toml" if text is None else write_design_file(tmp_path, text)
    assert run("design", path, "--out", tmp_path / "out") == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1 and "Traceback" not in told
    assert not (tmp_path / "out").exists()


# -- the folder of a fit --


def write_fit_report(folder: Path, *, posterior: bool = False, **changes: object) -> Path:
    """Write those parts of a report of `hdjax fit` that draws need."""
    model = TwoInertiaModel(hdc_40_050())
    stored = StoredModel(model, "zero-order", 1, 0, jnp.eye(2))
    (folder / "model.json").write_text(to_json(stored))
    parameters = {
        "K": {"value": 7160.0, "std": 70.0, "identifiable": True},
        "B_sp": {"value": 0.017, "std": 0.002, "identifiable": True},
        "alpha": {"value": 1e5, "std": 2e4, "identifiable": True} | changes,
    }
    account = {"parameters": parameters, "correlations": [{"between": ["K", "alpha"], "value": -0.9}]}
    report = {"before": account, "after": {"parameters": {}}, "posterior": {"draws": 9} if posterior else None}
    (folder / "report.json").write_text(json.dumps(report))
    return folder


def test_parameter_draws_have_the_reported_standard_errors_and_correlations(tmp_path: Path):
    draws = drawn_from_report(write_fit_report(tmp_path), 400)
    assert draws.paths == ("K", "B_sp", "alpha")
    values = np.asarray(draws.values)
    # A Latin hypercube gives means far better than 1/sqrt(400), and spreads and correlations to a few percent.
    np.testing.assert_allclose(values.mean(axis=0), [7160.0, 0.017, 1e5], rtol=0.01)
    np.testing.assert_allclose(values.std(axis=0), [70.0, 0.002, 2e4], rtol=0.08)
    np.testing.assert_allclose(np.corrcoef(values.T)[0], [1.0, 0.0, -0.9], atol=0.06)
    assert (values[:, :2] > 0.0).all()
    assert drawn_from_report(tmp_path, 8, hold=["alpha"]).paths == ("K", "B_sp")


def test_posterior_draws_take_precedence_over_the_normal_distribution(tmp_path: Path):
    folder = write_fit_report(tmp_path, posterior=True)
    table = pl.DataFrame(
        {"chain": [0] * 9, "draw": range(9), "K": np.arange(9.0), "B_sp": [1.0] * 9, "alpha": [2.0] * 9}
    )
    table.write_parquet(folder / "posterior.parquet")
    np.testing.assert_allclose(np.asarray(drawn_from_report(folder, 3).values)[:, 0], [0.0, 4.0, 8.0])
    # A later fit into the same folder, without draws.
    write_fit_report(folder)
    assert np.asarray(drawn_from_report(folder, 3).values)[:, 0].min() > 6000.0


def test_posterior_draws_of_other_parameters_are_refused(tmp_path: Path):
    folder = write_fit_report(tmp_path, posterior=True)
    pl.DataFrame({"mu": [1.0]}).write_parquet(folder / "posterior.parquet")
    with pytest.raises(InputError, match="not the draws of K, B_sp, alpha"):
        drawn_from_report(folder, 3)


def test_unidentifiable_parameter_is_not_drawn(tmp_path: Path):
    with pytest.raises(DataError, match=r"does not determine alpha.*hold = \[\"alpha\"\]"):
        drawn_from_report(write_fit_report(tmp_path, identifiable=False, std=None), 8)


def test_design_study_draws_parameters_from_a_fit_report(tmp_path: Path):
    folder = tmp_path / "fit"
    folder.mkdir()
    write_fit_report(folder)
    text = """
[variables]
N = { from = 30, to = 160 }
[objective.static_twist]
torque = 20.0
[robust]
report = "fit"
hold = ["B_sp"]
draws = 4
"""
    asked = read_design_file(write_design_file(tmp_path, text))
    assert float(asked.study.case.drive.K) == 7160.0
    assert asked.study.draws is not None and asked.study.draws.paths == ("K", "alpha")
    assert asked.study.criterion == "worst" and asked.search.starts == 8


def test_parameter_spread_is_relative_to_the_value():
    draws = np.asarray(spread_around({"K": 100.0, "alpha": -2.0}, {"K": 0.1, "alpha": 0.2}, 500).values)
    np.testing.assert_allclose(draws.mean(axis=0), [100.0, -2.0], rtol=0.01)
    np.testing.assert_allclose(draws.std(axis=0), [10.0, 0.4], rtol=0.05)
    assert (draws[:, 1] < 0.0).all()


def test_documented_design_file_is_read(tmp_path: Path):
    page = (Path(__file__).parents[2] / "docs" / "design.md").read_text(encoding="utf-8")
    asked = read_design_file(write_design_file(tmp_path, page.split("```toml")[1].split("```")[0]))
    assert [v.path for v in asked.study.variables] == ["size", "N"]
    assert [limit.label for limit in asked.study.limits] == ["motor_speed"] and asked.search.starts == 8
    for name in MEASURES:
        assert f"| `{name}` |" in page
