"""Test data of quasi-static logs, and the error of an equation on them.

Test data are not used in any fit, selection or noise estimate. A log's zero and initial states are fitted to points
before the test data; all other parameters of the equation are fixed.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from fitting.errors import DataError
from fitting.estimation.test_part import TEST_SHARE
from fitting.logs.drive_file import DriveFile
from fitting.logs.log import Log
from fitting.quasi_static.attribution import Held
from fitting.quasi_static.facts import FEW_STRETCHES
from fitting.quasi_static.form import START
from fitting.quasi_static.points import Points, points_of
from fitting.quasi_static.preparation import Motion, QuasiStaticData, believed, prepare
from fitting.quasi_static.twist_model import TwistModel
from fitting.quasi_static.unseen_logs import LEAD

# Reversals of two torque cycles.
_REVERSALS = 4


@dataclass(frozen=True, eq=False)
class Unseen:
    """The points of one log with test data.

    Attributes:
        points: Of the whole log.
        lead: Those that determine its zero and initial states, (n,).
        scored: Those of the test error, (n,).
    """

    points: Points
    lead: np.ndarray
    scored: np.ndarray

    @property
    def rows(self) -> int:
        """Number of scored rows."""
        return int(np.sum(self.scored)) * self.points.rows[0]

    @classmethod
    def of(cls, points: Points, begins: float) -> "Unseen":
        """Test data from a time on [s], without rests, where friction has a free level."""
        later = points.time >= begins
        moving = True if points.direction is None else points.direction != 0
        return cls(points, ~later, later & moving)


@dataclass(frozen=True, eq=False)
class Parted:
    """Quasi-static logs, divided into fitted and test data.

    Attributes:
        data: Fitted data.
        points: Of these rows.
        tests: By log; empty where the logs are too short to be divided, or at rest at their ends.
    """

    data: QuasiStaticData
    points: Points
    tests: tuple[Unseen, ...]


def parted(logs: Sequence[Log], drive_file: DriveFile, test: Sequence[Log] = ()) -> Parted:
    """Divide quasi-static logs into fitted and test data.

    Args:
        logs: Of one drive.
        drive_file: Of the drive.
        test: Logs of test data; without any, the end of each log is, unless too little would remain to select a model,
            or all joints are at rest there.

    Raises:
        DataError: A log can't be fitted.
    """
    ratio = drive_file.reduction_ratio
    if test:
        data = prepare(logs, drive_file, at_rest=True)
        alone = [prepare([log], drive_file, at_rest=True) for log in test]
        whole = [points_of(one.logs, one.motion, ratio) for one in alone]
        points = points_of(data.logs, data.motion, ratio)
        for log, one in zip(test, whole, strict=True):
            _refuse_lacking(log, one, points)
        tests = tuple(Unseen.of(one, LEAD * one.duration) for one in whole)
        data = replace(data, findings=data.findings | {name: f for one in alone for name, f in one.findings.items()})
        return Parted(data, points, tests)
    try:
        data = prepare([log.rows(0, _border(log)) for log in logs], drive_file, at_rest=True)
        points = points_of(data.logs, data.motion, ratio)
        tests = tuple(_end(log, motion, ratio) for log, motion in zip(logs, data.motion, strict=True))
        if _is_enough(points) and any(one.rows for one in tests):
            return Parted(data, points, tests)
    except DataError:
        pass
    data = prepare(logs, drive_file, at_rest=True)
    return Parted(data, points_of(data.logs, data.motion, ratio), ())


def _refuse_lacking(log: Log, points: Points, fitted: Points) -> None:
    """Refuse a log of test data without a signal that an effect may depend on."""
    for signal in ("motor_angle", "load_angle", "temperature"):
        if getattr(points, signal) is None and getattr(fitted, signal) is not None:
            raise DataError(
                f"{log.path}: the log of test data has no {signal}, on which effects found in the others may depend; "
                "add the column, or leave it out of the others"
            )


def _end(log: Log, motion: Motion, ratio: float | None) -> Unseen:
    known = believed(log)
    return Unseen.of(points_of([known], [motion], ratio), float(log.time[_border(log)] - known.time[0]))


def _is_enough(points: Points) -> bool:
    """Whether points without test data suffice to select a model: two torque cycles of each log, or enough nearly
    uncorrelated stretches of the straight line's misfit."""
    return min(points.reversals) >= _REVERSALS or Held.of(points).stretch[-1] + 1 >= FEW_STRETCHES


def _border(log: Log) -> int:
    return len(log) - round(TEST_SHARE * len(log))


def misfit_on(tests: Sequence[Unseen], model: TwistModel, fitted: Points) -> np.ndarray | None:
    """Measured less predicted twist of the test data [rad], (scored,); None where nothing is scored.

    Args:
        tests: By log.
        model: The equation.
        fitted: The fitted points.
    """
    found = np.concatenate([np.zeros(0), *(_misfit(one, model, fitted) for one in tests)])
    return found if found.size else None


def _misfit(test: Unseen, model: TwistModel, fitted: Points) -> np.ndarray:
    # A joint that did not move has no direction.
    direction = np.zeros_like(test.points.torque) if test.points.direction is None else test.points.direction
    points = replace(test.points, reference=fitted, direction=direction)
    left = points.twist - model.coefficients[0] * (points.torque - points.centre)
    # A form that only has initial states of logs or rests predicts nothing for another log.
    lasting = [(form, shape) for form, shape in model.terms if form.size]
    kept = [[not name.startswith(START) for name in form.shape_names] for form, _ in lasting]
    begun = [int(not all(names)) for names in kept]

    def misfit(starts: Sequence[float]) -> np.ndarray:
        found, own = left, iter(starts)
        for (form, shape), names, has_start in zip(lasting, kept, begun, strict=True):
            columns = form.columns(points, np.array([*shape[names], *itertools.islice(own, has_start)]))
            strengths = model.coefficients[model.own(form)[0]][: form.lasting]
            found = found - columns[:, : form.lasting] @ strengths
        return found - np.mean(found[test.lead])

    starts: Sequence[float] = ()
    if any(begun):
        grid = itertools.product((-0.9, 0.0, 0.9), repeat=sum(begun))
        first = min(grid, key=lambda at: float(np.sum(misfit(at)[test.lead] ** 2)))
        size = float(np.std(points.twist)) or 1.0
        # The branch of a loop has kinks: steps of difference quotients must extend over them.
        starts = least_squares(
            lambda at: misfit(at)[test.lead] / size, first, bounds=(-1.0, 1.0), diff_step=1e-3, max_nfev=25
        ).x
    return misfit(starts)[test.scored]
