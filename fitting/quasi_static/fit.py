"""Fits of all curves to quasi-static logs of one drive, and selection of one by cross-validation."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fitting.logs.log import Log
from fitting.quasi_static.blocks import average
from fitting.quasi_static.curve_figures import figures
from fitting.quasi_static.curve_fit import CurveFit, best_fit, polish
from fitting.quasi_static.intervals import Known
from fitting.quasi_static.stretches import FOLDS, folds, stretches, worse
from fitting.quasi_static.torque_twist import SHAPES, Blocks, Shape


@dataclass(frozen=True, eq=False)
class QuasiStaticFit:
    """The fits of all shapes, and their held-out errors.

    Attributes:
        blocks: The fitted data.
        fits: By shape.
        known: Figures with intervals, by shape.
        held_out: Held-out misfit [rad] of each block, by shape.
        stretch: Number of the stretch that each block was held out with, (n,).
    """

    blocks: Blocks
    fits: dict[Shape, CurveFit]
    known: dict[Shape, dict[str, Known]]
    held_out: dict[Shape, np.ndarray]
    stretch: np.ndarray

    @cached_property
    def chosen(self) -> Shape:
        """The simplest shape that is not significantly worse than the best one on held-out stretches, among those whose
        figures the logs determine.

        A bend that the logs do not determine would fit their errors; the straight line is always admissible.
        """
        able: list[Shape] = [shape for shape in SHAPES if shape == "linear" or self._is_determined(shape)]
        least = min(able, key=self._mean_square)
        return next(shape for shape in able if shape == least or not self.is_worse(shape, least))

    def _is_determined(self, shape: Shape) -> bool:
        own = [one for name, one in self.known[shape].items() if name[0] in "KT" or name == "alpha"]
        return all(one.identifiable for one in own)

    def _mean_square(self, shape: Shape) -> float:
        return float(np.mean(self.held_out[shape] ** 2))

    @property
    def best(self) -> CurveFit:
        """The chosen shape's fit."""
        return self.fits[self.chosen]

    @property
    def undetermined(self) -> Shape | None:
        """A shape that predicts held-out stretches significantly better, but whose figures the logs do not
        determine."""
        least = min(SHAPES, key=self._mean_square)
        return least if self.is_worse(self.chosen, least) else None

    def is_worse(self, one: Shape, other: Shape) -> bool:
        """Whether the first shape predicts held-out stretches significantly worse than the second."""
        return worse(self.held_out[one], self.held_out[other], self.stretch, self.blocks.twist_noise)


def fit_quasi_static(
    logs: Sequence[Log], *, rated_torque: float | None = None, hysteresis: bool = True
) -> QuasiStaticFit:
    """Fit all shapes of torque-twist curve to quasi-static logs of one drive, and choose one.

    Args:
        logs: Of kind "quasi-static", checked by [`fitting.quasi_static.preparation.prepare`][]. All share the curve and
            the torque bias; each has its own twist zero and drift.
        rated_torque: [N m], or None; without it the figures that vendors define by it are unknown.
        hysteresis: Whether loading and unloading may differ. A joint that always turns one way shows no hysteresis,
            since the sign of its friction is constant.

    Returns:
        The fits.
    """
    blocks = average(logs)
    fits: dict[Shape, CurveFit] = {shape: best_fit(blocks, shape, hysteresis) for shape in SHAPES}
    known: dict[Shape, dict[str, Known]] = {shape: figures(fit, blocks, rated_torque) for shape, fit in fits.items()}
    stretch = stretches(fits["three slopes"].residual, blocks.log)
    held_out: dict[Shape, np.ndarray] = {shape: hold_out(blocks, fit, stretch) for shape, fit in fits.items()}
    return QuasiStaticFit(blocks, fits, known, held_out, stretch)


def hold_out(blocks: Blocks, fit: CurveFit, stretch: np.ndarray) -> np.ndarray:
    """Misfit [rad] of each block in the fit without its stretch, (n,).

    The torque of a held-out stretch still acts on the hysteresis, since it is an input; its twist is not used.
    """
    fold = folds(stretch)
    misfit = np.empty_like(blocks.twist)
    for i in range(FOLDS):
        kept = polish(blocks, fit.curve, fit.parameters, fit.excess, (fold != i).astype(float), most=20)
        misfit[fold == i] = kept.misfit[fold == i]
    return misfit
