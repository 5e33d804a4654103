"""Whole logs of test data, and by how much a torque-twist curve errs on them.

They take no part in the fit. A log's zero and the branch on which it began hold for that log alone: its first rows tell
them, while all else of the curve stays as it was fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fitting.logs.drive_file import DriveFile
from fitting.logs.log import Log
from fitting.quasi_static.blocks import average
from fitting.quasi_static.curve_fit import CurveFit
from fitting.quasi_static.preparation import QuasiStaticData, prepare
from fitting.quasi_static.torque_twist import Blocks

LEAD = 0.2
"""Share of a log of test data, at its beginning, that tells its zero."""

# Branches on which a log may have begun, from unloading to loading: the nearest is off by 0.5 % of the friction.
_BEGINNINGS = np.linspace(-1.0, 1.0, 201)


@dataclass(frozen=True, eq=False)
class UnseenLogs:
    """Logs that are test data from beginning to end.

    Attributes:
        data: The logs, checked as those that are fitted.
        blocks: Means over short runs of their rows, by log.
    """

    data: QuasiStaticData
    blocks: tuple[Blocks, ...]

    @classmethod
    def of(cls, logs: Sequence[Log], drive_file: DriveFile) -> "UnseenLogs":
        """Logs made ready.

        Raises:
            DataError: A log can't be used.
        """
        data = prepare(logs, drive_file)
        return cls(data, tuple(average([log]) for log in data.logs))

    @property
    def rows(self) -> list[int]:
        """Number of rows that tell an error, by log."""
        return [int(np.sum(~_lead(blocks))) * blocks.rows[0] for blocks in self.blocks]

    @property
    def torque(self) -> np.ndarray:
        """Joint torque of the blocks that tell an error [N m], (scored,)."""
        return np.concatenate([np.zeros(0), *(blocks.torque[~_lead(blocks)] for blocks in self.blocks)])

    def misfit(self, fit: CurveFit) -> np.ndarray | None:
        """Measured less predicted twist of the blocks that tell an error [rad], (scored,); None without test data."""
        return np.concatenate([_misfit(blocks, fit) for blocks in self.blocks]) if self.blocks else None


def _lead(blocks: Blocks) -> np.ndarray:
    """Which blocks tell the zero of their log, (n,)."""
    return blocks.time < blocks.time[0] + LEAD * np.ptp(blocks.time)


def _misfit(blocks: Blocks, fit: CurveFit) -> np.ndarray:
    # The rate of a drift is another one in each log, and the lead is too short to tell it.
    curve, lead = replace(fit.curve, drifting=False, logs=1), _lead(blocks)
    lasting = [0.0 if name == "offset 0" else fit.curve.value(name, fit.parameters) for name in curve.names]
    begins = np.array([name == "start 0" for name in curve.names])

    def misfit(start: float) -> np.ndarray:
        parameters = np.where(begins, start, lasting)
        left = blocks.twist - curve.predict(parameters, blocks)[0]
        return left - np.mean(left[lead])

    beginnings = _BEGINNINGS if curve.memory is not None else [0.0]
    best = min(beginnings, key=lambda start: float(np.sum(misfit(start)[lead] ** 2)))
    return misfit(best)[~lead]
