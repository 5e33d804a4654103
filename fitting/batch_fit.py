"""Fits of many logs of different drives, into one table.

Logs are fitted in parallel, in threads or on a cluster; logs of similar length share compiled programs. Each fit is
stored in a file named by a hash of its inputs, so that an interrupted run is resumed, and a changed log is fitted
again.
"""

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import jax
import polars as pl

from fitting.blas import one_blas_thread
from fitting.drive_data import Rig, read_rig
from fitting.errors import DataError, InputError
from fitting.files import write_whole
from fitting.fit_drive import fit_only
from fitting.formatting import in_log_words
from fitting.logs.read_table import LOG_SUFFIXES, format_suffix
from fitting.outcome import FitOnly
from fitting.validation.account import Account
from hdjax import SimulationError
from hdjax.cluster import on_cluster
from hdjax.engine import one_thread

State = Literal["fitted", "refused", "failed"]
Row = dict[str, Any]
# A drive file beside a log takes precedence over the common one.
_OWN_DRIVE = "drive.toml"
_FINISHED, _TABLE = "finished", "fleet.parquet"


def find_logs(folder: Path, *, apart_from: Path) -> tuple[Path, ...]:
    """The log files below a folder, in order of their names, without hidden files and folders.

    Args:
        folder: to search.
        apart_from: a file or folder of results, which is skipped.

    Raises:
        InputError: there is none.
    """
    found = []
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder).parts
        if path.resolve().is_relative_to(apart_from.resolve()):
            continue
        if path.is_file() and format_suffix(path) in LOG_SUFFIXES and not any(p.startswith(".") for p in inside):
            found.append(path)
    if not found:
        raise InputError(f"{folder}: no log files in this folder; it should hold {', '.join(LOG_SUFFIXES)} files")
    return tuple(found)


