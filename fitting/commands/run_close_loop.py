"""What `hdjax close-loop` and `hdjax demo` do."""

from collections.abc import Sequence
from pathlib import Path

from fitting.commands.demo import write_demo_logs
from fitting.commands.next_experiment import is_quasi_static, logs_of, stated_limits
from fitting.commands.options import ExperimentLimits
from fitting.commands.spinner import Spinner
from fitting.drive_data import Rig, read_logs, read_rig, rig_of
from fitting.logs.drive_file import read_drive_file
from fitting.loop import close_loop
from fitting.next_experiment.proposal import experiment_for_ties
from fitting.report import rig_text, write_rig_report
from fitting.search_options import SearchOptions


def close_loop_on_logs(
    logs: list[Path],
    drive: Path,
    out: Path,
    search: SearchOptions = SearchOptions(),
    *,
    test: Sequence[Path] = (),
    limits: ExperimentLimits | None = None,
) -> None:
    """Close the loop on logs of one drive, write the report, and show it.

    Args:
        logs: files.
        drive: drive file.
        out: folder of the report.
        search: how effects are searched for.
        test: files of test data.
        limits: of the next experiment; None where none is asked for.

    Raises:
        InputError: for bad files.
        DataError: where the logs can't support a fit.
    """
    drive_file = read_drive_file(drive)
    read, tests = read_logs(logs, drive_file, test=test)
    if is_quasi_static(read, limits):
        # Loaded here: most logs are of other kinds.
        from fitting.quasi_static.told import close_quasi_static_loop

        with Spinner() as progress:
            told = close_quasi_static_loop(read, drive_file, test=tests, search=search, progress=progress)
        page = told.write(out)
        print(f"{told.text}\nReport: {page}")
    else:
        _close_loop(rig_of(read, drive_file, test=tests), out, search, limits)


def demonstrate(out: Path, seed: int) -> None:
    """Simulate a drive with an effect that nobody declared, and close the loop on its logs.

    Args:
        out: folder for the logs and the report.
        seed: of torque and noise.
    """
    out.mkdir(parents=True, exist_ok=True)
    logs, drive = write_demo_logs(out, seed=seed)
    print(f"Logs with an undeclared effect: {', '.join(str(p) for p in logs)}")
    _close_loop(read_rig(logs, drive), out, SearchOptions(seed=seed), limits=None)


def _close_loop(rig: Rig, out: Path, search: SearchOptions, limits: ExperimentLimits | None) -> None:
    stated = None if limits is None else stated_limits(limits, logs_of(rig))
    with Spinner() as progress:
        loop = close_loop(
            rig.model,
            rig.experiments,
            test=rig.test,
            hold=rig.hold,
            search=search,
            progress=progress,
        )
        proposed = None if stated is None else experiment_for_ties(loop, stated, progress=progress)
    paths = write_rig_report(out, loop, rig=rig, next_experiment=proposed)
    print(rig_text(loop, rig=rig, next_experiment=proposed))
    print(f"Report: {paths['report.html']}")
