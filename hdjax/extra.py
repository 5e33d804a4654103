"""Optional libraries, imported on demand."""

import importlib
from typing import Any


def required(name: str) -> Any:
    """A library of the extra `sweep`.

    Raises:
        ImportError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{name} is not installed: install the extra, `pip install 'hdjax[sweep]'`") from error
