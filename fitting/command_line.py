"""The command line: `hdjax fit | close-loop | predict | simulate | sweep | design | demo | amplitudes | seed-tables |
speeds`."""

# ruff: noqa: E402

import contextlib
import gc
import os

# XLA reads this once, when jax loads. With a warm cache it would warn at length that the processor lacks
# "+prefer-no-gather", a tuning flag that it set itself.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import cyclopts
import jax
import numpy as np
from cyclopts import Parameter
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from fitting.close_loop import close_loop
from fitting.demonstration import write_demo_logs
from fitting.design_commands import design
from fitting.drive_file import read_drive_file
from fitting.errors import DataError, InputError
from fitting.experiment import Experiment, Stretch
from fitting.experiment_options import ExperimentLimits, stated_limits, wanted
from fitting.files import write_whole
from fitting.fit_only import fit_only
from fitting.fleet import fit_fleet, fleet_text
from fitting.free_run import WINDOW, free_run
from fitting.logs import Log
from fitting.model_file import StoredModel, read_model, to_json
from fitting.next_experiment import experiment_for_alpha, experiment_for_ties
from fitting.posterior import sampler
from fitting.report import fit_text, loop_text, write_fit_report, write_loop_report
from fitting.response_commands import amplitudes, seed_tables, speeds
from fitting.rig import WHY_NOT_QUASI_STATIC, Rig, experiments, read_rig, ready_log, ready_logs, rig_of
from fitting.sweep_commands import sweep
from hdjax import (
    PRESETS,
    Chirp,
    Harmonic,
    SimulationError,
    TwoInertiaModel,
    random_phase_multisine,
    sampled,
    simulate,
)

# A log of usual length has too few lanes for more.
_MOST_DEVICES = 8

app = cyclopts.App(
    name="hdjax",
    help="The dynamic error of harmonic drives: simulate it, fit it to logs, and find what the model lacks.",
)
app.command(amplitudes)
app.command(seed_tables)
app.command(speeds)
app.command(sweep)
app.command(design)

Logs = Annotated[
    list[Path], Parameter(help="Log files of one drive: CSV, TSV, MAT, HDF5, Parquet or MDF4.", negative="")
]
DriveOption = Annotated[Path, Parameter(help="Drive file (TOML): ratio, inertias, columns and units.")]


@app.command
def fit(
    logs: Logs,
    /,
    *,
    drive: DriveOption,
    out: Path,
    posterior: bool = False,
    seed: int = 0,
    next_experiment: bool = False,
    limits: ExperimentLimits = ExperimentLimits(),
    workers: int = 0,
    scheduler: str | None = None,
) -> None:
    """Fit stiffness, cubic coefficient and damping, and report how well the logs determine them.

    Several logs are of one drive and are fitted together. Of a folder each log is fitted on its own, into one table; a
    run that was cut off goes on where it stopped. Quasi-static logs (twist and joint torque) give stiffness, knees,
    hysteresis and lost motion instead.

    Parameters
    ----------
    out
        Folder for report.html, report.json and, but for quasi-static logs, model.json; of a folder of logs for
        fleet.parquet.
    posterior
        Draw from the posterior as well (minutes), and write the draws to posterior.parquet. Needs the extra
        `posterior`.
    seed
        Of the draws.
    next_experiment
        Where alpha is not identifiable, look for the motor torque that would tell it within limits (up to a minute),
        and write it to next_experiment.csv.
    workers
        Of a folder: processes on this machine that share its logs; threads where 0.
    scheduler
        Of a folder: address of a Dask scheduler whose workers do it, for instance tcp://10.0.0.1:8786.
    """
    asked = wanted(limits, next_experiment)
    if (workers or scheduler) and not any(path.is_dir() for path in logs):
        raise InputError(f"{logs[0]}: --workers and --scheduler are for a folder of logs; give the folder")
    if workers < 0:
        raise InputError(f"--workers must be 0 or more, but is {workers}")
    if asked is not None and any(path.is_dir() for path in logs):
        raise InputError(f"{logs[0]}: --next-experiment is for log files of one drive; name its logs")
    if posterior:
        _check_posterior(logs)
    if any(path.is_dir() for path in logs):
        _fit_fleet(logs, drive, out, workers, scheduler)
        return
    drive_file = read_drive_file(drive)
    read = ready_logs(logs, drive_file)
    if _is_quasi_static(read, asked):
        # Loaded here: most logs are of other kinds.
        from fitting.quasi_static.commands import fit_quasi_static_logs

        with _progress() as progress:
            shown = fit_quasi_static_logs(read, drive_file, out, progress=progress)
        print(shown)
    else:
        _fit_drive(rig_of(read, drive_file, other_holds=False), out, seed if posterior else None, asked)


