"""Implementation of `hdjax sweep`."""

import shutil
from pathlib import Path

import numpy as np

from fitting.commands.spinner import counting
from fitting.commands.sweep_file import read_sweep_file
from fitting.errors import InputError
from fitting.files import write_whole
from hdjax.sweep import sweep

_MEBIBYTE = 1 << 20


def sweep_file(spec: Path, out: Path, *, workers: int, scheduler: str | None, memory: int, plot: bool) -> None:
    """Compute a sweep file, write the result, and print it.

    Args:
        spec: sweep file.
        out: folder of the store.
        workers: processes on this machine; this process alone where 0.
        scheduler: address of a Dask scheduler, or None.
        memory: for the chunks of a process [MiB].
        plot: whether the summary is plotted.

    Raises:
        InputError: bad file, or the extra `sweep` is missing.
    """
    asked = read_sweep_file(spec)
    try:
        with counting("points", first="choosing the route") as progress:
            result = sweep(
                asked.model,
                asked.forcing,
                asked.request,
                store=out,
                workers=workers,
                scheduler=scheduler,
                memory=memory * _MEBIBYTE,
                progress=progress,
            )
    except (ValueError, ImportError) as error:
        raise InputError(f"{spec}: {error}") from error
    folder = out / result.attrs["request"]
    _write_result(result, folder / "result.zarr")
    if plot:
        from fitting.commands.sweep_plot import summary

        write_whole({folder / "summary.png": summary(result)})
    print(_text(result))
    print(f"Result: {folder / 'result.zarr'}")


def _write_result(result, path: Path) -> None:
    """Write the result; it gets its name only when complete."""
    waiting = path.with_name(f".{path.name}")
    shutil.rmtree(waiting, ignore_errors=True)
    result.to_zarr(waiting, mode="w", consolidated=False)
    shutil.rmtree(path, ignore_errors=True)
    waiting.rename(path)


def _text(result) -> str:
    """Text of a sweep for a terminal."""
    a = result.attrs
    errors = f"{a['checked_error']:.1e} at most, {a['checked_median_error']:.1e} in the median"
    checked = np.isfinite(a["checked_error"])
    lines = [
        f"{a['points']} points: {a['route']}",
        f"Error on {a['checked_points']} drawn points against {a['checked_against']}: "
        f"{errors if checked else 'no point could be checked'}",
    ]
    if checked and not a["tolerance_kept"]:
        lines.append(f"The tolerance of {a['tolerance']:g} is exceeded on these points: some motions amplify errors")
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
