"""The commands that fit logs: `hdjax fit | close-loop | demo`."""

from pathlib import Path

from fitting.commands.options import (
    DriveFileOption,
    ExperimentLimits,
    FleetOptions,
    Logs,
    Search,
    TestLogs,
    require_folder,
    require_seed,
    wanted,
)
from fitting.commands.start import start_jax
from fitting.errors import InputError
from fitting.search_options import SearchOptions


def fit(
    logs: Logs,
    /,
    *,
    drive: DriveFileOption,
    out: Path,
    test: TestLogs = (),
    posterior: bool = False,
    seed: int = 0,
    next_experiment: bool = False,
    limits: ExperimentLimits = ExperimentLimits(),
    fleet: FleetOptions = FleetOptions(),
) -> None:
    """Fit stiffness, cubic coefficient and damping, and report how well the logs determine them.

    Several logs of one drive are fitted together. The logs of a folder are fitted separately, into one table; an
    interrupted run is resumed. Quasi-static logs (twist and joint torque) give stiffness, knees, hysteresis and lost
    motion instead.

    Parameters
    ----------
    out
        Folder for report.html, report.json and, but for quasi-static logs, model.json; of a folder of logs for
        fleet.parquet.
    posterior
        Also draw from the posterior (minutes), and write the draws to posterior.parquet. Needs the extra
        `posterior`.
    seed
        Of the draws.
    next_experiment
        If alpha is not identifiable, search for a motor torque within limits that determines it (up to a minute),
        and write it to next_experiment.csv.
    """
    require_folder(out)
    require_seed(seed)
    asked = wanted(limits, next_experiment)
    folder = next((path for path in logs if path.is_dir()), None)
    if (fleet.workers or fleet.scheduler) and folder is None:
        raise InputError(f"{logs[0]}: --workers and --scheduler are for a folder of logs; give the folder")
    if fleet.workers < 0:
        raise InputError(f"--workers must be 0 or more, but is {fleet.workers}")
    if asked is not None and folder is not None:
        raise InputError(f"{logs[0]}: --next-experiment is for log files of one drive; name its logs")
    if test and folder is not None:
        raise InputError(f"{folder}: --test is for log files of one drive, but this is a folder; name its logs")
    if posterior and folder is not None:
        raise InputError(f"{folder}: --posterior is for log files of one drive, but this is a folder; name its logs")
    start_jax()
    if folder is not None:
        from fitting.commands.run_fleet import fit_folder

        fit_folder(logs, drive, out, fleet)
        return
    from fitting.commands.run_fit import fit_logs

    fit_logs(logs, drive, out, seed if posterior else None, test=test, limits=asked)


def close_loop(
    logs: Logs,
    /,
    *,
    drive: DriveFileOption,
    out: Path,
    test: TestLogs = (),
    search: Search = SearchOptions(),
    next_experiment: bool = False,
    limits: ExperimentLimits = ExperimentLimits(),
) -> None:
    """Fit, find the effect that the model lacks, add it to the equations, refit, and compare on test data.

    The last fifth of each log is test data, unless test logs are named; only the final figures use it.

    Quasi-static logs (twist and joint torque) are fitted without inertia: the base equation is the torque-twist line.

    Parameters
    ----------
    out
        Folder for report.html, report.json and, but for quasi-static logs, model.json.
    next_experiment
        If explanations are tied, search for a motor torque within limits that separates them (minutes), and write
        it to next_experiment.csv.
    """
    require_folder(out)
    require_seed(search.seed)
    if search.max_effects < 0:
        raise InputError(f"--max-effects must be 0 or more, but is {search.max_effects}")
    asked = wanted(limits, next_experiment)
    start_jax()
    from fitting.commands.run_fit import close_loop_on_logs

    close_loop_on_logs(logs, drive, out, search, test=test, limits=asked)


def demo(*, out: Path = Path("hdjax-demo"), seed: int = 0) -> None:
    """Simulate a drive with an undeclared effect, close the loop on its logs, and print the path of the report.

    Parameters
    ----------
    out
        Folder for the logs and the report.
    seed
        Of torque and noise.
    """
    require_folder(out)
    require_seed(seed)
    start_jax()
    from fitting.commands.run_fit import demonstrate

    demonstrate(out, seed)
