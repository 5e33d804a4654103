"""The report says what the loop found, in numbers that others can read, and is written whole or not at all."""

import dataclasses
import json
import math
import os
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import numpy as np
import plotly.graph_objects as go
import polars as pl
import pytest
from browser import shown
from scipy import stats

import rig
from fitting import formatting
from fitting.attribution.selection_round import Verdict
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Experiment, whole
from fitting.estimation.starting_values import starting_models
from fitting.fit_drive import fit_only
from fitting.logs.findings import Finding
from fitting.loop import close_loop
from fitting.outcome import FitOnly, Loop
from fitting.report import (
    Report,
    explained_share,
    report_dict,
    report_text,
    separating_experiment,
)
from fitting.report.intervals import is_withheld, say_what_intervals_hold
from fitting.report.limits import limits, parameter_note
from fitting.report.plots import decimated, fit_plots, plots
from fitting.report.summary import _change, _remembering, summary
from fitting.report.web_page import environment
from fitting.search_options import SearchOptions
from fitting.stored_model import to_json
from fitting.uncertainty.posterior import Posterior
from fitting.uncertainty.standard_errors import Estimate, Uncertainty
from fitting.validation.residual_diagnostics import Dependence
from hdjax import Hold
from hdjax.effects import FAMILIES
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.backlash import Backlash
from hdjax.effects.friction import MotorFriction
from hdjax.parameters import own_parameters

HOSTILE = "<script>alert(1)</script>"
HOLD: Hold = "zero-order"
T_C = 0.03
HEALTH = [(HOSTILE, Finding("warning", f"8 rows of {HOSTILE} repeat", "time", "they are left out"))]
FILES = {"report.html", "report.json", "model.json"}
ESTIMATE_KEYS = {"value", "std", "ci95", "unit", "identifiable"}


@pytest.fixture(scope="module")
def loop() -> Loop:
    """The loop closed on one log of a drive with motor friction, with two forms to choose from."""
    known, test = rig.drive_parts(2400, 600, motor_friction=(T_C, 0.05), name=HOSTILE)
    data: dict[Hold, tuple[Experiment, ...]] = {HOLD: (known,)}
    start = rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0)
    forms = (MotorFriction, TorqueBias)
    return close_loop(start, data, test={HOLD: (test,)}, hold=HOLD, catalogue=forms, search=SearchOptions(1))


@pytest.fixture(scope="module")
def fitted() -> FitOnly:
    """A fit of the same log, which has a hostile name."""
    known, test = rig.drive_parts(2400, 600, motor_friction=(T_C, 0.05), name=HOSTILE)
    return fit_only(rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0), {HOLD: (known,)}, test={HOLD: (test,)}, hold=HOLD)


@pytest.fixture
def page(loop: Loop, tmp_path: Path) -> str:
    return write_page(tmp_path, loop)


def write_page(folder: Path, outcome: Loop | FitOnly) -> str:
    """The written page without plotly's own code, which mentions addresses that it does not visit."""
    paths = Report.of(outcome, health=HEALTH, name=HOSTILE).write(folder)
    text = paths["report.html"].read_text(encoding="utf-8")
    start, end = text.index("<script>"), text.index("</script>")
    assert "plotly.js" in text[start : start + 200]
    return text[:start] + text[end:]


def with_estimate(outcome, side: str, path: str, **changes):
    """An outcome with another estimate of a parameter."""
    account = getattr(outcome, side)
    known = account.uncertainty.estimates
    estimates = known | {path: dataclasses.replace(known[path], **changes)}
    changed = dataclasses.replace(account, uncertainty=dataclasses.replace(account.uncertainty, estimates=estimates))
    return dataclasses.replace(outcome, **{side: changed})


def with_limits(outcome, side: str, **changes):
    """An outcome whose logs can't tell other things."""
    account = getattr(outcome, side)
    changed = dataclasses.replace(account.identifiability, **changes)
    return dataclasses.replace(outcome, **{side: dataclasses.replace(account, identifiability=changed)})


