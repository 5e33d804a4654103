"""Whether the twist rises with the torque: the sign of the compliance, with its interval.

While a joint moves, its twist also depends on the angle (kinematic error, eccentric encoders, a ratio that is a little
off), and friction shifts the torque by the direction. Both may outweigh what the torque does, so that the correlation
of twist and torque has no sign to rely on; a regression with all of them has.
"""

from typing import NamedTuple

import numpy as np

from fitting.logs.log import Log
from fitting.quasi_static.blocks import means
from fitting.quasi_static.intervals import scatter
from fitting.quasi_static.stretches import stretches
from fitting.uncertainty.normal_law import NORMAL_95

# Blocks of a log: enough to follow the motor's second order over tens of turns.
_BLOCKS = 400
_ORDERS = (1, 2)


class Compliance(NamedTuple):
    """Slope of twist against torque [rad/(N m)].

    Attributes:
        value: Least squares.
        classical: Half of its 95 % interval if what is left over were white noise.
        robust: Likewise whatever the colour of what is left over; wide where one stretch of the log decides.
    """

    value: float
    classical: float
    robust: float


def compliance(log: Log, speed: np.ndarray, *, moves: bool) -> Compliance:
    """The slope of twist against torque, beside all else that the twist follows.

    Args:
        log: Of the rows that count, in which a joint that moves does so steadily.
        speed: Of the joint in these rows [rad/s], (n,).
        moves: Whether the joint moved.
    """
    torque, twist = log.joint_torque, log.twist
    assert torque is not None
    size = max(1, len(log) // _BLOCKS)
    columns = [torque, np.ones_like(torque), *(_of_motion(log, speed) if moves else ())]
    scale = float(np.std(torque)) or 1.0
    # Sizes of order one; a column that never changes is the constant once more.
    matrix = np.column_stack([_scaled(means(column, size)) for column in columns])
    matrix[:, 0] = (means(torque, size) - np.mean(torque)) / scale
    solution, *_ = np.linalg.lstsq(matrix, means(twist, size), rcond=1e-9)
    residual = means(twist, size) - matrix @ solution
    found = scatter(matrix, residual, stretches(residual, np.zeros(len(residual), dtype=int)))
    first = np.eye(len(solution))[0]
    classical = NORMAL_95 * np.sqrt(found.classical[0, 0])
    return Compliance(*(float(v) / scale for v in (solution[0], classical, found.half_width(first))))


def _of_motion(log: Log, speed: np.ndarray) -> list[np.ndarray]:
    """What the twist follows beside the torque while the joint moves."""
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
