"""Functions `fit` and `close_loop`."""

from collections.abc import Iterable

from fitting.api.data import Data
from fitting.api.results import FitResult, LoopResult
from fitting.errors import InputError
from fitting.estimation.base_fit import need_double_precision
from fitting.fit_drive import fit_only
from fitting.progress import Progress, silent
from fitting.report import Report
from fitting.search_options import SearchOptions


def fit(data: Data, *, draws: int | None = None, progress: Progress = silent) -> FitResult:
    """Fit the base model: stiffness K, its cubic coefficient alpha and mesh damping B_sp.

    Args:
        data: Logs of one drive, from [`fitting.load`][].
        draws: Seed of draws from the posterior; None for no draws.
        progress: Receives messages.

    Raises:
        InputError: Draws are requested for quasi-static logs.
        DataError: The logs can't support a fit.
        ImportError: Draws are requested and blackjax is not installed.
        ValueError: JAX computes in single precision.
    """
    need_double_precision()
    if data.kind == "quasi-static":
        if draws is not None:
            raise InputError(f"{data.logs[0].path}: a quasi-static log has no draws from the posterior; ask for none")
        # Imported here, like the others: each import takes long, and most logs need one of them.
        from fitting.quasi_static.results import fit_quasi_static_logs

        return FitResult(fit_quasi_static_logs(data.logs, data.drive, test=data.test, progress=progress))
    rig = data.rig(other_holds=False)
    found = fit_only(rig.model, rig.experiments, test=rig.test, hold=rig.hold, seed=draws, progress=progress)
    return FitResult(Report.of_rig(found, rig), rig)


def close_loop(
    data: Data,
    *,
    test: str | Iterable[str] = (),
    search: SearchOptions = SearchOptions(),
    progress: Progress = silent,
) -> LoopResult:
    """Fit the base model, find the effects that it lacks, add them to the equations, and refit.

    Args:
        data: Logs of one drive, from [`fitting.load`][].
        test: Names of logs that are test data; if none is named or was loaded as such, the end of each log is.
        search: Settings of the search for effects.
        progress: Receives messages.

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
        from fitting.quasi_static.results import close_quasi_static_loop

        told = close_quasi_static_loop(data.logs, data.drive, test=data.test, search=search, progress=progress)
        return LoopResult(told)
    from fitting.loop import close_loop as close_loop_of_drive

    rig = data.rig()
    found = close_loop_of_drive(
        rig.model, rig.experiments, test=rig.test, hold=rig.hold, search=search, progress=progress
    )
    return LoopResult(Report.of_rig(found, rig), rig)