def leaves(value: object) -> Iterator[object]:
    """All scalars of a nested structure."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from leaves(item)
    else:
        yield value


def test_json_is_the_schema_that_others_read(loop: Loop, tmp_path: Path):
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
    # The report's own number, not the loop's precision: that is tested with the loop.
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
    }
    assert found["hold"] == HOLD and found["dropped"] == [] and found["unexplained"] is None


def test_each_step_with_its_error_on_selection_data(loop: Loop):
    base, last = report_dict(loop)["steps"]
    assert base["added"] is None and last["added"] == loop.findings[0].name
    assert last["selection_segments_rmse"] < 0.5 * base["selection_segments_rmse"]
    assert base["segment_seconds"] == pytest.approx(loop.setting.segmentation.horizon * rig.STEP)


def test_free_runs_that_leave_a_right_model_are_told(loop: Loop):
    """As behind a dead zone: short simulations stay at the noise, long ones can't."""
    assert not any("grow" in note for note in report_dict(loop)["cannot_tell"])
    lost = eqx.tree_at(lambda x: x.after.selection[0].predicted, loop, replace_fn=lambda p: p + 1e-3)
    (note,) = (n for n in report_dict(lost)["cannot_tell"] if "grow" in n)
    assert "times the noise" in note


def test_every_number_is_finite(loop: Loop):
    broken = eqx.tree_at(lambda x: x.before.test[0].predicted, loop, replace_fn=lambda p: p * np.inf)
    found = report_dict(broken)
    assert found["before"]["rmse"]["test"] is None
    assert all(math.isfinite(v) for v in leaves(found) if isinstance(v, float))
    assert "diverged" in report_text(found) or "much of" in report_text(found)


def test_effects_are_ordered_by_gain(loop: Loop):
    (finding,) = loop.findings
    second = eqx.tree_at(lambda f: f.gain, finding, 0.1)
    both = eqx.tree_at(lambda x: x.findings, loop, (finding, second))
    gains = [e["gain"] for e in report_dict(both)["after"]["effects"]]
    assert gains == sorted(gains, reverse=True) and len(gains) == 2


def test_a_tie_is_told_with_the_experiment_that_separates(loop: Loop):
    """A competitor that does as well as the winner is an alternative; one of the same family that does not is none."""
    winner = loop.rounds[0].winner
    tied = Verdict("torque_bias", "torque_sensor", winner.trial, winner.gain, winner.p_value, separable=False)
    apart = Verdict("other", "motor_friction", winner.trial, winner.gain, winner.p_value, separable=True)
    told = eqx.tree_at(lambda x: x.rounds[0].verdicts, loop, (winner, tied, apart))
    found = report_dict(told)
    (other,) = found["alternatives"]
    assert (other["family"], other["separable"]) == ("torque_sensor", False)
    assert "both directions" in other["separating_experiment"]
    assert other["selection_rmse"] == other["selection_rmse_of_found"] > 0
    assert any("tie" in note for note in found["cannot_tell"])


def test_what_is_unexplained_is_told(loop: Loop):
    worse = eqx.tree_at(lambda x: x.residual_after, loop, loop.residual_before)
    found = report_dict(Loop(**{**vars(worse), "decision": "unexplained"}))
    left = found["unexplained"]
    assert left["times_noise"] == pytest.approx(loop.residual_before.rms / found["noise"]["dynamic_error"])
    # Motor friction jumps with the sign of the motor's speed.
    assert left["depends_on"] in ("motor speed", "dynamic error", "rate of the dynamic error", "motor angle")
    assert left["explained_share"] == max(left["explained_shares"].values())
    assert f"depends most on the {left['depends_on']}" in found["summary"]


def test_free_runs_that_names_do_not_explain_are_told(loop: Loop):
    found = report_dict(Loop(**{**vars(loop), "decision": "unexplained", "surprise": 1.4}))
    assert found["unexplained"]["free_runs_times_expected"] == 1.4
    assert "A part was found" in found["summary"]
    assert "1.40 times what noise and uncertainty allow" in found["summary"]


@pytest.mark.parametrize(("family", "told"), [("load_disturbance", True), ("motor_friction", False)])
def test_a_line_that_begins_each_log_anyhow_is_told(loop: Loop, family: str, told: bool):
    """Where something of the final model comes back in time: whose clock was put back, and what no log can tell."""
    (finding,) = loop.findings
    late = Loop(**{**vars(loop), "findings": (dataclasses.replace(finding, family=family),), "put_back": (-0.0147,)})
    found = report_dict(late)
    assert [log["clock_put_back"] for log in found["logs"]] == [-0.0147]
    notes = [note for note in found["cannot_tell"] if "clock" in note]
    assert [HOSTILE in note and "\u221214.7 ms" in note for note in notes] == [True] * told


def test_share_that_a_dependence_explains():
    """A residual that is a function of the quantity is explained whole, noise not at all."""
    random = np.random.default_rng(0)
    mean, error = random.normal(size=40), np.full(40, 0.1)
    exact = Dependence(np.arange(40.0), mean, np.zeros(40))
    assert explained_share(exact, float(np.sqrt(np.mean(mean**2)))) == pytest.approx(1.0)
    noise = Dependence(np.arange(40.0), 0.1 * random.normal(size=40), error)
    # 40 bins of 1/100 of the variance scatter by 0.01 * sqrt(2/40).
    assert explained_share(noise, 1.0) < 0.01


