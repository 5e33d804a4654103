"""Fit of the load's equation of motion: the measured motion of the motor drives the load.

    J_l theta_l'' = K f(x) + B_sp x' + T_l,    x = theta_m/N - theta_l

holds whatever acts on the motor: it contains neither the motor's friction nor an error of the torque. Both angles must
be measured. The motor's motion is a cubic spline through its angle. The spline's second derivative forces the twist.
Integrating it twice gives the spline back, so that encoder noise is not amplified.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import MESH, base_paths
from fitting.estimation.problem import Segmentation, segment_length, short_horizon, suggested_substeps
from fitting.estimation.starting_values import starts_of_load_equation
from hdjax import Model, MotorDrivenModel, PiecewisePolynomial, TwoInertiaModel


def motor_driven_fit(model: TwoInertiaModel, stretches: Sequence[Stretch]) -> Fit | None:
    """Fit K, alpha and B_sp to the load's motion for the measured motion of the motor.

    Args:
        model: the base model; its stiffness and damping are only placeholders, and it has no priors of the motor.
        stretches: the data.

    Returns:
        The best of the fits from all starts of the load's equation; None where there are none.
    """
    driven = tuple(_driven(stretch) for stretch in stretches)
    starts = [
        MotorDrivenModel(model.drive).replace({p: start.get(p) for p in MESH})
        for start in starts_of_load_equation(model, stretches)
    ]
    if not starts:
        return None
    # Equally short segments for all starts make their objectives comparable.
    horizon = min(short_horizon(start, driven) for start in starts)
    coarse = [_fitted(start, driven, horizon) for start in starts]
    best = min(coarse, key=lambda found: found.objective)
    return _fitted(best.model, driven, short_horizon(best.model, driven))


def held_at(model: Model, found: Fit) -> Fit:
    """A motor-driven fit with K, alpha and B_sp fixed at those of another model.

    Args:
        model: supplies the values.
        found: the motor-driven fit.
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


def _driven(stretch: Stretch) -> Stretch:
    """A stretch with the motor's acceleration over N in place of the torque."""
    # Imported here: most logs do not need it.
    from scipy.interpolate import CubicSpline

    whole = stretch.experiment
    known = np.ones(len(whole), dtype=bool) if whole.weight is None else whole.weight > 0
    acceleration = CubicSpline(whole.time[known], whole.measured[known, 0])(whole.time, 2)
    slope = np.append(np.diff(acceleration) / np.diff(whole.time), 0.0)
    pieces = jnp.asarray(np.stack([acceleration, slope], axis=1))
    torque = PiecewisePolynomial(whole.torque.knots, pieces)
    own = {"measured": whole.measured[:, 1:], "outputs": ("dynamic_error",), "motor_angle": None}
    experiment = replace(whole, torque=torque, **own)
    return Stretch(experiment, stretch.start, stretch.stop)
