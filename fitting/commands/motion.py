"""The commands that run a model: `hdjax predict | simulate`."""

from pathlib import Path

from fitting.commands.options import DriveFileOption, ForcingOptions, require_file, require_number, require_seed
from fitting.commands.start import start_jax


def predict(model: Path, log: Path, /, *, drive: DriveFileOption, out: Path) -> None:
    """Run a fitted model freely along a log and write the outputs that it predicts.

    The log's outputs are used in the first 50 samples only, for the initial state.

    Parameters
    ----------
    model
        model.json of a report.
    log
        The log that supplies torque and time stamps.
    out
        CSV file with the columns time and each fitted output of the model, the principal one first (dynamic_error
        where available).
    """
    require_file(out)
    start_jax()
    from fitting.commands.run_predict import write_prediction

    write_prediction(model, log, drive, out)


def simulate(
    *,
    out: Path,
    model: Path | None = None,
    preset: str = "HDC-40-050",
    torque: ForcingOptions = ForcingOptions(),
    noise: float = 0.0,
    seed: int = 0,
) -> None:
    """Simulate a drive under a zero-order-held motor torque and write it as a log.

    Parameters
    ----------
    out
        CSV file with the columns time, motor_angle, load_angle, motor_torque (or time, dynamic_error, forcing).
    model
        model.json of a report; a preset where not given.
    preset
        Name of a drive with published parameters; HDC-40-050 is the only one.
    noise
        Rms noise of each angle [rad at the output].
    seed
        Of phases and noise.
    """
    require_file(out)
    require_seed(seed)
    for name in ("duration", "rate", "frequency", "frequency_end"):
        require_number(f"--{name.replace('_', '-')}", getattr(torque, name))
    require_number("--amplitude", torque.amplitude, positive=False)
    require_number("--noise", noise, positive=False)
    start_jax()
    from fitting.commands.run_simulate import write_simulation

    write_simulation(out, torque, model=model, preset=preset, noise=noise, seed=seed)
