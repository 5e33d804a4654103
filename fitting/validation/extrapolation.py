"""Test data that take the drive farther than the data that were fitted."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from fitting.estimation.free_run import FreeRun
from fitting.estimation.reach import Condition, Quantity, Range
from fitting.validation.account import Account

_QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
_UNSEEN: tuple[Quantity, ...] = ("speed", "torque")
_CONDITIONS: tuple[Condition, ...] = get_args(Condition)

BEYOND = 0.1
"""Share by which test data must reach farther to be told; extremes of one random torque differ by about as much."""


@dataclass(frozen=True)
class Extrapolation:
    """A quantity that goes farther on test data.

    Attributes:
        quantity: Which one.
        fitted: Its largest size on the data that were fitted; of an angle or a temperature the end of its range that
            test data pass.
        test: Likewise on test data.
    """

    quantity: Quantity | Condition
    fitted: float
    test: float


def extrapolations(account: Account) -> tuple[Extrapolation, ...]:
    """The quantities in which test data reach beyond the fitted data; none without test data."""
    fitted = (*account.training, *account.selection)
    # What the model makes of other outputs rings where a log begins in motion.
    seen = {"dynamic_error", "joint_torque"} & set(fitted[0].outputs)
    quantities = _QUANTITIES if seen else _UNSEEN
    both = [Extrapolation(q, _largest(q, fitted), _largest(q, account.test)) for q in quantities]
    larger = (one for one in both if one.test > (1.0 + BEYOND) * one.fitted)
    return (*larger, *(one for c in _CONDITIONS for one in _outside(c, fitted, account.test)))


def _largest(quantity: Quantity, runs: Sequence[FreeRun]) -> float:
    return max((run.reach[quantity] for run in runs), default=0.0)


def _outside(condition: Condition, fitted: Sequence[FreeRun], test: Sequence[FreeRun]) -> list[Extrapolation]:
    """The ends at which the range of test data is wider by a share of the fitted one."""
    known, asked = _joined(condition, fitted), _joined(condition, test)
    if known is None or asked is None:
        return []
    span = known[1] - known[0]
    if condition != "temperature":
        # An angle repeats after a revolution.
        if span >= 2.0 * math.pi:
            return []
        away = 2.0 * math.pi * round((sum(asked) - sum(known)) / (4.0 * math.pi))
        asked = asked[0] - away, asked[1] - away
    margin = BEYOND * span
    ends = ((known[0], asked[0], known[0] - asked[0]), (known[1], asked[1], asked[1] - known[1]))
    return [Extrapolation(condition, own, other) for own, other, passed in ends if passed > margin]


def _joined(condition: Condition, runs: Sequence[FreeRun]) -> Range | None:
    """The range over all runs; None where one has none."""
    if not runs or any(condition not in run.ranges for run in runs):
        return None
    lows, highs = zip(*(run.ranges[condition] for run in runs), strict=True)
    return min(lows), max(highs)