VAGUE = "alpha is not identifiable from these logs: |alpha| is at most 2e+03 rad^-2"


def test_what_is_not_identifiable_is_told_once_and_why(loop: Loop):
    blind = with_estimate(loop, "after", "alpha", value=50.0, std=1e3, ci95=(-1910.0, 2010.0), identifiable=False)
    blind = with_limits(blind, "after", reasons={"alpha": VAGUE, "motor_friction.T_c": "T_c is open"})
    found = report_dict(blind)
    assert [n for n in found["cannot_tell"] if n.startswith("alpha")] == [VAGUE]
    assert "T_c is open" in found["cannot_tell"]
    assert found["identifiability"]["reasons"]["alpha"] == found["after"]["parameters"]["alpha"]["note"] == VAGUE
    assert found["before"]["parameters"]["alpha"]["note"] is None
    assert "NOT IDENTIFIABLE" in report_text(found)


def test_orders_that_are_not_there_are_told_in_one_sentence(loop: Loop):
    """An order that is known to be next to nothing is no failure of the log, and deserves no sentence of its own."""
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
    # With nothing of its kind beside it, it is the effect itself that is in doubt.
    effect["parameters"] = {first: entry}
    assert "more samples" in limits(found)


def test_the_page_loads_nothing(page: str):
    assert not re.search(r"""(src|href|action)\s*=\s*["']?\s*(https?:)?//""", page)
    assert not re.search(r"@import|url\(", page)
    assert "default-src 'none'" in page


@pytest.mark.parametrize(("gap", "said"), [(2e-4, False), (1e-3, True)])
def test_a_value_beyond_real_drives_is_told(loop: Loop, gap: float, said: bool):
    info = dict(own_parameters(Backlash(b=gap)))["b"]
    b = Estimate("backlash.b", gap, 1e-6, 1e-6, (gap - 2e-6, gap + 2e-6), "rad", True)
    note = parameter_note(b, loop.after.identifiability, info)
    assert (note is not None and "real drives have at most 290 µrad" in note) == said
    assert parameter_note(b, loop.after.identifiability) is None


@pytest.mark.parametrize("kind", ["loop", pytest.param("fitted", marks=pytest.mark.slow)])
def test_a_browser_draws_every_picture_offline(kind: str, request: pytest.FixtureRequest, tmp_path: Path):
    outcome = request.getfixturevalue(kind)
    write_page(tmp_path, outcome)
    document, console = shown(tmp_path / "report.html")
    assert console == []
    assert not re.search(r"(src=|<link)[^>]*//", re.sub("<script.*?</script>", "", document, flags=re.DOTALL))
    places = re.findall(r'<div class="plot[^"]*" id="([^"]+)"', document)
    pictures = plots(outcome, units={}) if kind == "loop" else fit_plots(outcome, units={})
    evidence = ["evidence-motor-friction"] if kind == "loop" else []
    assert sorted(places) == sorted([p.key for p in pictures] + evidence)
    drawn = [document[a:b] for a, b in pairwise([*(document.index(f'id="{p}"') for p in places), len(document)])]
    assert all("main-svg" in picture for picture in drawn)
    # What stayed text has made no element, and nothing has run.
    assert HOSTILE not in document


def test_hostile_names_stay_text(page: str):
    assert HOSTILE not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    # The page's own two blocks, plotly's closing tag left by the cut.
    assert page.count("<script>") == 1 and page.count("</script>") == 2


def test_hostile_names_stay_text_in_a_fit(fitted: FitOnly, tmp_path: Path):
    page = write_page(tmp_path, fitted)
    assert HOSTILE not in page and "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert page.count("<script>") == 1 and page.count("</script>") == 2


def test_the_page_tells_the_story_in_order(page: str):
    heads = re.findall(r"<h2>(.*?)</h2>", page)
    assert heads == [
        "What was fitted",
        "Residual",
        "What was found",
        "Why this decision",
        "What it changed",
        "What it can&rsquo;t tell",
        "The data",
        "How it was done",
    ]
    assert "A missing effect was found: motor friction." in page
    assert not re.search(r"\bNaN\b|\bInfinity\b|\bnan\b|\bNone\b", page)


