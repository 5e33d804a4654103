"""What logs allow the next experiment to be, as stated on the command line."""

from collections.abc import Sequence

from fitting.commands.options import ExperimentLimits
from fitting.drive_data import WHY_NOT_QUASI_STATIC, Rig
from fitting.errors import InputError
from fitting.estimation.experiment import Experiment
from fitting.logs.log import Log

_FEWEST_SAMPLES = 200


def stated_limits(options: ExperimentLimits, experiments: Sequence[Experiment]) -> dict[str, float]:
    """The limits that the user states, by their names in [`fitting.next_experiment.excitation.Limits`][].

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
    if options.duration is not None:
        # Loaded here: few fits look for a next experiment.
        from fitting.next_experiment.proposal import MOST_SAMPLES

        step = experiments[0].time_step
        shortest, longest = _FEWEST_SAMPLES * step, MOST_SAMPLES * step
        if not shortest <= options.duration <= longest:
            raise InputError(
                f"--duration must be between {shortest:.3g} s and {longest:.3g} s ({_FEWEST_SAMPLES} to {MOST_SAMPLES} "
                f"samples of the logs), but is {options.duration} s"
            )
    return {name: value for name, (_, value) in given.items() if value is not None}


def is_quasi_static(logs: tuple[Log, ...], asked: ExperimentLimits | None) -> bool:
    """Whether logs hold nothing of the resonance, for which no next experiment can be looked for.

    Raises:
        InputError: where one is asked for.
    """
    if logs[0].kind != "quasi-static":
        return False
    if asked is not None:
        raise InputError(f"{logs[0].path}: --next-experiment needs a motion to simulate, but {WHY_NOT_QUASI_STATIC}")
    return True


def logs_of(rig: Rig) -> tuple[Experiment, ...]:
    """The logs, under whichever hold."""
    return next(iter(rig.experiments.values()))