def _is_quasi_static(logs: tuple[Log, ...], asked: ExperimentLimits | None) -> bool:
    """Whether logs hold nothing of the resonance, for which no next experiment can be looked for."""
    if logs[0].kind != "quasi-static":
        return False
    if asked is not None:
        raise InputError(f"{logs[0].path}: --next-experiment needs a motion to simulate, but {WHY_NOT_QUASI_STATIC}")
    return True


def _fit_drive(rig: Rig, out: Path, seed: int | None, limits: ExperimentLimits | None) -> None:
    stated = None if limits is None else stated_limits(limits, _logs_of(rig))
    with _progress() as progress:
        fitted = fit_only(rig.model, rig.experiments, hold=rig.hold, seed=seed, progress=progress)
        proposed = None
        if stated is not None:
            proposed = experiment_for_alpha(fitted, rig.experiments[fitted.hold], stated, progress=progress)
    stored = StoredModel(fitted.account.model, fitted.hold, fitted.goodness.substeps, 0, fitted.noise)
    paths = write_fit_report(out, fitted, rig=rig, model_json=to_json(stored), next_experiment=proposed)
    print(fit_text(fitted, rig=rig, next_experiment=proposed))
    if limits is not None and proposed is None:
        print(
            "No next experiment: either alpha is known from these logs, or no command was found that keeps the limits."
        )
    print(f"Report: {paths['report.html']}")


def _check_posterior(logs: list[Path]) -> None:
    for path in logs:
        if path.is_dir():
            raise InputError(f"{path}: --posterior is for log files of one drive, but this is a folder; name its logs")
    try:
        sampler()
    except ImportError as error:
        raise InputError(f"--posterior: {error}") from error