def test_a_fit_alone_has_a_report_too(fitted: FitOnly, tmp_path: Path):
    page = write_page(tmp_path, fitted)
    assert "What was found" not in page and "The base model was fitted" in page
    found = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert found["decision"] == "fit_only"
    assert found["after"]["parameters"] == {} and not any(found["after"]["rmse"].values())
    assert found["before"]["parameters"]["K"]["value"] == pytest.approx(rig.K, rel=0.05)
    heads = re.findall(r"<h2>(.*?)</h2>", page)
    assert heads[:4] == ["Parameters", "Goodness", "Residual", "Frequency response"]
    assert not re.search(r"\bNaN\b|\bInfinity\b|\bnan\b|\bNone\b", page)


def test_a_fit_tells_all_that_fitters_expect(fitted: FitOnly):
    found = report_dict(fitted, name=HOSTILE)
    before, good = found["before"], found["goodness"]
    for path, entry in before["parameters"].items():
        assert set(entry) >= ESTIMATE_KEYS | {"start", "percent", "at_bound", "note"}
        assert entry["percent"] == pytest.approx(100 * entry["std"] / abs(entry["value"]))
        # A start is from the weak form, and no answer.
        assert entry["start"] != entry["value"], path
        assert not entry["at_bound"]
    known, _ = rig.drive_parts(2400, 600, motor_friction=(T_C, 0.05), name=HOSTILE)
    starts = starting_models(rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0), whole([known]))
    assert before["parameters"]["K"]["start"] in [float(s.drive.K) for s in starts]
    (run,) = fitted.account.test
    error = run.measured - run.predicted
    assert good["fit_percent"]["test"] == pytest.approx(
        100 * (1 - np.linalg.norm(error) / np.linalg.norm(run.measured - run.measured.mean()))
    )
    assert good["rmse_over_noise"]["test"] == pytest.approx(
        np.sqrt(np.mean(error**2)) / found["noise"]["dynamic_error"]
    )
    assert good["data"] == 2 * 2400 and good["parameters"] == 3 and good["converged"]
    (K_alpha,) = [c for c in before["correlations"] if c["between"] == ["K", "alpha"]]
    assert K_alpha["value"] == pytest.approx(float(fitted.account.uncertainty.correlation[0, 1]))
    assert all(abs(c["value"]) > 0.1 for c in before["correlations"])
    # The motor's friction is missing: the tests see it, and the report says what to do.
    verdicts = {t["name"]: t["verdict"] for t in found["residual_tests"]}
    assert verdicts["whiteness"] == "failed"
    assert any("close-loop" in sentence for sentence in found["meaning"])
    assert found["frequency_response"]["excited"] and found["seconds"]["final fit"] > 0


def test_a_perfect_model_is_told_so(monkeypatch: pytest.MonkeyPatch):
    def doubt(found: Fit, known: Uncertainty) -> Uncertainty:
        alpha = dataclasses.replace(
            known.estimates["alpha"], ci95=(-900.0, math.inf), identifiable=False, interval="profile"
        )
        return dataclasses.replace(known, estimates=known.estimates | {"alpha": alpha})

    monkeypatch.setattr("fitting.validation.account.with_profiles", doubt)
    known, test = rig.drive_parts(2400, 600)
    start = rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0)
    good = report_dict(fit_only(start, {HOLD: (known,)}, test={HOLD: (test,)}, hold=HOLD))
    # What a profile says of an interval goes before the parabola, in the reason as well.
    alpha = good["before"]["parameters"]["alpha"]
    assert (alpha["interval"], alpha["ci95"]) == ("profile", [-900.0, None])
    assert alpha["note"].startswith("alpha is not identifiable from these logs: it may lie above -9e+02 rad^-2.")
    # 600 samples know a share of 95 % to 1 %.
    assert good["goodness"]["band_coverage"] == pytest.approx(0.95, abs=0.03)
    assert {t["verdict"] for t in good["residual_tests"]} == {"passed"}
    assert good["meaning"] == ["The model explains these logs down to the measurement noise."]
    assert good["goodness"]["reduced_chi_square"] == pytest.approx(1.0, abs=0.1)
    assert good["before"]["rmse"]["test"] < 1.2 * good["noise"]["dynamic_error"]


def test_a_diverged_fit_has_a_report_too(fitted: FitOnly, tmp_path: Path):
    broken = eqx.tree_at(lambda f: f.account.test[0].predicted, fitted, replace_fn=lambda p: p * np.inf)
    broken = eqx.tree_at(lambda f: f.bands[0].std_parameters, broken, replace_fn=lambda s: s * np.nan)
    broken = eqx.tree_at(lambda f: f.goodness.fit_percent["test"], broken, -math.inf)
    found = report_dict(broken)
    assert found["goodness"]["fit_percent"]["test"] is None
    assert found["goodness"]["band_coverage"] is None
    assert any("diverges" in sentence for sentence in found["meaning"])
    assert "n/a" in report_text(found)
    assert "diverged" in write_page(tmp_path, broken)


