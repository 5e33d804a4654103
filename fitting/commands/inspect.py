"""The commands for logs that nobody has described: `hdjax inspect | init`."""

from pathlib import Path

from fitting.commands.options import AnyLogs
from fitting.errors import InputError


def inspect(logs: AnyLogs, /, *, joint: str | None = None) -> None:
    """Look at logs without a drive file: columns, guessed signals and units with reasons, sampling, health, excitation.

    Says what a fit of such logs could tell, and what the drive file will need. Where nothing can be told, it says so.

    Parameters
    ----------
    joint
        Of a robot's log: the joint to look at, as in q[3]; the one that moves the most where not given.
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
        Of a robot's log: the joint to describe, as in q[3]; the one that moves the most where not given.
    force
        Overwrite a file that is there already.
    """
    if out.is_dir():
        raise InputError(f"--out must be a file, but {out} is a folder; give the drive file's own name")
    if out.exists() and not force:
        raise InputError(f"--out: there is a file {out} already; give another name, or --force to overwrite it")
    from fitting.commands.run_inspect import write_drive_file

    write_drive_file(logs, out, joint)
