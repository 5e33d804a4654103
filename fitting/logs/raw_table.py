"""What a log file holds, before anyone says what it means: columns of numbers in the file's own names and units."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fitting.errors import InputError


@dataclass(frozen=True, eq=False)
class RawColumn:
    """One column as numbers.

    Attributes:
        values: float64, (n,), NaN where the file has nothing or text.
        unit: as the file states it (unit row, "name [unit]", attribute), or None.
        time: own stamps [s], (n,), of a channel that brings its own clock; None for the table's rows.
        text_rows: rows that hold text where a number was expected.
        text: of the first of them.
    """

    values: np.ndarray
    unit: str | None = None
    time: np.ndarray | None = None
    text_rows: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    text: str = ""


@dataclass(frozen=True, eq=False)
class RawTable:
    """What one file holds of what was asked for.

    Attributes:
        names: All columns of the file.
        columns: The asked columns that the file has, by the name asked for.
        sample_rate: Hz, a scalar `fs` beside the data (MAT and HDF5 only), or None.
    """

    names: tuple[str, ...]
    columns: dict[str, RawColumn] = field(default_factory=dict)
    sample_rate: float | None = None


def not_numbers(path: Path, name: str, what: str, mend: str = "save it as one") -> InputError:
    """The refusal of a column that is no vector."""
    return InputError(f"{path}: the column '{name}' {what}, where a plain vector of numbers is needed; {mend}")


def split_unit(name: str) -> tuple[str, str | None]:
    """A header such as "torque [N m]" or "time (ms)" as name and unit; the unit is None where there is none."""
    match = re.fullmatch(r"\s*(.+?)\s*[\[(]([^\[\]()]*[A-Za-zµ°%][^\[\]()]*)[\])]\s*", name)
    return (name.strip(), None) if match is None else (match[1], match[2].strip())
