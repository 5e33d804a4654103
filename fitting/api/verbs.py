"""Fit a drive, close the loop on it: one verb, one result."""

from collections.abc import Iterable
from pathlib import Path

from fitting.api.data import Data
from fitting.api.results import FitResult, LoopResult
from fitting.drive_data import Rig
from fitting.estimation.base_fit import need_double_precision
from fitting.fit_drive import FitOnly, fit_only
from fitting.loop import close_loop as close_loop_of_drive
from fitting.outcome import Loop
from fitting.progress import Progress, silent
from fitting.quasi_static.told import Told, close_quasi_static_loop, fit_quasi_static_logs
from fitting.report import of_rig, pictures, report_dict, report_text, write_rig_report
from fitting.search_options import SearchOptions


def fit(data: Data, *, draws: int | None = None, progress: Progress = silent) -> FitResult:
    """Fit the base model: stiffness K, its cubic coefficient alpha and mesh damping B_sp.

    Args:
        data: Logs of one drive, from [`fitting.load`][].
        draws: Seed of draws from the posterior; where None, none are made.
        progress: Told what is being done.

    Raises:
        DataError: The logs can't support a fit.
        ImportError: Draws are asked for and blackjax is not installed.
        ValueError: JAX computes in single precision.
    """
    need_double_precision()
    if data.kind == "quasi-static":
        return FitResult(
            *_quasi_static(fit_quasi_static_logs(data.logs, data.drive, test=data.test, progress=progress))
        )
    rig = data.rig(other_holds=False)
    found = fit_only(rig.model, rig.experiments, test=rig.test, hold=rig.hold, seed=draws, progress=progress)
    return FitResult(*_of_drive(found, rig))


def close_loop(
    data: Data,
    *,
    test: str | Iterable[str] = (),
    search: SearchOptions = SearchOptions(),
    progress: Progress = silent,
) -> LoopResult:
    """Fit the base model, find what it lacks, put that inside the equations, and refit.

    Args:
        data: Logs of one drive, from [`fitting.load`][].
        test: Names of those logs that are test data; where none is named or was loaded as such, the end of each log is.
        search: How effects are searched for.
        progress: Told what is being done.

    Raises:
        InputError: There is no such log.
        DataError: The logs can't support a fit.
        ValueError: JAX computes in single precision.
    """
    need_double_precision()
    named = [test] if isinstance(test, str) else list(test)
    if named:
        data = data.with_test(named)
    if data.kind == "quasi-static":
        told = close_quasi_static_loop(data.logs, data.drive, test=data.test, search=search, progress=progress)
        return LoopResult(*_quasi_static(told))
    rig = data.rig()
    found = close_loop_of_drive(
        rig.model, rig.experiments, test=rig.test, hold=rig.hold, search=search, progress=progress
    )
    return LoopResult(*_of_drive(found, rig))


def _of_drive(outcome: Loop | FitOnly, rig: Rig) -> tuple:
    report = report_dict(outcome, **of_rig(rig))

    def write(folder: Path) -> None:
        write_rig_report(folder, outcome, rig=rig)

    return report, report_text(report), tuple(pictures(outcome, report)), outcome.stored, write


def _quasi_static(told: Told) -> tuple:
    return told.report, told.text, tuple(told.pictures), None, told.write
