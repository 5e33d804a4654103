"""One command in a process of its own, with a limit on its time."""

import os
import resource
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes:
        exit_code: None where its time ran out.
        seconds: by the clock.
        processor_seconds: of the command and the processes that it waited for.
        stdout: what it printed.
        stderr: likewise.
    """

    exit_code: int | None
    seconds: float
    processor_seconds: float
    stdout: str
    stderr: str


def execute(command: Sequence[str], *, folder: Path, environment: Mapping[str, str], timeout: float) -> Ended:
    """Run a command to its end, or until its time runs out.

    Args:
        command: program and arguments.
        folder: to run in.
        environment: variables.
        timeout: when the command and all processes of its group are killed [s].
    """
    before, begin = _processor_seconds(), time.perf_counter()
    # A session of its own: the command's workers end with it.
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=dict(environment),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        stdout, stderr = process.communicate(timeout=timeout)
        code: int | None = process.returncode
    except subprocess.TimeoutExpired:
        _kill(process)
        stdout, stderr = process.communicate()
        code = None
    except BaseException:
        _kill(process)
        raise
    spent = time.perf_counter() - begin
    return Ended(code, spent, _processor_seconds() - before, stdout, stderr)


def _kill(process: subprocess.Popen) -> None:
    os.killpg(process.pid, signal.SIGKILL)


def _processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def environment(cache: Path, *, script: bool) -> dict[str, str]:
    """Variables of a command.

    Args:
        cache: folder of kept programs; the command line takes `hdjax` in it.
        script: whether the command is no command line, so that JAX itself must be told of the folder.
    """
    own = dict(os.environ) | {
        "XDG_CACHE_HOME": str(cache),
        "COLUMNS": "120",
        "MPLBACKEND": "Agg",
        "NO_COLOR": "1",
        # The folder that a command runs in, and that of a script, hold nothing that may be imported.
        "PYTHONSAFEPATH": "1",
        "TERM": "dumb",
    }
    if "PYTHONPATH" in own:
        own["PYTHONPATH"] = os.pathsep.join(os.path.abspath(p) for p in own["PYTHONPATH"].split(os.pathsep) if p)
    if script:
        own["JAX_COMPILATION_CACHE_DIR"] = str(cache / "hdjax")
    return own
