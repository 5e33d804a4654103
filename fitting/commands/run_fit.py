"""Implementation of `hdjax fit`, `hdjax close-loop` and `hdjax demo` for the logs of one drive."""

from collections.abc import Sequence
from pathlib import Path

from fitting.api.data import load
from fitting.api.results import Result
from fitting.api.verbs import close_loop, fit
from fitting.commands.demo import write_demo_logs
from fitting.commands.next_experiment import stated_limits
from fitting.commands.options import ExperimentLimits
from fitting.commands.spinner import spinning
from fitting.errors import InputError
from fitting.search_options import SearchOptions


def fit_logs(
    logs: list[Path],
    drive: Path,
    out: Path,
    seed: int | None = None,
    *,
    test: Sequence[Path] = (),
    limits: ExperimentLimits | None = None,
) -> None:
    """Fit logs together, write the report, and print it.

    Args:
        logs: files.
        drive: drive file.
        out: folder of the report.
        seed: of draws from the posterior; None for no draws.
        test: files of test data.
        limits: of the next experiment; None for no experiment.

    Raises:
        InputError: bad files, or draws without the required extra.
        DataError: the logs can't support a fit.
    """
    if seed is not None:
        _check_posterior()
    data = load(logs, drive, test=test)
    stated = None if limits is None else stated_limits(limits, data)
    with spinning() as progress:
        found = fit(data, draws=seed, progress=progress)
        if stated is not None:
            found = found.with_next_experiment(stated, progress=progress)
    _show(found, out)


def close_loop_on_logs(
    logs: list[Path],
    drive: Path,
    out: Path,
    search: SearchOptions = SearchOptions(),
    *,
    test: Sequence[Path] = (),
    limits: ExperimentLimits | None = None,
) -> None:
    """Close the loop on logs of one drive, write the report, and print it.

    Args:
        logs: files.
        drive: drive file.
        out: folder of the report.
        search: settings of the search for effects.
        test: files of test data.
        limits: of the next experiment; None for no experiment.

    Raises:
        InputError: bad files.
        DataError: the logs can't support a fit.
    """
    data = load(logs, drive, test=test)
    stated = None if limits is None else stated_limits(limits, data)
    with spinning() as progress:
        found = close_loop(data, search=search, progress=progress)
        if stated is not None:
            found = found.with_next_experiment(stated, progress=progress)
    _show(found, out)


def demonstrate(out: Path, seed: int) -> None:
    """Simulate a drive with an undeclared effect, and close the loop on its logs.

    Args:
        out: folder for the logs and the report.
        seed: of torque and noise.
    """
    out.mkdir(parents=True, exist_ok=True)
    logs, drive = write_demo_logs(out, seed=seed)
    print(f"Logs with an undeclared effect: {', '.join(str(p) for p in logs)}")
    close_loop_on_logs(logs, drive, out, SearchOptions(seed=seed))


def _check_posterior() -> None:
    from fitting.uncertainty.posterior import sampler

    try:
        sampler()
    except ImportError as error:
        raise InputError(f"--posterior: {error}") from error


def _show(found: Result, out: Path) -> None:
    folder = found.save(out)
    print(f"{found.summary()}\nReport: {folder / 'report.html'}")
