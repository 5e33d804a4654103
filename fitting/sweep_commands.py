"""The command `hdjax sweep`."""

import shutil
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from fitting.errors import InputError
from fitting.files import write_whole
from fitting.response_commands import require_folder

_MEBIBYTE = 1 << 20


def sweep(
    spec: Path, /, *, out: Path, workers: int = 0, scheduler: str | None = None, memory: int = 512, plot: bool = True
) -> None:
    """Work out the response of very many drives and forcings, chunk by chunk, into a store.

    A run that was cut off goes on where it stopped. Needs the extra `sweep`.

    Parameters
    ----------
    spec
        Sweep file (TOML): drive, forcing, axes or sample, and what is wanted of each point.
    out
        Folder of the store. Each request has a folder of its own in it, named by its content, with result.zarr and
        summary.png.
    workers
        Processes on this machine among which the chunks are shared; this process alone where 0.
    scheduler
        Address of a Dask scheduler whose workers do it, for instance tcp://10.0.0.1:8786.
    memory
        What the chunks in work may take in each process [MiB].
    plot
        Whether summary.png is drawn.
    """
    require_folder(out)
    if workers < 0 or memory < 1:
        raise InputError(f"--workers must be 0 or more and --memory above 0, but are {workers} and {memory}")
    # Here: the other commands start without what this one alone needs.
    from fitting.sweep_file import read_sweep_file
    from fitting.sweep_plot import summary
    from hdjax.sweep import sweep as run

    asked = read_sweep_file(spec)
    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    try:
        with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
            task = bar.add_task("choosing the route", total=None)

            def told(done: int, total: int) -> None:
                bar.update(task, description="points", completed=done, total=total)

            result = run(
                asked.model,
                asked.forcing,
                asked.request,
                store=out,
                workers=workers,
                scheduler=scheduler,
                memory=memory * _MEBIBYTE,
                progress=told,
            )
    except (ValueError, ImportError) as error:
        raise InputError(f"{spec}: {error}") from error
    folder = out / result.attrs["request"]
    _write_result(result, folder / "result.zarr")
    if plot:
        write_whole({folder / "summary.png": summary(result)})
    print(_text(result))
    print(f"Result: {folder / 'result.zarr'}")


def _write_result(result, path: Path) -> None:
    """The result under its name only when it is whole."""
    waiting = path.with_name(f".{path.name}")
    shutil.rmtree(waiting, ignore_errors=True)
    result.to_zarr(waiting, mode="w", consolidated=False)
    shutil.rmtree(path, ignore_errors=True)
    waiting.rename(path)


def _text(result) -> str:
    """What a terminal shows of a sweep."""
    a = result.attrs
    lines = [
        f"{a['points']} points: {a['route']}",
        f"Error on {a['checked_points']} drawn points against {a['checked_against']}: "
        f"{a['checked_error']:.1e} at most, {a['checked_median_error']:.1e} in the median",
    ]
    if not a["tolerance_kept"]:
        lines.append(
            f"The asked tolerance of {a['tolerance']:g} is not kept on these points: some motions magnify errors"
        )
    if "motions" in result:
        several, lost = int((result.motions > 1).sum()), int(result.lost.sum())
        missing = f"; at {lost} one was not found, mostly at a fold" if lost else ""
        lines.append(f"{several} points have several steady motions{missing}")
    for name in ("peak", "amplitude", "settling_time"):
        if name in result and np.isfinite(result[name]).any():
            lines.append(
                f"{name}: {float(result[name].min()):.4g} to {float(result[name].max()):.4g} {result[name].units}"
            )
    return "\n".join(lines)