@pytest.mark.parametrize("kind", ["fitted", "loop"])
def test_a_speed_beyond_those_fitted_is_told(kind: str, request: pytest.FixtureRequest, tmp_path: Path):
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


def test_text_of_a_fit_is_aligned(fitted: FitOnly):
    found = report_dict(fitted, health=HEALTH)
    text = report_text(found)
    assert text.isascii() or set(text) - set(map(chr, range(128))) <= set("µ²⁻¹ωα×")
    heads = re.findall(r"^\[(.*)\]$", text, re.MULTILINE)
    assert heads == [
        "Result",
        "Parameters",
        "Derived",
        "What this log can't tell",
        "Correlations above 0.1",
        "Goodness",
        "Residual",
        "Frequency response",
        "Log health",
    ]
    rows = re.findall(r"^    (K|alpha|B_sp) +(\S+) +(\S+) +(\S+) +(\S+) to (\S+) +(\S+)  (\S+)", text, re.MULTILINE)
    assert [r[0] for r in rows] == ["K", "alpha", "B_sp"]
    for path, value, std, percent, low, high, start, _ in rows:
        entry = found["before"]["parameters"][path]
        # Two digits of the standard error, and as many decimals for the rest.
        assert float(std) == pytest.approx(entry["std"], rel=0.06)
        assert float(value) == pytest.approx(entry["value"], abs=0.06 * entry["std"])
        assert [float(low), float(high)] == pytest.approx(entry["ci95"], abs=0.06 * entry["std"])
        assert float(percent) == pytest.approx(entry["percent"], rel=0.06)
        assert float(start) == pytest.approx(entry["start"], rel=1e-4)
    assert [line for line in text.splitlines() if len(line) > 120] == []


def test_flags_have_a_sentence(fitted: FitOnly, tmp_path: Path):
    """A parameter that stopped at its bound, one that the data do not know, and a damping that feeds energy."""
    sentence = "K ended at its bound"
    stopped = with_limits(fitted, "account", bounds={"K": sentence})
    told = report_dict(stopped)
    assert told["before"]["parameters"]["K"]["at_bound"] and told["before"]["parameters"]["K"]["note"] == sentence
    assert not told["before"]["parameters"]["B_sp"]["at_bound"]
    assert told["identifiability"]["bounds"] == {"K": sentence}
    assert "AT BOUND" in report_text(told) and sentence in report_text(told)
    page = write_page(tmp_path, stopped)
    assert "at bound" in page and sentence in page
    vague = with_estimate(fitted, "account", "alpha", ci95=(-1910.0, 2010.0), identifiable=False)
    vague = with_limits(vague, "account", reasons={"alpha": VAGUE})
    assert report_dict(vague)["before"]["parameters"]["alpha"]["note"] == VAGUE
    text = report_text(report_dict(vague))
    assert "NOT IDENTIFIABLE" in text and text.count("alpha is not identifiable") == 1
    assert VAGUE.replace("^-2", "⁻²") in write_page(tmp_path, vague)
    feeding = with_estimate(fitted, "account", "B_sp", value=-0.1, ci95=(-0.11, -0.09))
    assert "negative" in report_dict(feeding)["before"]["parameters"]["B_sp"]["note"]


def test_what_a_log_cannot_tell(fitted: FitOnly, tmp_path: Path):
    """The account's own sentences, all of them, in JSON, text and page."""
    held = fitted.account.identifiability.held
    assert [h.path for h in held] == ["J_m", "J_l"]
    first, *others = fitted.account.identifiability.directions
    weak = dataclasses.replace(first, sentence="The logs do not separate K and B_sp")
    blind = with_limits(fitted, "account", directions=(weak, *others))
    found = report_dict(blind)["identifiability"]
    assert [h["sentence"] for h in found["held"]] == [h.sentence for h in held]
    assert found["held"][0]["changes"] == held[0].changes
    assert [d["std"] for d in found["directions"]] == [first.std, *(d.std for d in others)]
    sentences = [weak.sentence, *(h.sentence for h in held)]
    assert report_dict(blind)["cannot_tell"][: len(sentences)] == sentences
    text = re.sub(r"\s+", " ", report_text(report_dict(blind)).split("[What this log can't tell]")[1])
    page = write_page(tmp_path, blind).replace("&#39;", "'")
    for sentence in sentences:
        assert sentence in text and sentence in page


