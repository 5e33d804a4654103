"""What a terminal shows while a command works, and a pipe every minute."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fitting.commands.minutes import line_a_minute
from fitting.progress import Progress


@contextmanager
def spinning(first: str = "starting") -> Iterator[Progress]:
    """A spinner on a terminal, a line a minute in a pipe; it gives what is to be told what is being done.

    Args:
        first: What is done first.
    """
    if sys.stderr.isatty():
        # Loaded here: a pipe has no need of it.
        from rich.console import Console

        console = Console(stderr=True)
        if console.is_terminal:
            with console.status(first) as status:
                yield status.update
            return
    with line_a_minute(first) as progress:
        yield progress


@contextmanager
def counting(what: str, *, first: str | None = None) -> Iterator[Callable[[int, int], None]]:
    """A bar that counts on a terminal, a line a minute in a pipe; it gives what is to be told how many of how many are
    done.

    Args:
        what: the counted items.
        first: message before counting starts.
    """
    # Imported here: most commands have nothing to count.
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    console = Console(stderr=True)
    if not console.is_terminal:
        with line_a_minute(first or what) as say:
            yield lambda done, total: say(f"{done} of {total} {what}")
        return
    with Progress(*Progress.get_default_columns(), MofNCompleteColumn(), console=console) as bar:
        task = bar.add_task(first or what, total=None)
        yield lambda done, total: bar.update(task, description=what, completed=done, total=total)
