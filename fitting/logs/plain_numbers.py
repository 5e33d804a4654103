"""Tables of nothing but plain numbers, which most logs are: read without loading a library for tables."""

import numpy as np
from jaxtyping import Float

# Longer texts are worth the time that a library for tables takes to load.
_MOST_CHARACTERS = 1 << 24


def plain_columns(lines: list[str], delimiter: str, places: list[int]) -> Float[np.ndarray, "columns rows"] | None:
    """Some columns of a table of text.

    Args:
        lines: rows, of which some may be blank.
        delimiter: between cells; a blank stands for any run of blanks.
        places: which columns, counted from zero.

    Returns:
        The columns; None where a cell is anything but a number with a decimal point, or a row is too short.
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
