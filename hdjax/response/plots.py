"""Pictures of the response, as matplotlib figures that the caller saves or shows. Nothing is computed here."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from hdjax.response.amplitudes import GOOD, ErrorMap
from hdjax.response.attractors import Basins, PoincareSection, SweptSine
from hdjax.response.continuation import Branch, Folds
from hdjax.response.critical_speeds import SpeedBand, swing
from hdjax.response.lyapunov import PhasePortrait
from hdjax.response.modulation import Branches
from hdjax.response.resonance import Backbone, Peak

# Okabe and Ito's colours, which colour-blind readers tell apart, also in grey print.
STABLE, UNSTABLE, UP, DOWN, INK = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#444444"


def frequency_response_plot(
    branch: Branch,
    *,
    folds: Folds | None = None,
    peak: Peak | None = None,
    backbone: Backbone | None = None,
    sweeps: Sequence[SweptSine] = (),
    analytic: tuple[np.ndarray, Branches] | None = None,
    unit: str = "rad",
) -> Figure:
    """The steady response over frequency: stable and unstable branches, with simulated points on them.

    Args:
        branch: from [`hdjax.response.frequency_response`][].
        folds: marked by crosses.
        peak: marked by a star.
        backbone: drawn dotted.
        sweeps: simulated sweeps, drawn as points; the first up, the second down.
        analytic: forcing frequencies [rad/s] and multiple scales' branches at them, drawn as thin lines.
        unit: of the dynamic error.
    """
    figure, axes = _figure()
    omega, size = np.asarray(branch.omega), np.asarray(branch.amplitude)
    stable, valid = np.asarray(branch.stable), np.asarray(branch.valid)
    # The unstable part reaches to the neighbouring stable rows, or the curve would have gaps.
    reach = ~stable
    reach[1:] |= ~stable[:-1]
    reach[:-1] |= ~stable[1:]
    _curve(axes, omega, size, valid & reach & (~stable).any(), UNSTABLE, "--", "harmonic balance, unstable")
    _curve(axes, omega, size, valid & stable, STABLE, "-", "harmonic balance, stable")
    if analytic is not None:
        at, branches = analytic
        amplitudes = np.where(np.asarray(branches.exists), np.asarray(branches.amplitude), np.nan)
        for slot in range(amplitudes.shape[1]):
            axes.plot(
                at,
                amplitudes[:, slot],
                color=INK,
                linewidth=0.8,
                label=None if slot else "multiple scales, first order",
            )
    for sweep, colour, marker, label in zip(sweeps, (UP, DOWN), "^v", ("sweep up", "sweep down"), strict=False):
        shown = ~np.asarray(sweep.escaped)
        axes.plot(
            np.asarray(sweep.omegas)[shown],
            np.asarray(sweep.amplitude)[shown],
            linestyle="",
            marker=marker,
            markersize=4,
            color=colour,
            label=f"time integration, {label}",
        )
    if backbone is not None:
        shown = np.asarray(backbone.converged) & (np.asarray(backbone.amplitude) <= size[valid].max())
        axes.plot(
            np.asarray(backbone.omega)[shown],
            np.asarray(backbone.amplitude)[shown],
            color=INK,
            linestyle=":",
            label="backbone",
        )
    if folds is not None and np.asarray(folds.exists).any():
        at = np.asarray(folds.value)[np.asarray(folds.exists)]
        rows = [int(np.argmin(np.where(valid, np.abs(omega - f), np.inf))) for f in at]
        axes.plot(at, size[rows], linestyle="", marker="x", markersize=8, color="black", label="folds (jumps)")
    if peak is not None and bool(peak.converged):
        axes.plot(float(peak.value), float(peak.amplitude), "*", markersize=12, color="black", label="peak")
    axes.set_xlim(omega[valid].min(), omega[valid].max())
    axes.set_ylim(bottom=0.0)
    _label(axes, "forcing frequency $\\omega$ [rad/s]", f"largest |x| [{unit}]")
    axes.legend(frameon=False)
    return figure


def phase_portrait_plot(portrait: PhasePortrait, *, unit: str = "rad") -> Figure:
    """Unforced motions in the plane of x and v, with the set from which the energy shows the return to rest."""
    figure, axes = _figure()
    for i, (x, v, escaped) in enumerate(zip(*map(np.asarray, (portrait.x, portrait.v, portrait.escaped)), strict=True)):
        axes.plot(x, v, color=UNSTABLE if escaped else STABLE, linewidth=1.0)
        axes.plot(x[0], v[0], "o", markersize=3, color=INK, label=None if i else "start")
    level = np.asarray(portrait.level)
    grid = np.asarray(portrait.grid)
    if level.max() > 0.0:
        inside = level > 0.0
        edge = np.flatnonzero(inside)
        span = slice(max(edge[0] - 1, 0), edge[-1] + 2)
        axes.fill_between(
            grid[span], -level[span], level[span], color=UP, alpha=0.15, label="$V < V_c$: returns to rest"
        )
    axes.plot(0.0, 0.0, "+", color="black", markersize=10, label="equilibrium")
    # What escapes would leave nothing else to be seen.
    near = np.abs(np.asarray(portrait.x)) <= grid[-1]
    axes.set_xlim(grid[0], grid[-1])
    axes.set_ylim(*(sign * 1.1 * np.abs(np.asarray(portrait.v))[near].max() for sign in (-1.0, 1.0)))
    _label(axes, f"x [{unit}]", f"v [{unit}/s]")
    axes.legend(frameon=False, loc="upper right")
    return figure


def poincare_plot(section: PoincareSection, *, unit: str = "rad") -> Figure:
    """States at multiples of the forcing period, one colour a start."""
    figure, axes = _figure()
    for states, escaped in zip(np.asarray(section.states), np.asarray(section.escaped), strict=True):
        if not escaped:
            axes.plot(states[:, 0], states[:, 1], ".", markersize=3)
    _label(axes, f"x at $t = 2\\pi k/\\omega$ [{unit}]", f"v [{unit}/s]")
    return figure


def basins_plot(basins: Basins, *, unit: str = "rad") -> Figure:
    """Which attractor each initial state reaches."""
    figure, axes = _figure()
    x, v, labels = (np.asarray(a) for a in (basins.x, basins.v, basins.labels))
    palette = [STABLE, UNSTABLE, UP, DOWN, "#E69F00", "#56B4E9", "#F0E442"]
    picture = np.ones((*labels.T.shape, 3))
    for label in np.unique(labels[labels >= 0]):
        colour = palette[label % len(palette)].lstrip("#")
        picture[labels.T == label] = [int(colour[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    picture[labels.T < 0] = 0.25
    axes.imshow(picture, origin="lower", aspect="auto", extent=(x[0], x[-1], v[0], v[-1]), interpolation="nearest")
    for i, attractor in enumerate(basins.attractors):
        points = attractor.states
        axes.plot(
            points[:, 0],
            points[:, 1],
            "o",
            color=palette[i % len(palette)],
            markeredgecolor="white",
            markersize=9,
            label=f"period {attractor.period}, amplitude {float(attractor.amplitude):.3g} {unit}",
        )
    axes.legend(loc="upper right")
    _label(axes, f"x(0) [{unit}]", f"v(0) [{unit}/s]")
    return figure


def error_map_plot(errors: ErrorMap, *, title: str, strength: str) -> Figure:
    """Where first- and second-order multiple scales hold to 1, 5 and 10 %, one row for each damping.

    Args:
        errors: from [`hdjax.response.error_map`][].
        title: of the resonance.
        strength: label of the nonlinearity, in mathtext.
    """
    mus = np.asarray(errors.mu)
    figure = Figure(figsize=(9.0, 2.8 * mus.size + 0.8), layout="constrained")
    grid = np.atleast_2d(figure.subplots(mus.size, 2, sharex=True, sharey=True, squeeze=False))
    colours = ["#1b7837", "#a6dba0", "#fdae61", "#d7191c"]
    for row, mu in enumerate(mus):
        for axes, error, order in zip(
            grid[row], (errors.first_order, errors.second_order), ("first", "second"), strict=True
        ):
            level = np.minimum(np.asarray(error[row]), 1e3)
            axes.contourf(
                np.asarray(errors.sigma), np.asarray(errors.strength), level, levels=[0.0, *GOOD, 1e9], colors=colours
            )
            missing = np.where(np.isinf(np.asarray(error[row])), 1.0, np.nan)
            axes.pcolormesh(
                np.asarray(errors.sigma), np.asarray(errors.strength), missing, cmap="Greys", vmin=0.0, vmax=2.0
            )
            axes.set_yscale("log")
            axes.set_title(f"{order} order, $\\mu/\\omega_0$ = {mu:g}", fontsize=10)
    for axes in grid[-1]:
        axes.set_xlabel("detuning $\\sigma/\\omega_0$")
    for axes in grid[:, 0]:
        axes.set_ylabel(strength)
    names = ["within 1 %", "within 5 %", "within 10 %", "worse", "no such motion"]
    patches = [Patch(facecolor=c) for c in [*colours, "#888888"]]
    figure.legend(patches, names, loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(title)
    return figure


def speed_plot(branch: Branch, bands: Sequence[SpeedBand], limit: float) -> Figure:
    """Swing of the dynamic error over motor speed, with the speeds to avoid shaded."""
    figure, axes = _figure()
    rpm = 30.0 / np.pi
    omega, size, stable, valid = (np.asarray(a) for a in (branch.omega, swing(branch), branch.stable, branch.valid))
    _curve(axes, omega * rpm, size, valid & ~stable, UNSTABLE, "--", "unstable")
    _curve(axes, omega * rpm, size, valid & stable, STABLE, "-", "stable")
    axes.axhline(limit, color=INK, linewidth=0.8, linestyle=":", label="limit")
    for i, band in enumerate(bands):
        axes.axvspan(band.start * rpm, band.end * rpm, color=UNSTABLE, alpha=0.12, label=None if i else "avoid")
    axes.set_yscale("log")
    _label(axes, "motor speed [rpm]", "largest swing of x [rad]")
    axes.legend(frameon=False)
    return figure


def _curve(axes: Axes, x: np.ndarray, y: np.ndarray, shown: np.ndarray, colour: str, style: str, label: str) -> None:
    if shown.any():
        axes.plot(x, np.where(shown, y, np.nan), color=colour, linestyle=style, label=label)


def _figure() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
