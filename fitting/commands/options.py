"""Common options of commands, and their checks."""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from fitting.errors import InputError
from fitting.search_options import SearchOptions

Logs = Annotated[list[Path], Parameter(help="Log files of one drive, of any format.", negative="")]
AnyLogs = Annotated[list[Path], Parameter(help="Log files of any format, or folders of them.", negative="")]
TestLogs = Annotated[
    tuple[Path, ...],
    Parameter(
        help="One or more logs of the same drive that are test data, in place of the last fifth of each log.",
        consume_multiple=True,
        negative="",
    ),
]
Search = Annotated[SearchOptions, Parameter(name="*")]
DriveFileOption = Annotated[Path, Parameter(help="Drive file (TOML): ratio, inertias, columns and units.")]


@Parameter(name="*")
@dataclass(frozen=True)
class ExperimentLimits:
    """Limits of the next experiment; those reached in the logs where not given."""

    largest_torque: Annotated[float | None, Parameter(help="Of the next experiment: torque [N m], or forcing.")] = None
    largest_speed: Annotated[float | None, Parameter(help="Of the next experiment: motor speed [rad/s].")] = None
    largest_travel: Annotated[
        float | None, Parameter(help="Of the next experiment: largest angle of the output from its start [rad].")
    ] = None
    largest_twist: Annotated[
        float | None, Parameter(help="Of the next experiment: dynamic error [rad]; none where not given.")
    ] = None
    duration: Annotated[float | None, Parameter(help="Of the next experiment [s].")] = None


@Parameter(name="*")
@dataclass(frozen=True)
class DriveOptions:
    """The drive of a command.

    Attributes:
        preset: Name of a drive with published parameters; HDC-40-050 is the only one.
        model: model.json of a report, in place of a preset. Of its effects only `speeds` uses one, the kinematic error.
        K: Torsional stiffness [N m/rad] in place of the drive's own.
        alpha: Cubic stiffness coefficient [rad^-2] in place of the drive's own.
        B_sp: Mesh damping [N m s/rad] in place of the drive's own.
    """

    preset: str = "HDC-40-050"
    model: Path | None = None
    K: Annotated[float | None, Parameter(name="--K")] = None
    alpha: Annotated[float | None, Parameter(name="--alpha")] = None
    B_sp: Annotated[float | None, Parameter(name="--B_sp")] = None


@Parameter(name="*")
@dataclass(frozen=True)
class FleetOptions:
    """Workers that fit the logs of a folder.

    Attributes:
        workers: Of a folder: processes on this machine that share its logs; threads where 0.
        scheduler: Of a folder: address of a Dask scheduler whose workers do it, for instance tcp://10.0.0.1:8786.
    """

    workers: int = 0
    scheduler: str | None = None


@Parameter(name="*")
@dataclass(frozen=True)
class ForcingOptions:
    """A motor torque and its sampling.

    Attributes:
        forcing: Shape of the motor torque.
        amplitude: Its peak (multisine: rms) [N m].
        frequency: Its frequency, or where a chirp or multisine begins [Hz].
        frequency_end: Where a chirp or multisine ends [Hz].
        duration: Length of the log [s].
        rate: Sampling rate [Hz].
    """

    forcing: Literal["harmonic", "chirp", "multisine"] = "multisine"
    amplitude: float = 0.5
    frequency: float = 10.0
    frequency_end: float = 100.0
    duration: float = 4.0
    rate: float = 2000.0


def wanted(options: ExperimentLimits, next_experiment: bool) -> ExperimentLimits | None:
    """The limits if a next experiment is requested, else None.

    Raises:
        InputError: limits are stated, but no experiment is requested.
    """
    if next_experiment:
        return options
    if options != ExperimentLimits():
        raise InputError(
            "--largest-torque, --largest-speed, --largest-travel, --largest-twist and --duration are limits of the "
            "next experiment; add --next-experiment"
        )
    return None


def require_number(name: str, value: float, *, positive: bool = True) -> None:
    """Refuse NaN, infinity, or a number that is not positive.

    Raises:
        InputError: names the option.
    """
    if not math.isfinite(value) or (positive and value <= 0.0):
        raise InputError(f"{name} must be a {'positive ' if positive else ''}number, but is {value:g}")


def require_seed(seed: int) -> None:
    """Refuse a number that can't seed random numbers.

    Raises:
        InputError: names the option.
    """
    if not 0 <= seed < 1 << 31:
        raise InputError(f"--seed must be a whole number from 0 to {(1 << 31) - 1}, but is {seed}")


def require_file(path: Path) -> None:
    """Refuse an output file whose name is that of a folder, before the computation.

    Raises:
        InputError: names the option.
    """
    if path.is_dir():
        raise InputError(f"--out must be a file, but {path} is a folder; give the file's own name")


def require_folder(path: Path | None) -> None:
    """Refuse a folder that can't be written to, before the computation. Nothing is created.

    Raises:
        InputError: it, or its parent, is not a folder or not writable.
    """
    if path is None:
        return
    place = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not place.is_dir():
        raise InputError(f"--out must be a folder, but {place} is a file")
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"--out must be open for writing, but {place} is not; give another folder")
