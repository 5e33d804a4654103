"""Atomic writing of files, and content for JSON."""

import contextlib
import errno
import math
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np


def write_whole(contents: Mapping[Path, str | bytes], *, older: Iterable[Path] = ()) -> None:
    """Write several files so that either all are complete or none is changed.

    Each is first written to a temporary file beside its destination; all are renamed when complete.

    Args:
        contents: text or bytes by path; missing folders are created.
        older: files that an earlier run may have left; those that are not written are then removed.
    """
    waiting: list[tuple[str, Path]] = []
    try:
        for path, content in contents.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            with _naming(path):
                if path.is_dir():
                    raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
                handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
                waiting.append((name, path))
                with os.fdopen(handle, "wb") as file:
                    file.write(content.encode() if isinstance(content, str) else content)
                # mkstemp creates files that only the owner can read; a report is an ordinary file.
                os.chmod(name, 0o644)
        while waiting:
            name, path = waiting[0]
            with _naming(path):
                os.replace(name, path)
            waiting.pop(0)
        for path in set(older) - set(contents):
            path.unlink(missing_ok=True)
    finally:
        for name, _ in waiting:
            os.unlink(name)


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Errors of the system name the destination, not the temporary file."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def finite(value: Any, *, infinite: float | None = None) -> Any:
    """The same structure with None (null in JSON) in place of numbers that are not finite.

    Args:
        value: a structure of mappings, lists and plain values.
        infinite: what stands for infinity, with its sign; None if None.
    """
    if isinstance(value, Mapping):
        return {k: finite(v, infinite=infinite) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v, infinite=infinite) for v in value]
    if isinstance(value, bool) or not isinstance(value, float | np.floating):
        return value
    if infinite is not None and math.isinf(value):
        return math.copysign(infinite, value)
    return float(value) if math.isfinite(value) else None
