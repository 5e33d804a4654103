"""Test for a dependence of the residual on a logged quantity, beyond the catalogue."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import BSpline

from fitting.attribution.rules import RULES
from fitting.quasi_static.attribution import Held, TwistTrial, torque_error
from fitting.quasi_static.form import Form
from fitting.quasi_static.points import Points
from fitting.quasi_static.screening import screen

_SPLINES = 8
_HARMONICS = 6


@dataclass(frozen=True)
class Leftover:
    """A dependence of the residual.

    Attributes:
        depends_on: The quantity that it depends on.
        explained_share: Share of the held-out mean square that a smooth function of the quantity explains.
        p_value: Under the null distribution of the best quantity on noise.
    """

    depends_on: str
    explained_share: float
    p_value: float


def leftover(held: Held, trial: TwistTrial, base: TwistTrial, seed: int) -> Leftover | None:
    """The quantity of which a smooth function predicts the residual on held-out stretches; None without one.

    Args:
        held: The points.
        trial: The final model.
        base: The straight line.
        seed: Of the surrogates.
    """
    found = screen(held.points, trial.model, [(form,) for form in _smooth_functions(held.points)], held.fold, seed)
    best = found.leads[0]
    p_value = found.p_value(best.gain)
    share = 1.0 - math.exp(-2.0 * best.gain)
    if (
        best.gain < RULES.least_gain
        or p_value > RULES.significance
        or share * trial.mean_square < torque_error(held.points, base)
    ):
        return None
    return Leftover(best.forms[0].name, share, p_value)


def _smooth_functions(points: Points) -> list[Form]:
    quantities = {"joint torque": points.torque, "rate of the joint torque": points.torque_rate}
    if points.temperature is not None and np.ptp(points.temperature) > 0:
        quantities["temperature"] = points.temperature
    if points.direction is not None and points.load_angle is not None:
        quantities["load angle"] = points.load_angle
    columns = {name: _splines(values) for name, values in quantities.items()}
    if points.direction is not None and points.motor_angle is not None:
        phases = np.outer(points.motor_angle, np.arange(1, _HARMONICS + 1))
        columns["motor angle"] = np.hstack([np.cos(phases), np.sin(phases)])
    return [Form("unknown", name, partial(_given, own), ("",) * own.shape[1], "") for name, own in columns.items()]


def _given(columns: np.ndarray, points: Points, shape: np.ndarray) -> np.ndarray:
    return columns


def _splines(values: np.ndarray) -> np.ndarray:
    """Cubic splines with equally many points between knots."""
    inner = np.unique(np.quantile(values, np.linspace(0, 1, _SPLINES - 2)))
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    return BSpline.design_matrix(values, knots, 3).toarray()
