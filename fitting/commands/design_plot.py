"""Plot of a design study: the sweep around the optimum, and the draws at it."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitting.commands.pictures import png
from fitting.formatting import pretty_unit
from hdjax.design import Confirmation, Optimised, Study
from hdjax.design.robustness import exact_worst_share

# Okabe and Ito's colours, which colour-blind readers can distinguish, also in grey print.
_LINE, _MARK = "#0072B2", "#D55E00"


def summary(study: Study, found: Optimised, proof: Confirmation) -> bytes:
    """The plot as a PNG."""
    count, best = len(study.variables), found.best
    panels = 1 if count == 2 and proof.shape else count
    drawn = study.draws is not None
    figure = Figure(figsize=(max(5.2 * (panels + drawn), 6.5), 4.6), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, panels + drawn))
    if count == 2 and proof.shape:
        _map(axes[0], study, found, proof, figure)
    else:
        for i in range(count):
            _curve(axes[i], study, found, proof, i)
    if drawn:
        _draws(axes[-1], study, best.draws)
    figure.suptitle(
        "Design study: the optimum and the sweep around it"
        if best.feasible
        else "Design study: no design meets all limits",
        fontsize=11,
    )
    return png(figure)


def _values(study: Study, shares: np.ndarray, i: int) -> np.ndarray:
    return np.asarray(study.variables[i].value(shares[..., i]))


def _label(study: Study, i: int) -> str:
    path = study.variables[i].path
    known = study.case.parameters()
    unit = pretty_unit(known[path][1].unit) if path in known else ""
    return f"{path} [{unit}]" if unit else path


def _map(axes: Axes, study: Study, found: Optimised, proof: Confirmation, figure: Figure) -> None:
    """Objective over two variables, designs that violate a limit in grey."""
    x, y = (_values(study, proof.shares, i).reshape(proof.shape) for i in (0, 1))
    kept = np.where(proof.feasible, proof.objective, np.nan).reshape(proof.shape)
    axes.set_facecolor("#dddddd")
    drawn = axes.pcolormesh(x, y, kept, cmap="viridis", shading="nearest")
    figure.colorbar(drawn, ax=axes, label="objective")
    if not proof.feasible.all():
        axes.plot([], [], "s", color="#dddddd", label="violates a limit")
    _ends(axes, study, found, x, y)
    _scales(axes, study, 0, 1)
    axes.legend(frameon=True, fontsize=8, loc="best")


def _ends(axes: Axes, study: Study, found: Optimised, x: np.ndarray, y: np.ndarray) -> None:
    best = found.best.shares[None]
    axes.plot(_values(study, best, 0), _values(study, best, 1), "*", color=_MARK, ms=15, mec="white", label="optimum")
    axes.set_xlim(x.min(), x.max())
    axes.set_ylim(y.min(), y.max())


def _curve(axes: Axes, study: Study, found: Optimised, proof: Confirmation, i: int) -> None:
    """The best objective of the sweep at each value of one variable."""
    at = _values(study, proof.shares, i)
    objective = np.where(proof.feasible, proof.objective, np.inf)
    if proof.shape:
        levels = np.unique(proof.shares[:, i])
        rows = [objective[proof.shares[:, i] == level].min() for level in levels]
        shown = np.isfinite(rows)
        axes.plot(np.unique(at)[shown], np.array(rows)[shown], ".-", color=_LINE, label="best of the sweep")
    else:
        shown = np.isfinite(objective)
        axes.plot(at[shown], objective[shown], ".", color=_LINE, ms=4, label="sweep")
    best = found.best
    if np.isfinite(best.objective):
        axes.plot(_values(study, best.shares[None], i), best.objective, "*", color=_MARK, ms=14, label="optimum")
    _scales(axes, study, i, None)
    axes.set_ylabel("objective")
    axes.legend(frameon=False, fontsize=8)


def _scales(axes: Axes, study: Study, i: int, j: int | None) -> None:
    axes.set_xlabel(_label(study, i))
    if _wide(study, i, axes.get_xlim()):
        axes.set_xscale("log")
    if j is not None:
        axes.set_ylabel(_label(study, j))
        if _wide(study, j, axes.get_ylim()):
            axes.set_yscale("log")


def _wide(study: Study, i: int, limits: tuple[float, float]) -> bool:
    """Whether a logarithmic scale contains a power of ten."""
    return study.variables[i].spacing == "log" and bool(limits[0] > 0.0 and limits[1] > 10.0 * limits[0])


def _draws(axes: Axes, study: Study, draws: dict[str, np.ndarray]) -> None:
    """Distribution of the objective over the draws, with the criterion."""
    objective = sum(float(t.weight) * draws[t.label] for t in study.terms if t.label in draws)
    if not isinstance(objective, np.ndarray):
        return
    axes.hist(objective, bins=min(20, objective.size), color=_LINE, alpha=0.6)
    axes.axvline(float(objective.mean()), color="black", label="expected")
    worst = exact_worst_share(objective, study.share)
    axes.axvline(worst, color=_MARK, ls="--", label=f"mean of the worst {100 * study.share:g} %")
    axes.set_xlabel("objective at the optimum")
    axes.set_ylabel("draws")
    axes.legend(frameon=False, fontsize=8)
