"""What `hdjax fit` and `hdjax close-loop` do with quasi-static logs, from logs to report."""

from collections.abc import Callable, Sequence
from pathlib import Path

from fitting.logs.drive_file import DriveFile
from fitting.logs.log import Log
from fitting.quasi_static.content import report_dict
from fitting.quasi_static.fit import fit_quasi_static
from fitting.quasi_static.loop import close_loop
from fitting.quasi_static.loop_content import loop_report
from fitting.quasi_static.plots import fit_pictures, loop_pictures
from fitting.quasi_static.points import points_of
from fitting.quasi_static.preparation import prepare
from fitting.quasi_static.report import report_text, write_report


def fit_quasi_static_logs(
    logs: Sequence[Log], drive_file: DriveFile, out: Path, *, progress: Callable[[str], None]
) -> str:
    """Fit all torque-twist curves and write the report.

    Args:
        logs: Of kind "quasi-static", of one drive.
        drive_file: Of the drive.
        out: Folder of the report.
        progress: Told what is being done.

    Returns:
        What the terminal shows.
    """
    progress("fitting torque-twist curves")
    data = prepare(logs, drive_file)
    found = fit_quasi_static(data.logs, rated_torque=drive_file.rated_torque, hysteresis="one way" not in data.motion)
    report = report_dict(data, found)
    return f"{report_text(report)}\nReport: {write_report(out, report, fit_pictures(found))}"


def close_quasi_static_loop(
    logs: Sequence[Log],
    drive_file: DriveFile,
    out: Path,
    *,
    max_effects: int,
    seed: int,
    progress: Callable[[str], None],
) -> str:
    """Look for what the torque-twist line lacks and write the report.

    Args:
        logs: Of kind "quasi-static", of one drive.
        drive_file: Of the drive.
        out: Folder of the report.
        max_effects: See [`fitting.quasi_static.loop.close_loop`][].
        seed: Likewise.
        progress: Told what is being done.

    Returns:
        What the terminal shows.
    """
    data = prepare(logs, drive_file, at_rest=True)
    points = points_of(data.logs, data.motion, drive_file.reduction_ratio)
    loop = close_loop(points, max_effects=max_effects, seed=seed, progress=progress)
    report = loop_report(data, loop)
    return f"{report_text(report)}\nReport: {write_report(out, report, loop_pictures(loop))}"
