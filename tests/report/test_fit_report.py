"""The report of a fit: parameters, goodness, residual tests, identifiability and posterior draws."""

import dataclasses
import json
import math
import os
import re
from pathlib import Path

import equinox as eqx
import numpy as np
import polars as pl
import pytest
from report_cases import ESTIMATE_KEYS, FILES, HEALTH, HOLD, HOSTILE, T_C, VAGUE, with_estimate, with_limits, write_page
from scipy import stats

import rig
from fitting import formatting
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import whole
from fitting.estimation.starting_values import starting_models
from fitting.fit_drive import fit_only
from fitting.outcome import FitOnly
from fitting.report import report_dict, report_text
from fitting.report.fit_content import meaning
from fitting.report.plots import fit_plots
from fitting.uncertainty.posterior import Posterior
from fitting.uncertainty.standard_errors import Uncertainty


def test_report_of_a_fit_has_no_findings(fitted: FitOnly, tmp_path: Path):
    page = write_page(tmp_path, fitted)
    assert "What was found" not in page and "The base model was fitted" in page
    found = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert found["decision"] == "fit_only"
    assert found["after"]["parameters"] == {} and not any(found["after"]["rmse"].values())
    assert found["before"]["parameters"]["K"]["value"] == pytest.approx(rig.K, rel=0.05)
    heads = re.findall(r"<h2>(.*?)</h2>", page)
    assert heads[:4] == ["Parameters", "Goodness", "Residual", "Frequency response"]
    assert not re.search(r"\bNaN\b|\bInfinity\b|\bnan\b|\bNone\b", page)


def test_report_of_a_fit_holds_starting_values_goodness_and_residual_tests(fitted: FitOnly):
    found = report_dict(fitted, name=HOSTILE)
    before, good = found["before"], found["goodness"]
    for path, entry in before["parameters"].items():
        assert set(entry) >= ESTIMATE_KEYS | {"start", "percent", "at_bound", "note"}
        assert entry["percent"] == pytest.approx(100 * entry["std"] / abs(entry["value"]))
        # Starting values follow from the weak form, and differ from the estimates.
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
    # Motor friction is missing: the residual tests fail, and the report recommends the loop.
    verdicts = {t["name"]: t["verdict"] for t in found["residual_tests"]}
    assert verdicts["whiteness"] == "failed"
    assert any("close-loop" in sentence for sentence in found["meaning"])
    assert found["frequency_response"]["excited"] and found["seconds"]["final fit"] > 0


def test_report_of_a_sufficient_model_passes_all_residual_tests(monkeypatch: pytest.MonkeyPatch):
    def doubt(found: Fit, known: Uncertainty) -> Uncertainty:
        alpha = dataclasses.replace(
            known.estimates["alpha"], ci95=(-900.0, math.inf), identifiable=False, interval="profile"
        )
        return dataclasses.replace(known, estimates=known.estimates | {"alpha": alpha})

    monkeypatch.setattr("fitting.validation.account.with_profiles", doubt)
    known, test = rig.drive_parts(2400, 600)
    start = rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0)
    good = report_dict(fit_only(start, {HOLD: (known,)}, test={HOLD: (test,)}, hold=HOLD))
    # The interval of the profile likelihood takes precedence, also in the reason.
    alpha = good["before"]["parameters"]["alpha"]
    assert (alpha["interval"], alpha["ci95"]) == ("profile", [-900.0, None])
    assert alpha["note"].startswith("alpha is not identifiable from these logs: it may lie above -9e+02 rad^-2.")
    # A coverage of 95 % has a standard deviation of 1 % over 600 samples.
    assert good["goodness"]["band_coverage"] == pytest.approx(0.95, abs=0.03)
    assert {t["verdict"] for t in good["residual_tests"]} == {"passed"}
    assert good["meaning"] == ["The model explains these logs down to the measurement noise."]
    assert good["goodness"]["reduced_chi_square"] == pytest.approx(1.0, abs=0.1)
    assert good["before"]["rmse"]["test"] < 1.2 * good["noise"]["dynamic_error"]


def test_unexplained_motion_of_the_motor_is_told_beside_an_explained_twist(fitted: FitOnly):
    found = report_dict(fitted)
    tests = [test | {"verdict": "passed"} for test in found["residual_tests"]]
    found["goodness"]["rmse_over_noise"]["test"] = 1.0
    notes = " ".join(meaning(found | {"residual_tests": tests}))
    assert "The motor angle is not explained" in notes and "down to the measurement noise" not in notes