def test_intervals_from_profiles_are_marked(fitted: FitOnly, tmp_path: Path):
    assert {e["interval"] for e in report_dict(fitted)["before"]["parameters"].values()} == {"curvature"}
    profiled = with_estimate(fitted, "account", "alpha", ci95=(-1910.0, math.inf), interval="profile")
    found = report_dict(profiled)
    assert found["before"]["parameters"]["alpha"]["interval"] == "profile"
    assert found["before"]["parameters"]["alpha"]["ci95"] == [-1910.0, None]
    (row,) = re.findall(r"^ +alpha .*$", report_text(found), re.MULTILINE)[:1]
    assert "above -1910" in row and row.rstrip().endswith("interval from profile")
    page = write_page(tmp_path, profiled)
    assert page.count('<span class="soft">profile</span>') == 1 and "above −1" in page


def test_sentences_have_the_units_of_a_reduced_log():
    sentence = "alpha is at most 2 1/[x]^2, and gain 3 [x]/s^2/[u]"
    assert formatting.in_log_words(sentence, response="V", forcing="N m") == (
        "alpha is at most 2 1/V^2, and gain 3 V/s^2/(N m)"
    )
    assert formatting.superscripts("K^-2 and omega_0^-2.1") == "K⁻² and omega_0^-2.1"


def test_share_of_test_samples_in_the_band(fitted: FitOnly, tmp_path: Path):
    (band,) = fitted.bands
    (run,) = fitted.account.test
    assert band.run is run
    spread = np.sqrt(band.std_predicted**2 + float(fitted.noise[-1, -1]))
    share = float(np.mean(np.abs(run.measured - run.predicted) <= stats.norm.ppf(0.975) * spread))
    assert report_dict(fitted)["goodness"]["band_coverage"] == pytest.approx(share)
    # The model lacks the motor's friction, which no band knows of.
    assert share < 0.9
    assert f"95 % band of the free runs: {formatting.percent(share)}" in report_text(report_dict(fitted))
    assert f"it contains {formatting.percent(share)} of them" in write_page(tmp_path, fitted)
    (picture,) = [p for p in fit_plots(fitted, units={}) if p.key == "prediction-0"]
    edges = [t["y"] for t in picture.figure["data"] if t["name"] == "95 % band"]
    assert len(edges) == 4 and all(np.all(np.array(a) <= b) for a, b in (edges[:2], edges[2:]))


def drawn(fitted: FitOnly, **changes) -> FitOnly:
    """The fit with draws that a random generator made up."""
    paths = tuple(fitted.account.uncertainty.estimates)
    values = np.random.default_rng(0).normal(size=(2, 50, 3)) + [7000.0, 100.0, 1.0]
    options = {"r_hat": np.full(3, 1.001), "effective_samples": np.array([80.0, 90.0, 100.0]), "divergences": 0}
    return dataclasses.replace(fitted, posterior=Posterior(paths, values, values, **options | changes))


def test_draws_are_told_and_written(fitted: FitOnly, tmp_path: Path):
    assert report_dict(fitted)["posterior"] is None and "[Posterior]" not in report_text(report_dict(fitted))
    sampled = drawn(fitted)
    page = write_page(tmp_path, sampled)
    assert set(os.listdir(tmp_path)) == FILES | {"posterior.parquet"}
    table = pl.read_parquet(tmp_path / "posterior.parquet")
    assert table.columns == ["chain", "draw", "K", "alpha", "B_sp"] and len(table) == 100
    one = table.filter((pl.col("chain") == 1) & (pl.col("draw") == 7))
    assert sampled.posterior is not None
    np.testing.assert_array_equal(one.to_numpy()[0, 2:], sampled.posterior.values[1, 7])
    found = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["posterior"]
    assert (found["chains"], found["draws"], found["divergences"], found["settled"]) == (2, 50, 0, True)
    for level, value in found["parameters"]["K"]["quantiles"].items():
        assert value == pytest.approx(np.quantile(table["K"].to_numpy(), float(level)))
    assert found["parameters"]["alpha"]["r_hat"] == 1.001
    assert found["parameters"]["alpha"]["effective_samples"] == 90.0
    text = report_text(report_dict(sampled))
    assert re.search(r"^    K +(\S+ +){5}1\.001 +80 +N m/rad$", text, re.MULTILINE) and "the chains agree" in text
    assert "<h2>Posterior</h2>" in page and "posterior.parquet" in page


