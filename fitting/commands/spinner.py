"""What a terminal shows while a command works."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Spinner:
    """A spinner on a terminal, nothing in a pipe."""

    def __init__(self):
        self._status: Any = None
        if sys.stderr.isatty():
            from rich.console import Console

            console = Console(stderr=True)
            self._status = console.status("starting") if console.is_terminal else None

    def __enter__(self) -> Callable[[str], None]:
        if self._status is not None:
            self._status.start()
        return self._say

    def __exit__(self, *details: object) -> None:
        if self._status is not None:
            self._status.stop()

    def _say(self, message: str) -> None:
        if self._status is not None:
            self._status.update(message)


@contextmanager
def counting(what: str, *, first: str | None = None) -> Iterator[Callable[[int, int], None]]:
    """A bar that counts on a terminal, nothing in a pipe; it gives what is to be told how many of how many are done.

    Args:
        what: is counted.
        first: what is done before there is anything to count.
    """
    # Loaded here: most commands have nothing to count.
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(first or what, total=None)
        yield lambda done, total: bar.update(task, description=what, completed=done, total=total)