def test_diverged_fit_has_a_report(fitted: FitOnly, tmp_path: Path):
    broken = eqx.tree_at(lambda f: f.account.test[0].predicted, fitted, replace_fn=lambda p: p * np.inf)
    broken = eqx.tree_at(lambda f: f.bands[0].std_parameters, broken, replace_fn=lambda s: s * np.nan)
    broken = eqx.tree_at(lambda f: f.goodness.fit_percent["test"], broken, -math.inf)
    found = report_dict(broken)
    assert found["goodness"]["fit_percent"]["test"] is None
    assert found["goodness"]["band_coverage"] is None
    assert any("diverges" in sentence for sentence in found["meaning"])
    assert "n/a" in report_text(found)
    assert "its free run diverges" in write_page(tmp_path, broken)


def test_text_report_of_a_fit_lists_sections_and_parameters(fitted: FitOnly):
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


def test_flagged_parameters_have_an_explanation(fitted: FitOnly, tmp_path: Path):
    """A parameter at its bound, one that is not identifiable, and a negative damping."""
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


def test_unidentifiable_directions_are_listed_in_json_text_and_page(fitted: FitOnly, tmp_path: Path):
    """All sentences on identifiability are in JSON, text and page."""
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


def test_profile_likelihood_intervals_are_marked(fitted: FitOnly, tmp_path: Path):
    assert {e["interval"] for e in report_dict(fitted)["before"]["parameters"].values()} == {"curvature"}
    profiled = with_estimate(fitted, "account", "alpha", ci95=(-1910.0, math.inf), interval="profile")
    found = report_dict(profiled)
    assert found["before"]["parameters"]["alpha"]["interval"] == "profile"
    assert found["before"]["parameters"]["alpha"]["ci95"] == [-1910.0, None]
    (row,) = re.findall(r"^ +alpha .*$", report_text(found), re.MULTILINE)[:1]
    assert "above -1910" in row and row.rstrip().endswith("interval from profile")
    page = write_page(tmp_path, profiled)
    assert page.count('<span class="soft">profile</span>') == 1 and "above −1" in page


def test_coverage_of_the_prediction_band_is_reported(fitted: FitOnly, tmp_path: Path):
    (band,) = fitted.bands
    (run,) = fitted.account.test
    assert band.run is run
    spread = np.sqrt(band.std_predicted**2 + float(fitted.noise[-1, -1]))
    share = float(np.mean(np.abs(run.measured - run.predicted) <= stats.norm.ppf(0.975) * spread))
    assert report_dict(fitted)["goodness"]["band_coverage"] == pytest.approx(share)
    # The model lacks motor friction, for which the band does not allow.
    assert share < 0.9
    assert f"95 % band of the free runs: {formatting.percent(share)}" in report_text(report_dict(fitted))
    assert f"it contains {formatting.percent(share)} of them" in write_page(tmp_path, fitted)
    (picture,) = [p for p in fit_plots(fitted, units={}) if p.key == "prediction-0"]
    edges = [t["y"] for t in picture.figure["data"] if t["name"] == "95 % band"]
    assert len(edges) == 4 and all(np.all(np.array(a) <= b) for a, b in (edges[:2], edges[2:]))


def with_posterior(fitted: FitOnly, **changes) -> FitOnly:
    """The fit with random numbers as posterior draws."""
    paths = tuple(fitted.account.uncertainty.estimates)
    values = np.random.default_rng(0).normal(size=(2, 50, 3)) + [7000.0, 100.0, 1.0]
    options = {"r_hat": np.full(3, 1.001), "effective_samples": np.array([80.0, 90.0, 100.0]), "divergences": 0}
    return dataclasses.replace(fitted, posterior=Posterior(paths, values, values, **options | changes))


def test_posterior_draws_are_reported_and_written(fitted: FitOnly, tmp_path: Path):
    assert report_dict(fitted)["posterior"] is None and "[Posterior]" not in report_text(report_dict(fitted))
    sampled = with_posterior(fitted)
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
def test_posterior_draws_that_did_not_converge_are_flagged(fitted: FitOnly, tmp_path: Path, changes: dict):
    doubtful = with_posterior(fitted, **changes)
    assert "NOT converged" in report_text(report_dict(doubtful)) and "NOT converged" in write_page(tmp_path, doubtful)
    assert not report_dict(doubtful)["posterior"]["settled"]
