"""The commands without a log: `hdjax amplitudes | seed-tables | speeds`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from fitting.commands.options import DriveOptions, require_folder, require_number
from fitting.commands.start import start_jax
from fitting.errors import InputError


def amplitudes(
    *,
    drive: DriveOptions = DriveOptions(),
    motor_torque: float = 10.0,
    load_torque: float = 0.0,
    omega: Annotated[list[float] | None, Parameter(consume_multiple=True, negative="")] = None,
    out: Path | None = None,
) -> None:
    """Check the analytic amplitudes of the dynamic error against harmonic balance and time integration.

    Takes a few seconds; the plots of --out take half a minute, most of it compilation.

    Parameters
    ----------
    motor_torque
        Amplitude of the harmonic motor torque [N m] (or of a reduced drive's forcing).
    load_torque
        Amplitude of a load torque at the same frequency, in phase [N m].
    omega
        Forcing frequencies [rad/s]; two off resonance and the centres of the three resonances where not given.
    out
        Folder for amplitudes.json, frequency_response.png and error_map.png; none where not given.
    """
    require_folder(out)
    require_number("--motor-torque", motor_torque, positive=False)
    require_number("--load-torque", load_torque, positive=False)
    if omega is not None and not omega:
        raise InputError("--omega must be followed by frequencies, but none is given")
    for w in omega or ():
        require_number("--omega", w)
    start_jax()
    from fitting.commands.run_amplitudes import show_amplitudes

    show_amplitudes(drive, motor_torque, load_torque, omega, out)


def seed_tables() -> None:
    """Recompute the seed document's Tables 1 to 4 and its figure, and compare them with the printed values, cell by
    cell."""
    start_jax()
    from fitting.commands.spinner import spinning
    from hdjax.response.seed_fit import best_fit_of_table_2
    from hdjax.response.seed_tables import as_text
    from hdjax.response.seed_tables import seed_tables as computed

    with spinning("recomputing the tables"):
        found = as_text(computed(), best_fit_of_table_2())
    print(found)


def speeds(
    *,
    drive: DriveOptions = DriveOptions(),
    kinematic_error: float = 1.5e-4,
    slowest: float = 100.0,
    fastest: float = 3500.0,
    limit: float | None = None,
    out: Path | None = None,
) -> None:
    """Find the motor speeds to avoid, at which the kinematic error excites the drive's natural frequency.

    Parameters
    ----------
    kinematic_error
        Amplitude of two error cycles per motor revolution [rad], where the model has no kinematic error.
    slowest
        Lowest motor speed [rpm].
    fastest
        Highest motor speed [rpm].
    limit
        Largest allowed amplitude of the dynamic error [rad]; three times the kinematic error where not given.
    out
        Folder for speeds.json and speeds.png; none where not given.
    """
    require_folder(out)
    given = {"--kinematic-error": kinematic_error, "--slowest": slowest, "--fastest": fastest, "--limit": limit}
    for name, value in given.items():
        if value is not None:
            require_number(name, value)
    if not slowest < fastest:
        raise InputError(f"--slowest must be below --fastest, but they are {slowest:g} and {fastest:g} rpm")
    start_jax()
    from fitting.commands.run_speeds import show_speeds

    show_speeds(drive, kinematic_error, slowest, fastest, limit, out)
