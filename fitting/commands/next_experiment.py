"""Limits of the next experiment, as stated on the command line."""

import numpy as np

from fitting.api.data import Data
from fitting.commands.options import ExperimentLimits
from fitting.drive_data import WHY_NOT_QUASI_STATIC
from fitting.errors import InputError

_FEWEST_SAMPLES = 200


def stated_limits(options: ExperimentLimits, data: Data) -> dict[str, float]:
    """The stated limits, by their names in [`fitting.next_experiment.excitation.Limits`][].

    Args:
        options: of the command line.
        data: the logs.

    Raises:
        InputError: a limit is not valid, or the logs are quasi-static.
    """
    log = data.logs[0]
    if data.kind == "quasi-static":
        raise InputError(f"{log.path}: --next-experiment needs a motion to simulate, but {WHY_NOT_QUASI_STATIC}")
    given = {
        "torque": ("--largest-torque", options.largest_torque),
        "speed": ("--largest-speed", options.largest_speed),
        "travel": ("--largest-travel", options.largest_travel),
        "twist": ("--largest-twist", options.largest_twist),
        "duration": ("--duration", options.duration),
    }
    for name, (option, value) in given.items():
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"{option} must be positive and finite, but is {value}")
        if value is not None and data.kind == "reduced" and name in ("speed", "travel"):
            raise InputError(f"{option} is for drives, but a reduced log has no motor; leave it out")
    if options.duration is not None:
        # Imported here: few fits search for a next experiment.
        from fitting.next_experiment.proposal import MOST_SAMPLES

        step = float(np.median(np.diff(log.time)))
        shortest, longest = _FEWEST_SAMPLES * step, MOST_SAMPLES * step
        if not shortest <= options.duration <= longest:
            raise InputError(
                f"--duration must be between {shortest:.3g} s and {longest:.3g} s ({_FEWEST_SAMPLES} to {MOST_SAMPLES} "
                f"samples of the logs), but is {options.duration} s"
            )
    return {name: value for name, (_, value) in given.items() if value is not None}