@pytest.mark.parametrize("changes", [{"divergences": 3}, {"r_hat": np.array([1.0, 1.2, math.nan])}])
def test_draws_that_have_not_settled_are_told_so(fitted: FitOnly, tmp_path: Path, changes: dict):
    doubtful = drawn(fitted, **changes)
    assert "NOT converged" in report_text(report_dict(doubtful)) and "NOT converged" in write_page(tmp_path, doubtful)
    assert not report_dict(doubtful)["posterior"]["settled"]


@pytest.mark.parametrize("kind", ["loop", "fit"])
def test_plotly_knows_every_property_of_every_figure(kind: str, loop: Loop, fitted: FitOnly):
    units = {"dynamic_error": "rad"}
    pictures = plots(loop, units=units) if kind == "loop" else fit_plots(fitted, units=units)
    assert len({p.key for p in pictures}) == len(pictures)
    for picture in pictures:
        go.Figure(picture.figure)
        points = [len(t["x"]) for t in picture.figure["data"]]
        assert 0 < max(points) <= 4000


@pytest.mark.parametrize("failing", ["os.replace", "os.fdopen"])
def test_nothing_is_left_when_writing_fails(loop: Loop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str):
    def full(*args, **kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr(failing, full)
    with pytest.raises(OSError, match="no space"):
        Report.of(loop).write(tmp_path)
    monkeypatch.undo()
    assert os.listdir(tmp_path) == []
    Report.of(loop).write(tmp_path)
    assert set(os.listdir(tmp_path)) == FILES
    assert (tmp_path / "model.json").read_text(encoding="utf-8") == to_json(loop.stored)


def test_text_lists_parameters_and_decision(loop: Loop):
    text = report_text(report_dict(loop))
    (K,) = re.findall(r"^    K +(\S+) \+/- (\S+) \((\S+) %\) N m/rad +\[(\S+), (\S+)\]$", text, re.MULTILINE)
    value, std, share, low, high = map(float, K)
    # The numbers are shown to 6, 2 and 2 digits.
    assert value == pytest.approx(float(loop.after.model.drive.K), rel=1e-5)
    assert share == pytest.approx(100 * std / value, rel=0.1)
    assert low < value < high
    assert "A missing effect was found: motor friction." in text
    assert "motor_friction.T_c" in text


def test_decimation_keeps_every_peak():
    values = np.zeros(100_001)
    values[[777, 50_000, 99_998]] = 3.0, -2.0, 1.0
    time, kept = decimated(np.arange(values.size) * 0.5, values, 400)
    assert time.size <= 400 and np.all(np.diff(time) >= 0)
    assert {*kept[kept != 0]} == {3.0, -2.0, 1.0}
    assert {*time[kept != 0]} == {388.5, 25_000.0, 49_999.0}


def test_experiments_are_symmetric_and_always_there():
    for one in FAMILIES:
        for other in FAMILIES:
            assert separating_experiment(one, other) == separating_experiment(other, one) or one != other
            assert len(separating_experiment(one, other)) > 20


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (1.05e-6, "rad", "1.05 µrad"),
        (-0.0123, "N m", "−12.3 mN m"),
        (2.0, "rad", "2.00 rad"),
        (1.2e5, "rad^-2", "120 000 rad⁻²"),
        (3.4e-7, "N m s/rad", "3.40 × 10⁻⁷ N m s/rad"),
        (0.0, "1", "0"),
        (None, "rad", "—"),
        (math.nan, "rad", "—"),
    ],
)
def test_quantities(value: float | None, unit: str, shown: str):
    assert formatting.quantity(value, unit).replace("\N{NARROW NO-BREAK SPACE}", " ") == shown


def test_values_have_the_digits_that_their_errors_leave():
    def shown(*args) -> str:
        return formatting.measured(*args).replace("\N{NARROW NO-BREAK SPACE}", " ")

    assert shown(17432.123, 12.3, "N m/rad") == "17 432 ± 12 N m/rad"
    assert shown(1.2345e7, 3.4e4, "rad^-2") == "(1.2345 ± 0.0034) × 10⁷ rad⁻²"
    assert shown(4.05e-5, 1.2e-8, "rad") == "40.500 ± 0.012 µrad"
    assert shown(0.3, None, "rad") == "300.0 mrad"


@pytest.mark.parametrize(
    ("unit", "place", "shown"),
    [
        ("N m", "mesh", "V/s^2"),
        ("N m", "actuator", "A"),
        ("N m s^2/rad^2", "mesh", "1/V"),
        ("rad^-4", "mesh", "1/V^4"),
        ("rad/s", "mesh", "V/s"),
        ("rad/s", "drive", "rad/s"),
        ("[x]/s^2/[u]", "drive", "V/(s^2 A)"),
        ("1/[x]^2", "drive", "1/V^2"),
        ("1", "mesh", "1"),
    ],
)
def test_units_of_a_reduced_log(unit: str, place: Literal["drive", "mesh", "actuator"], shown: str):
    """The mesh torque stands for an acceleration of the response, the actuator's for the forcing."""
    assert formatting.in_log_units(unit, response="V", forcing="A", place=place) == shown


