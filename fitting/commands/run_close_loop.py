"""What `hdjax close-loop` and `hdjax demo` do."""

from collections.abc import Sequence
from pathlib import Path

from fitting.close_loop import close_loop
from fitting.commands.next_experiment import is_quasi_static, logs_of, stated_limits
from fitting.commands.options import ExperimentLimits
from fitting.commands.spinner import Spinner
from fitting.demonstration import write_demo_logs
from fitting.drive_file import read_drive_file
from fitting.model_file import StoredModel, to_json
from fitting.next_experiment import experiment_for_ties
from fitting.report import loop_text, write_loop_report
from fitting.rig import Rig, read_logs, read_rig, rig_of


def close_loop_on_logs(
    logs: list[Path],
    drive: Path,
    out: Path,
    max_effects: int,
    seed: int,
    limits: ExperimentLimits | None,
    test: Sequence[Path] = (),
) -> None:
    """Close the loop on logs of one drive, write the report, and show it.

    Args:
        logs: files.
        drive: drive file.
        out: folder of the report.
        max_effects: to add at most.
        seed: of the surrogates.
        limits: of the next experiment; None where none is asked for.
        test: files of test data.

    Raises:
        InputError: for bad files.
        DataError: where the logs can't support a fit.
    """
    drive_file = read_drive_file(drive)
    read, tests = read_logs(logs, drive_file, test=test)
    if is_quasi_static(read, limits):
        # Loaded here: most logs are of other kinds.
        from fitting.quasi_static.commands import close_quasi_static_loop

        with Spinner() as progress:
            shown = close_quasi_static_loop(
                read, drive_file, out, max_effects=max_effects, seed=seed, progress=progress
            )
        print(shown)
    else:
        _close_loop(rig_of(read, drive_file, test=tests), out, max_effects, seed, limits)


def demonstrate(out: Path, seed: int) -> None:
    """Simulate a drive with an effect that nobody declared, and close the loop on its logs.

    Args:
        out: folder for the logs and the report.
        seed: of torque and noise.
    """
    out.mkdir(parents=True, exist_ok=True)
    logs, drive = write_demo_logs(out, seed=seed)
    print(f"Logs with an undeclared effect: {', '.join(str(p) for p in logs)}")
    _close_loop(read_rig(logs, drive), out, max_effects=3, seed=seed, limits=None)


def _close_loop(rig: Rig, out: Path, max_effects: int, seed: int, limits: ExperimentLimits | None) -> None:
    stated = None if limits is None else stated_limits(limits, logs_of(rig))
    with Spinner() as progress:
        loop = close_loop(
            rig.model,
            rig.experiments,
            test=rig.test,
            hold=rig.hold,
            max_effects=max_effects,
            seed=seed,
            progress=progress,
        )
        proposed = None if stated is None else experiment_for_ties(loop, stated, progress=progress)
    stored = StoredModel(loop.after.model, loop.hold, loop.after_substeps, loop.setting.halo, loop.noise)
    paths = write_loop_report(out, loop, rig=rig, model_json=to_json(stored), next_experiment=proposed)
    print(loop_text(loop, rig=rig, next_experiment=proposed))
    print(f"Report: {paths['report.html']}")
