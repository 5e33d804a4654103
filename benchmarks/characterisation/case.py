"""One command of the characterisation."""

from dataclasses import dataclass
from typing import Literal

Group = Literal["quick", "practice", "convergence"]
GROUPS: tuple[Group, ...] = ("quick", "practice", "convergence")


@dataclass(frozen=True)
class Case:
    """A command and what is read of its results.

    Arguments may hold `{inputs}` (generated logs), `{out}` (the case's own folder), `{outs}` (the folder of all cases'
    folders), `{shared}` (the folder given by `--shared`) and `{repo}` (the checkout that is characterised).

    Attributes:
        name: unique.
        group: what it is run with.
        arguments: of the command.
        runs: the command line of the package, a probe of its Python interface, or a script of the checkout.
        after: cases whose results it takes.
        modules: Python modules that it needs beside the package's own.
        timeout: its own time limit [s]; the run's limit where None.
        measured: a log whose dynamic error a prediction is compared with.
        ratio: reduction ratio of that log.
        printed: whether what it prints is compared, number by number.
    """

    name: str
    group: Group
    arguments: tuple[str, ...]
    runs: Literal["command", "probe", "script"] = "command"
    after: tuple[str, ...] = ()
    modules: tuple[str, ...] = ()
    timeout: float | None = None
    measured: str | None = None
    ratio: float = 50.0
    printed: bool = False


def words(text: str) -> tuple[str, ...]:
    """Arguments from a line without quotes."""
    return tuple(text.split())
