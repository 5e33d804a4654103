"""Output logs of commands."""

from pathlib import Path

import numpy as np

from fitting.files import write_whole


def write_table(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write a CSV file.

    Args:
        path: of the file.
        columns: by name, of one length.
    """
    rows = np.stack(list(columns.values()), axis=1)
    lines = [",".join(columns)] + [",".join(f"{v:.12g}" for v in row) for row in rows]
    write_whole({path: "\n".join(lines) + "\n"})
