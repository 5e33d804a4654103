"""Delay between the encoders, in whole rows, by both sides' equations of motion in weak form.

    J_l theta_l'' = K f(x) + B_sp x' + T_l - friction of the load,    x = theta_m/N - theta_l
    k_T T_m = J_m theta_m'' + (K f(x) + B_sp x')/N + friction of the motor

are linear in the unknowns for a given delay. The first holds whatever acts on the motor, the second whatever acts on
the load. A wrong delay leaves much of either unexplained: near the resonance the load does not follow the motor, so
that nothing else shifts their phase alike.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fitting.estimation import weak_form
from fitting.estimation.experiment import Stretch
from fitting.estimation.starting_values import MOST_LEFT, sees_twist
from fitting.estimation.weak_form import WIDTHS, blind_functions
from hdjax import Model, TwoInertiaModel

LONGEST_DELAY = 1e-2
"""Longest delay that is looked for [s]; assumed, several cycles of a bus."""

# Most rows of a delay, and of a stretch, that are looked at: more take longer and tell little.
_MOST_ROWS, _ENOUGH = 64, 4000
# Rows between the delays of the first search: the error changes smoothly over a part of a period.
_APART = 4


def delay_of_load(model: Model, stretches: Sequence[Stretch]) -> float:
    """Whole rows by which the load's readings are later than the motor's [s], negative where they are earlier. Zero
    where no delay explains the motion far better, or the twist was not measured.

    Args:
        model: supplies the load's inertia.
        stretches: the data.
    """
    if not isinstance(model, TwoInertiaModel) or not sees_twist(stretches):
        return 0.0
    step = stretches[0].experiment.time_step
    most = int(min(LONGEST_DELAY / step, _MOST_ROWS))
    parts = [_signals(stretch) for stretch in stretches]

    @functools.cache
    def left(row: int, width: int, side: str = "load") -> float:
        return _unexplained(model, parts, width, row * step, most * step, side)

    coarse = range(-(most // _APART) * _APART, most + 1, _APART)
    near, width = min(itertools.product(coarse, WIDTHS), key=lambda pair: left(*pair))
    close = range(max(near - _APART, -most), min(near + _APART, most) + 1)
    row = min(close, key=lambda row: left(row, width))
    if not left(row, width) < MOST_LEFT**2 * left(0, width):
        return 0.0
    # Friction shifts a phase as well, over wide test functions alone: of the load, which the motor's equation does not
    # contain, or of the mesh. The likelihood depends on the product of all errors, where each has its own noise; narrow
    # functions give more of them.
    falls = [
        max(WIDTHS) / width * np.log(max(left(row, width, side), 1e-300) / max(left(0, width, side), 1e-300))
        for width, side in itertools.product(WIDTHS, ("load", "motor"))
    ]
    return row * step if sum(falls) < 2.0 * np.log(MOST_LEFT) else 0.0


class _Signals(NamedTuple):
    """The first samples of a stretch.

    Attributes:
        turn: of the motor over N, from the start [rad].
        angle: of the load, likewise.
        T_m: logged torque of the motor [N m].
        T_l: logged torque on the load [N m].
        step: sample interval [s].
    """

    turn: np.ndarray
    angle: np.ndarray
    T_m: np.ndarray
    T_l: np.ndarray
    step: float


def _signals(stretch: Stretch) -> _Signals:
    experiment, part = stretch.experiment, slice(stretch.start, min(stretch.stop, stretch.start + _ENOUGH))
    turn, x = experiment.measured[part, 0], experiment.measured[part, -1]
    load = experiment.load_torque
    T_l = np.zeros(x.size) if load is None else np.asarray(load.coefficients)[part, 0]
    T_m, angle = np.asarray(experiment.torque.coefficients)[part, 0], turn - x
    return _Signals(turn - turn[0], angle - angle[0], T_m, T_l, experiment.time_step)


def _unexplained(
    model: TwoInertiaModel, parts: Sequence[_Signals], width: int, late: float, longest: float, side: str
) -> float:
    """Unexplained share of the load's mean square acceleration, or of the motor's mean square torque, if the load's
    readings are late [s]."""
    rows, hop = [], max(1, width // 4)
    for turn, angle, T_m, T_l, step in parts:
        tests, slopes, curvatures = blind_functions(width, step)
        row, most = round(late / step), math.ceil(longest / step - 1e-9)
        inner = slice(most, turn.size - most)
        if turn.size < 2 * most + 3 * width:
            continue
        load, x = np.roll(angle, -row)[inner], (turn - np.roll(angle, -row))[inner]
        if side == "load":
            shaft, others = load, []
            right = [(float(model.drive.J_l) * load, curvatures), (-T_l[inner], tests)]
        else:
            shaft, others = turn[inner], [(turn[inner], curvatures)]
            right = [(T_m[inner], tests)]
        friction = [(shaft, slopes), (np.sign(np.gradient(shaft)), tests)]
        terms = [(x, tests), (x**3, tests), (x, slopes), *friction, *others]
        columns = [
            [weak_form.against(signal, functions, hop) for signal, functions in pairs] for pairs in (terms, right)
        ]
        rows.append(np.stack([*columns[0], sum(columns[1])], axis=1))
    if not rows:
        return 1.0
    matrix = np.concatenate(rows)
    matrix = matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    solution = np.linalg.lstsq(matrix[:, :-1], matrix[:, -1], rcond=1e-10)[0]
    return float(np.sum((matrix[:, -1] - matrix[:, :-1] @ solution) ** 2))
