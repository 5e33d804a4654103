"""The commands for logs without a drive file: `hdjax inspect | init`."""

from pathlib import Path

from fitting.commands.options import AnyLogs, require_file
from fitting.errors import InputError


def inspect(logs: AnyLogs, /, *, joint: str | None = None) -> None:
    """Inspect logs without a drive file: columns, guessed signals and units with reasons, sampling, health, excitation.

    States what a fit of such logs could determine, and what the drive file will need.

    Parameters
    ----------
    joint
        Joint of a robot's log, as in q[3]; the one that moves the most where not given.
    """
    from fitting.commands.run_inspect import show_logs

    show_logs(logs, joint)


def init(logs: AnyLogs, /, *, out: Path, joint: str | None = None, force: bool = False) -> None:
    """Write a drive file from logs of one drive: each guess with its reason, and lines to fill in for the rest.

    Parameters
    ----------
    out
        Drive file (TOML).
    joint
        Joint of a robot's log, as in q[3]; the one that moves the most where not given.
    force
        Overwrite an existing file.
    """
    require_file(out)
    if out.exists() and not force:
        raise InputError(f"--out: {out} exists already; give another name, or --force to overwrite it")
    from fitting.commands.run_inspect import write_drive_file

    write_drive_file(logs, out, joint)
