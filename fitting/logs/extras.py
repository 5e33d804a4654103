"""Optional libraries, which only some log formats need."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fitting.errors import InputError


@contextmanager
def needing(path: Path, needs: str, extra: str, otherwise: str) -> Iterator[None]:
    """Raise an input error where an import in the block fails.

    Args:
        path: of the log.
        needs: requirement, as in "MDF files need asammdf; install it".
        extra: that installs it.
        otherwise: alternative without it.

    Raises:
        InputError: The extra is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise InputError(f'{path}: {needs} by pip install "hdjax[{extra}]", or {otherwise}') from error
