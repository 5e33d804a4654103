"""The command `hdjax design`."""

import json
from pathlib import Path

from rich.console import Console

from fitting.errors import DataError
from fitting.files import write_whole
from fitting.response_commands import require_folder


def design(spec: Path, /, *, out: Path, plot: bool = True) -> None:
    """Find the best design of a drive by gradients, from several starts, and confirm it by a sweep around it.

    Takes a minute or two where the steady response counts, most of it compilation.

    Parameters
    ----------
    spec
        Design file (TOML): drive, variables, objective, limits, what is not known exactly.
    out
        Folder for design.json and design.png.
    plot
        Whether design.png is drawn.
    """
    # Loaded here: most commands need neither searches nor samples.
    from fitting.design_file import read_design_file
    from fitting.design_report import design_dict, design_text
    from hdjax.design import confirm, optimise
    from hdjax.design.study import LANES

    require_folder(out)
    asked = read_design_file(spec)
    study, search = asked.study, asked.search
    # Beside many draws, designs side by side only wait for the slowest.
    lanes = max(1, min(search.starts, LANES, 64 // (1 if study.draws is None else len(study.draws.values))))
    console = Console(stderr=True)
    with console.status("compiling") as status:
        try:
            found = optimise(
                study,
                search.starts,
                seed=search.seed,
                lanes=lanes,
                progress=lambda count: status.update(f"searching: {count} designs appraised"),
            )
        except ValueError as error:
            raise DataError(f"{spec}: {error}; change the ranges in [variables]") from error
        status.update("sweeping around the optimum")
        proof = confirm(study, found.best, width=search.width, points=search.points, seed=search.seed, lanes=lanes)
    files: dict[Path, str | bytes] = {
        out / "design.json": json.dumps(design_dict(study, found, proof), indent=1, allow_nan=False) + "\n"
    }
    if plot:
        from fitting.design_plot import summary

        files[out / "design.png"] = summary(study, found, proof)
    write_whole(files)
    print(design_text(study, found, proof))
    print(f"Files: {', '.join(str(f) for f in files)}")
    if not found.best.feasible:
        raise DataError(f"{spec}: no design that was found keeps all limits; widen [variables] or loosen [limits]")
