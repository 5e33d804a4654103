"""Standard errors and intervals of parameters, robust against model discrepancy."""

from dataclasses import replace
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from fitting.estimation.estimate import Fit
from fitting.estimation.one_side import torque_columns
from fitting.estimation.sample_rate import rate_columns
from fitting.uncertainty.input_noise import torque_noise_covariance
from fitting.uncertainty.normal_law import NORMAL_95
from fitting.uncertainty.sandwich import Covariance, Linearised, covariance, linearised, with_further
from hdjax.parameters import ParameterInfo

_DISSIPATIVE = ("B_sp", "mu")


class Estimate(eqx.Module):
    """One fitted parameter.

    Attributes:
        path: dotted path.
        value: in SI units.
        std: standard error, robust against coloured residuals (sandwich), and no less than the classical one.
        std_classical: standard error from J^T J alone, for a white residual.
        ci95: 95 % interval; wider than 1.96 standard errors for few degrees of freedom.
        unit: SI unit.
        identifiable: whether the parameter is significantly nonzero; for a positive one, whether its interval is within
            a factor of e to either side.
        degrees_of_freedom: of Student's t behind the interval.
        interval: whether `ci95` is from the curvature at the optimum or from the profile likelihood.
    """

    path: str = eqx.field(static=True)
    value: float
    std: float
    std_classical: float
    ci95: tuple[float, float]
    unit: str = eqx.field(static=True)
    identifiable: bool
    degrees_of_freedom: float = np.inf
    interval: Literal["curvature", "profile"] = eqx.field(static=True, default="curvature")


