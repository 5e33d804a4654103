"""The report of a loop: JSON, text, and statements on what the logs can't determine."""

import dataclasses
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from report_cases import ESTIMATE_KEYS, HEALTH, HOLD, HOSTILE, T_C, VAGUE, with_estimate, with_limits, write_page

import rig
from fitting.attribution.selection_round import Verdict
from fitting.estimation.estimate import Start, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from fitting.logs.findings import Finding
from fitting.outcome import FitOnly, Loop
from fitting.report import Report, explained_share, report_dict, report_text
from fitting.report.limits import limits, parameter_note
from fitting.report.summary import summary
from fitting.uncertainty.standard_errors import Estimate, uncertainty
from fitting.validation.residual_diagnostics import Dependence
from hdjax.effects import FAMILIES
from hdjax.effects.backlash import Backlash
from hdjax.parameters import own_parameters


def leaves(value: object) -> Iterator[object]:
    """All scalars of a nested structure."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from leaves(item)
    else:
        yield value


def test_files_of_an_earlier_report_are_removed(loop: Loop, tmp_path: Path):
    for name in ("posterior.parquet", "next_experiment.csv", "notes.txt"):
        (tmp_path / name).write_text("old", encoding="utf-8")
    Report.of(loop, health=HEALTH, name="rig").write(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "report.json", "model.json", "notes.txt"}


def test_report_json_follows_the_schema(loop: Loop, tmp_path: Path):
    paths = Report.of(loop, health=HEALTH, name="rig").write(tmp_path)
    found = json.loads(paths["report.json"].read_text(encoding="utf-8"))
    assert found["schema"] == "hdjax-report/2"
    assert found["decision"] == "effect_found"
    assert found["noise"]["dynamic_error"] > 0
    for side in ("before", "after"):
        assert found[side]["rmse"]["test"] == found[side]["rmse"]["validation"]
        assert set(found[side]["rmse"]) == {"training", "selection", "test", "validation"}
        assert set(found[side]["parameters"]) == {"K", "alpha", "B_sp"}
        assert all(set(e) >= ESTIMATE_KEYS for e in found[side]["parameters"].values())
    assert found["before"]["effects"] == []
    (effect,) = found["after"]["effects"]
    assert effect["family"] in FAMILIES
    assert 0.5 < effect["gain"] < 1.0 and 0.0 < effect["p_value"] <= 0.01
    assert all(set(e) >= ESTIMATE_KEYS for e in effect["parameters"].values())
    T_c = effect["parameters"]["motor_friction.T_c"]
    # The precision of the estimate is tested with the loop.
    assert T_c["value"] == pytest.approx(T_C, rel=1e-2) and T_c["unit"] == "N m"
    assert found["health"] == [
        {
            "log": HOSTILE,
            "severity": "warning",
            "what": f"8 rows of {HOSTILE} repeat",
            "where": "time",
            "consequence": "they are left out",
        }
    ]
    (log,) = found["logs"]
    assert log == {
        "name": HOSTILE,
        "samples": 3000,
        "training": 1920,
        "selection": 480,
        "test": 600,
        "held_out": 600,
        "seconds": pytest.approx(2997 * rig.STEP),
        "clock_put_back": 0.0,
        "zero": 0.0,
    }
    assert found["hold"] == HOLD and found["dropped"] == [] and found["unexplained"] is None


def test_report_lists_each_step_with_its_error_on_selection_data(loop: Loop):
    base, last = report_dict(loop)["steps"]
    assert base["added"] is None and last["added"] == loop.findings[0].name
    assert last["selection_segments_rmse"] < 0.5 * base["selection_segments_rmse"]
    assert base["segment_seconds"] == pytest.approx(loop.setting.segmentation.horizon * rig.STEP)


def test_growing_error_of_free_runs_is_reported(loop: Loop):
    """Short simulations stay at the noise while free runs do not, as with a dead zone."""
    assert not any("grow" in note for note in report_dict(loop)["cannot_tell"])
    lost = eqx.tree_at(lambda x: x.after.selection[0].predicted, loop, replace_fn=lambda p: p + 1e-3)
    (note,) = (n for n in report_dict(lost)["cannot_tell"] if "grow" in n)
    assert "times the noise" in note


def test_report_of_a_diverged_run_has_only_finite_numbers(loop: Loop):
    broken = eqx.tree_at(lambda x: x.before.test[0].predicted, loop, replace_fn=lambda p: p * np.inf)
    found = report_dict(broken)
    assert found["before"]["rmse"]["test"] is None
    assert all(math.isfinite(v) for v in leaves(found) if isinstance(v, float))
    assert "It keeps free runs along test data from diverging; the error is" in found["summary"]


def test_effects_are_ordered_by_gain_in_the_report(loop: Loop):
    (finding,) = loop.findings
    second = eqx.tree_at(lambda f: f.gain, finding, 0.1)
    both = eqx.tree_at(lambda x: x.findings, loop, (finding, second))
    gains = [e["gain"] for e in report_dict(both)["after"]["effects"]]
    assert gains == sorted(gains, reverse=True) and len(gains) == 2


def test_tie_is_reported_with_the_separating_experiment(loop: Loop):
    """A candidate that is as good as the chosen one is an alternative; a worse one of the same family is not."""
    winner = loop.rounds[0].winner
    tied = Verdict("torque_bias", "torque_sensor", winner.trial, winner.gain, winner.p_value, separable=False)
    apart = Verdict("other", "motor_friction", winner.trial, winner.gain, winner.p_value, separable=True)
    told = eqx.tree_at(lambda x: x.compared[0].verdicts, loop, (winner, tied, apart))
    found = report_dict(told)
    (other,) = found["alternatives"]
    assert (other["family"], other["separable"]) == ("torque_sensor", False)
    assert "both directions" in other["separating_experiment"]
    assert other["selection_rmse"] == other["selection_rmse_of_found"] > 0
    assert any("tie" in note for note in found["cannot_tell"])
    assert "The data do not tell motor friction from torque sensor error." in found["summary"]


def test_unexplained_residual_is_reported_with_its_dependence(loop: Loop):
    worse = eqx.tree_at(lambda x: x.residual_after, loop, loop.residual_before)
    found = report_dict(Loop(**{**vars(worse), "decision": "unexplained"}))
    left = found["unexplained"]
    assert left["times_noise"] == pytest.approx(loop.residual_before.rms / found["noise"]["dynamic_error"])
    # Motor friction jumps with the sign of the motor's speed.
    assert left["depends_on"] in ("motor speed", "dynamic error", "rate of the dynamic error", "motor angle")
    assert left["explained_share"] == max(left["explained_shares"].values())
    assert f"depends most on the {left['depends_on']}" in found["summary"]


def _with_surprise(loop: Loop, beyond: float | None, **changes) -> Loop:
    """A loop with another error of free runs over their bands; None where these say nothing."""
    final = dataclasses.replace(loop.case.final, surprise=beyond, wide_bands=beyond is None)
    return Loop(**{**vars(loop), "case": dataclasses.replace(loop.case, final=final), "surprise": beyond, **changes})


def test_bands_that_say_nothing_are_noted(loop: Loop):
    for beyond in (None, 1.1):
        notes = report_dict(_with_surprise(loop, beyond))["cannot_tell"]
        assert any("bands are wider than the measured dynamic error itself" in n for n in notes) == (beyond is None)


def test_free_runs_that_diverge_are_told_where_the_decision_is_unexplained(loop: Loop):
    found = report_dict(_with_surprise(loop, np.inf, decision="unexplained"))
    assert found["free_runs_times_expected"] is None
    assert "Short segments hardly show it" in found["summary"]
    assert "Free runs diverge: K" in found["before"]["parameters"]["K"]["note"]


def test_unexplained_error_of_free_runs_is_reported(loop: Loop):
    found = report_dict(_with_surprise(loop, 1.4, decision="unexplained"))
    assert found["free_runs_times_expected"] == 1.4
    assert "A part was found" in found["summary"]
    assert "1.40 times what noise and uncertainty allow" in found["summary"]
    assert found["unknown_remains"]


@pytest.mark.parametrize(("beyond", "remains"), [(None, False), (1.1, False), (1.4, True)])
def test_free_runs_beyond_their_bands_are_reported_beside_an_effect(loop: Loop, beyond: float | None, remains: bool):
    found = report_dict(_with_surprise(loop, beyond))
    assert found["unknown_remains"] == remains
    told = "Something unknown is also missing: free runs along training or selection data err by up to"
    assert (told in found["summary"]) == remains
    assert (found["after"]["parameters"]["K"]["flag"] == "not covered") == remains


@pytest.mark.parametrize(("times", "drifts"), [(1.05, False), (24.0, True)])
def test_summary_of_a_sufficient_model_tells_drifting_free_runs_from_noise(loop: Loop, times: float, drifts: bool):
    report = report_dict(loop) | {"decision": "model_sufficient"}
    report["before"]["rmse"]["test"] = times * report["noise"]["dynamic_error"]
    said = summary(report)
    assert ("Free runs drift: on test data it errs by" in said) is drifts
    assert said.startswith("The model suffices: over short segments it leaves only noise, and none") is drifts


@pytest.mark.parametrize(
    ("limited", "why"), [(False, " that the catalogue does not explain."), (True, ": --max-effects ended the search.")]
)
def test_side_on_which_something_is_missing_is_told(loop: Loop, limited: bool, why: str):
    changed = {"decision": "unexplained", "parameters_from": "motor equation", "limited": limited}
    found = report_dict(Loop(**{**vars(loop), **changed}))
    assert f"is missing on the load{why}" in found["summary"]
    assert "depends on none of the quantities" in found["summary"]
    assert found["search_limited"] is limited


def test_learned_term_beside_names_is_told_with_them(loop: Loop):
    """The error falls by all of them together."""
    report = report_dict(Loop(**{**vars(loop), "decision": "unexplained"}))
    report["unknown"] = {"place": "load", "variables": ["theta_l"], "period": None, "memory": None}
    assert "Together with a learned torque on the load" in summary(report)


@pytest.mark.parametrize(("family", "told"), [("load_disturbance", True), ("motor_friction", False)])
def test_time_offset_of_a_log_is_reported(loop: Loop, family: str, told: bool):
    """Where the model depends on time, the report lists the time offset of each log and that its phase is unknown."""
    (finding,) = loop.findings
    late = Loop(**{**vars(loop), "findings": (dataclasses.replace(finding, family=family),), "put_back": (-0.0147,)})
    found = report_dict(late)
    assert [log["clock_put_back"] for log in found["logs"]] == [-0.0147]
    notes = [note for note in found["cannot_tell"] if "clock" in note]
    assert [HOSTILE in note and "\u221214.7 ms" in note for note in notes] == [True] * told


def test_explained_share_is_one_for_a_function_and_zero_for_noise():
    """A residual that is a function of the quantity is explained wholly, and noise is not."""
    random = np.random.default_rng(0)
    mean, error = random.normal(size=40), np.full(40, 0.1)
    exact = Dependence(np.arange(40.0), mean, np.zeros(40))
    assert explained_share(exact, float(np.sqrt(np.mean(mean**2)))) == pytest.approx(1.0)
    noise = Dependence(np.arange(40.0), 0.1 * random.normal(size=40), error)
    # 40 bins of 1/100 of the variance scatter by 0.01 * sqrt(2/40).
    assert explained_share(noise, 1.0) < 0.01


def test_unidentifiable_parameter_is_reported_once_with_its_reason(loop: Loop):
    blind = with_estimate(loop, "after", "alpha", value=50.0, std=1e3, ci95=(-1910.0, 2010.0), identifiable=False)
    blind = with_limits(blind, "after", reasons={"alpha": VAGUE, "motor_friction.T_c": "T_c is open"})
    found = report_dict(blind)
    assert [n for n in found["cannot_tell"] if n.startswith("alpha")] == [VAGUE]
    assert "T_c is open" in found["cannot_tell"]
    assert found["identifiability"]["reasons"]["alpha"] == found["after"]["parameters"]["alpha"]["note"] == VAGUE
    assert found["before"]["parameters"]["alpha"]["note"] is None
    assert "NOT IDENTIFIABLE" in report_text(found)


def test_insignificant_orders_are_reported_in_one_sentence(loop: Loop):
    """Orders whose amplitude is bounded near zero share one sentence."""
    found = report_dict(loop)
    (effect,) = found["after"]["effects"]
    flags = report_text(found).count("NOT TOLD FROM ZERO")
    first, second = "motor_friction.c_1", "motor_friction.c_2"
    entry = {"unit": "N m", "value": 1e-9, "std": 1.5e-9, "ci95": [-2e-9, 4e-9]}
    entry |= {"note": "more samples", "flag": "not told from zero"}
    effect["parameters"] |= {first: entry, second: entry}
    found["identifiability"]["directions"] = [
        {"members": (first, second), "sentence": "the two"},
        {"members": (first, "K"), "sentence": "one and K"},
    ]
    notes = limits(found)
    (told,) = [n for n in notes if first in n]
    assert told.startswith(f"{first} and {second} are not told from zero: at most 4.0 nN m")
    assert "more samples" not in notes and "the two" not in notes and "one and K" in notes
    assert report_text(found).count("NOT TOLD FROM ZERO") == flags + 2
    # An insignificant order that is alone makes the whole effect insignificant.
    effect["parameters"] = {first: entry}
    assert "more samples" in limits(found)


@pytest.mark.parametrize(("gap", "said"), [(2e-4, False), (1e-3, True)])
def test_value_beyond_the_range_of_real_drives_is_noted(loop: Loop, gap: float, said: bool):
    info = dict(own_parameters(Backlash(b=gap)))["b"]
    b = Estimate("backlash.b", gap, 1e-6, 1e-6, (gap - 2e-6, gap + 2e-6), "rad", True)
    note = parameter_note(b, loop.after.identifiability, info)
    assert (note is not None and "real drives have at most 290 µrad" in note) == said
    assert parameter_note(b, loop.after.identifiability) is None


@pytest.mark.parametrize("kind", ["fitted", "loop"])
def test_extrapolation_in_speed_is_reported(kind: str, request: pytest.FixtureRequest, tmp_path: Path):
    outcome = request.getfixturevalue(kind)
    side = "account" if kind == "fitted" else "after"
    assert report_dict(outcome)["extrapolation"] == []
    runs = [run.reach["speed"] for run in (*getattr(outcome, side).training, *getattr(outcome, side).selection)]
    far = eqx.tree_at(lambda o: getattr(o, side).test[0].reach["speed"], outcome, 2.0 * max(runs))
    found = report_dict(far)
    expected = {"quantity": "motor speed", "unit": "rad/s", "fitted": max(runs), "test": 2.0 * max(runs)}
    assert found["extrapolation"] == [pytest.approx(expected)]
    assert "the model extrapolates: motor speed up to" in report_text(found).replace("\n      ", " ")
    assert "the model extrapolates: motor speed up to" in write_page(tmp_path, far)


def test_text_report_tells_warnings_of_the_health_check(loop: Loop):
    noted = ("log", Finding("note", "the sampling jitters", "time", "the stamps are used as they are"))
    text = report_text(report_dict(loop, health=[*HEALTH, noted]))
    assert f"[Log health] warning: {HOSTILE}, time: 8 rows of {HOSTILE} repeat; they are left out" in text
    assert "jitters" not in text


def test_row_heads_of_the_text_report_fit_their_column(loop: Loop):
    report = report_dict(loop)
    for stage in ("before", "after"):
        of_outputs = report[stage]["rmse_of_outputs"]
        of_outputs["motor_velocity"] = of_outputs[report["output"]]
    report["units"]["motor_velocity"] = "rad/s"
    lines = report_text(report).splitlines()
    rows = [line for line in lines if re.match("    (test|motor velocity|noise) ", line)]
    assert {row[4:18].strip() for row in rows} == {"test", "motor velocity", "noise"}
    # The first number ends where its column does.
    assert all(row[31] != " " and row[32] == " " for row in rows)


def test_text_report_lists_parameters_and_decision(loop: Loop):
    text = report_text(report_dict(loop))
    (K,) = re.findall(r"^    K +(\S+) \+/- (\S+) \((\S+) %\) N m/rad +\[(\S+), (\S+)\]$", text, re.MULTILINE)
    value, std, share, low, high = map(float, K)
    # The numbers are shown to 6, 2 and 2 digits.
    assert value == pytest.approx(float(loop.after.model.drive.K), rel=1e-5)
    assert share == pytest.approx(100 * std / value, rel=0.1)
    assert low < value < high
    assert "A missing effect was found: motor friction." in text
    assert "motor_friction.T_c" in text


@pytest.mark.parametrize(
    ("imperfect", "said"),
    [
        (
            True,
            "The residual is 1.90 times the noise, which an inexact law of the effect may explain. The effect removes",
        ),
        (False, "Something unknown is also missing: the residual is 1.90 times the noise. The effect removes"),
    ],
)
def test_summary_states_that_an_inexact_law_may_explain_the_residual(loop: Loop, imperfect: bool, said: str):
    report = report_dict(loop)
    report["times_noise"], report["evidence"]["challenge"]["imperfect"] = 1.9, imperfect
    assert said in summary(report)


def test_reports_of_loop_and_fit_have_the_same_keys(loop: Loop, fitted: FitOnly):
    assert set(report_dict(loop)) == set(report_dict(fitted))


@pytest.mark.parametrize("kind", ["loop", "fitted"])
def test_documentation_describes_every_key_of_report_json(kind, request):
    """Names of schema 1 and keys that are data (paths, effects, outputs) are described in the text of the page."""
    page = (Path(__file__).parents[2] / "docs" / "reference" / "report_json.md").read_text(encoding="utf-8")
    described = set(re.findall(r"`([a-z_0-9]+)`", page))
    report = report_dict(request.getfixturevalue(kind), health=HEALTH)
    keys = set(report) - {"evidence"}
    for part in ("before", "after", "goodness", "frequency_response", "noise", "setting", "engine", "identifiability"):
        keys |= set(report[part] or {})
    for entries in ("rules", "alternatives", "steps", "residual_tests", "logs", "health"):
        keys |= {key for entry in report[entries] for key in entry}
    keys |= {key for estimate in report["before"]["parameters"].values() for key in estimate}
    keys |= {key for effect in report["after"]["effects"] for key in effect}
    earlier = {"validation_gain", "validation_rmse", "validation_rmse_of_found", "held_out_rmse", "held_out"}
    assert keys - described - earlier == set()


@pytest.mark.parametrize("family", ["motor_friction", "torque_sensor"])
def test_intervals_include_those_of_tied_forms_of_the_same_family(loop: Loop, family: str):
    """A fit to half the data stands for the tied form: it has other values and is less certain."""
    winner = loop.rounds[0].winner
    assert winner.trial is not None and winner.family == "motor_friction"
    known = winner.trial.training
    half = [Stretch(s.experiment, s.start, (s.start + s.stop) // 2) for s in known.stretches]
    training = fit(known.model, half, known.free.paths, Segmentation(known.horizon), start=Start(known.covariance))
    trial = dataclasses.replace(winner.trial, model=training.model, training=training)
    tied = Verdict("another", family, trial, winner.gain, winner.p_value, separable=False)
    this = dataclasses.replace(loop.compared[0], verdicts=(winner, tied))
    # `tree_at` would sort the estimates, and their correlations are in that order.
    told = Loop(**{**vars(loop), "compared": (this,)})
    own, theirs = (uncertainty(f, torque_noise=False).estimates for f in (known, training))
    before, after = (report_dict(x)["after"] for x in (loop, told))
    if family != winner.family:
        assert after["parameters"] == before["parameters"] and after["derived"] == before["derived"]
        return
    for path in ("K", "B_sp"):
        wider = theirs[path].std / own[path].std
        value, (low, high) = before["parameters"][path]["value"], before["parameters"][path]["ci95"]
        moved = value + theirs[path].value - own[path].value
        ends = [min(low, moved + wider * (low - value)), max(high, moved + wider * (high - value))]
        assert after["parameters"][path]["ci95"] == pytest.approx(ends, rel=1e-12)
        assert ends[1] - ends[0] > 1.1 * (high - low)
    assert np.diff(after["derived"]["omega_0"]["ci95"]) > np.diff(before["derived"]["omega_0"]["ci95"])
    std, note = before["parameters"]["K"]["std"], after["parameters"]["K"]["note"]
    ends, (low, high) = after["parameters"]["K"]["ci95"], before["parameters"]["K"]["ci95"]
    assert (note is not None) == (max(low - ends[0], ends[1] - high) > std)
