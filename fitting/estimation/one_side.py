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

from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import MESH, base_paths, with_priors
from fitting.estimation.problem import Segmentation, segment_length, short_horizon, suggested_substeps
from fitting.estimation.starting_values import starts_of_equation
from hdjax import LoadDrivenModel, Model, MotorDrivenModel, OneSideModel, PiecewisePolynomial, TwoInertiaModel

SIDES: tuple[type[OneSideModel], ...] = (MotorDrivenModel, LoadDrivenModel)


def one_side_fit(model: TwoInertiaModel, stretches: Sequence[Stretch]) -> Fit | None:
    """The fit of the side whose equation describes the twist better; None where neither gives starting values.

    Args:
        model: the base model; its stiffness and damping are only placeholders, and it has no priors.
        stretches: the data.
    """
    fits = [found for side in SIDES if (found := fit_of_side(side, model, stretches)) is not None]
    return min(fits, key=lambda found: found.objective, default=None)


def fit_of_side(side: type[OneSideModel], model: TwoInertiaModel, stretches: Sequence[Stretch]) -> Fit | None:
    """Fit K, alpha and B_sp to one side's motion for the measured motion of the other.

    Args:
        side: the equation.
        model: the base model; its stiffness and damping are only placeholders, and it has no priors of the other side.
        stretches: the data.

    Returns:
        The best of the fits from all starts of the equation; None where there are none.
    """
    driven = tuple(_driven(side, stretch) for stretch in stretches)
    starts = [
        side(model.drive).replace({p: start.get(p) for p in MESH})
        for start in starts_of_equation(side.equation, model, stretches)
    ]
    if not starts:
        return None
    # Equally short segments for all starts make their objectives comparable.
    horizon = min(short_horizon(start, driven) for start in starts)
    coarse = [_fitted(start, driven, horizon) for start in starts]
    best = min(coarse, key=lambda found: found.objective)
    return _fitted(best.model, driven, short_horizon(best.model, driven))


def known_to(side: type[OneSideModel], model: TwoInertiaModel) -> TwoInertiaModel | None:
    """The base model with priors for one side's equation; None where a value that scales its K is unknown.

    Args:
        side: the equation.
        model: of the drive, with its priors.
    """
    priors = tuple(p for p in model.drive.priors if p.path in side.scaled_by)
    if any(np.isinf(p.tolerance) for p in priors):
        return None
    return with_priors(TwoInertiaModel(model.drive), priors)


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


def _driven(side: type[OneSideModel], stretch: Stretch) -> Stretch:
    """A stretch with the acceleration of the motor over N in place of the motor torque, or with that of the load in
    place of the load torque."""
    # Imported here: most logs do not need it.
    from scipy.interpolate import CubicSpline

    whole = stretch.experiment
    turn, twist = whole.measured[:, 0], whole.measured[:, 1]
    angle = turn if side is MotorDrivenModel else turn - twist
    known = np.ones(len(whole), dtype=bool) if whole.weight is None else whole.weight > 0
    acceleration = CubicSpline(whole.time[known], angle[known])(whole.time, 2)
    slope = np.append(np.diff(acceleration) / np.diff(whole.time), 0.0)
    pieces = jnp.asarray(np.stack([acceleration, slope], axis=1))
    forcing = {"torque" if side is MotorDrivenModel else "load_torque": PiecewisePolynomial(whole.torque.knots, pieces)}
    own = {"measured": whole.measured[:, 1:], "outputs": ("dynamic_error",), "motor_angle": None}
    return Stretch(replace(whole, **forcing, **own), stretch.start, stretch.stop)
