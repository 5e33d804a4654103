"""From quasi-static logs to a report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from fitting.logs.drive_file import DriveFile
from fitting.logs.log import Log
from fitting.quasi_static.content import report_dict
from fitting.quasi_static.fit import fit_quasi_static
from fitting.quasi_static.loop import close_loop
from fitting.quasi_static.loop_content import loop_report
from fitting.quasi_static.plots import fit_pictures, loop_pictures
from fitting.quasi_static.preparation import prepare
from fitting.quasi_static.report import report_text, write_report
from fitting.quasi_static.test_part import parted
from fitting.quasi_static.unseen_logs import UnseenLogs
from fitting.report.plots import Plot
from fitting.search_options import SearchOptions


@dataclass(frozen=True, eq=False)
class QuasiStaticResult:
    """Content and plots of a quasi-static report.

    Attributes:
        content: What `report.json` holds.
        pictures: Of the page.
    """

    content: dict[str, Any]
    pictures: list[Plot]

    @property
    def text(self) -> str:
        """Text for a terminal."""
        return report_text(self.content)

    def write(self, folder: str | PathLike[str]) -> Path:
        """Write `report.html` and `report.json`; the page's path."""
        return write_report(Path(folder), self.content, self.pictures)


def fit_quasi_static_logs(
    logs: Sequence[Log], drive_file: DriveFile, *, test: Sequence[Log] = (), progress: Callable[[str], None]
) -> QuasiStaticResult:
    """Fit all torque-twist curves.

    Args:
        logs: Of kind "quasi-static", of one drive.
        drive_file: Of the drive.
        test: Logs of test data; where there are none, all rows are fitted, and held-out stretches tell an error.
        progress: Receives messages.
    """
    progress("fitting torque-twist curves")
    data = prepare(logs, drive_file)
    unseen = UnseenLogs.of(test, drive_file)
    found = fit_quasi_static(data.logs, rated_torque=drive_file.rated_torque, hysteresis="one way" not in data.motion)
    return QuasiStaticResult(report_dict(data, found, unseen), fit_pictures(found))


def close_quasi_static_loop(
    logs: Sequence[Log],
    drive_file: DriveFile,
    *,
    test: Sequence[Log] = (),
    search: SearchOptions,
    progress: Callable[[str], None],
) -> QuasiStaticResult:
    """Search for effects that the torque-twist line lacks.

    Args:
        logs: Of kind "quasi-static", of one drive.
        drive_file: Of the drive.
        test: Logs of test data; without any, the end of each log is, if the rest is long enough.
        search: Settings of the search for effects.
        progress: Receives messages.
    """
    parts = parted(logs, drive_file, test)
    loop = close_loop(parts.points, max_effects=search.max_effects, seed=search.seed, progress=progress)
    return QuasiStaticResult(loop_report(parts, loop), loop_pictures(loop))
