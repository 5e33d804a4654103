"""Reports on disk: all files are written, or none."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fitting.discrepancy.curve import LearnedCurve
from fitting.drive_data import Rig
from fitting.files import write_whole
from fitting.next_experiment.proposal import NextExperiment
from fitting.outcome import FitOnly, Loop
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

REPORT_FILES = ("report.html", "report.json", "model.json", DRAWS_FILE, COMMAND_FILE)
"""All files that a report may have."""


@dataclass(frozen=True, eq=False)
class Report:
    """Report of an outcome: the same content as text, page and files.

    Attributes:
        outcome: of the loop or of a fit.
        content: of `report.json`.
        pictures: plots in the order of the page.
        next_experiment: the proposed experiment.
    """

    outcome: Outcome
    content: dict[str, Any]
    pictures: list[Plot]
    next_experiment: NextExperiment | None

    @classmethod
    def of(cls, outcome: Outcome, *, next_experiment: NextExperiment | None = None, **told: Any) -> "Report":
        """Make the report of an outcome.

        Args:
            outcome: of the loop or of a fit.
            next_experiment: the proposed experiment.
            told: units, health findings and name of the drive, and whether an experiment was sought; see
                [`report_dict`][].
        """
        content = report_dict(outcome, next_experiment=next_experiment, **told)
        return cls(outcome, content, _pictures(outcome, content, next_experiment), next_experiment)

    @classmethod
    def of_rig(
        cls, outcome: Outcome, rig: Rig, *, next_experiment: NextExperiment | None = None, sought: bool = False
    ) -> "Report":
        """Make the report of an outcome of a rig's logs; arguments as in [`report_dict`][]."""
        health = [(log, finding) for log, found in rig.findings.items() for finding in found]
        told = {"units": rig.logs[0].units, "health": health, "name": rig.name}
        return cls.of(outcome, next_experiment=next_experiment, sought=sought, **told)

    @property
    def text(self) -> str:
        """Text for a terminal."""
        return report_text(self.content)

    def write(self, folder: str | os.PathLike[str]) -> dict[str, Path]:
        """Write `report.html`, `report.json` and `model.json`, `posterior.parquet` where draws were made, and
        `next_experiment.csv` where one is proposed: all of them or none. Such files of an earlier report are removed.

        Args:
            folder: created where absent.

        Returns:
            The files' paths, by name.
        """
        contents: dict[str, str | bytes] = {
            "report.html": report_page(self.content, self.pictures),
            "report.json": json.dumps(self.content, indent=1, allow_nan=False) + "\n",
            "model.json": to_json(self.outcome.stored),
        }
        if isinstance(self.outcome, FitOnly) and self.outcome.posterior is not None:
            contents[DRAWS_FILE] = draws_table(self.outcome.posterior)
        if self.next_experiment is not None:
            contents[COMMAND_FILE] = command_table(self.next_experiment)
        paths = {file: Path(folder) / file for file in contents}
        older = [Path(folder) / file for file in REPORT_FILES]
        write_whole({paths[file]: content for file, content in contents.items()}, older=older)
        return paths


def _pictures(outcome: Outcome, report: Mapping[str, Any], proposed: NextExperiment | None) -> list[Plot]:
    units, last = report["units"], []
    if proposed is not None:
        last.append(next_experiment_plot(proposed, unit=units["dynamic_error"], forcing_unit=units["forcing"]))
    if isinstance(outcome, Loop):
        found = plots(outcome, units=units)
        quantities = {"torque": "N m"} | UNITS
        in_log = {name: unit_in_log(unit, outcome, units) for name, unit in quantities.items()}
        found += [evidence_plot(seen, units=in_log) for seen in outcome.evidence]
        learned, told = curve_of(outcome), report["unknown"]
        if isinstance(learned, LearnedCurve):
            found.append(learned_plot(learned, unit=told["units"][learned.quantity], units=told["units"]))
        elif learned is not None:
            found.append(response_plot(learned, unit=unit_in_log("N m/rad", outcome, units)))
        return found + last
    return fit_plots(outcome, units=units) + last
