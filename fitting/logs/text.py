"""Logs as text, in whatever dialect: CSV, TSV and their relatives, with anything written above the table."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

from fitting.errors import InputError
from fitting.logs.plain_numbers import plain_columns
from fitting.logs.raw_table import RawColumn, RawTable, split_unit

_DELIMITERS = (",", ";", "\t", "|", " ")
_LOOKED_AT = 400
_LETTER = re.compile(r"[^\W\d_]")
# Lines above the table that are worth reading; a file whose numbers begin later is no log.
_PREAMBLE = 2000
_NUMBER = re.compile(
    r"[-+\u2212]?(?:[0-9][0-9.,'’]*|\.[0-9]+)(?:[eEdD][-+]?[0-9]+)?|[-+]?(?:nan|inf(?:inity)?)", re.IGNORECASE
)
_STAMP = re.compile(r"(?:[0-9./-]+[T _])?[0-9]{1,2}:[0-9]{2}(?::[0-9]{2}(?:[.,][0-9]*)?)?(?:Z|UTC|[-+][0-9:]{4,5})?")


@dataclass(frozen=True)
class _Dialect:
    """Where the table is in a text, and how its cells are parted.

    Attributes:
        delimiter: between cells; a blank stands for any run of blanks.
        width: cells in a row.
        first: line of the first row of numbers.
    """

    delimiter: str
    width: int
    first: int


def read_text(path: Path, raw: bytes, wanted: tuple[str, ...]) -> RawTable:
    """The wanted columns of a text log.

    Args:
        path: named in messages.
        raw: the file's bytes.
        wanted: names of columns; "torque" also finds "torque [N m]".

    Raises:
        InputError: The text holds no table with a header, or a wanted column twice.
    """
    lines = _decode(path, raw).splitlines()
    if not any(line.strip() for line in lines):
        raise InputError(f"{path}: the file is empty; export the log again")
    dialect = _dialect(lines)
    if dialect is None:
        return RawTable(_header_alone(lines))
    header, unit_row, first = _header(path, lines, dialect)
    width = max(dialect.width, len(header))
    places = [p for name in wanted if (p := _place(path, header, name)) is not None]
    asked = [name for name in wanted if _place(path, header, name) is not None]
    found = _columns(lines[first:], dialect.delimiter, width, sorted(set(places)))
    columns = {}
    for name, place in zip(asked, places, strict=True):
        column = found[place]
        stated = split_unit(header[place])[1] if header[place] != name else None
        below = unit_row[place] if place < len(unit_row) else None
        columns[name] = RawColumn(
            column.values, column.unit or stated or below or None, None, column.text_rows, column.text
        )
    return RawTable(tuple(name for name in header if name), columns)


def _decode(path: Path, raw: bytes) -> str:
    head = raw[:4096]
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = raw.decode("utf-16", errors="replace")
    elif len(head) > 8 and head[1::2].count(0) > 0.4 * len(head[1::2]) and head[::2].count(0) == 0:
        text = raw.decode("utf-16-le", errors="replace")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("latin-1")
    # A logger that lost power leaves a block of zeros at the end of its last file.
    text = text.rstrip("\0\x1a")
    if "\0" in text:
        raise InputError(f"{path}: the file is not text; export the log again or mend its suffix")
    return text


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]
    return [cell.strip() for cell in line.split(delimiter)]


def _is_number(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell) or _STAMP.fullmatch(cell))


def _numeric_share(cells: list[str]) -> float:
    filled = [cell for cell in cells if cell]
    return sum(map(_is_number, filled)) / len(filled) if filled else 0.0


def _dialect(lines: list[str]) -> _Dialect | None:
    """The delimiter under which the lines are rows of numbers of one width, with as many names above."""
    begin = next((i for i, line in enumerate(lines[:_PREAMBLE]) if re.match(r"""[\s"']*[-+.,;|\t]*[0-9]""", line)), 0)
    sample = list(enumerate(lines[: begin + _LOOKED_AT]))
    best, most = None, (False, 0.0, 0, 0)
    for rank, delimiter in enumerate(_DELIMITERS):
        shares: dict[int, float] = {}
        where: dict[int, int] = {}
        for index, line in sample:
            if line.strip() == "" or line.lstrip().startswith("#"):
                continue
            cells = _split(line, delimiter)
            share = _numeric_share(cells)
            # A row of samples may have blanks and a word in it.
            if share > 0.5:
                shares[len(cells)] = shares.get(len(cells), 0.0) + share
                where.setdefault(len(cells), index)
        if not shares:
            continue
        width = max(shares, key=lambda w: (shares[w], w))
        found = _Dialect(delimiter, width, where[width])
        # A decimal comma taken for the delimiter gives cells that are no numbers, and no header.
        score = (width > 1 and bool(_heads(lines, found)), shares[width] if width > 1 else 0.0, width, -rank)
        if score > most:
            best, most = found, score
    return best


