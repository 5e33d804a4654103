"""Raw content of a log file: columns of numbers with the file's names and units."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fitting.errors import InputError

DATE = r"(?:[0-9./-]+|[0-9]{1,2}[ ./-][A-Za-z]{3,9}[ ./-][0-9]{2,4}|[A-Za-z]{3,9}\.? [0-9]{1,2}[,.]? [0-9]{4})"
"""Pattern of a date before a time of day, in numbers or with the name of the month."""

HALF_DAY = r"(?:\s?([AaPp])\.?[Mm]\.?)?"
"""Pattern of the half of the day behind a time of day."""


@dataclass(frozen=True, eq=False)
class RawColumn:
    """One column as numbers.

    Attributes:
        values: float64, (n,), NaN for blanks and text.
        unit: as the file states it (unit row, "name [unit]", attribute), or None.
        time: stamps [s], (n,), of a channel with a separate clock; None for the table's rows.
        text_rows: rows that hold text where a number was expected.
        text: in the first of them.
        rate_std: relative standard deviation of the sample interval of `time`, from rounding.
    """

    values: np.ndarray
    unit: str | None = None
    time: np.ndarray | None = None
    text_rows: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    text: str = ""
    rate_std: float = 0.0


@dataclass(frozen=True, eq=False)
class RawTable:
    """Requested columns of a file.

    Attributes:
        names: All columns of the file.
        columns: The requested columns that the file has, by requested name.
        sample_rate: Hz, a scalar `fs` beside the data or a step in a header, or None.
        repeated: Names of several columns of the file; in `names`, a number distinguishes them.
    """

    names: tuple[str, ...]
    columns: dict[str, RawColumn] = field(default_factory=dict)
    sample_rate: float | None = None
    repeated: frozenset[str] = frozenset()


def not_numbers(path: Path, name: str, what: str, mend: str = "save it as one") -> InputError:
    """The error for a column that is not a vector."""
    return InputError(f"{path}: the column '{name}' {what}, where a plain vector of numbers is needed; {mend}")


def numbered(number: int) -> str:
    """The name that requests a column by its number, counted from one."""
    return f"column {number}"


def places_of(wanted: Iterable[str], names: Sequence[str]) -> dict[str, int]:
    """Indices of the wanted columns, from zero; missing ones are omitted.

    Args:
        wanted: Names such as "torque", which also finds "torque [N m]", or numbers such as "column 3". The first of
            several columns of one name is also "torque (1)".
        names: Of all columns, in order.
    """
    known: dict[str, int] = {}
    plain = [split_unit(name)[0] for name in names]
    first = [f"{name} (1)" for name in plain]
    for form in (names, plain, [numbered(i + 1) for i in range(len(names))], first):
        for place, name in enumerate(form):
            known.setdefault(name, place)
    return {name: known[name] for name in wanted if name in known}


def split_unit(name: str) -> tuple[str, str | None]:
    """A header such as "torque [N m]" or "time (ms)" as name and unit; None without a unit."""
    match = re.fullmatch(r"\s*(.+?)\s*[\[(]([^\[\]()]*[A-Za-zµ°%][^\[\]()]*)[\])]\s*", name)
    return (name.strip(), None) if match is None else (match[1], match[2].strip())
