"""Text logs in any dialect: CSV, TSV and similar, with arbitrary lines above the table."""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from fitting.errors import InputError
from fitting.logs.column_names import unit_in_name
from fitting.logs.lvm import MAGIC, lvm_table
from fitting.logs.plain_numbers import plain_columns
from fitting.logs.raw_table import DATE, HALF_DAY, RawColumn, RawTable, numbered, places_of, split_unit
from fitting.logs.units import USUAL

_DELIMITERS = (",", ";", "\t", "|", " ")
_LOOKED_AT = 400
_LETTER = re.compile(r"[^\W\d_]")
# Most lines above the table; a file whose numbers begin later is not a log.
_PREAMBLE = 2000
# Most lines with words between a header and the numbers, as in exports that list properties of each channel; assumed.
_LINES_ABOVE = 24
_MOST_LEFT_OUT = 3
_NUMBER = re.compile(
    r"[-+\u2212]?(?:[0-9][0-9.,'’]*|\.[0-9]+)(?:[eEdD][-+]?[0-9]+)?|[-+]?(?:nan|inf(?:inity)?)|true|false",
    re.IGNORECASE,
)
_STAMP = re.compile(
    rf"(?:{DATE}[T _]|[0-9]+ days?,? )?[0-9]{{1,4}}:[0-9]{{2}}(?::[0-9]{{2}})?(?:[.,][0-9]*)?{HALF_DAY}"
    r"(?:Z|UTC|[-+][0-9:]{4,5})?"
)
# A duration, or a number with a blank before its unit: 0.001 sec, 12ms, 3.5 N m.
_UNITS = "|".join(map(re.escape, sorted((*USUAL, "sec", "msec", "usec", "°", "A", "mA", "V", "mV", "%"), reverse=True)))
_QUANTITY = re.compile(rf"[-+\u2212]?[0-9][0-9.,]*(?:[eE][-+]?[0-9]+)?(?:[nuµμm]?s| ?(?:{_UNITS}))")


@dataclass(frozen=True)
class _Dialect:
    """Position and delimiter of a table in a text.

    Attributes:
        delimiter: between cells; a blank matches any run of blanks.
        width: cells in a row.
        first: line of the first row of numbers.
    """

    delimiter: str
    width: int
    first: int


