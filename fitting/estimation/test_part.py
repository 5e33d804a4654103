"""The test part of a log, cut off when it is read, so that no fit, selection or check uses it."""

from collections.abc import Sequence
from dataclasses import replace

from fitting.errors import DataError
from fitting.estimation.initial_states import WINDOW
from fitting.logs.drive_file import DriveFile
from fitting.logs.log import Log
from fitting.logs.masks import masked
from fitting.logs.zeroing import counted_from, zeroed

TEST_SHARE = 0.2
"""Share at the end of a log that is test data, unless test logs are named."""

# Rows of a free run's initial-state window, and as many again to estimate an error.
_FEWEST = 2 * WINDOW


def parted(
    log: Log, drive_file: DriveFile, *, share: float = TEST_SHARE, zeros: Sequence[float] = ()
) -> tuple[Log, Log | None]:
    """A log without its test part, prepared for a fit, and the test part.

    Args:
        log: as read.
        drive_file: for the load's inertia.
        share: of the log that is test data; 0 where test logs are named.
        zeros: of the twist, in other logs of the drive.

    Returns:
        Both parts masked, with the zero offsets of the first. The whole log without a test part, where one of them
        would have no stretch to fit, or the test part would be too short to estimate an error.
    """
    border = len(log) - round(share * len(log))
    known, end = log.rows(0, border), None
    if share > 0.0 and len(log) - border >= _FEWEST and known.pieces != ():
        end = _end(log, border)
    if end is None:
        return zeroed(masked(log), drive_file, zeros=zeros), None
    known = zeroed(masked(known), drive_file, zeros=zeros)
    return known, counted_from(end, known.zero)


def _end(log: Log, border: int) -> Log | None:
    """The rows from a border on, masked; None where they hold no stretch, or too few valid samples."""
    try:
        end = masked(log.rows(border, len(log)))
    except DataError:
        return None
    return None if end.pieces == () else end


def whole_test_log(log: Log, drive_file: DriveFile, *, zeros: Sequence[float] = ()) -> Log:
    """A log that is test data as a whole, masked, with the zero of the fitted logs where they tell it; else it has a
    zero of its own ([`fitting.logs.zeroing.zeroed`][]).

    Args:
        log: as read.
        drive_file: for the load's inertia.
        zeros: of the twist, in the fitted logs.

    Raises:
        DataError: too few valid outputs.
    """
    ready = masked(log)
    known = zeroed(replace(ready, outputs_until=WINDOW), drive_file, zeros=zeros)
    return replace(known, outputs_until=ready.outputs_until)
