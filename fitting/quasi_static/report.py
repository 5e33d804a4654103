"""The report of quasi-static logs on disk: a page and JSON."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from fitting import formatting
from fitting.files import write_whole
from fitting.plots import Plot
from fitting.quasi_static.content import plain_shape
from fitting.quasi_static.facts import ARCMIN
from fitting.web_page import environment


def write_report(out: Path, report: Mapping[str, Any], shown: Sequence[Plot]) -> Path:
    """Write `report.html` and `report.json`: both, whole, or none.

    Args:
        out: Folder; made where absent.
        report: Of a fit or of a loop.
        shown: Its pictures.

    Returns:
        The page's path.
    """
    page = out / "report.html"
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    write_whole({page: report_page(report, shown), out / "report.json": text})
    return page


def report_page(report: Mapping[str, Any], shown: Sequence[Plot]) -> str:
    """The page: self-contained, reads without a network."""
    filters = {
        "value": _value,
        "interval": lambda k: "—" if None in k["ci95"] else formatting.interval(k["ci95"], k["std"], k["unit"]),
        "shape": plain_shape,
        "percent": formatting.percent,
        "smaller": formatting.smaller,
        "family": lambda name: name.replace("_", " "),
    }
    template = "quasi_static.html.jinja" if report["decision"] == "fit_only" else "quasi_static_loop.html.jinja"
    page = environment(filters).get_template(template)
    return page.render(report=report, pictures=shown, plotlyjs=Markup(get_plotlyjs()))


def _value(known: Mapping[str, Any]) -> str:
    """A figure, and beside radians the unit in which vendors state small angles."""
    if known["value"] is None:
        return "unknown"
    small = known["unit"] == "rad" and known.get("arcmin", known) is not None
    arcmin = f" ({formatting.number(ARCMIN * known['value'])} arcmin)" if small else ""
    return formatting.measured(known["value"], known["std"], known["unit"]) + arcmin
