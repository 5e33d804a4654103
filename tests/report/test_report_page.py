"""The page of a report: plots, escaped names, order of sections, and how files are written."""

import math
import os
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from browser import shown
from report_cases import FILES, HOSTILE, VAGUE, with_estimate, with_limits, write_page

from fitting.outcome import FitOnly, Loop
from fitting.report import Report, report_dict
from fitting.report.page import report_page
from fitting.report.plots import decimated, fit_plots, plots
from fitting.report.web_page import environment
from fitting.stored_model import to_json


def test_report_page_loads_no_external_resource(page: str):
    assert not re.search(r"""(src|href|action)\s*=\s*["']?\s*(https?:)?//""", page)
    assert not re.search(r"@import|url\(", page)
    assert "default-src 'none'" in page


@pytest.mark.parametrize("kind", ["loop", pytest.param("fitted", marks=pytest.mark.slow)])
def test_report_page_draws_every_plot_in_a_browser_offline(kind: str, request: pytest.FixtureRequest, tmp_path: Path):
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
    # The escaped name has made no element, and no script has run.
    assert HOSTILE not in document


def test_markup_in_names_is_escaped_in_the_report_page(page: str):
    assert HOSTILE not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    # The page has one further script; plotly's closing tag is left.
    assert page.count("<script>") == 1 and page.count("</script>") == 2


def test_markup_in_names_is_escaped_in_the_page_of_a_fit(fitted: FitOnly, tmp_path: Path):
    page = write_page(tmp_path, fitted)
    assert HOSTILE not in page and "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert page.count("<script>") == 1 and page.count("</script>") == 2


@pytest.mark.parametrize(
    ("sought", "said"), [(False, "--next-experiment searches for a command"), (True, "No next experiment: either")]
)
def test_page_tells_whether_a_next_experiment_was_sought(fitted: FitOnly, sought: bool, said: str):
    vague = with_estimate(fitted, "account", "alpha", ci95=(-1910.0, 2010.0), identifiable=False)
    vague = with_limits(vague, "account", reasons={"alpha": VAGUE})
    page = report_page(report_dict(vague, sought=sought), [])
    assert said in page and page.count("next-experiment") <= 1


def test_page_of_a_loop_without_effects_compares_no_explanations(loop: Loop):
    report = report_dict(loop)
    assert "No other explanation that was tried does as well." in report_page(report, [])
    report["after"]["effects"], report["forms_tried"] = [], 0
    page = report_page(report | {"decision": "model_sufficient"}, [])
    assert "No other explanation" not in page and "Nothing: no form of missing physics was tried." in page


def test_step_of_a_learned_term_tells_the_names_that_it_replaces(loop: Loop):
    report = report_dict(loop)
    assert [step["in_place_of"] for step in report["steps"]] == [[], []]
    report["steps"].append(report["steps"][-1] | {"added": "learned", "in_place_of": ["motor_friction"]})
    assert "<code>learned</code>, in place of motor_friction" in report_page(report, [])


def test_sections_of_the_report_page_are_in_order(page: str):
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
    assert re.findall(r'<a href="#[a-z]+">(.*?)</a>', page) == heads
    assert "A missing effect was found: motor friction." in page
    assert not re.search(r"\bNaN\b|\bInfinity\b|\bnan\b|\bNone\b", page)


@pytest.mark.parametrize("kind", ["loop", "fit"])
def test_every_figure_is_valid_for_plotly(kind: str, loop: Loop, fitted: FitOnly):
    units = {"dynamic_error": "rad"}
    pictures = plots(loop, units=units) if kind == "loop" else fit_plots(fitted, units=units)
    assert len({p.key for p in pictures}) == len(pictures)
    for picture in pictures:
        go.Figure(picture.figure)
        points = [len(t["x"]) for t in picture.figure["data"]]
        assert 0 < max(points) <= 4000


@pytest.mark.parametrize("failing", ["os.replace", "os.fdopen"])
def test_failed_write_of_a_report_leaves_no_file(
    loop: Loop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
):
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


def test_decimation_keeps_every_peak():
    values = np.zeros(100_001)
    values[[777, 50_000, 99_998]] = 3.0, -2.0, 1.0
    time, kept = decimated(np.arange(values.size) * 0.5, values, 400)
    assert time.size <= 400 and np.all(np.diff(time) >= 0)
    assert {*kept[kept != 0]} == {3.0, -2.0, 1.0}
    assert {*time[kept != 0]} == {388.5, 25_000.0, 49_999.0}


def test_non_finite_values_are_null_in_a_figure():
    template = environment({}).from_string("{{ figure | finite | tojson }}")
    assert template.render(figure={"y": [1.0, math.nan, -math.inf]}) == '{"y":[1.0,null,null]}'
