"""Test data that take the drive farther than the data that were fitted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from fitting.estimation.free_run import FreeRun
from fitting.estimation.reach import Quantity
from fitting.validation.account import Account

_QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
_UNSEEN: tuple[Quantity, ...] = ("speed", "torque")

BEYOND = 0.1
"""Share by which test data must reach farther to be told; extremes of one random torque differ by about as much."""


@dataclass(frozen=True)
class Extrapolation:
    """A quantity that is larger on test data.

    Attributes:
        quantity: Which one.
        fitted: Its largest size on the data that were fitted.
        test: Likewise on test data.
    """

    quantity: Quantity
    fitted: float
    test: float


def extrapolations(account: Account) -> tuple[Extrapolation, ...]:
    """The quantities in which test data reach beyond the fitted data; none without test data."""
    fitted = (*account.training, *account.selection)
    # What the model makes of other outputs rings where a log begins in motion.
    seen = {"dynamic_error", "joint_torque"} & set(fitted[0].outputs)
    quantities = _QUANTITIES if seen else _UNSEEN
    both = [Extrapolation(q, _largest(q, fitted), _largest(q, account.test)) for q in quantities]
    return tuple(one for one in both if one.test > (1.0 + BEYOND) * one.fitted)


def _largest(quantity: Quantity, runs: Sequence[FreeRun]) -> float:
    return max((run.reach[quantity] for run in runs), default=0.0)