def _fit_fleet(folders: list[Path], drive: Path, out: Path, workers: int, scheduler: str | None) -> None:
    if len(folders) > 1:
        raise InputError(f"{folders[0]} and others: give one folder of logs, or log files of one drive")
    read_drive_file(drive)
    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("logs", total=None)
        table = fit_fleet(
            folders[0],
            drive,
            out,
            workers=workers,
            scheduler=scheduler,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(fleet_text(table))
    print(f"Table: {out / 'fleet.parquet'}")
    if not (table["state"] == "fitted").any():
        raise DataError(f"{folders[0]}: none of its {len(table)} logs could be fitted; the reasons stand above")


@app.command(name="close-loop")
def close_loop_command(
    logs: Logs,
    /,
    *,
    drive: DriveOption,
    out: Path,
    max_effects: int = 3,
    seed: int = 0,
    next_experiment: bool = False,
    limits: ExperimentLimits = ExperimentLimits(),
) -> None:
    """Fit, find the effect that the model lacks, put it inside the equations, refit, and compare on held-out data.

    Quasi-static logs (twist and joint torque) are explained without inertia: the equation is the torque-twist line.

    Parameters
    ----------
    out
        Folder for report.html, report.json and, but for quasi-static logs, model.json.
    max_effects
        Effects to add at most.
    seed
        Of the surrogates behind the p-values.
    next_experiment
        Where explanations are tied, look for the motor torque that would tell them apart within limits (minutes), and
        write it to next_experiment.csv.
    """
    if max_effects < 0:
        raise InputError(f"--max-effects must be 0 or more, but is {max_effects}")
    asked = wanted(limits, next_experiment)
    drive_file = read_drive_file(drive)
    read = ready_logs(logs, drive_file)
    if _is_quasi_static(read, asked):
        from fitting.quasi_static.commands import close_quasi_static_loop

        with _progress() as progress:
            shown = close_quasi_static_loop(
                read, drive_file, out, max_effects=max_effects, seed=seed, progress=progress
            )
        print(shown)
    else:
        _close_loop(rig_of(read, drive_file), out, max_effects, seed, asked)


def _close_loop(rig: Rig, out: Path, max_effects: int, seed: int, limits: ExperimentLimits | None) -> None:
    stated = None if limits is None else stated_limits(limits, _logs_of(rig))
    with _progress() as progress:
        loop = close_loop(
            rig.model, rig.experiments, hold=rig.hold, max_effects=max_effects, seed=seed, progress=progress
        )
        proposed = None if stated is None else experiment_for_ties(loop, stated, progress=progress)
    stored = StoredModel(loop.after.model, loop.hold, loop.after_substeps, loop.setting.halo, loop.noise)
    paths = write_loop_report(out, loop, rig=rig, model_json=to_json(stored), next_experiment=proposed)
    print(loop_text(loop, rig=rig, next_experiment=proposed))
    print(f"Report: {paths['report.html']}")


def _logs_of(rig: Rig) -> tuple[Experiment, ...]:
    """The logs, under whichever hold."""
    return next(iter(rig.experiments.values()))


@app.command
def predict(model: Path, log: Path, /, *, drive: DriveOption, out: Path) -> None:
    """Run a fitted model freely along a log and write the dynamic error that it predicts.

    The log's outputs are used in the first 50 samples only, for the initial state.

    Parameters
    ----------
    model
        model.json of a report.
    log
        The log that supplies torque and time stamps.
    out
        CSV file with the columns time, dynamic_error.
    """
    stored = read_model(model)
    drive_file = read_drive_file(drive)
    read = ready_log(log, drive_file, outputs_until=WINDOW)
    if read.kind == "quasi-static":
        raise InputError(f"{log}: {WHY_NOT_QUASI_STATIC}")
    if (read.kind == "drive") != isinstance(stored.model, TwoInertiaModel):
        raise InputError(
            f"{log}: a {read.kind} log, but {model} is a model of the other kind; give a log like those fitted"
        )
    warm = [e.name for e in stored.model.effects if e.needs_temperature]
    if warm and read.temperature is None:
        raise InputError(
            f"{log}: there is no temperature, on which {warm[0]} of {model} depends; add the column, or name it in "
            f"[columns] temperature of {drive}"
        )
    (ready,) = experiments(read, drive_file, stored.hold)
    (run,) = free_run(
        stored.model,
        [Stretch(ready, 0, len(ready))],
        covariance=stored.noise,
        halo=stored.halo,
        substeps=stored.substeps,
    )
    if not np.isfinite(run.predicted).all():
        raise DataError(f"{log}: the model's free run leaves the numbers; check the torque column's unit and sign")
    rows = slice(None) if ready.rows is None else ready.rows
    _write_table(out, {"time": run.time[rows], "dynamic_error": run.predicted[rows] + read.zero})
    for finding in read.findings:
        if finding.severity == "warning":
            print(f"hdjax: {log}: {finding}", file=sys.stderr)
    print(f"Prediction: {out}")


@app.command(name="simulate")
def simulate_command(
    *,
    out: Path,
    model: Path | None = None,
    preset: str = "HDC-40-050",
    forcing: Literal["harmonic", "chirp", "multisine"] = "multisine",
    amplitude: float = 0.5,
    frequency: float = 10.0,
    frequency_end: float = 100.0,
    duration: float = 4.0,
    rate: float = 2000.0,
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
        Name of a drive with published parameters.
    forcing
        Shape of the motor torque.
    amplitude
        Its peak (multisine: rms) [N m].
    frequency
        Its frequency, or where a chirp or multisine begins [Hz].
    frequency_end
        Where a chirp or multisine ends [Hz].
    duration
        Length of the log [s].
    rate
        Sampling rate [Hz].
    noise
        Rms noise of each angle [rad at the output].
    seed
        Of phases and noise.
    """
    for name, value in {"duration": duration, "rate": rate, "frequency": frequency}.items():
        if not value > 0:
            raise InputError(f"--{name} must be positive, but is {value}")
    if preset not in PRESETS:
        raise InputError(f"--preset must be one of {', '.join(PRESETS)}, but is {preset}")
    system = TwoInertiaModel(PRESETS[preset]()) if model is None else read_model(model).model
    time = np.arange(max(2, round(duration * rate))) / rate
    torque = np.asarray(jax.vmap(_forcing(forcing, amplitude, frequency, frequency_end, duration, seed))(time))
    motion = simulate(system, sampled(time, torque, hold="zero-order"), time, rtol=1e-9, atol=1e-12)
    random = np.random.default_rng(seed)
    if isinstance(system, TwoInertiaModel):
        outputs = np.asarray(motion.outputs)
        motor = outputs[:, 0] + noise * random.normal(size=time.size)
        load = outputs[:, 0] - outputs[:, 1] + noise * random.normal(size=time.size)
        columns = {"motor_angle": motor * float(system.drive.N), "load_angle": load, "motor_torque": torque}
    else:
        x = np.asarray(motion.dynamic_error) + noise * random.normal(size=time.size)
        columns = {"dynamic_error": x, "forcing": torque}
    _write_table(out, {"time": time} | columns)
    print(f"Log: {out}")


def _forcing(shape: str, amplitude: float, start: float, end: float, duration: float, seed: int) -> Callable:
    first, last = 2 * np.pi * start, 2 * np.pi * end
    if shape == "harmonic":
        return Harmonic(amplitude, first)
    if shape == "chirp":
        return Chirp(amplitude, first, last, duration)
    try:
        return random_phase_multisine(
            rms=amplitude, omega_min=first, omega_max=last, period=duration, key=jax.random.key(seed)
        )
    except ValueError as error:
        raise InputError(f"--frequency, --frequency-end and --duration do not go together: {error}") from error


@app.command
def demo(*, out: Path = Path("hdjax-demo"), seed: int = 0) -> None:
    """Simulate a drive with an effect that nobody declared, close the loop on its logs, and say where the report is.

    Parameters
    ----------
    out
        Folder for the logs and the report.
    seed
        Of torque and noise.
    """
    out.mkdir(parents=True, exist_ok=True)
    logs, drive = write_demo_logs(out, seed=seed)
    print(f"Logs with an undeclared effect: {', '.join(str(p) for p in logs)}")
    _close_loop(read_rig(logs, drive), out, max_effects=3, seed=seed, limits=ExperimentLimits())


def _write_table(path: Path, columns: dict[str, np.ndarray]) -> None:
    rows = np.stack(list(columns.values()), axis=1)
    lines = [",".join(columns)] + [",".join(f"{v:.12g}" for v in row) for row in rows]
    write_whole({path: "\n".join(lines) + "\n"})


class _progress:
    """A spinner on a terminal, nothing in a pipe."""

    def __init__(self):
        self._console = Console(stderr=True)
        self._status = self._console.status("starting") if self._console.is_terminal else None

    def __enter__(self) -> Callable[[str], None]:
        if self._status is not None:
            self._status.start()
        return self._say

    def __exit__(self, *details: object) -> None:
        if self._status is not None:
            self._status.stop()

    def _say(self, message: str) -> None:
        if self._status is not None:
            self._status.update(message)


def _set_up_jax() -> None:
    """Double precision, a device for each core, and compiled programs kept between runs."""
    jax.config.update("jax_enable_x64", True)
    with contextlib.suppress(RuntimeError):  # JAX has started: this is not the process' first command
        jax.config.update("jax_num_cpu_devices", min(os.cpu_count() or 1, _MOST_DEVICES))
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hdjax"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 the data can't support the request, 2 bad usage or bad input."""
    # Making programs leaves millions of small objects that stay: Python would go through them again and again.
    gc.set_threshold(200_000)
    _set_up_jax()
    try:
        app(arguments, exit_on_error=False, print_error=False)
        sys.stdout.flush()
    except (cyclopts.CycloptsError, InputError) as error:
        _fail(error, 2)
    except (DataError, SimulationError) as error:
        _fail(error, 1)
    except BrokenPipeError:
        # Who reads along, as `head` does, has seen enough; the files are written before anything is printed.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror}; check the path and its permissions", 2)


def _fail(error: object, code: int) -> None:
    print(f"hdjax: {error}", file=sys.stderr)
    sys.exit(code)
