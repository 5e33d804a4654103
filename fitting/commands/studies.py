"""The commands with a study file: `hdjax sweep | design`."""

from pathlib import Path

from fitting.commands.options import require_folder
from fitting.commands.start import start_jax
from fitting.errors import InputError


def sweep(
    spec: Path, /, *, out: Path, workers: int = 0, scheduler: str | None = None, memory: int = 512, plot: bool = True
) -> None:
    """Compute the response of many drives and forcings, chunk by chunk, into a store.

    An interrupted run is resumed. Needs the extra `sweep`.

    Parameters
    ----------
    spec
        Sweep file (TOML): drive, forcing, axes or sample, and outputs of each point.
    out
        Folder of the store. Each request has a subfolder, named by its content, with result.zarr and summary.png.
    workers
        Processes on this machine that share the chunks; this process alone where 0.
    scheduler
        Address of a Dask scheduler, for instance tcp://10.0.0.1:8786.
    memory
        Memory of the chunks in each process [MiB].
    plot
        Whether summary.png is written.
    """
    require_folder(out)
    if workers < 0 or memory < 1:
        raise InputError(f"--workers must be 0 or more and --memory above 0, but are {workers} and {memory}")
    start_jax()
    from fitting.commands.run_sweep import sweep_file

    sweep_file(spec, out, workers=workers, scheduler=scheduler, memory=memory, plot=plot)


def design(spec: Path, /, *, out: Path, plot: bool = True) -> None:
    """Find the best design of a drive by gradients, from several starts, and confirm it by a sweep around it.

    Takes a minute or two with the steady response, most of it compilation.

    Parameters
    ----------
    spec
        Design file (TOML): drive, variables, objective, limits, uncertainty.
    out
        Folder for design.json and design.png.
    plot
        Whether design.png is written.
    """
    require_folder(out)
    start_jax()
    from fitting.commands.run_design import design_file

    design_file(spec, out, plot=plot)
