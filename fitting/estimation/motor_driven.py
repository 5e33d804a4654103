"""A fit of the load's own equation: the motor's motion as measured drives the load.

    J_l theta_l'' = K f(x) + B_sp x' + T_l,    x = theta_m/N - theta_l

holds whatever acts on the motor: neither the motor's friction nor an error of the torque is in it. Both angles must be
measured. A cubic spline through the motor's angle stands for its motion; the second derivative of the spline forces the
twist, and integrating it twice gives the spline back, so that differentiating does not amplify the encoder's noise.
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
    """Fit K, alpha and B_sp to the load's motion under the motor's.

    Args:
        model: the base model; its stiffness and damping are only placeholders. Of its priors, none may be of the motor.
        stretches: the data.

    Returns:
        The best of the fits from each start that the load's equation supplies; None where it supplies none.
    """
    driven = tuple(_driven(stretch) for stretch in stretches)
    starts = [
        MotorDrivenModel(model.drive).replace({p: start.get(p) for p in MESH})
        for start in starts_of_load_equation(model, stretches)
    ]
    if not starts:
        return None
    # Judged on equally short segments, a start with the wrong frequency can't hide.
    horizon = min(short_horizon(start, driven) for start in starts)
    coarse = [_fitted(start, driven, horizon) for start in starts]
    best = min(coarse, key=lambda found: found.objective)
    return _fitted(best.model, driven, short_horizon(best.model, driven))


def held_at(model: Model, found: Fit) -> Fit:
    """A motor-driven fit with K, alpha and B_sp held at those of another model.

    Args:
        model: supplies the values.
        found: the fit with its own values.
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
    """A stretch with the motor's acceleration over N in the place of the torque."""
    # Loaded here: the base model explains most logs.
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