@dataclass(frozen=True)
class Head:
    """Header of a table.

    Attributes:
        names: of the columns, made unique; a number without a name.
        units: from the row of units, if any.
        first: the first line of the table's rows.
        delimiter: between cells.
        width: cells in a row.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    first: int
    delimiter: str
    width: int

    def places(self, wanted: tuple[str, ...]) -> dict[str, int]:
        """Indices of the wanted columns."""
        return places_of(wanted, self.names)

    def table(self, wanted: tuple[str, ...], found: Mapping[int, RawColumn]) -> RawTable:
        """The wanted columns, with the units of the header.

        Args:
            wanted: names of columns.
            found: columns by index.
        """
        columns = {}
        for name, place in self.places(wanted).items():
            stated = unit_in_name(self.names[place], name)
            below = self.units[place] if place < len(self.units) else None
            columns[name] = replace(found[place], unit=found[place].unit or stated or below or None)
        plain = [split_unit(name)[0] for name in self.names]
        repeated = frozenset(name for name in plain if f"{name} (2)" in plain)
        return RawTable(self.names, columns, repeated=repeated)


def read_text(path: Path, raw: bytes, wanted: tuple[str, ...]) -> RawTable:
    """The wanted columns of a text log.

    Args:
        path: named in messages.
        raw: the file's bytes.
        wanted: names of columns; "torque" also finds "torque [N m]", "torque (2)" the second of that name, and
            "column 3" the third column.

    Raises:
        InputError: The text has no table, or columns are wanted by name and it has no header.
    """
    lines = _decode(path, raw).splitlines()
    if not any(line.strip() for line in lines):
        raise InputError(f"{path}: the file is empty; export the log again")
    lines, rate = lvm_table(lines) if lines[0].startswith(MAGIC) else (lines, None)
    head = head_of(path, lines, wanted)
    if head is None:
        return RawTable(_header_alone(lines) if lines else ())
    width = max(head.width, len(head.names))
    places = sorted(set(head.places(wanted).values()))
    return replace(head.table(wanted, _columns(lines[head.first :], head.delimiter, width, places)), sample_rate=rate)


def head_of(path: Path, lines: list[str], wanted: tuple[str, ...]) -> "Head | None":
    """Position and column names of a table in a text; None without rows of numbers.

    Args:
        path: named in messages.
        lines: of the text.
        wanted: names of columns.

    Raises:
        InputError: The table has no header, and columns are wanted by name.
    """
    dialect = _dialect(lines)
    if dialect is None:
        return None
    names, units, first = _header(path, lines, dialect, wanted)
    return Head(tuple(names), tuple(units), first, dialect.delimiter, dialect.width)


def _decode(path: Path, raw: bytes) -> str:
    head = raw[:4096]
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = raw.decode("utf-16", errors="replace")
    elif len(head) > 8 and head.count(0) > 0.2 * len(head) and 0 in (head[::2].count(0), head[1::2].count(0)):
        text = raw.decode("utf-16-be" if head[::2].count(0) else "utf-16-le", errors="replace")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("latin-1")
    # A logger that loses power may leave a block of zeros at the end of a file.
    text = text.rstrip("\0\x1a")
    if "Â" in text:
        # UTF-8 that was read as Latin-1 and encoded again.
        text = re.sub("Â([°·µ²])", r"\1", text)
    if "\0" in text:
        raise InputError(f"{path}: the file is not text; export the log again or mend its suffix")
    return text


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        # Each name or cell may be quoted; a lone mark is a part of its cell.
        quoted = line.count('"') > 0 and line.count('"') % 2 == 0
        return next(csv.reader([" ".join(line.split())], delimiter=" "), []) if quoted else line.split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]
    return [cell.strip() for cell in line.split(delimiter)]


def _is_number(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell) or _STAMP.fullmatch(cell) or _QUANTITY.fullmatch(cell))


def _numeric_share(cells: list[str]) -> float:
    filled = [cell for cell in cells if cell]
    return sum(map(_is_number, filled)) / len(filled) if filled else 0.0


def _dialect(lines: list[str]) -> _Dialect | None:
    """The delimiter that gives rows of numbers of equal width, with as many names above."""
    begin = next((i for i, line in enumerate(lines[:_PREAMBLE]) if re.match(r"""[\s"']*[-+.,;|\t]*[0-9]""", line)), 0)
    sample = list(enumerate(lines[: begin + _LOOKED_AT]))
    best, most = None, (False, 0.0, 0, 0)
    for rank, delimiter in enumerate(_DELIMITERS):
        rows = [(index, *_row(line, delimiter)) for index, line in sample if _is_told(line)]
        shares: dict[int, float] = {}
        for _, cells, share in rows:
            shares[cells] = shares.get(cells, 0.0) + share
        width = max(shares, key=lambda w: (shares[w], w), default=0)
        if not shares.get(width):
            continue
        # Most rows leave out comments, some have one.
        fits = range(width, width + _MOST_LEFT_OUT + 1)
        run = _longest_run([(i, cells in fits and share > 0) for i, cells, share in rows])
        found = _Dialect(delimiter, width, run)
        # A decimal comma as delimiter gives cells that are not numbers, and no header.
        score = (width > 1 and bool(_heads(lines, found)), shares[width] if width > 1 else 0.0, width, -rank)
        if score > most:
            best, most = found, score
    return best


def _is_told(line: str) -> bool:
    """Whether a line is neither blank nor a comment."""
    return line.strip() != "" and not line.lstrip().startswith("#")


def _row(line: str, delimiter: str) -> tuple[int, float]:
    """Number of a line's cells, and their share of numbers; 0 for a line that is not a row of samples."""
    cells = _split(line, delimiter)
    share = _numeric_share(cells)
    # A row of samples may have blanks and a word in it.
    return len(cells), share if share > 0.5 else 0.0


def _longest_run(rows: list[tuple[int, bool]]) -> int:
    """The first line of the longest run of rows, since single lines above a table may resemble rows."""
    best, longest, start, length = 0, 0, 0, 0
    for index, fits in rows:
        start = index if fits and length == 0 else start
        length = length + 1 if fits else 0
        if length > longest:
            best, longest = start, length
    return best


def _heads(lines: list[str], dialect: _Dialect) -> list[tuple[int, list[str]]]:
    """Lines shortly above the numbers that may be the header, and their cells."""
    found = []
    for index in range(dialect.first - 1, -1, -1):
        # numpy.savetxt and others write the header as a comment.
        line = lines[index].strip(" ").lstrip("#%/! ")
        if not _LETTER.search(line) or (_is_told(lines[index]) and _row(line, dialect.delimiter)[1] > 0):
            continue
        found.append((index, _split(line, dialect.delimiter)))
        if len(found) == _LINES_ABOVE:
            break
    return [(index, row) for index, row in reversed(found) if _could_head(row, dialect)]


