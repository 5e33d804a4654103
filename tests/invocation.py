"""A command of hdjax, run in this process."""

from fitting.commands.main import main


def run(*arguments: object) -> int:
    """The exit code of a command."""
    try:
        main([str(a) for a in arguments])
    except SystemExit as end:
        return 0 if end.code is None else int(end.code)
    return 0