@pytest.mark.parametrize(("share", "shown"), [(0.98, "98 %"), (0.9996, "99.96 %"), (-0.013, "−1.3 %"), (1.0, "100 %")])
def test_shares_do_not_round_up_to_everything(share: float, shown: str):
    assert formatting.percent(share) == shown


def test_what_is_no_number_leaves_a_gap_in_a_figure():
    template = environment({}).from_string("{{ figure | finite | tojson }}")
    assert template.render(figure={"y": [1.0, math.nan, -math.inf]}) == '{"y":[1.0,null,null]}'


@pytest.mark.parametrize(
    ("after", "said"),
    [
        (2e-6, "It removes 80 % of the error on test data, which falls from 10"),
        (3e-5, "It explains short segments alone; over whole stretches of test data the error rises from 10"),
        (None, "to a simulation that diverged."),
    ],
)
def test_the_summary_claims_no_gain_where_the_error_rises(after: float | None, said: str):
    assert said in _change("It", _changed(1e-5, after, motor=(None, None)))


@pytest.mark.parametrize(
    ("after", "motor", "said"),
    [
        (
            8.7e-7,
            (0.2, 1e-4),
            "It affects the motor's angle, whose error on test data falls by 99.95 %, from 200 mrad to 0.1",
        ),
        (8.8e-7, (0.2, 1e-4), "It affects the motor's angle"),
        (8.7e-7, (None, 1e-4), "from a simulation that diverged to 100 µrad"),
        (8.7e-7, (0.2, 0.2), "It removes 0 % of the error on test data"),
        (1e-7, (0.2, 1e-4), "It removes 89 % of the error on test data"),
    ],
)
def test_the_summary_tells_of_the_motor_what_the_dynamic_error_does_not_show(
    after: float, motor: tuple[float | None, float], said: str
):
    assert said in _change("It", _changed(8.7e-7, after, motor=motor))


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
def test_the_summary_tells_what_an_inexact_law_may_leave(loop: Loop, imperfect: bool, said: str):
    report = report_dict(loop)
    report["times_noise"], report["evidence"]["challenge"]["imperfect"] = 1.9, imperfect
    assert said in summary(report)


@pytest.mark.parametrize(("memory", "said"), [(0.028, "correlation time of about 28 ms"), (None, "")])
def test_the_summary_tells_where_the_noise_was_told_from_what_is_missing_by_its_memory(memory: float | None, said: str):
    sentence = _remembering({"noise": {"memory": memory}})
    assert said in sentence and bool(sentence) == (memory is not None)


def _changed(before: float, after: float | None, *, motor: tuple[float | None, float | None]) -> dict[str, Any]:
    stages = zip(("before", "after"), (before, after), motor, strict=True)
    found = {s: {"rmse": {"test": x}, "rmse_motor_angle": {"test": m}} for s, x, m in stages}
    told = {"output": "dynamic_error", "units": {"dynamic_error": "rad"}, "noise": {"dynamic_error": 1e-6}}
    return found | told | {"judged_on": "test"}


@pytest.mark.parametrize(
    ("decision", "times_noise", "withheld", "flagged"),
    [
        ("effect_found", 1.1, False, False),
        ("effect_found", 2.7, False, True),
        ("unexplained", 44.0, True, True),
        ("unexplained", 1.1, False, True),
    ],
)
def test_intervals_say_what_is_left(decision: str, times_noise: float, withheld: bool, flagged: bool):
    def account() -> dict[str, Any]:
        omega_0 = {"ci95": [1.0, 2.0], "flag": None}
        return {"parameters": {"K": omega_0 | {"interval": "quadratic", "note": None}}, "derived": {"omega_0": omega_0}}

    report = {"decision": decision, "before": account(), "after": account()}
    say_what_intervals_hold(report, times_noise)
    K = report["after"]["parameters"]["K"]
    assert (K["ci95"] == [None, None]) == withheld == is_withheld(report["after"]["derived"]["omega_0"])
    assert (K["flag"] is not None) == (K["note"] is not None) == flagged
    assert not flagged or "K may be off" in K["note"]


@pytest.mark.parametrize("kind", ["loop", "fitted"])
def test_page_of_the_json_describes_every_key(kind, request):
    """Names of schema 1 and keys that are data (paths, effects, outputs) are told by the page's own words."""
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
