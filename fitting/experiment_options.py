"""What a user may state of the next experiment on the command line."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from fitting.errors import InputError
from fitting.experiment import Experiment
from fitting.next_experiment import MOST_SAMPLES

_FEWEST_SAMPLES = 200


@Parameter(name="*")
@dataclass(frozen=True)
class ExperimentLimits:
    """Limits of the next experiment; what the logs have reached where not given."""

    largest_torque: Annotated[float | None, Parameter(help="Of the next experiment: torque [N m], or forcing.")] = None
    largest_speed: Annotated[float | None, Parameter(help="Of the next experiment: motor speed [rad/s].")] = None
    largest_travel: Annotated[
        float | None, Parameter(help="Of the next experiment: how far the output may turn from its start [rad].")
    ] = None
    largest_twist: Annotated[
        float | None, Parameter(help="Of the next experiment: dynamic error [rad]; none where not given.")
    ] = None
    duration: Annotated[float | None, Parameter(help="Of the next experiment [s].")] = None


def wanted(options: ExperimentLimits, next_experiment: bool) -> ExperimentLimits | None:
    """The limits where a next experiment is wanted, None where not.

    Raises:
        InputError: where limits are stated for an experiment that nobody wants.
    """
    if next_experiment:
        return options
    if options != ExperimentLimits():
        raise InputError(
            "--largest-torque, --largest-speed, --largest-travel, --largest-twist and --duration are limits of the "
            "next experiment; add --next-experiment"
        )
    return None


def stated_limits(options: ExperimentLimits, experiments: Sequence[Experiment]) -> dict[str, float]:
    """The limits that the user states, by their names in [`fitting.excitation.Limits`][].

    Args:
        options: as given.
        experiments: the logs.

    Raises:
        InputError: where a limit makes no sense.
    """
    given = {
        "torque": ("--largest-torque", options.largest_torque),
        "speed": ("--largest-speed", options.largest_speed),
        "travel": ("--largest-travel", options.largest_travel),
        "twist": ("--largest-twist", options.largest_twist),
        "duration": ("--duration", options.duration),
    }
    drive = experiments[0].motor_angle is not None
    for name, (option, value) in given.items():
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"{option} must be positive and finite, but is {value}")
        if value is not None and not drive and name in ("speed", "travel"):
            raise InputError(f"{option} is for drives, but a reduced log has no motor; leave it out")
    step = experiments[0].time_step
    if options.duration is not None:
        shortest, longest = _FEWEST_SAMPLES * step, MOST_SAMPLES * step
        if not shortest <= options.duration <= longest:
            raise InputError(
                f"--duration must be between {shortest:.3g} s and {longest:.3g} s ({_FEWEST_SAMPLES} to {MOST_SAMPLES} "
                f"samples of the logs), but is {options.duration} s"
            )
    return {name: value for name, (_, value) in given.items() if value is not None}