class Uncertainty(eqx.Module):
    """Standard errors and correlations of all free parameters.

    Attributes:
        estimates: by dotted path.
        correlation: of the free parameters, in the order of `estimates`.
        covariance: robust, of the free vector (logarithms, or units of the parameters' scales).
        unit_covariance: the same for white noise of the variance used as weight, (J^T J)^-1.
    """

    estimates: dict[str, Estimate]
    correlation: Float[np.ndarray, "parameters parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    unit_covariance: Float[np.ndarray, "parameters parameters"]

    def in_units_of(self, fit: Fit, source: Fit) -> "Uncertainty":
        """The same for the parameters that another fit shares, in units of its free vector.

        Args:
            fit: the other fit.
            source: the fit whose uncertainty this is.
        """
        shared = [path for path in fit.free.paths if path in source.free.paths]
        own, theirs = ([f.free.paths.index(path) for path in shared] for f in (source, fit))
        ratio = np.asarray(source.free.slopes(source.model))[own] / np.asarray(fit.free.slopes(fit.model))[theirs]
        kept, both = np.ix_(own, own), np.outer(ratio, ratio)
        return Uncertainty(
            {path: self.estimates[path] for path in shared},
            self.correlation[kept],
            both * self.covariance[kept],
            both * self.unit_covariance[kept],
        )

    def with_parameters_of(self, other: "Uncertainty") -> "Uncertainty":
        """The same with some parameters from another source, whose errors are uncorrelated with those of the rest."""
        known = list(self.estimates)
        own = [known.index(path) for path in other.estimates]

        def both(mine: np.ndarray, given: np.ndarray) -> np.ndarray:
            found = mine.copy()
            found[own], found[:, own] = 0.0, 0.0
            found[np.ix_(own, own)] = given
            return found

        return Uncertainty(
            self.estimates | other.estimates,
            both(self.correlation, other.correlation),
            both(self.covariance, other.covariance),
            both(self.unit_covariance, other.unit_covariance),
        )

    def of_effect(self, name: str) -> tuple[list[str], Float[np.ndarray, "own own"]]:
        """The dotted paths of an effect's parameters, and their covariance in SI units."""
        known = list(self.estimates)
        own = [i for i, path in enumerate(known) if path.startswith(f"{name}.")]
        paths = [known[i] for i in own]
        std = np.array([self.estimates[path].std for path in paths])
        return paths, self.correlation[np.ix_(own, own)] * np.outer(std, std)


def uncertainty(fit: Fit, *, torque_noise: bool = True) -> Uncertainty:
    """Standard errors and intervals of a fit.

    The classical covariance is (J^T J)^-1 after each segment's initial state is eliminated, times the residual
    variance. The robust one holds for residuals of any spectrum, see [`fitting.uncertainty.sandwich`][]. Its own
    uncertainty enters the intervals by Student's t. Where torque noise describes the residual's spectrum, that gives a
    third one ([`fitting.uncertainty.input_noise`][]). The largest counts.

    Args:
        fit: the fit.
        torque_noise: whether to consider torque noise; that compiles a program for each form of a model.
    """
    free = fit.free
    if not free.paths:
        empty = np.zeros((0, 0))
        return Uncertainty({}, empty, empty, empty)
    regression = _beside_further(fit, linearised(fit))
    found, own = covariance(regression), len(free.paths)
    other = torque_noise_covariance(fit, regression, found.unit) if torque_noise else None
    robust, classical, unit = (matrix[:own, :own] for matrix in (found.robust, found.classical, found.unit))
    found = Covariance(robust, classical, unit, found.degrees_of_freedom[:own])
    if other is not None:
        found = _described(found, other[:own, :own])
    slopes = np.abs(np.asarray(free.slopes(fit.model)))
    known = fit.model.parameters()
    estimates = {
        path: _estimate(path, float(known[path][0]), known[path][1], found, i, float(slopes[i]), free.logarithmic[i])
        for i, path in enumerate(free.paths)
    }
    spread = np.sqrt(np.diag(found.robust))
    return Uncertainty(estimates, found.robust / np.outer(spread, spread), found.robust, found.unit)


def _beside_further(fit: Fit, regression: Linearised) -> Linearised:
    """The regression with uncertain sample rates and strengths of shaft torques appended to the free vector."""
    columns, prior = [], []
    rates, torques = rate_columns(fit), torque_columns(fit)
    if rates is not None:
        columns, prior = [rates.columns], [1.0 / rates.std**2]
    if torques.size:
        columns, prior = [*columns, torques], [*prior, np.zeros(torques.shape[2])]
    if not columns:
        return regression
    return with_further(fit, regression, np.concatenate(columns, axis=2), np.concatenate(prior))


def _described(found: Covariance, other: Float[np.ndarray, "parameters parameters"]) -> Covariance:
    """The covariance with larger variances where the torque noise model gives longer intervals."""
    reach = stdtrit(found.degrees_of_freedom, 0.975) * np.sqrt(np.diag(found.robust))
    # Where only a prior gives information, rounding may make the data's part negative.
    variance = np.maximum(np.diag(other), 0.0)
    longer = NORMAL_95 * np.sqrt(variance) > reach
    stretch = np.where(longer, np.sqrt(variance / np.diag(found.robust)), 1.0)
    return replace(
        found,
        robust=found.robust * np.outer(stretch, stretch),
        degrees_of_freedom=np.where(longer, np.inf, found.degrees_of_freedom),
    )


def is_identifiable(path: str, interval: tuple[float, float], *, logarithmic: bool) -> bool:
    """Whether an interval determines a parameter: it excludes zero, or is narrower than a factor of e to either side.

    Args:
        path: of the parameter.
        interval: of 95 %.
        logarithmic: whether its logarithm was fitted.
    """
    low, high = interval
    if logarithmic and low > 0.0:
        return bool(high / low < np.exp(2.0))
    # Negative damping is not physical: significantly nonzero does not mean identifiable.
    return bool(low > 0.0 if path in _DISSIPATIVE else not low <= 0.0 <= high)


def _estimate(
    path: str, value: float, info: ParameterInfo, found: Covariance, i: int, slope: float, logarithmic: bool
) -> Estimate:
    freedom = float(found.degrees_of_freedom[i])
    robust, classical = float(np.sqrt(found.robust[i, i])), float(np.sqrt(found.classical[i, i]))
    # In short or narrow-band logs the estimated spectrum may be too small by chance.
    error = max(robust, classical)
    reach = max(float(stdtrit(freedom, 0.975)) * robust, NORMAL_95 * classical)
    if logarithmic:
        factor = float(np.exp(min(reach, 700.0)))
        interval = (value / factor, value * factor)
    else:
        interval = (value - slope * reach, value + slope * reach)
    return Estimate(
        path=path,
        value=value,
        std=slope * error,
        std_classical=slope * classical,
        ci95=interval,
        unit=info.unit,
        identifiable=is_identifiable(path, interval, logarithmic=logarithmic),
        degrees_of_freedom=freedom,
    )
