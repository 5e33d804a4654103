"""A drive file and its logs made ready: the base model, and the logs under each assumption about the torque."""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx

from fitting.drive_file import DriveFile, read_drive_file
from fitting.errors import InputError
from fitting.experiment import Experiment, experiment_from_log
from fitting.findings import Finding
from fitting.health import examine, refuse_unfit
from fitting.logs import Log, read_log
from hdjax import HOLDS, Drive, Hold, Model, ReducedDrive, ReducedModel, TwoInertiaModel

WHY_NOT_QUASI_STATIC = (
    "a quasi-static log holds nothing of the resonance, so that there is no motion to simulate; `hdjax fit` finds its "
    "stiffness and hysteresis, and for the rest record a drive log with motor torque"
)


class Rig(eqx.Module):
    """One drive and its logs.

    Attributes:
        name: of the drive.
        model: base model; its stiffness and damping are placeholders until they are fitted.
        hold: what the drive file says of the torque between samples, or None.
        experiments: the logs under each hold.
        logs: as read.
        findings: what the health gate saw, by log.
        error_unit: unit of the dynamic error.
    """

    name: str = eqx.field(static=True)
    model: Model
    hold: Hold | None = eqx.field(static=True)
    experiments: dict[Hold, tuple[Experiment, ...]]
    logs: tuple[Log, ...] = eqx.field(static=True)
    findings: dict[str, tuple[Finding, ...]] = eqx.field(static=True)
    error_unit: str = eqx.field(static=True)


def read_rig(log_paths: Sequence[Path], drive_path: Path) -> Rig:
    """Read a drive file and logs, and refuse what can't be fitted.

    Raises:
        InputError: for a bad file, or logs of different kinds.
        DataError: for logs that can't support a fit.
    """
    drive_file = read_drive_file(drive_path)
    return rig_of(tuple(read_log(path, drive_file) for path in log_paths), drive_file)


def rig_of(logs: tuple[Log, ...], drive_file: DriveFile) -> Rig:
    """[`read_rig`][] for logs that have been read."""
    refuse_mixed(logs)
    if logs[0].kind == "quasi-static":
        raise InputError(f"{logs[0].path}: {WHY_NOT_QUASI_STATIC}")
    findings = {}
    for log in logs:
        findings[log.name] = examine(log, drive_file)
        refuse_unfit(findings[log.name], log)
    return Rig(
        name=drive_file.name,
        model=base_model(drive_file, logs[0]),
        hold=drive_file.torque_hold,
        experiments={h: tuple(experiment(log, drive_file, h) for log in logs) for h in HOLDS},
        logs=logs,
        findings=findings,
        error_unit=logs[0].units.get("dynamic_error", "rad"),
    )


def refuse_mixed(logs: Sequence[Log]) -> None:
    """Nothing when all logs are of one kind.

    Raises:
        InputError: They are of several kinds.
    """
    kinds = sorted({log.kind for log in logs})
    if len(kinds) > 1:
        raise InputError(
            f"{logs[0].path} and the other logs: {' and '.join(kinds)} logs can't be fitted together; run them apart"
        )


def base_model(drive_file: DriveFile, log: Log) -> Model:
    """The model without effects that suits a log; stiffness and damping are placeholders."""
    if log.kind == "reduced":
        return ReducedModel(ReducedDrive(mu=1.0, omega_0=1.0))
    return TwoInertiaModel(
        Drive(N=drive_file.reduction_ratio, J_m=drive_file.motor_inertia, J_l=drive_file.load_inertia, K=1.0)
    )


def experiment(log: Log, drive_file: DriveFile, hold: Hold) -> Experiment:
    """The log on its sample grid under one hold."""
    ratio = drive_file.reduction_ratio if log.kind == "drive" else None
    return experiment_from_log(log, hold=hold, N=ratio)
