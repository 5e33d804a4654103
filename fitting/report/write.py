"""Reports on disk: all files, whole, or none."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fitting.discrepancy.curve import LearnedCurve
from fitting.drive_data import Rig
from fitting.files import write_whole
from fitting.fit_drive import FitOnly
from fitting.logs import findings
from fitting.next_experiment.proposal import NextExperiment
from fitting.outcome import Loop
from fitting.report.content import report_dict
from fitting.report.outcome import Outcome
from fitting.report.page import report_page
from fitting.report.plots import (
    Plot,
    evidence_plot,
    fit_plots,
    learned_plot,
    next_experiment_plot,
    plots,
    response_plot,
)
from fitting.report.posterior import DRAWS_FILE, draws_table
from fitting.report.proposal import COMMAND_FILE, command_table
from fitting.report.text import report_text
from fitting.report.unknown import curve_of, unit_in_log
from fitting.stored_model import to_json
from hdjax.effects.learned_axes import UNITS


def write_report(
    out_dir: str | os.PathLike[str],
    outcome: Outcome,
    *,
    model_json: str,
    units: Mapping[str, str] | None = None,
    health: Sequence[tuple[str, findings.Finding]] = (),
    name: str = "drive",
    next_experiment: NextExperiment | None = None,
) -> dict[str, Path]:
    """Write `report.html`, `report.json` and `model.json`, `posterior.parquet` where draws were made, and
    `next_experiment.csv` where one is proposed: all of them, whole, or none.

    Args:
        out_dir: folder; made where absent.
        outcome: of the loop or of a fit.
        model_json: the fitted model, as `hdjax predict` reads it.
        units: see [`report_dict`][].
        health: see [`report_dict`][].
        name: the drive's.
        next_experiment: that would tell more.

    Returns:
        The files' paths, by name.
    """
    report = report_dict(outcome, units=units, health=health, name=name, next_experiment=next_experiment)
    contents: dict[str, str | bytes] = {
        "report.html": report_page(report, pictures(outcome, report, next_experiment)),
        "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "model.json": model_json,
    }
    if isinstance(outcome, FitOnly) and outcome.posterior is not None:
        contents[DRAWS_FILE] = draws_table(outcome.posterior)
    if next_experiment is not None:
        contents[COMMAND_FILE] = command_table(next_experiment)
    paths = {file: Path(out_dir) / file for file in contents}
    write_whole({paths[file]: content for file, content in contents.items()})
    return paths


def write_rig_report(
    out_dir: str | os.PathLike[str],
    outcome: Outcome,
    *,
    rig: Rig,
    next_experiment: NextExperiment | None = None,
) -> dict[str, Path]:
    """[`write_report`][] of a rig's logs, with the final model."""
    model = to_json(outcome.stored)
    return write_report(out_dir, outcome, model_json=model, next_experiment=next_experiment, **of_rig(rig))


def rig_text(outcome: Outcome, *, rig: Rig, next_experiment: NextExperiment | None = None) -> str:
    """[`report_text`][] of a rig's logs."""
    return report_text(report_dict(outcome, next_experiment=next_experiment, **of_rig(rig)))


def of_rig(rig: Rig) -> dict[str, Any]:
    """What a report says of the drive and its logs."""
    return {
        "name": rig.name,
        "units": rig.logs[0].units,
        "health": [(log, finding) for log, found in rig.findings.items() for finding in found],
    }


def pictures(outcome: Outcome, report: Mapping[str, Any], proposed: NextExperiment | None = None) -> list[Plot]:
    """All pictures of a report, in the order of the page.

    Args:
        outcome: of the loop or of a fit.
        report: from [`report_dict`][].
        proposed: the next experiment, where one is proposed.
    """
    units, last = report["units"], []
    if proposed is not None:
        last.append(next_experiment_plot(proposed, unit=units["dynamic_error"], forcing_unit=units["forcing"]))
    if isinstance(outcome, Loop):
        found = plots(outcome, units=units)
        quantities = {"torque": "N m", "error": "rad"} | UNITS
        in_log = {name: unit_in_log(unit, outcome, units) for name, unit in quantities.items()}
        found += [evidence_plot(seen, units=in_log) for seen in outcome.evidence]
        learned, told = curve_of(outcome), report["unknown"]
        if isinstance(learned, LearnedCurve):
            found.append(learned_plot(learned, unit=told["units"][learned.quantity], units=told["units"]))
        elif learned is not None:
            found.append(response_plot(learned, unit=unit_in_log("N m/rad", outcome, units)))
        return found + last
    return fit_plots(outcome, units=units) + last
