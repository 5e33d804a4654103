"""The test part of a log: cut off as soon as it is read, so that no fit, no choice and no check can look at it."""

from dataclasses import replace

from fitting.errors import DataError
from fitting.estimation.free_run import WINDOW
from fitting.logs.drive_file import DriveFile
from fitting.logs.log import Log
from fitting.logs.masks import masked
from fitting.logs.zeroing import counted_from, zeroed

TEST_SHARE = 0.2
"""Share of a log, at its end, that is test data where no other log is named for it."""

# A free run takes its initial state from a window; as many rows again are the least that tell an error.
_FEWEST = 2 * WINDOW


def parted(log: Log, drive_file: DriveFile, *, share: float = TEST_SHARE) -> tuple[Log, Log | None]:
    """A log without its test part, made ready for a fit, and that part.

    Args:
        log: as read.
        drive_file: for the load's inertia.
        share: of the log that is test data; 0 where other logs are.

    Returns:
        Both parts masked, and zeroed as the first one is; no second part where it would be too short to tell an error.
    """
    border = len(log) - round(share * len(log))
    if share <= 0.0 or len(log) - border < _FEWEST:
        return zeroed(masked(log), drive_file), None
    known = zeroed(masked(log.rows(0, border)), drive_file)
    end = log.rows(border, len(log))
    if end.pieces == ():
        return known, None
    try:
        end = masked(end)
    except DataError:
        return known, None
    return known, counted_from(end, known.zero)


def whole_test_log(log: Log, drive_file: DriveFile) -> Log:
    """A log that is test data from its beginning to its end, as read; its zero is taken from where a free run begins.

    Raises:
        DataError: Hardly an output can be believed.
    """
    ready = masked(log)
    zero = zeroed(replace(ready, outputs_until=WINDOW), drive_file).zero
    return counted_from(ready, zero)
