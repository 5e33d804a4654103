"""Constants and changed outcomes for the tests of reports."""

import dataclasses
from pathlib import Path

from fitting.logs.findings import Finding
from fitting.outcome import FitOnly, Loop
from fitting.report import Report
from hdjax import Hold

HOSTILE = "<script>alert(1)</script>"


HOLD: Hold = "zero-order"


T_C = 0.03


HEALTH = [(HOSTILE, Finding("warning", f"8 rows of {HOSTILE} repeat", "time", "they are left out"))]


FILES = {"report.html", "report.json", "model.json"}


ESTIMATE_KEYS = {"value", "std", "ci95", "unit", "identifiable"}


def write_page(folder: Path, outcome: Loop | FitOnly) -> str:
    """Write a report and return its page without plotly's code, which contains addresses that are not loaded."""
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
    """An outcome with another identifiability."""
    account = getattr(outcome, side)
    changed = dataclasses.replace(account.identifiability, **changes)
    return dataclasses.replace(outcome, **{side: dataclasses.replace(account, identifiability=changed)})


VAGUE = "alpha is not identifiable from these logs: |alpha| is at most 2e+03 rad^-2"
