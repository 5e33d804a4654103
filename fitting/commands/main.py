"""The command line: `hdjax inspect | init | fit | close-loop | predict | simulate | sweep | design | demo |
amplitudes | seed-tables | speeds`."""

import atexit
import gc
import os
import sys

import cyclopts

from fitting.commands.fit import close_loop, demo, fit
from fitting.commands.inspect import init, inspect
from fitting.commands.motion import predict, simulate
from fitting.commands.response import amplitudes, seed_tables, speeds
from fitting.commands.studies import design, sweep
from fitting.errors import DataError, InputError


def _version() -> str:
    # Imported here: it takes a quarter of the other import time of `--help`, and only `--version` needs it.
    from importlib.metadata import version

    return version("hdjax")


app = cyclopts.App(
    name="hdjax",
    help="The dynamic error of harmonic drives: simulate it, fit it to logs, and find what the model lacks.",
    version=_version,
)
for command in (
    inspect,
    init,
    amplitudes,
    seed_tables,
    speeds,
    sweep,
    design,
    fit,
    close_loop,
    predict,
    simulate,
    demo,
):
    app.command(command)
app.register_install_completion_command(
    "install-completion", help="Add the completion of commands and options to your shell."
)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 the data can't support the request, 2 bad usage or bad input."""
    # Libraries and compiled programs create millions of permanent small objects. Garbage collection over them, repeated
    # and at exit, would take as long as importing jax.
    gc.set_threshold(500_000)
    atexit.register(gc.freeze)
    try:
        app(arguments, exit_on_error=False, print_error=False)
        sys.stdout.flush()
    except (cyclopts.CycloptsError, InputError) as error:
        _fail(error, 2)
    except DataError as error:
        _fail(error, 1)
    except RuntimeError as error:
        # Imported here: the simulator takes long to import, and is imported already where it has failed.
        from hdjax import SimulationError

        if not isinstance(error, SimulationError):
            raise
        _fail(error, 1)
    except BrokenPipeError:
        # The reader of the pipe, such as `head`, has closed it; files are written before anything is printed.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        what = str(error) if error.filename is None else f"{error.filename}: {error.strerror}"
        _fail(f"{what}; check the path and its permissions", 2)


def _fail(error: object, code: int) -> None:
    print(f"hdjax: {error}", file=sys.stderr)
    sys.exit(code)
