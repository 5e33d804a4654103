"""What a terminal shows while a command works."""

import sys
from collections.abc import Callable
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