# Held over all logs: a fit that ends in one thread would give BLAS its threads back while others go on.
@one_blas_thread
def fit_fleet(
    folder: Path,
    drive: Path,
    out: Path,
    *,
    workers: int = 0,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> pl.DataFrame:
    """Fit the base model to each log below a folder separately, and write `fleet.parquet`.

    Args:
        folder: of the logs.
        drive: drive file of the logs; a `drive.toml` beside a log takes precedence.
        out: folder for the table and for files to resume an interrupted run.
        workers: processes of a cluster on this machine; 0 for threads of this process, one for each core.
        scheduler: address of a Dask scheduler, in place of `workers`; logs and `out` must have the same paths for its
            workers.
        progress: receives the counts of done and total.

    Returns:
        A row for each log: outcome, and for each parameter value, standard error, 95 % interval and its origin,
        identifiability, and the reason if not identifiable.

    Raises:
        InputError: there are no logs, or no cluster.
    """
    logs = find_logs(folder, apart_from=out / _TABLE)
    given = folder.absolute(), drive.absolute(), out.absolute()
    absolute = {log.absolute(): log for log in logs}
    if workers or scheduler:
        finished = on_cluster(_finished_row, list(absolute), given, workers=workers, scheduler=scheduler)
    else:
        finished = _in_threads(list(absolute), given)
    rows: dict[Path, Row] = {}
    try:
        for log, row in finished:
            rows[absolute[log]] = row
            progress(len(rows), len(logs))
    except (ImportError, ValueError) as error:
        raise InputError(f"{folder}: {error}") from error
    table = pl.DataFrame([rows[log] for log in logs], infer_schema_length=None)
    buffer = BytesIO()
    table.write_parquet(buffer)
    write_whole({out / _TABLE: buffer.getvalue()})
    return table


def _in_threads(logs: Sequence[Path], given: tuple[Path, Path, Path]) -> Iterator[tuple[Path, Row]]:
    # The first one alone: the others reuse its compiled programs.
    yield logs[0], _finished_row(*given, logs[0])
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        waiting = {pool.submit(_finished_row, *given, log): log for log in logs[1:]}
        try:
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _finished_row(folder: Path, drive: Path, out: Path, log: Path) -> Row:
    """The row of a log, from an earlier run with the same log, drive file and program."""
    own = log.parent / _OWN_DRIVE
    drive = own if own.is_file() else drive
    name = str(log.relative_to(folder))
    try:
        key = hashlib.sha256(b"\0".join([version("hdjax").encode(), drive.read_bytes(), log.read_bytes()])).hexdigest()
    except OSError as error:
        return _row(name, drive, "refused", f"{error.filename}: {error.strerror}; check the path and its permissions")
    kept = out / _FINISHED / f"{key}.json"
    if kept.is_file():
        try:
            return json.loads(kept.read_text(encoding="utf-8")) | {"log": name, "drive": str(drive)}
        except ValueError:
            # Corrupt file: computed again below.
            pass
    row = _fit_one(log, name, drive)
    # What was refused may be accepted once a package is installed.
    if row["state"] == "fitted":
        write_whole({kept: json.dumps(row, allow_nan=False)})
    return row


def _fit_one(log: Path, name: str, drive: Path) -> Row:
    begin = time.perf_counter()
    try:
        rig = read_rig([log], drive, other_holds=False)
        # Fits run in parallel, so each uses one device.
        with jax.default_device(jax.local_devices()[0]), one_thread():
            fitted = fit_only(rig.model, rig.experiments, test=rig.test, hold=rig.hold)
        figures = _figures(rig, fitted)
    except (InputError, DataError, SimulationError) as error:
        return _row(name, drive, "refused", str(error), seconds=time.perf_counter() - begin)
    except Exception as error:  # a failing log must not stop the others
        reason = f"{log}: the fit failed ({type(error).__name__}: {error}); please report this with the log"
        return _row(name, drive, "failed", reason, seconds=time.perf_counter() - begin)
    return _row(name, drive, "fitted", "", seconds=time.perf_counter() - begin, **figures)


def _row(name: str, drive: Path, state: State, message: str, **figures: object) -> Row:
    return {"log": name, "drive": str(drive), "state": state, "message": message} | {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in figures.items()
    }


def _figures(rig: Rig, fitted: FitOnly) -> Row:
    """Columns of the table for a fit."""
    log, account, goodness = rig.logs[0], fitted.account, fitted.goodness
    found: Row = {
        "kind": log.kind,
        "samples": sum(run.time.size for runs in account.parts().values() for run in runs),
        "findings": len(rig.findings[log.name]),
        "torque_hold": fitted.hold,
        "converged": goodness.converged,
        "rmse_training": account.rmse["training"],
        "rmse_test": account.rmse.get("test"),
        "noise": float(fitted.noise[-1, -1]) ** 0.5,
        "error_over_noise": list(goodness.error_over_noise.values())[-1],
        "fit_percent_test": goodness.fit_percent.get("test"),
    }
    return found | parameter_columns(account, log.units)


def parameter_columns(account: Account, units: Mapping[str, str]) -> Row:
    """Columns of the table for each parameter.

    Args:
        account: of the fitted model.
        units: of `dynamic_error` and, in a reduced log, of `forcing`.
    """
    found: Row = {}
    for path, estimate in account.uncertainty.estimates.items():
        note = account.identifiability.note(path) or ""
        low, high = estimate.ci95
        found |= {
            path: estimate.value,
            f"{path}_std": estimate.std,
            f"{path}_low": low,
            f"{path}_high": high,
            f"{path}_interval": estimate.interval,
            f"{path}_identifiable": estimate.identifiable,
            f"{path}_note": in_log_words(note, response=units["dynamic_error"], forcing=units.get("forcing", "N m")),
        }
    return found


def fleet_text(table: pl.DataFrame, names: Sequence[str] = ("K", "alpha", "B_sp", "mu", "omega_0", "gain")) -> str:
    """Text of a fleet for a terminal: outcome of the logs, spread of each parameter, and every refusal."""
    counts = {state: int((table["state"] == state).sum()) for state in ("fitted", "refused", "failed")}
    lines = [f"{len(table)} logs: " + ", ".join(f"{n} {state}" for state, n in counts.items() if n)]
    shown = [n for n in names if n in table.columns and table[n].count()]
    if shown:
        lines += ["", f"{'':<10}{'logs':>6}{'least':>13}{'median':>13}{'most':>13}"]
    for name in shown:
        known = table.filter(pl.col(f"{name}_identifiable"))[name]
        if not known.count():
            lines.append(f"{name:<10}{0:>6}   not identifiable in any of the logs")
            continue
        values = (known.min(), known.median(), known.max())
        lines.append(f"{name:<10}{known.count():>6}" + "".join(f"{v:>13.6g}" for v in values))
    for row in table.filter(pl.col("state") != "fitted").iter_rows(named=True):
        lines.append(f"{row['state']}: {row['message']}")
    return "\n".join(lines)
