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

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.estimation.engines import linearise, residual_at
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Experiment, Moved, Stretch
from fitting.estimation.free_parameters import MESH, base_paths, with_priors
from fitting.estimation.problem import Segmentation, short_horizon, suggested_substeps
from fitting.estimation.projection import FirstStates
from fitting.estimation.starting_values import shaft_torques, start_beside_torques, starts_of_equation
from hdjax import LoadDrivenModel, Model, MotorDrivenModel, OneSideModel, PiecewisePolynomial, TwoInertiaModel
from hdjax.drive import Prior

# Change of a torque for difference quotients, over the spring's: small beside the cubic term's range.
_CHANGE = 1e-3

SIDES: tuple[type[OneSideModel], ...] = (MotorDrivenModel, LoadDrivenModel)


def one_side_fit(model: TwoInertiaModel, stretches: Sequence[Stretch]) -> Fit | None:
    """The fit of the side whose equation determines K better; None where neither gives starting values.

    Arguments as in [`fits_of_sides`][].
    """
    return min(fits_of_sides(model, stretches), key=stiffness_error, default=None)


def stiffness_error(found: Fit) -> float:
    """Relative standard error of K, whatever the colour of the residual within a segment (Liang and Zeger 1986)."""
    slopes, residual = _regression(found)
    with np.errstate(all="ignore"):
        scores = np.einsum("srp,sr->sp", slopes, residual)
        information = np.einsum("srp,srq->pq", slopes, slopes)
        if not (np.all(np.isfinite(information)) and np.all(np.isfinite(scores))):
            return np.inf
        influence = np.linalg.pinv(information, hermitian=True) @ scores.T
    # K enters by its logarithm. Without any influence on the residual it is not determined.
    return float(np.linalg.norm(influence[found.free.paths.index("K")])) or np.inf


def _regression(found: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Sensitivities to the free parameters (segments, rows, parameters), orthogonal to the initial states, and the
    residual (segments, rows)."""
    linear = linearise(found.at_solution, found.unknowns)
    slopes = FirstStates.of(linear, found.problem.segments.joined).parameters_without(linear)
    return slopes, np.asarray(linear.residual).reshape(*slopes.shape[:2])


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
        fits.append(
            fit_of_side(side, model, stretches) if beside is None else _beside_torques(side, model, stretches, *beside)
        )
    return [found for found in fits if found is not None]


def _beside_torques(
    side: type[OneSideModel],
    model: TwoInertiaModel,
    stretches: Sequence[Stretch],
    start: Model,
    strengths: Float[np.ndarray, " torques"],
) -> Fit | None:
    """The fit of one side beside shaft torques, whose strengths are refined by a step of Gauss and Newton."""
    first = _best_fit(side(model.drive), [start], [_driven(side, model, s, strengths) for s in stretches])
    if first is None:
        return None
    own, residual = _regression(first)
    columns = np.concatenate([own, torque_columns(first)], axis=2).reshape(residual.size, -1)
    if not (np.all(np.isfinite(columns)) and np.all(np.isfinite(residual))):
        return first
    norm = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    step = -np.linalg.lstsq(columns / norm, residual.reshape(-1), rcond=1e-10)[0] / norm
    refined = strengths + step[own.shape[2] :]
    second = _best_fit(side(model.drive), [first.model], [_driven(side, model, s, refined) for s in stretches])
    return first if second is None or second.objective > first.objective else second


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


def held_at(model: Model, found: Fit, paths: Sequence[str] | None = None) -> Fit:
    """A fit with some or all parameters fixed at those of another model.

    Args:
        model: supplies the values.
        found: the fit.
        paths: dotted paths of the values; those that the fit does not free don't count. All of the fit's if None.
    """
    fixed = tuple(path for path in found.free.paths if paths is None or path in paths)
    return fit(
        found.model.replace({path: model.get(path) for path in fixed}),
        found.stretches,
        found.free.paths,
        found.segmentation,
        start=Start(found.covariance, found.unknowns.states),
        strategy=Strategy(hold_parameters=fixed),
    )


def _fitted(model: Model, driven: Sequence[Stretch], horizon: int) -> Fit:
    segmentation = Segmentation(horizon, substeps=suggested_substeps(model, driven))
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
    forces = {"torque": forcing} if by_motor else {"load_torque": forcing}
    own = {"measured": whole.measured[:, 1:], "outputs": ("dynamic_error",), "motor_angle": None, "moved": Moved()}
    driven = replace(whole, **forces, **own)
    if strengths is not None:
        shaft = load if by_motor else turn * float(model.drive.N)
        driven = _pushed(replace(driven, shaft_torques=shaft_torques(shaft, whole.time_step)), side, strengths)
    return Stretch(driven, stretch.start, stretch.stop)


def _pushed(driven: Experiment, side: type[OneSideModel], strengths: Float[np.ndarray, " torques"]) -> Experiment:
    """An experiment with shaft torques of given strengths added to the torque on the side of the equation."""
    assert driven.shaft_torques is not None
    added = _through(driven.torque, driven.time, driven.shaft_torques @ strengths)
    if side is MotorDrivenModel:
        return replace(driven, load_torque=_sum(driven.load_torque, added))
    return replace(driven, torque=_sum(driven.torque, added))


def torque_columns(found: Fit) -> Float[np.ndarray, "segments rows torques"]:
    """Sensitivities of a fit to the strengths of its data's shaft torques, orthogonal to the initial states; no columns
    without such torques."""
    torques = [s.experiment.shaft_torques for s in found.stretches]
    side = type(found.model)
    if any(own is None for own in torques) or not issubclass(side, OneSideModel):
        return np.zeros((*np.asarray(found.error).shape[:1], 0, 0))
    problem = found.at_solution
    linear = linearise(problem, found.unknowns)
    unit = np.sqrt(np.mean(np.concatenate([np.asarray(own) for own in torques]) ** 2, axis=0))
    largest = float(found.model.drive.stiffness) * max(float(np.std(s.experiment.measured)) for s in found.stretches)
    sizes = _CHANGE * largest / np.maximum(unit, 1e-300)
    rows, gaps = [], []
    for strengths, size in zip(np.diag(sizes), sizes, strict=True):
        pushed = [replace(s, experiment=_pushed(s.experiment, side, strengths)) for s in found.stretches]
        forces = found.segmentation.of(pushed)
        other = eqx.tree_at(
            lambda p: (p.segments.torque, p.segments.load_torque), problem, (forces.torque, forces.load_torque)
        )
        moved, gap = residual_at(other, found.unknowns)
        rows.append((np.asarray(moved) - np.asarray(linear.residual)) / size)
        gaps.append((np.asarray(gap) - np.asarray(linear.gap)) / size)
    states = FirstStates.of(linear, problem.segments.joined)
    return states.without(np.stack(rows, axis=-1), -np.stack(gaps, axis=-1))


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
