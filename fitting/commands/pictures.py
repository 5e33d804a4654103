"""Plots of commands as files."""

from collections.abc import Collection
from io import BytesIO
from pathlib import Path
from typing import Any


def png(figure: Any) -> bytes:
    """A figure of matplotlib as PNG."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def show_files(files: Collection[Path]) -> None:
    """Print the names of written files."""
    if files:
        print(f"Files: {', '.join(str(f) for f in files)}")
