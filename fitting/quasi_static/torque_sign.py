"""Whether the twist rises with the torque: the sign of the compliance, with its interval.

While a joint moves, its twist also depends on the angle (kinematic error, eccentric encoders, a slightly wrong ratio),
and friction shifts the torque with the direction. Both may dominate, so that the correlation of twist and torque has an
unreliable sign. So a regression includes all of them.
"""

from typing import NamedTuple

import numpy as np

from fitting.logs.log import Log
from fitting.quasi_static.blocks import means
from fitting.quasi_static.intervals import scatter
from fitting.quasi_static.stretches import stretches
from fitting.uncertainty.normal_law import NORMAL_95

# Number of blocks of a log: enough to resolve the motor's second order over tens of turns.
_BLOCKS = 400
_ORDERS = (1, 2)


class Compliance(NamedTuple):
    """Slope of twist against torque [rad/(N m)].

    Attributes:
        value: Least squares.
        classical: Half of its 95 % interval for a white residual.
        robust: Likewise for a residual of any spectrum; wide where one stretch of the log dominates.
    """

    value: float
    classical: float
    robust: float


def compliance(log: Log, speed: np.ndarray, *, moves: bool) -> Compliance:
    """The slope of twist against torque, in a regression with all other dependences of the twist.

    Args:
        log: With valid rows only, in which a moving joint moves steadily.
        speed: Of the joint in these rows [rad/s], (n,).
        moves: Whether the joint moved.
    """
    torque, twist = log.joint_torque, log.twist
    assert torque is not None
    size = max(1, len(log) // _BLOCKS)
    columns = [torque, np.ones_like(torque), *(_of_motion(log, speed) if moves else ())]
    scale = float(np.std(torque)) or 1.0
    # Scaled to order one; a constant column would duplicate the constant.
    matrix = np.column_stack([_scaled(means(column, size)) for column in columns])
    matrix[:, 0] = (means(torque, size) - np.mean(torque)) / scale
    solution, *_ = np.linalg.lstsq(matrix, means(twist, size), rcond=1e-9)
    residual = means(twist, size) - matrix @ solution
    found = scatter(matrix, residual, stretches(residual, np.zeros(len(residual), dtype=int)))
    first = np.eye(len(solution))[0]
    classical = NORMAL_95 * np.sqrt(found.classical[0, 0])
    return Compliance(*(float(v) / scale for v in (solution[0], classical, found.half_width(first))))


def _of_motion(log: Log, speed: np.ndarray) -> list[np.ndarray]:
    """Regressors of the twist other than the torque while the joint moves."""
    angle = log.motor_angle if log.motor_angle is not None else log.load_angle
    found = [np.sign(speed)]
    if angle is not None:
        found += [angle - angle[0], *(turn(order * angle) for order in _ORDERS for turn in (np.cos, np.sin))]
    return found


def _scaled(column: np.ndarray) -> np.ndarray:
    spread = float(np.std(column))
    return (
        (column - np.mean(column)) / spread if spread > 1e-12 * float(np.max(np.abs(column))) else np.ones_like(column)
    )
