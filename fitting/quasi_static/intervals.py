"""Figures of quasi-static fits with intervals that allow for coloured residuals.

Model discrepancy makes the residuals of a torque-twist curve correlated, so that the number of samples is not
informative. The log is cut into nearly independent stretches. The change of the estimates without each stretch gives
the variance (jackknife over clusters, CR3: Bell and McCaffrey 2002). Quantiles are Student's with the effective number
of clusters (Carter, Schnepel and Steigerwald 2017): a figure that depends on a single stretch gets a wide interval.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import stdtrit

from fitting.quasi_static.differences import slopes

_RIDGE = 1e-10
_BLIND = 1e-6
# Largest half-width of the 95 % interval of a positive parameter's logarithm, as for all fits.
_VAGUE = 0.98
# Beyond a factor of a thousand an interval is not stated.
_NOT_AT_ALL = math.log(1e3)

Formula = Callable[[np.ndarray], float]


@dataclass(frozen=True)
class Known:
    """One figure.

    Attributes:
        value: In `unit`; None where the logs do not determine it.
        std: Standard error, robust against coloured residuals, or None.
        ci95: 95 % interval, or None.
        unit: SI unit.
        identifiable: Whether its interval excludes zero or, if it must be positive, stays within a factor of e.
        description: Its meaning.
        reason: Why it is not identifiable; empty where it is.
    """

    value: float | None
    std: float | None
    ci95: tuple[float, float] | None
    unit: str
    identifiable: bool
    description: str
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of a fit's parameters over clusters.

    Attributes:
        changes: Of the parameters without each cluster, (clusters, parameters).
        classical: Covariance for white residuals.
        shares: Derivatives of the estimates by each cluster's rows, (rows, parameters).
    """

    changes: np.ndarray
    classical: np.ndarray
    shares: list[np.ndarray]

    def std(self, slope: np.ndarray) -> float:
        """Standard error of a figure whose derivative with respect to the parameters is `slope`."""
        count = len(self.changes)
        robust = (count - 1) / count * float(np.sum((self.changes @ slope) ** 2))
        # Few clusters underestimate the variance; the larger of both is taken.
        return math.sqrt(max(robust, float(slope @ self.classical @ slope), 0.0))

    def half_width(self, slope: np.ndarray) -> float:
        """Half of its 95 % interval: Student's, with the effective number of clusters."""
        weight = np.array([float(np.sum((share @ slope) ** 2)) for share in self.shares])
        effective = np.sum(weight) ** 2 / max(float(np.sum(weight**2)), 1e-300)
        return float(stdtrit(max(1.0, effective - 1.0), 0.975)) * self.std(slope)


def scatter(jacobian: np.ndarray, residual: np.ndarray, cluster: np.ndarray) -> Scatter:
    """The scatter of a fit's parameters over clusters of rows.

    Args:
        jacobian: Of the residual, (n, parameters).
        residual: Of the fit, (n,).
        cluster: Number of the cluster of each row, (n,).
    """
    # A column of zeros would make the scale infinite.
    norms = np.linalg.norm(jacobian, axis=0)
    scale = 1.0 / np.where(norms > 0, norms, 1.0)
    scaled = jacobian * scale
    information = scaled.T @ scaled
    values, vectors = np.linalg.eigh(information)
    # Directions without information get a huge variance.
    inverse = (vectors / np.maximum(values, _RIDGE)) @ vectors.T
    changes, shares = [], []
    for number in range(int(cluster[-1]) + 1):
        own = cluster == number
        part = scaled[own]
        # A parameter that only one cluster determines stays unchanged; its effective number of clusters is one.
        without = np.linalg.pinv(information - part.T @ part, rcond=_BLIND, hermitian=True)
        changes.append(scale * (without @ (part.T @ residual[own])))
        shares.append(part @ inverse * scale)
    freedom = max(1, len(residual) - int(np.sum(norms > 0)))
    variance = float(residual @ residual) / freedom
    return Scatter(np.array(changes), variance * inverse * np.outer(scale, scale), shares)


@dataclass(frozen=True)
class Figure:
    """A figure derived from fitted parameters.

    Attributes:
        name: As reports use it.
        formula: Of the parameters.
        unit: SI unit.
        description: Its meaning.
        positive: Whether it must be positive; the interval is then that of its logarithm.
    """

    name: str
    formula: Formula
    unit: str
    description: str
    positive: bool = False

    def known(self, parameters: np.ndarray, steps: np.ndarray, found: Scatter) -> Known:
        """Its value and interval.

        Args:
            parameters: As fitted.
            steps: Of the difference quotients, (parameters,).
            found: Scatter of the parameters.
        """
        value, slope = float(self.formula(parameters)), slopes(self.formula, parameters, steps)
        half = found.half_width(slope)
        told = partial(Known, value, found.std(slope), unit=self.unit, description=self.description)
        if self.positive and (value <= 0 or half > _NOT_AT_ALL * value):
            reason = (
                "the logs do not determine it at all"
                if value > 0
                else "its estimate is negative, which is not physical"
            )
            return Known(None, None, None, self.unit, False, self.description, reason)
        if self.positive:
            factor = math.exp(half / value)
            reason = "" if half < _VAGUE * value else f"the logs determine it only to within a factor of {factor:.2g}"
            return told(ci95=(value / factor, value * factor), identifiable=not reason, reason=reason)
        reason = "" if abs(value) > half else f"it would be significantly nonzero only above {half:.2g} {self.unit}"
        return told(ci95=(value - half, value + half), identifiable=not reason, reason=reason)