def _heads(lines: list[str], dialect: _Dialect) -> list[list[str]]:
    """The one or two lines above the numbers that could name their columns."""
    above = [line for line in lines[: dialect.first] if _LETTER.search(line)][-2:]
    # numpy.savetxt and its like write the header as a comment.
    rows = [_split(line.strip().lstrip("#%/!").strip(), dialect.delimiter) for line in above]
    return [row for row in rows if _could_head(row, dialect.width)]


def _header(path: Path, lines: list[str], dialect: _Dialect) -> tuple[list[str], list[str], int]:
    """Names of the columns, the row of units below them where there is one, and the first line behind both."""
    above = [i for i, line in enumerate(lines[: dialect.first]) if _LETTER.search(line)]
    rows = _heads(lines, dialect)
    if not rows:
        last = len(_split(lines[above[-1]].lstrip("#%/! "), dialect.delimiter)) if above else 0
        commas = dialect.delimiter == "," and 1 < last <= dialect.width // 2
        mend = "export it with semicolons between cells, if its decimal sign is a comma" if commas else ""
        raise InputError(
            f"{path}: the file has no header line of {dialect.width} names above its {dialect.width} columns of "
            f"numbers; {mend or 'write the column names into its first line'}"
        )
    if len(rows) == 2 and _are_units(rows[1]):
        return rows[0], [cell.strip("[]()") for cell in rows[1]], above[-1] + 1
    return rows[-1], [], above[-1] + 1


def _could_head(cells: list[str], width: int) -> bool:
    # A delimiter at the end of rows or of the header alone makes them differ by one.
    named = [cell for cell in cells if cell]
    return len(named) > 0 and abs(len(cells) - width) <= 1 and not any(_is_number(cell) for cell in named)


def _are_units(cells: list[str]) -> bool:
    filled = [cell for cell in cells if cell]
    known = (
        r"[\[(].*[\])]|-|n?s|[munµμ]s|sec.*|°.*|deg.*|m?rad.*|rev.*|[mkM]?N\W?m+.*|counts?|inc.*|[mk]?V|rpm|1/min|K|%"
    )
    return sum(bool(re.fullmatch(known, cell)) for cell in filled) > 0.5 * len(filled)


def _header_alone(lines: list[str]) -> tuple[str, ...]:
    """Names in the last line of a text without rows."""
    line = next(line for line in reversed(lines) if line.strip()).lstrip("# ")
    delimiter = max(_DELIMITERS[:-1], key=line.count)
    return tuple(cell[:60] for cell in _split(line, delimiter) if cell)


def _place(path: Path, header: list[str], wanted: str) -> int | None:
    """The column of that name, or the only one of that name with a unit behind it."""
    for match in (lambda name: name == wanted, lambda name: split_unit(name)[0] == wanted):
        places = [i for i, name in enumerate(header) if match(name)]
        if len(places) > 1:
            raise InputError(f"{path}: the column '{wanted}' appears twice; rename one of the two")
        if places:
            return places[0]
    return None


def _columns(lines: list[str], delimiter: str, width: int, places: list[int]) -> dict[int, RawColumn]:
    plain = plain_columns(lines, delimiter, places)
    if plain is not None:
        return {place: RawColumn(values) for place, values in zip(places, plain, strict=True)}
    # Loaded here: most logs are plain numbers.
    from fitting.logs.text_cells import cells, column_from_text

    frame = cells(lines, delimiter, width, places)
    return {p: column_from_text(frame[f"c{p}"], comma_parts_cells=delimiter == ",") for p in places}
