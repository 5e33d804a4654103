"""Inspection of logs without a drive file."""

import html
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
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
    """Guessed content of logs, and what a fit of them could determine.

    Attributes:
        inspection: Columns, signals, units and signs as guessed, with reasons.
        findings: Of the health check, by log.
        excitations: Excitation and response of each log.
        told: Sentences on what a fit can and can't determine.
    """

    inspection: Inspection
    findings: tuple[tuple[Finding, ...], ...]
    excitations: tuple[Excitation, ...]
    told: tuple[str, ...]

    @property
    def columns(self) -> pl.DataFrame:
        """One row per column that is or may be a signal: signal, unit, sign, confidence, reasons."""
        return pl.DataFrame(column_rows(self.inspection), schema=dict.fromkeys(HEAD, pl.String), orient="row")

    @property
    def drive(self) -> dict[str, Any]:
        """The known tables of a drive file, in the form of [`fitting.load`][]."""
        return drive_tables(self.inspection)

    @property
    def unknown(self) -> dict[str, str]:
        """Values that must be filled in before a fit, by their place in the drive file, with the reason."""
        return unknowns(self.inspection)

    def drive_file(self) -> str:
        """The text of a drive file: each guess with its reason, and lines to fill in for unknown values."""
        return drive_file_text(self.inspection)

    def save(self, path: str | PathLike[str], *, force: bool = False) -> Path:
        """Write the drive file.

        Args:
            path: Of the file.
            force: Whether an existing file may be overwritten.

        Raises:
            InputError: The file exists already.
        """
        if Path(path).exists() and not force:
            raise InputError(f"{path}: the file exists already; give another name, or overwrite it with force")
        write_whole({Path(path): self.drive_file()})
        return Path(path)

    def plot(self, log: int = 0, axes: Any = None) -> Any:
        """Draw the signals of a log in SI units as guessed.

        Args:
            log: Number of the log.
            axes: Of matplotlib, one for each signal; created where not given.
        """
        import matplotlib.pyplot as plt

        signals = list(self.inspection.joint.signals)
        if not signals:
            raise ValueError("no column was recognised, so that there is nothing to plot")
        if axes is None:
            height = 1.6 * len(signals) + 0.8
            axes = plt.subplots(len(signals), 1, sharex=True, squeeze=False, figsize=(8.0, height))[1][:, 0]
        for place, signal in zip(np.atleast_1d(axes), signals, strict=True):
            place.plot(*self.inspection.samples(signal, log), linewidth=0.8)
            place.set_ylabel(signal, fontsize="small")
        np.atleast_1d(axes)[-1].set_xlabel("time [s]" if self.inspection.clocks[log].known else "row")
        return axes

    def summary(self) -> str:
        """The whole inspection as text."""
        return inspection_text(self.inspection, self.findings, self.excitations, self.told)

    def to_dict(self) -> dict[str, Any]:
        """The inspection as JSON content."""
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
        told = html.escape(" ".join(self.told), quote=False)
        return f"<p>{told}</p>{self.columns._repr_html_()}"


def inspect(logs: Any, *, joint: str | int | None = None) -> InspectionResult:
    """Inspect logs of one drive or robot without a drive file.

    Args:
        logs: A path, a table in memory (a frame of pandas or polars, a dataset of xarray, or arrays by name), or
            several of these with the same columns.
        joint: Label of the robot's joint, as in "q[3]"; if None, the one that moves the most.

    Raises:
        InputError: A file can't be read, the logs have different columns, or there is no such joint.
    """
    given = sources(logs)
    if not given:
        raise InputError("there is no log; give a path or a table")
    return inspected([read_columns(path, table) for path, table in given], joint=None if joint is None else str(joint))


def inspected(tables: Sequence[Table], *, joint: str | None = None) -> InspectionResult:
    """[`inspect`][] for logs with columns already read."""
    found = inspect_tables(tables, joint=joint)
    with np.errstate(all="ignore"):
        moved = tuple(excitation(found, k) for k in range(len(tables)))
    return InspectionResult(found, health(found), moved, promises(found, _most(moved)))


def _most(moved: Sequence[Excitation]) -> Excitation:
    """The largest twist, and the widest band with what is seen in it: a log at rest must not decide for the others."""

    def width(band: tuple[float, float] | None) -> float:
        return -1.0 if band is None else band[1] - band[0]

    # Noise of a torque at rest has a wide band, but nothing follows it.
    widest = max(moved, key=lambda one: (width(one.coherent), width(one.band)))
    return replace(widest, twist=max((one.twist for one in moved if one.twist is not None), default=None))
