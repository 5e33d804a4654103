"""What `hdjax fit` does with log files of one drive."""

from pathlib import Path

from fitting.commands.next_experiment import is_quasi_static, logs_of, stated_limits
from fitting.commands.options import ExperimentLimits
from fitting.commands.spinner import Spinner
from fitting.drive_data import Rig, read_logs, rig_of
from fitting.errors import InputError
from fitting.fit_drive import fit_only
from fitting.logs.drive_file import read_drive_file
from fitting.report import rig_text, write_rig_report


def fit_logs(logs: list[Path], drive: Path, out: Path, seed: int | None, limits: ExperimentLimits | None) -> None:
    """Fit logs together, write the report, and show it.

    Args:
        logs: files.
        drive: drive file.
        out: folder of the report.
        seed: of draws from the posterior; None where none are asked for.
        limits: of the next experiment; None where none is asked for.

    Raises:
        InputError: for bad files, or draws without the extra that makes them.
        DataError: where the logs can't support a fit.
    """
    if seed is not None:
        _check_posterior()
    drive_file = read_drive_file(drive)
    read, _ = read_logs(logs, drive_file)
    if is_quasi_static(read, limits):
        # Loaded here: most logs are of other kinds.
        from fitting.quasi_static.told import fit_quasi_static_logs

        with Spinner() as progress:
            told = fit_quasi_static_logs(read, drive_file, progress=progress)
        page = told.write(out)
        print(f"{told.text}\nReport: {page}")
    else:
        _fit_drive(rig_of(read, drive_file, other_holds=False), out, seed, limits)


def _check_posterior() -> None:
    from fitting.uncertainty.posterior import sampler

    try:
        sampler()
    except ImportError as error:
        raise InputError(f"--posterior: {error}") from error


def _fit_drive(rig: Rig, out: Path, seed: int | None, limits: ExperimentLimits | None) -> None:
    stated = None if limits is None else stated_limits(limits, logs_of(rig))
    with Spinner() as progress:
        fitted = fit_only(rig.model, rig.experiments, test=rig.test, hold=rig.hold, seed=seed, progress=progress)
        proposed = None
        if stated is not None:
            # Loaded here: few fits look for a next experiment.
            from fitting.next_experiment.proposal import experiment_for_alpha

            proposed = experiment_for_alpha(fitted, rig.experiments[fitted.hold], stated, progress=progress)
    paths = write_rig_report(out, fitted, rig=rig, next_experiment=proposed)
    print(rig_text(fitted, rig=rig, next_experiment=proposed))
    if limits is not None and proposed is None:
        print(
            "No next experiment: either alpha is known from these logs, or no command was found that keeps the limits."
        )
    print(f"Report: {paths['report.html']}")
