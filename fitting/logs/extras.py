"""Libraries of an extra, which only logs of some formats need."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fitting.errors import InputError


@contextmanager
def needing(path: Path, needs: str, extra: str, otherwise: str) -> Iterator[None]:
    """Refuse a log where an import in the block fails.

    Args:
        path: of the log.
        needs: what it needs, as in "MDF files need asammdf; install it".
        extra: that brings it.
        otherwise: what can be done without.

    Raises:
        InputError: The extra is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise InputError(f'{path}: {needs} by pip install "hdjax[{extra}]", or {otherwise}') from error
