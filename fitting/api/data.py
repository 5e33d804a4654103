"""The logs of one drive, from files or from tables in memory."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.drive_data import Rig, Source, read_logs, ready, rig_of
from fitting.errors import InputError
from fitting.logs.drive_file import DriveFile, drive_of, read_drive_file
from fitting.logs.log import Log, read_log

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True, eq=False)
class Data:
    """The logs of one drive.

    Attributes:
        drive: Content of the drive file.
        logs: To be fitted; without test logs, the end of each is test data.
        test: Logs that are test data as a whole.
        tables: Tables in memory in place of files, by the path used for them in messages.
        outputs_until: Rows in which the outputs are known; None for all.
    """

    drive: DriveFile
    logs: tuple[Log, ...]
    test: tuple[Log, ...]
    tables: dict[Path, Any]
    outputs_until: int | None = None

    @property
    def kind(self) -> str:
        """Kind of the logs: "drive", "reduced" or "quasi-static"."""
        return self.logs[0].kind

    def with_test(self, names: str | Iterable[str]) -> "Data":
        """The same with some of the logs as test data.

        Args:
            names: Of the logs, or of their files.

        Raises:
            InputError: There is no such log, or none would remain for the fit.
        """
        wanted = {names} if isinstance(names, str) else set(names)
        chosen = [log for log in self.logs if {log.name, log.path.name, str(log.path)} & wanted]
        known = {name for log in chosen for name in (log.name, log.path.name, str(log.path))}
        if wanted - known:
            have = ", ".join(log.name for log in self.logs)
            raise InputError(f"there is no log '{min(wanted - known)}' to be test data; the logs are {have}")
        if len(chosen) == len(self.logs):
            raise InputError("every log would be test data; leave one to be fitted")
        rest = tuple(log for log in self.logs if log not in chosen)
        return replace(self, logs=rest, test=(*self.test, *chosen))

    def rig(self, *, other_holds: bool = True) -> Rig:
        """The prepared logs; arguments as in `fitting.drive_data.rig_of`."""
        return rig_of(self.logs, self.drive, test=self.test, other_holds=other_holds)

    def ready(self, log: Log, *, outputs_until: int | None = None, zeros: Sequence[float] = ()) -> Log:
        """A log, masked and zeroed by outputs known so far; see `fitting.logs.log.read_log` and
        `fitting.logs.zeroing.zeroed`."""
        table = self.tables.get(log.path)
        if outputs_until != self.outputs_until:
            log = replace(read_log(log.path, self.drive, outputs_until=outputs_until, table=table), name=log.name)
        return ready(log, self.drive, zeros=zeros)

    @property
    def table(self) -> "pl.DataFrame":
        """One row per log."""
        import polars as pl

        both = [(log, part) for part, logs in (("fitted", self.logs), ("test", self.test)) for log in logs]
        return pl.DataFrame(
            {
                "log": [log.name for log, _ in both],
                "kind": [log.kind for log, _ in both],
                "rows": [len(log) for log, _ in both],
                "seconds": [float(np.ptp(log.time)) for log, _ in both],
                "used": [part for _, part in both],
            }
        )

    def __repr__(self) -> str:
        rows = sum(len(log) for log in (*self.logs, *self.test))
        return f"Data({self.drive.name}: {len(self.logs)} {self.kind} logs, {len(self.test)} of test, {rows} rows)"

    def _repr_html_(self) -> str:
        return self.table._repr_html_()


def load(
    logs: Any,
    drive: str | PathLike[str] | Mapping[str, Any] | DriveFile,
    *,
    test: Any = (),
    outputs_until: int | None = None,
) -> Data:
    """Load the logs of one drive.

    Args:
        logs: A path, a table in memory (a frame of pandas or polars, a dataset of xarray, or arrays by name), or
            several of these.
        drive: A drive file, or its tables [drive], [signals] and [columns] by name.
        test: Logs of the same drive that are test data, likewise; if none is given, the end of each log is.
        outputs_until: Rows in which angles or dynamic error must be known; 50 suffice for a prediction. None for the
            requirements of a fit.

    Raises:
        InputError: A file can't be read, lacks a column, is named twice, or the logs are of several kinds.
        DataError: A log is too short, or has too many gaps.
    """
    known = _drive(drive)
    fitted = sources(logs)
    if not fitted:
        raise InputError("there is no log; give a path or a table")
    tested = sources(test, first=len(fitted) + 1)
    own, tests = read_logs(fitted, known, test=tested, outputs_until=outputs_until)
    tables = {path: table for path, table in (*fitted, *tested) if table is not None}
    return Data(known, own, tests, tables, outputs_until)


def sources(logs: Any, *, first: int = 1) -> list[Source]:
    """The path of each log and None, or a name for messages and the table in memory.

    Args:
        logs: A path, a table in memory, or several of these.
        first: The number of the first, used in the names of tables.
    """
    several = [logs] if isinstance(logs, str | PathLike) or _is_table(logs) else list(logs)
    return [
        (Path(f"log {number}"), source) if _is_table(source) else (Path(source), None)
        for number, source in enumerate(several, start=first)
    ]


def _drive(drive: str | PathLike[str] | Mapping[str, Any] | DriveFile) -> DriveFile:
    if isinstance(drive, DriveFile):
        return drive
    return drive_of(drive, Path("drive")) if isinstance(drive, Mapping) else read_drive_file(drive)


def _is_table(source: Any) -> bool:
    """Whether an object is a table in memory: it has columns (pandas, polars), variables (xarray), or is a mapping."""
    return hasattr(source, "columns") or hasattr(source, "variables") or isinstance(source, Mapping)
