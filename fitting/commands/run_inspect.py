"""Implementation of `hdjax inspect` and `hdjax init`."""

import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

from fitting.api.inspection import inspected
from fitting.commands.spinner import spinning
from fitting.errors import InputError
from fitting.inspection.columns import Table, read_columns
from fitting.inspection.inspection import alike
from fitting.logs.read_table import LOG_SUFFIXES, format_suffix


def show_logs(logs: Iterable[Path], joint: str | None) -> None:
    """Print inspections of logs, those with the same columns together.

    Args:
        logs: files, and folders of them.
        joint: label of a joint, or None.

    Raises:
        InputError: A file can't be read, or has no such joint.
    """
    with spinning("reading the logs") as say:
        groups = alike(_tables(logs))
        say("inspecting the logs")
        found = [inspected(group, joint=joint).summary() for group in groups]
    print("\n\n".join(found))


def write_drive_file(logs: Iterable[Path], out: Path, joint: str | None) -> None:
    """Write a drive file from logs of one drive, and print what must be filled in.

    Args:
        logs: files, and folders of them.
        out: the drive file.
        joint: label of a joint, or None.

    Raises:
        InputError: A file can't be read, or the logs have different columns.
    """
    with spinning("reading the logs") as say:
        tables = _tables(logs)
        say("inspecting the logs")
        found = inspected(tables, joint=joint)
    found.save(out, force=True)
    print(f"Drive file: {out}")
    if found.inspection.joint.label is not None:
        print(f"It describes joint {found.inspection.joint.label}; --joint picks another.")
    for place, why in found.unknown.items():
        print(f"Fill in {place}: {why}")
    if not found.unknown:
        names = " ".join(shlex.quote(str(table.path)) for table in tables)
        print(f"Check the guesses, then: hdjax close-loop {names} --drive {shlex.quote(str(out))} --out report")


def _tables(logs: Iterable[Path]) -> list[Table]:
    return [table for log in logs for table in (_inside(log) if log.is_dir() else [read_columns(log)])]


def _inside(folder: Path) -> list[Table]:
    """The logs of a folder, in order of their names; files that can't be read as one are told."""
    found = []
    for path in sorted(folder.iterdir()):
        if path.is_file() and format_suffix(path) in LOG_SUFFIXES and not path.name.startswith("."):
            try:
                found.append(read_columns(path))
            except InputError as error:
                print(f"hdjax: {error}", file=sys.stderr)
    if not found:
        raise InputError(f"{folder}: the folder has no log; give one with {', '.join(LOG_SUFFIXES)} files")
    return found
