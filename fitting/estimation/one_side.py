"""Fit of one side's equation of motion, which the measured motion of the other side drives.

    load:    J_l theta_l'' = tau + T_l
    motor:   J_m theta_m'' = k_T T_m - tau/N,      tau = K f(x) + B_sp x',   x = theta_m/N - theta_l

The load's equation holds whatever acts on the motor, the motor's whatever acts on the load: neither contains friction
of the other side. Both angles must be measured. The driving side's motion is a cubic spline through its angle. The
spline's second derivative forces the twist. Integrating it twice gives the spline back, so that encoder noise is not
amplified.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import MESH, base_paths, with_priors
from fitting.estimation.problem import Segmentation, segment_length, short_horizon, suggested_substeps
from fitting.estimation.projection import FirstStates
from fitting.estimation.starting_values import shaft_torques, start_beside_torques, starts_of_equation
from hdjax import LoadDrivenModel, Model, MotorDrivenModel, OneSideModel, PiecewisePolynomial, TwoInertiaModel
from hdjax.drive import Prior

SIDES: tuple[type[OneSideModel], ...] = (MotorDrivenModel, LoadDrivenModel)


def one_side_fit(model: TwoInertiaModel, stretches: Sequence[Stretch]) -> Fit | None:
    """The fit of the side whose equation determines K better; None where neither gives starting values.

    Arguments as in [`fits_of_sides`][].
    """
    return min(fits_of_sides(model, stretches), key=stiffness_error, default=None)


def stiffness_error(found: Fit) -> float:
    """Relative standard error of K, whatever the colour of the residual within a segment (Liang and Zeger 1986)."""
    linear = linearise(found.at_solution, found.unknowns)
    slopes = FirstStates.of(linear, found.problem.segments.joined).parameters_without(linear)
    residual = np.asarray(linear.residual).reshape(*slopes.shape[:2])
    with np.errstate(all="ignore"):
        scores = np.einsum("srp,sr->sp", slopes, residual)
        information = np.einsum("srp,srq->pq", slopes, slopes)
        if not np.all(np.isfinite(information)):
            return np.inf
        influence = np.linalg.pinv(information, hermitian=True) @ scores.T
    # K enters by its logarithm.
    return float(np.linalg.norm(influence[found.free.paths.index("K")])) or np.inf


def fits_of_sides(model: TwoInertiaModel, stretches: Sequence[Stretch]) -> list[Fit]:
    """Fits of both sides' equations: alone, or beside gravity and friction on the side where these explain most of what
    it leaves. They are then part of the data.

    Args:
        model: the base model; its stiffness and damping are only placeholders, and it has no priors.
        stretches: the data.
    """
    fits = []
    for side in SIDES:
        beside = start_beside_torques(side.equation, model, stretches)
        if beside is None:
            fits.append(fit_of_side(side, model, stretches))
        else:
            start, strengths = beside
            fits.append(_best_fit(side(model.drive), [start], [_driven(side, model, s, strengths) for s in stretches]))
    return [found for found in fits if found is not None]


def fit_of_side(side: type[OneSideModel], model: TwoInertiaModel, stretches: Sequence[Stretch]) -> Fit | None:
    """Fit K, alpha and B_sp to one side's motion for the measured motion of the other.

    Args:
        side: the equation.
        model: the base model; its stiffness and damping are only placeholders, and it has no priors of the other side.
        stretches: the data.

    Returns:
        The best of the fits from all starts of the equation; None where there are none.
    """
    starts = starts_of_equation(side.equation, model, stretches)
    return _best_fit(side(model.drive), starts, [_driven(side, model, stretch) for stretch in stretches])


def _best_fit(equation: OneSideModel, starts: Sequence[Model], driven: Sequence[Stretch]) -> Fit | None:
    if not starts:
        return None
    models = [equation.replace({p: start.get(p) for p in MESH}) for start in starts]
    # Equally short segments for all starts make their objectives comparable.
    horizon = min(short_horizon(start, driven) for start in models)
    coarse = [_fitted(start, driven, horizon) for start in models]
    best = min(coarse, key=lambda found: found.objective)
    return _fitted(best.model, driven, short_horizon(best.model, driven))


def with_known_priors(found: Fit, priors: Sequence[Prior]) -> Fit:
    """The fit of one side with those priors that scale its stiffness and have a finite tolerance.

    Args:
        found: the fit without priors.
        priors: of the drive.
    """
    assert isinstance(found.model, OneSideModel)
    known = tuple(p for p in priors if p.path in found.model.scaled_by and np.isfinite(p.tolerance))
    if not known:
        return found
    model, start = with_priors(found.model, known), Start(found.covariance, found.unknowns.states)
    return fit(model, found.stretches, base_paths(model), found.segmentation, start=start)


def held_at(model: Model, found: Fit) -> Fit:
    """A fit of one side with K, alpha and B_sp fixed at those of another model.

    Args:
        model: supplies the values.
        found: the fit of one side.
    """
    return fit(
        found.model.replace({path: model.get(path) for path in found.free.paths}),
        found.stretches,
        found.free.paths,
        found.segmentation,
        start=Start(found.covariance, found.unknowns.states),
        strategy=Strategy(hold_parameters=True),
    )


def _fitted(model: Model, driven: Sequence[Stretch], horizon: int) -> Fit:
    segmentation = Segmentation(horizon, segment_length(horizon), substeps=suggested_substeps(model, driven))
    return fit(model, driven, base_paths(model), segmentation)


def _driven(
    side: type[OneSideModel],
    model: TwoInertiaModel,
    stretch: Stretch,
    strengths: Float[np.ndarray, " torques"] | None = None,
) -> Stretch:
    """A stretch with the acceleration of the motor over N in place of the motor torque, or with that of the load in
    place of the load torque; and with shaft torques of given strengths on the side of the equation."""
    # Imported here: most logs do not need it.
    from scipy.interpolate import CubicSpline

    whole = stretch.experiment
    turn, load = whole.measured[:, 0], whole.measured[:, 0] - whole.measured[:, 1]
    by_motor = side is MotorDrivenModel
    known = np.ones(len(whole), dtype=bool) if whole.weight is None else whole.weight > 0
    acceleration = CubicSpline(whole.time[known], (turn if by_motor else load)[known])(whole.time, 2)
    forcing = _through(whole.torque, whole.time, acceleration)
    torque, load_torque = (forcing, whole.load_torque) if by_motor else (whole.torque, forcing)
    if strengths is not None:
        shaft = load if by_motor else turn * float(model.drive.N)
        added = _through(whole.torque, whole.time, shaft_torques(shaft, whole.time_step) @ strengths)
        torque, load_torque = (torque, _sum(load_torque, added)) if by_motor else (_sum(torque, added), load_torque)
    own = {"measured": whole.measured[:, 1:], "outputs": ("dynamic_error",), "motor_angle": None}
    return Stretch(replace(whole, torque=torque, load_torque=load_torque, **own), stretch.start, stretch.stop)


def _through(like: PiecewisePolynomial, time: np.ndarray, values: np.ndarray) -> PiecewisePolynomial:
    """Straight lines through values at the samples, on the knots of another signal."""
    slope = np.append(np.diff(values) / np.diff(time), 0.0)
    return PiecewisePolynomial(like.knots, jnp.asarray(np.stack([values, slope], axis=1)))


def _sum(one: PiecewisePolynomial | None, other: PiecewisePolynomial) -> PiecewisePolynomial:
    """The sum of a signal, if there is one, and straight lines on the same knots."""
    if one is None:
        return other
    coefficients = np.array(one.coefficients)
    coefficients = np.pad(coefficients, ((0, 0), (0, max(0, 2 - coefficients.shape[1]))))
    coefficients[:, :2] += np.asarray(other.coefficients)
    return PiecewisePolynomial(one.knots, jnp.asarray(coefficients))
