"""The report as a self-contained page."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from fitting import formatting
from fitting.report.intervals import is_withheld
from fitting.report.outputs import final_account, in_words, others, principal
from fitting.report.parameters import parts_of
from fitting.report.plots import Plot
from fitting.report.posterior import QUANTILES
from fitting.report.proposal import next_lines
from fitting.report.separating import plain_family
from fitting.report.summary import chance, gain
from fitting.report.tables import changes, parameter_rows
from fitting.report.web_page import environment

_SECTIONS = ("fit", "left_over", "look", "found", "next")


def report_page(report: Mapping[str, Any], pictures: Sequence[Plot]) -> str:
    """The page, self-contained, without network access.

    Args:
        report: from [`report_dict`][].
        pictures: plots from [`fitting.report.plots.plots`][].
    """
    filters = {
        "percent": formatting.percent,
        "superscripts": formatting.superscripts,
        "measured": lambda p: formatting.measured(p["value"], p["std"], p["unit"]),
        "in_factor": lambda p, factor: formatting.in_factor(p["value"], p["std"], factor),
        "interval_in_factor": lambda p, factor: (
            "withheld" if is_withheld(p) else formatting.interval_in_factor(p["ci95"], p["std"], factor)
        ),
        "value_in_factor": formatting.value_in_factor,
        "interval": lambda p: "withheld" if is_withheld(p) else formatting.interval(p["ci95"], p["std"], p["unit"]),
        "family": plain_family,
        "code": _code,
        "p_value": formatting.p_value,
        "symbol": _symbol,
    }
    output, unit, noise = principal(report)
    template = "fit.html.jinja" if report["decision"] == "fit_only" else "loop.html.jinja"
    return (
        environment(filters)
        .get_template(template)
        .render(
            report=report,
            parts=parts_of(report),
            output=output,
            noise=noise,
            x_unit=unit,
            twist_unit=report["units"]["dynamic_error"],
            others=others(report),
            in_words=in_words,
            gain=gain,
            chance=lambda effect: chance(effect, report),
            rows=parameter_rows(report, final_account(report)),
            changes=changes(report),
            quantiles=QUANTILES,
            next_lines=next_lines(report),
            sections={s: [p for p in pictures if p.section == s] for s in _SECTIONS},
            plots=pictures,
            plotlyjs=Markup(get_plotlyjs()),
        )
    )


def _code(text: str) -> Markup:
    """Text with its `backticked` parts as code."""
    parts = re.split(r"`([^`]*)`", text)
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else escape(p) for i, p in enumerate(parts))


def _symbol(path: str) -> Markup:
    """A parameter's path, breakable after its dot."""
    return Markup("<code>{}</code>").format(Markup(".<wbr>").join(path.split(".")))