def _header(
    path: Path, lines: list[str], dialect: _Dialect, wanted: tuple[str, ...]
) -> tuple[list[str], list[str], int]:
    """Unique names of the columns, the row of units below them if any, and the first line after both."""
    rows = _heads(lines, dialect)
    if not rows:
        return _numbered(path, lines, dialect, wanted), [], dialect.first
    has_units = len(rows) > 1 and _are_units(rows[-1][1])
    # The first cell may be the row's own title.
    units = [cell.strip("[]()") for cell in rows[-1][1]] if has_units else []
    units = ["" if re.fullmatch("(?:unit|einheit)[a-z]*:?", cell, re.IGNORECASE) else cell for cell in units]
    # A corrupt row of samples may be a word and blanks; a row of properties repeats its title.
    index, names = max(reversed(rows[:-1] if has_units else rows), key=lambda row: len({*row[1]} - {""}))
    behind = range((rows[-1][0] if has_units else index) + 1, dialect.first)
    rows_begin = (i for i in behind if not _LETTER.search(lines[i]) or _row(lines[i], dialect.delimiter)[1] > 0)
    first = next(rows_begin, dialect.first)
    if len(names) == dialect.width - 1 and _last_is_a_signal(lines, dialect):
        # R and pandas give the column of row names no name.
        names, units = ["", *names], ["", *units] if len(units) == len(names) else units
    return _each_once(names), units, first


def _last_is_a_signal(lines: list[str], dialect: _Dialect) -> bool:
    """Whether the last cells of rows hold numbers; they are empty where rows end in a delimiter."""
    rows = (_split(line, dialect.delimiter) for line in lines[dialect.first : dialect.first + _LOOKED_AT])
    return any(len(row) >= dialect.width and _is_number(row[dialect.width - 1]) for row in rows)


def _numbered(path: Path, lines: list[str], dialect: _Dialect, wanted: tuple[str, ...]) -> list[str]:
    """Names for the columns of a table without a header, where they are wanted by number."""
    names = [numbered(i + 1) for i in range(dialect.width)]
    above = [line for line in lines[: dialect.first] if _LETTER.search(line)]
    last = len(_split(above[-1].lstrip("#%/! "), dialect.delimiter)) if above else 0
    commas = dialect.delimiter == "," and 1 < last <= dialect.width // 2
    if set(names) & set(wanted) or not (wanted or (commas and dialect.width == 2 * last)):
        return names
    mend = "export it with semicolons between cells, if its decimal sign is a comma" if commas else ""
    raise InputError(
        f"{path}: the file has no header line of {dialect.width} names above its {dialect.width} columns of numbers; "
        f"{mend or 'write the names into its first line, or give [columns] the numbers of the columns'}"
    )


def _each_once(names: list[str]) -> list[str]:
    """The names, with a number after repeated ones: "time (2) [s]"."""
    found: list[str] = []
    seen: dict[str, int] = {}
    last = max(i for i, name in enumerate(names) if name)
    for i, name in enumerate(names[: last + 1]):
        plain, unit = split_unit(name or numbered(i + 1))
        seen[plain] = seen.get(plain, 0) + 1
        again = f"{plain} ({seen[plain]})" + (f" [{unit}]" if unit else "")
        found.append(again if seen[plain] > 1 else name or plain)
    return found


def _could_head(cells: list[str], dialect: _Dialect) -> bool:
    # A delimiter at the end of rows or of the header alone makes them differ by one; rows may leave out comments.
    named = [cell for cell in cells if cell]
    spare = 1 if dialect.delimiter == " " else _MOST_LEFT_OUT
    fits = dialect.width - 1 <= len(cells) <= dialect.width + spare
    return len(named) > 0 and fits and not any(_is_number(cell) for cell in named)


def _are_units(cells: list[str]) -> bool:
    filled = [cell for cell in cells if cell]
    known = (
        r"[\[(].*[\])]|-|n?s|[munµμ]s|sec.*|°.*|deg.*|m?rad.*|rev.*|[mkM]?N\W?m+.*|newton.*|counts?|inc.*|[mk]?V"
        r"|volts?|m?A|amp.*|rpm|1/min|K|%"
    )
    return sum(bool(re.fullmatch(known, cell, re.IGNORECASE)) for cell in filled) > 0.5 * len(filled)


def _header_alone(lines: list[str]) -> tuple[str, ...]:
    """Names in the last line without numbers, of a text without rows."""
    for line in reversed(lines):
        delimiter = max(_DELIMITERS[:-1], key=line.count)
        names = tuple(cell[:60] for cell in _split(line.lstrip("# "), delimiter) if cell)
        if names and not any(map(_is_number, names)):
            return names
    return ()


def _columns(lines: list[str], delimiter: str, width: int, places: list[int]) -> dict[int, RawColumn]:
    plain = plain_columns(lines, delimiter, places)
    if plain is not None:
        return {place: RawColumn(values) for place, values in zip(places, plain, strict=True)}
    # Imported here: most logs are plain numbers.
    from fitting.logs.text_cells import cells, column_from_text

    frame = cells(lines, delimiter, width, places)
    return {p: column_from_text(frame[f"c{p}"], comma_parts_cells=delimiter == ",") for p in places}
