"""A look at logs that nobody has described."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fitting.api.data import sources
from fitting.errors import InputError
from fitting.files import finite, write_whole
from fitting.inspection.columns import Table, read_columns
from fitting.inspection.drive_text import drive_file_text, drive_tables, unknowns
from fitting.inspection.excitation import Excitation, excitation
from fitting.inspection.health import health
from fitting.inspection.inspection import Inspection, inspect_tables
from fitting.inspection.promise import promises
from fitting.inspection.summary import HEAD, column_rows, inspection_text
from fitting.logs.findings import Finding


@dataclass(frozen=True, eq=False)
class InspectionResult:
    """What logs seem to hold, and what a fit could tell from them.

    Attributes:
        inspection: Columns, signals, units and signs as guessed, with reasons.
        findings: What the health gate saw, by log.
        excitations: How each log moves the drive.
        told: What a fit can and can't tell, in sentences.
    """

    inspection: Inspection
    findings: tuple[tuple[Finding, ...], ...]
    excitations: tuple[Excitation, ...]
    told: tuple[str, ...]

    @property
    def columns(self) -> pl.DataFrame:
        """One row a column that was recognised or could be something: signal, unit, sign, confidence, reasons."""
        return pl.DataFrame(column_rows(self.inspection), schema=dict.fromkeys(HEAD, pl.String), orient="row")

    @property
    def drive(self) -> dict[str, Any]:
        """The tables of a drive file as far as they are known, as [`fitting.load`][] takes them."""
        return drive_tables(self.inspection)

    @property
    def unknown(self) -> dict[str, str]:
        """What must be filled in before a fit, by its place in the drive file, and why."""
        return unknowns(self.inspection)

    def drive_file(self) -> str:
        """The text of a drive file: each guess with its reason, and lines to fill in for what is not known."""
        return drive_file_text(self.inspection, "`hdjax init`")

    def save(self, path: str | PathLike[str], *, force: bool = False) -> Path:
        """Write the drive file.

        Args:
            path: Of the file.
            force: Whether a file that is there already may be overwritten.

        Raises:
            InputError: There is a file already.
        """
        if Path(path).exists() and not force:
            raise InputError(f"{path}: there is a file already; give another name, or overwrite it with force")
        write_whole({Path(path): self.drive_file()})
        return Path(path)

    def plot(self, log: int = 0, axes: Any = None) -> Any:
        """Draw the signals of a log in SI units as guessed.

        Args:
            log: Number of the log.
            axes: Of matplotlib, one for each signal; made where not given.
        """
        import matplotlib.pyplot as plt

        signals = list(self.inspection.joint.signals)
        if not signals:
            raise ValueError("no column was recognised, so that there is nothing to draw")
        if axes is None:
            height = 1.6 * len(signals) + 0.8
            axes = plt.subplots(len(signals), 1, sharex=True, squeeze=False, figsize=(8.0, height))[1][:, 0]
        for place, signal in zip(np.atleast_1d(axes), signals, strict=True):
            place.plot(*self.inspection.samples(signal, log), linewidth=0.8)
            place.set_ylabel(signal, fontsize="small")
        np.atleast_1d(axes)[-1].set_xlabel("time [s]" if self.inspection.clocks[log].known else "row")
        return axes

    def summary(self) -> str:
        """All that was found, in a page of text."""
        return inspection_text(self.inspection, self.findings, self.excitations, self.told)

    def to_dict(self) -> dict[str, Any]:
        """The same for programs, as JSON can hold it."""
        joint, time = self.inspection.joint, self.inspection.time
        return finite(
            {
                "logs": [str(table.path) for table in self.inspection.tables],
                "kind": joint.kind,
                "joint": joint.label,
                "joints": [other.label for other in self.inspection.joints if other.label],
                "time": asdict(time),
                "rates": list(self.inspection.rates),
                "signals": {name: asdict(guess) for name, guess in joint.signals.items()},
                "open": joint.open,
                "copies": {name: {"of": of, "times": times} for name, (of, times) in joint.copies.items()},
                "reduction_ratio": None if joint.ratio is None else asdict(joint.ratio),
                "health": [[asdict(finding) for finding in own] for own in self.findings],
                "excitation": [asdict(one) for one in self.excitations],
                "told": list(self.told),
                "drive": self.drive,
                "unknown": self.unknown,
            }
        )

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        told = " ".join(self.told).replace("&", "&amp;").replace("<", "&lt;")
        return f"<p>{told}</p>{self.columns._repr_html_()}"


def inspect(logs: Any, *, joint: str | int | None = None) -> InspectionResult:
    """Look at logs of one drive or robot without a drive file.

    Args:
        logs: A path, a table in memory (a frame of pandas or polars, a dataset of xarray, or arrays by name), or
            several of these with the same columns.
        joint: Label of the robot's joint that matters, as in "q[3]"; where None, the one that moves the most.

    Raises:
        InputError: A file can't be read, the logs have different columns, or there is no such joint.
    """
    given = sources(logs)
    if not given:
        raise InputError("there is no log; give a path or a table")
    return inspected([read_columns(path, table) for path, table in given], joint=None if joint is None else str(joint))


def inspected(tables: Sequence[Table], *, joint: str | None = None) -> InspectionResult:
    """[`inspect`][] for logs whose columns have been read."""
    found = inspect_tables(tables, joint=joint)
    with np.errstate(all="ignore"):
        moved = tuple(excitation(found, k) for k in range(len(tables)))
    return InspectionResult(found, health(found), moved, promises(found, moved[0]))
