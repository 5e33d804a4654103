"""Fast reader for tables of plain numbers, without a library for tables."""

import numpy as np
from jaxtyping import Float

# For longer texts, a library for tables is faster despite its import time.
_MOST_CHARACTERS = 1 << 24


def plain_columns(lines: list[str], delimiter: str, places: list[int]) -> Float[np.ndarray, "columns rows"] | None:
    """Columns of a text table.

    Args:
        lines: rows, of which some may be blank.
        delimiter: between cells; a blank matches any run of blanks.
        places: which columns, counted from zero.

    Returns:
        The columns; None where a cell is not a number with a decimal point, or a row is too short.
    """
    rows = [line for line in lines if line.strip()]
    if not rows or not places or sum(map(len, rows)) > _MOST_CHARACTERS:
        return None
    text = "".join(rows)
    if not text.isascii() or text.encode().translate(None, b"0123456789+-.eE " + delimiter.encode()):
        return None
    try:
        found = np.loadtxt(rows, delimiter=delimiter.strip(" ") or None, usecols=places, comments=None, ndmin=2)
    except ValueError:
        return None
    return np.ascontiguousarray(found.T) if np.isfinite(found).all() else None
