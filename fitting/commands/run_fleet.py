"""Implementation of `hdjax fit` for a folder of logs."""

from pathlib import Path

from fitting.batch_fit import fit_fleet, fleet_text
from fitting.commands.options import FleetOptions
from fitting.commands.spinner import counting
from fitting.errors import DataError, InputError
from fitting.logs.drive_file import read_drive_file


def fit_folder(folders: list[Path], drive: Path, out: Path, fleet: FleetOptions) -> None:
    """Fit each log of a folder separately, into one table, and print it.

    Args:
        folders: exactly one.
        drive: drive file.
        out: folder of the table.
        fleet: the workers.

    Raises:
        InputError: several folders, or a bad drive file.
        DataError: no log could be fitted.
    """
    if len(folders) > 1:
        raise InputError(f"{folders[0]} and others: give one folder of logs, or log files of one drive")
    read_drive_file(drive)
    with counting("logs") as progress:
        table = fit_fleet(
            folders[0],
            drive,
            out,
            workers=fleet.workers,
            scheduler=fleet.scheduler,
            progress=progress,
        )
    print(fleet_text(table))
    print(f"Table: {out / 'fleet.parquet'}")
    if not (table["state"] == "fitted").any():
        raise DataError(f"{folders[0]}: none of its {len(table)} logs could be fitted; see the reasons above")
