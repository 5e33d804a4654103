"""LabVIEW measurement files: a file header, then sections with a header and a table each."""

from fitting.logs.raw_table import split_unit

MAGIC = "LabVIEW Measurement"
_END = "***End_of_Header***"


def lvm_table(lines: list[str]) -> tuple[list[str], float | None]:
    """The tables of all sections as one, with one line of names and units; and the sample rate [Hz] where the file
    states a step instead of stamps.

    Args:
        lines: of the file.

    References:
        National Instruments, "Specification for the LabVIEW Measurement File (.lvm)".
    """
    ends = [i for i, line in enumerate(lines) if line.startswith(_END)]
    if not ends:
        return lines, None
    about = _entries(lines[: ends[0]], "\t")
    comma = about.get("Separator", [""])[:1] == ["Comma"]
    delimiter = "," if comma else "\t"
    columns = about.get("X_Columns", ["One"])[0]
    section = _entries(lines[ends[0] + 1 : ends[-1]], delimiter)
    # A file without sections has its table after the only header.
    starts = ends[1:] or ends
    stops = [_next_section(lines, end) for end in starts]
    names = _names(lines[starts[0] + 1].split(delimiter) if starts[0] + 1 < len(lines) else [], section, columns)
    rows = [line for start, stop in zip(starts, stops, strict=True) for line in lines[start + 2 : stop]]
    step = section.get("Delta_X", [""])[0].replace(",", ".") if columns == "No" else ""
    return [delimiter.join(names), *rows], _rate(step)


def _entries(lines: list[str], delimiter: str) -> dict[str, list[str]]:
    """Value of each keyword at its first occurrence."""
    found: dict[str, list[str]] = {}
    for line in lines:
        key, *values = (cell.strip() for cell in line.split(delimiter))
        found.setdefault(key, values or [""])
    return found


def _next_section(lines: list[str], end: int) -> int:
    """First line of the next section, or the number of lines."""
    return next((i for i in range(end + 1, len(lines)) if lines[i].startswith("Channels")), len(lines))


def _names(names: list[str], section: dict[str, list[str]], columns: str) -> list[str]:
    """The names with the units that the section's header states."""
    units = section.get("Y_Unit_Label", [])
    found, channel = [], 0
    for place, name in enumerate(cell.strip() for cell in names):
        stamps = place % 2 == 0 if columns == "Multi" else place == 0
        unit = "s" if stamps else units[channel] if channel < len(units) else ""
        channel += not stamps
        found.append(f"{name} [{unit}]" if unit and split_unit(name)[1] is None and name != "Comment" else name)
    return found


def _rate(step: str) -> float | None:
    try:
        return 1.0 / float(step)
    except (ValueError, ZeroDivisionError):
        return None
