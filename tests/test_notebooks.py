"""Every notebook runs from top to bottom, in this process: a separate kernel would load JAX again."""

import sys
from pathlib import Path

import jupytext
import matplotlib.pyplot as plt
import pytest
from IPython.core.interactiveshell import InteractiveShell
from IPython.core.pylabtools import select_figure_formats
from traitlets.config import Config

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.py"))


# Their measures are pinned by other tests.
LONG = ("alpha_excitation", "close_the_loop", "damping_study")


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=pytest.mark.slow if p.stem in LONG else ()) for p in NOTEBOOKS],
    ids=lambda p: p.stem,
)
def test_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    # The shell replaces the module `__main__`.
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])
    plt.switch_backend("agg")
    shell = InteractiveShell(config=Config(HistoryManager={"enabled": False}))
    # Figures are shown as PNG.
    select_figure_formats(shell, {"png"})
    for cell in jupytext.read(path).cells:
        if cell.cell_type == "code":
            shell.run_cell(cell.source).raise_error()
    plt.close("all")


def test_notebooks_exist():
    assert set(LONG) < {p.stem for p in NOTEBOOKS}
