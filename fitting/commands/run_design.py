"""Implementation of `hdjax design`."""

import json
from pathlib import Path

from fitting.commands.design_file import read_design_file
from fitting.commands.design_report import design_dict, design_text
from fitting.commands.pictures import show_files
from fitting.commands.spinner import spinning
from fitting.errors import DataError
from fitting.files import write_whole
from hdjax.design import confirm, optimise
from hdjax.design.study import LANES


def design_file(spec: Path, out: Path, *, plot: bool) -> None:
    """Find the optimum of a design file, write it, and print it.

    Args:
        spec: design file.
        out: folder.
        plot: whether it is plotted.

    Raises:
        InputError: bad file.
        DataError: no design meets the limits.
    """
    asked = read_design_file(spec)
    study, search = asked.study, asked.search
    # With many draws, parallel designs would only wait for the slowest.
    lanes = max(1, min(search.starts, LANES, 64 // (1 if study.draws is None else len(study.draws.values))))
    with spinning("compiling") as say:
        try:
            found = optimise(
                study,
                search.starts,
                seed=search.seed,
                lanes=lanes,
                progress=lambda count: say(f"searching: {count} designs evaluated"),
            )
        except ValueError as error:
            raise DataError(f"{spec}: {error}; change the ranges in [variables]") from error
        say("sweeping around the optimum")
        proof = confirm(study, found.best, width=search.width, points=search.points, seed=search.seed, lanes=lanes)
    files: dict[Path, str | bytes] = {
        out / "design.json": json.dumps(design_dict(study, found, proof), indent=1, allow_nan=False) + "\n"
    }
    if plot:
        from fitting.commands.design_plot import summary

        files[out / "design.png"] = summary(study, found, proof)
    write_whole(files, older=[out / "design.png"])
    print(design_text(study, found, proof))
    show_files(files)
    if not found.best.feasible:
        raise DataError(f"{spec}: no design that was found meets all limits; widen [variables] or loosen [limits]")
