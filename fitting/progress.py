"""Progress messages."""

from collections.abc import Callable

Progress = Callable[[str], None]


def silent(message: str) -> None:
    """Discard messages."""
