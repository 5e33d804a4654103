"""Preparation of a drive file and its logs: the base model, and the logs under each hold of the torque."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx

from fitting.errors import InputError
from fitting.estimation.experiment import Experiment, experiments_from_log, fitted_outputs
from fitting.estimation.test_part import TEST_SHARE, parted, whole_test_log
from fitting.logs.checks import examine, refuse_unfit
from fitting.logs.drive_file import DriveFile, read_drive_file
from fitting.logs.findings import Finding
from fitting.logs.log import Log, read_log
from fitting.logs.masks import masked
from fitting.logs.zeroing import zeroed
from hdjax import HOLDS, Drive, Hold, Model, ReducedDrive, ReducedModel, TwoInertiaModel
from hdjax.drive import Prior

WHY_NOT_QUASI_STATIC = (
    "a quasi-static log has no dynamics to simulate; `hdjax fit` finds its stiffness and hysteresis. For the rest, "
    "record a drive log with motor torque"
)


class Rig(eqx.Module):
    """One drive and its logs.

    Attributes:
        name: of the drive.
        model: base model; its stiffness and damping are placeholders.
        hold: inter-sample behaviour of the torque in the drive file, or None.
        experiments: the logs' stretches between gaps, without test data, under each hold, or the stated one only.
        test: the same of the test data.
        logs: as fitted, without test data.
        findings: of the health check, by log.
    """

    name: str = eqx.field(static=True)
    model: Model
    hold: Hold | None = eqx.field(static=True)
    experiments: dict[Hold, tuple[Experiment, ...]]
    test: dict[Hold, tuple[Experiment, ...]]
    logs: tuple[Log, ...] = eqx.field(static=True)
    findings: dict[str, tuple[Finding, ...]] = eqx.field(static=True)


def read_rig(
    log_paths: Sequence[Path], drive_path: Path, *, test: Sequence[Path] = (), other_holds: bool = True
) -> Rig:
    """Read a drive file and logs, and refuse those that can't be fitted.

    Args:
        log_paths: of one drive.
        drive_path: its drive file.
        test: logs of the same drive that are test data; if none is given, the end of each log is.
        other_holds: whether to include other holds where the drive file states one.

    Raises:
        InputError: bad file, or logs of different kinds.
        DataError: the logs can't support a fit.
    """
    drive_file = read_drive_file(drive_path)
    fitted, tested = read_logs([(p, None) for p in log_paths], drive_file, test=[(p, None) for p in test])
    return rig_of(fitted, drive_file, test=tested, other_holds=other_holds)


def rig_of(
    logs: tuple[Log, ...], drive_file: DriveFile, *, test: tuple[Log, ...] = (), other_holds: bool = True
) -> Rig:
    """[`read_rig`][] for logs already read."""
    if logs[0].kind == "quasi-static":
        raise InputError(f"{logs[0].path}: {WHY_NOT_QUASI_STATIC}")
    logs, test = _equally_warm(logs, test)
    stated = drive_file.torque_hold
    holds = HOLDS if stated is None or other_holds else (stated,)
    parts, zeros = [], []
    for log in logs:
        parts.append(parted(log, drive_file, share=0.0 if test else TEST_SHARE, zeros=zeros))
        zeros.append(parts[-1][0].zero)
    findings = {}
    for known, _ in parts:
        findings[known.name] = examine(known, drive_file)
        refuse_unfit(findings[known.name], known)
    fitted, tests = tuple(known for known, _ in parts), [end for _, end in parts if end is not None]
    if test:
        tests = [whole_test_log(log, drive_file, zeros=zeros) for log in test]
        for log in tests:
            findings[log.name] = examine(log, drive_file)
            refuse_unfit(findings[log.name], log)
    # The end of a log keeps its clock.
    starts = {log.name: float(log.time[0]) for log in (*fitted, *test)}
    return Rig(
        name=drive_file.name,
        model=base_model(drive_file, fitted[0]),
        hold=stated,
        experiments={h: tuple(e for log in fitted for e in experiments(log, drive_file, h)) for h in holds},
        test={
            h: tuple(replace(e, origin=starts[e.log]) for log in tests for e in experiments(log, drive_file, h))
            for h in holds
        },
        logs=fitted,
        findings=findings,
    )


def _equally_warm(logs: tuple[Log, ...], test: tuple[Log, ...]) -> tuple[tuple[Log, ...], tuple[Log, ...]]:
    """Logs to fit and test logs, without the temperature where some of them lack it."""
    lacking = next((log for log in (*logs, *test) if log.temperature is None), None)
    if lacking is None:
        return logs, test
    finding = Finding(
        "warning",
        f"{lacking.name} has none",
        "temperature",
        "it was left out, since a model with it could not be simulated along that log",
    )

    def without(log: Log) -> Log:
        return log if log.temperature is None else replace(log, temperature=None, findings=(*log.findings, finding))

    return tuple(map(without, logs)), tuple(map(without, test))


Source = tuple[Path, Any]
"""A log: its path and None, or a name for messages and its table in memory."""


def read_logs(
    logs: Sequence[Source], drive_file: DriveFile, *, test: Sequence[Source] = (), outputs_until: int | None = None
) -> tuple[tuple[Log, ...], tuple[Log, ...]]:
    """Raw logs to fit, and those of test data; all of one kind, with unique names.

    Args:
        logs: to be fitted.
        drive_file: of the drive.
        test: logs that are test data.
        outputs_until: see [`fitting.logs.log.read_log`][].

    Raises:
        InputError: They are of several kinds, or a log is both fitted and test data.
    """
    fitted, tested = ({path.resolve() for path, table in own if table is None} for own in (logs, test))
    if fitted & tested:
        raise InputError(f"{min(fitted & tested)}: the log is both fitted and test data; name it once")
    both = (*logs, *test)
    read = together([read_log(path, drive_file, outputs_until=outputs_until, table=table) for path, table in both])
    return read[: len(logs)], read[len(logs) :]


def together(logs: Sequence[Log]) -> tuple[Log, ...]:
    """Logs of one kind with the same outputs, with unique names.

    Raises:
        InputError: They are of several kinds, or have different outputs.
    """
    kinds = sorted({log.kind for log in logs})
    if len(kinds) > 1:
        raise InputError(
            f"{logs[0].path} and the other logs: {' and '.join(kinds)} logs can't be fitted together; run them "
            "separately"
        )
    other = next((log for log in logs if kinds == ["drive"] and log.outputs != logs[0].outputs), None)
    if other is not None:
        one, two = (" and ".join(log.outputs) for log in (logs[0], other))
        raise InputError(
            f"{other.path}: it has {two} where {logs[0].path} has {one}, so that they can't be fitted together; run "
            "them separately, or leave the others out of both"
        )
    return _with_own_names(logs)


def ready_log(path: Path, drive_file: DriveFile, *, outputs_until: int | None = None) -> Log:
    """Read a log, mask invalid samples, and zero its dynamic error; arguments as in [`fitting.logs.log.read_log`][].
    The fit of a quasi-static log estimates its zero."""
    return ready(read_log(path, drive_file, outputs_until=outputs_until), drive_file)


def ready(log: Log, drive_file: DriveFile, *, zeros: Sequence[float] = ()) -> Log:
    """The log with invalid samples masked and its dynamic error zeroed, if possible with a zero of other logs."""
    return log if log.kind == "quasi-static" else zeroed(masked(log), drive_file, zeros=zeros)


def base_model(drive_file: DriveFile, log: Log) -> Model:
    """The model without effects for a log; stiffness and damping are placeholders."""
    if log.kind == "reduced":
        return ReducedModel(ReducedDrive(mu=1.0, omega_0=1.0))
    known = {"J_m": drive_file.motor_inertia or 1.0, "J_l": drive_file.load_inertia or 1.0, "k_T": 1.0}
    priors = tuple(Prior(path, known[path], tolerance) for path, tolerance in drive_file.tolerances.items())
    drive = Drive(N=drive_file.reduction_ratio, K=1.0, priors=priors, **known)
    return TwoInertiaModel(drive, measured=fitted_outputs(log))


def experiments(log: Log, drive_file: DriveFile, hold: Hold) -> tuple[Experiment, ...]:
    """The stretches of the log between its gaps, on their sample grids, under one hold."""
    ratio = drive_file.reduction_ratio if log.kind == "drive" else None
    return experiments_from_log(log, hold=hold, N=ratio, stated=drive_file.torque_hold)


def _with_own_names(logs: Sequence[Log]) -> tuple[Log, ...]:
    """Logs of the same name are distinguished by their folder, and then by a number."""
    stems = [log.path.stem for log in logs]
    wanted = [
        f"{log.path.absolute().parent.name}/{log.name}" if stems.count(stem) > 1 else log.name
        for log, stem in zip(logs, stems, strict=True)
    ]
    names: list[str] = []
    for name in wanted:
        free = (f"{name} ({number})" for number in itertools.count(2))
        names.append(name if name not in names else next(n for n in free if n not in (*names, *wanted)))
    return tuple(replace(log, name=name) for log, name in zip(logs, names, strict=True))
