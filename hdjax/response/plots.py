"""Plots of the response, as matplotlib figures that the caller saves or shows."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from hdjax.response.amplitudes import GOOD, ErrorMap
from hdjax.response.attractors import Basins
from hdjax.response.continuation import Branch
from hdjax.response.critical_speeds import SpeedBand, can_persist
from hdjax.response.fold import Folds
from hdjax.response.lyapunov import PhasePortrait
from hdjax.response.modulation import Branches
from hdjax.response.poincare import PoincareSection
from hdjax.response.resonance import Backbone, Peak
from hdjax.response.swept_sine import SweptSine

# Okabe and Ito's colours, which colour-blind readers can distinguish, also in grey print.
STABLE, UNSTABLE, UP, DOWN, INK = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#444444"
ANALYTIC, NOTHING = "#E69F00", "#888888"
_RPM = 30.0 / np.pi


def frequency_response_plot(
    *branches: Branch,
    folds: Sequence[Folds] = (),
    peak: Peak | None = None,
    backbone: Backbone | None = None,
    settled: Sequence[PoincareSection] = (),
    sweeps: Sequence[SweptSine] = (),
    analytic: tuple[np.ndarray, Branches] | None = None,
    unit: str = "rad",
) -> Figure:
    """The steady response over frequency: stable and unstable branches, with simulated points on them.

    Args:
        *branches: from [`hdjax.response.frequency_response`][] or [`hdjax.response.from_both_ends`][].
        folds: of each branch, marked by crosses.
        peak: marked by a star.
        backbone: drawn dotted.
        settled: motions that were simulated until they settled, drawn as circles.
        sweeps: simulated sweeps, drawn as points; the first up, the second down.
        analytic: forcing frequencies [rad/s] and multiple scales' branches at them, drawn as wide pale lines.
        unit: of the dynamic error.
    """
    figure, axes = _figure(height=5.2)
    curves = [_Curve(b) for b in branches]
    omega, size = (np.concatenate([getattr(c, n)[c.valid] for c in curves]) for n in ("omega", "size"))
    if analytic is not None:
        at, states = analytic
        amplitudes = np.where(np.asarray(states.exists), np.asarray(states.amplitude), np.nan)
        for slot in range(amplitudes.shape[1]):
            label = None if slot else "multiple scales, first order"
            axes.plot(at, amplitudes[:, slot], color=ANALYTIC, linewidth=5.0, alpha=0.4, label=label)
    if backbone is not None:
        shown = np.asarray(backbone.converged) & (np.asarray(backbone.amplitude) <= size.max())
        at, amplitudes = (np.asarray(a)[shown] for a in (backbone.omega, backbone.amplitude))
        axes.plot(at, amplitudes, color=INK, linestyle=":", linewidth=1.0, label="backbone")
    for curve in curves:
        _line(axes, curve.omega, curve.size, curve.unstable, UNSTABLE, "--", "harmonic balance, unstable")
    for curve in curves:
        _line(axes, curve.omega, curve.size, curve.stable, STABLE, "-", "harmonic balance, stable")
    for section in settled:
        _points(axes, section.omega, section.amplitude, section.escaped, "o", INK, "time integration")
    for sweep, colour, marker, label in zip(sweeps, (UP, DOWN), "^v", ("sweep up", "sweep down"), strict=False):
        _points(axes, sweep.omegas, sweep.amplitude, sweep.escaped, marker, colour, f"time integration, {label}")
    for curve, found in zip(curves, folds, strict=False):
        at = np.asarray(found.value)[np.asarray(found.exists)]
        rows = [curve.nearest(f) for f in at if omega.min() <= f <= omega.max()]
        if rows:
            axes.plot(curve.omega[rows], curve.size[rows], "x", markersize=8, color="black", label="folds (jumps)")
    if peak is not None and bool(peak.converged):
        axes.plot(float(peak.value), float(peak.amplitude), "*", markersize=12, color="black", label="peak")
    axes.set_xlim(omega.min(), omega.max())
    # The flanks and the super-harmonic peaks are a hundredth of the peak and less.
    axes.set_yscale("log")
    axes.set_ylim(0.7 * size.min(), 1.5 * size.max())
    _label(axes, "forcing frequency $\\omega$ [rad/s]", f"largest |x| [{unit}]")
    figure.legend(*_entries(axes), frameon=False, loc="outside lower center", ncols=3)
    return figure


class _Curve:
    """A branch's rows as arrays."""

    def __init__(self, branch: Branch):
        omega, size, valid, stable = (
            np.asarray(a) for a in (branch.omega, branch.amplitude, branch.valid, branch.stable)
        )
        self.omega, self.size, self.valid, self.stable = omega, size, valid, valid & stable
        # The unstable part reaches to the neighbouring stable rows, or the curve would have gaps.
        unstable = valid & ~stable
        reach = unstable.copy()
        reach[1:] |= unstable[:-1]
        reach[:-1] |= unstable[1:]
        self.unstable = valid & reach

    def nearest(self, omega: float) -> int:
        """The valid row nearest to a frequency."""
        return int(np.argmin(np.where(self.valid, np.abs(self.omega - omega), np.inf)))


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
    # Escaping motions would dominate the scale.
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
        strength: label of the nonlinearity's size, in mathtext.
    """
    mus, size = np.asarray(errors.mu), np.abs(np.asarray(errors.strength))
    figure = Figure(figsize=(9.0, 2.8 * mus.size + 0.8), layout="constrained")
    grid = np.atleast_2d(figure.subplots(mus.size, 2, sharex=True, sharey=True, squeeze=False))
    colours = ["#1b7837", "#a6dba0", "#fdae61", "#d7191c"]
    for row, mu in enumerate(mus):
        for axes, error, order in zip(
            grid[row], (errors.first_order, errors.second_order), ("first", "second"), strict=True
        ):
            # Missing values are grey.
            axes.set_facecolor(NOTHING)
            level = np.where(np.isfinite(error[row]), error[row], np.nan)
            axes.contourf(np.asarray(errors.sigma), size, level, levels=[0.0, *GOOD, 1e9], colors=colours)
            axes.set_yscale("log")
            axes.set_title(f"{order} order, $\\mu/\\omega_0$ = {mu:.2g}", fontsize=10)
    for axes in grid[-1]:
        axes.set_xlabel("detuning $\\sigma/\\omega_0$")
    for axes in grid[:, 0]:
        axes.set_ylabel(strength)
    names = ["within 1 %", "within 5 %", "within 10 %", "worse", "no such motion"]
    patches = [Patch(facecolor=c) for c in (*colours, NOTHING)]
    figure.legend(patches, names, loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(title)
    return figure


def speed_plot(*branches: Branch, bands: Sequence[SpeedBand], limit: float) -> Figure:
    """Swing of the dynamic error over motor speed, with the speeds to avoid shaded.

    Args:
        *branches: from slow to fast, or those of [`hdjax.response.from_both_ends`][].
        bands: shaded.
        limit: of the swing [rad], drawn dotted.
    """
    figure, axes = _figure()
    alone = len(branches) == 1
    names = ("steady motion",) if alone else ("reached from below", "reached from above")
    for branch, name, colour, style in zip(branches, names, (STABLE, UP), ("-", "-."), strict=False):
        speed, size = np.asarray(branch.omega) * _RPM, np.asarray(branch.steady_states.swing)
        valid, lasting = np.asarray(branch.valid), np.asarray(can_persist(branch))
        _line(axes, speed, size, valid & ~lasting, UNSTABLE, "--", "unstable")
        _line(axes, speed, size, lasting, colour, style, name)
    axes.axhline(limit, color=INK, linewidth=0.8, linestyle=":", label="limit")
    for band in bands:
        axes.axvspan(band.start * _RPM, band.end * _RPM, color=UNSTABLE, linewidth=0.0, alpha=0.12, label="avoid")
    axes.margins(x=0.0)
    axes.set_yscale("log")
    _label(axes, "motor speed [rpm]", "largest swing of x [rad]")
    axes.legend(*_entries(axes), frameon=False)
    return figure


def _entries(axes: Axes) -> tuple[list[Artist], list[str]]:
    """Each legend entry once, although several branches share it."""
    handles, labels = axes.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    return list(once.values()), list(once)


def _points(axes: Axes, omega: Array, size: Array, escaped: Array, marker: str, colour: str, label: str) -> None:
    shown = ~np.asarray(escaped)
    axes.plot(
        np.asarray(omega)[shown],
        np.asarray(size)[shown],
        linestyle="",
        marker=marker,
        markersize=5,
        markerfacecolor="none",
        color=colour,
        label=label,
    )


def _line(axes: Axes, x: np.ndarray, y: np.ndarray, shown: np.ndarray, colour: str, style: str, label: str) -> None:
    if shown.any():
        axes.plot(x, np.where(shown, y, np.nan), color=colour, linestyle=style, label=label)


def _figure(height: float = 4.5) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.0, height), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
