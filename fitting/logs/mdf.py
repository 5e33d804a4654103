"""Logs in ASAM MDF; each channel has the clock of its group."""

import logging
from io import BytesIO
from pathlib import Path

import numpy as np

from fitting.errors import InputError
from fitting.logs.extras import needing
from fitting.logs.raw_table import RawColumn, RawTable, not_numbers


def read_mdf(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """The wanted channels of an MDF file, by name or as "group/name" where several groups have that name.

    Args:
        path: named in messages.
        source: what is read.
        wanted: names of channels.

    Raises:
        InputError: The extra is not installed, or a name is not unique.
    """
    with needing(path, "MDF files need asammdf; install it", "mdf", "export the log as CSV"):
        from asammdf import MDF  # pyright: ignore[reportMissingImports]
    # The library also logs the errors that it raises.
    logging.getLogger("asammdf").setLevel(logging.CRITICAL + 1)
    with MDF(source) as file:
        places = {name: tuple(found) for name, found in file.channels_db.items()}
        columns = {}
        for asked in wanted:
            group, _, name = asked.rpartition("/") if asked not in places else ("", "", asked)
            found = [p for p in places.get(name, ()) if not group or group == str(p[0])]
            masters = [p for p in found if file.masters_db.get(p[0]) == p[1]]
            # Each group has its own time channel; its stamps come with the other channels.
            if not found or len(masters) == len(found):
                continue
            if len(found) > 1:
                groups = ", ".join(f"{p[0]}/{name}" for p in found[:6])
                raise InputError(
                    f"{path}: '{asked}' is the name of several channels; give one of {groups} in [columns]"
                )
            signal = file.get(name, group=found[0][0], index=found[0][1])
            samples = np.asarray(signal.samples)
            if samples.ndim != 1 or samples.dtype.kind not in "biuf":
                raise not_numbers(path, asked, f"is of type {samples.dtype}")
            stamps = np.asarray(signal.timestamps, dtype=np.float64)
            columns[asked] = RawColumn(samples.astype(np.float64), signal.unit or None, stamps)
        return RawTable(tuple(places), columns)
