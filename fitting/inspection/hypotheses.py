"""Assignment of columns to signals, by log odds of complete hypotheses.

The angles are enumerated, since all equations depend on them. Given these, each other column has log odds for each
signal, and the best assignment over all columns is computed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment

from fitting.inspection.columns import Column
from fitting.inspection.name_evidence import NameEvidence, in_context, name_evidence
from fitting.inspection.relations import NOTHING, RelationEvidence, Relations
from fitting.inspection.unit_evidence import UnitChoice, angle_units, velocity_units

ANGLES = ("motor_angle", "load_angle", "dynamic_error")
OTHERS = (
    "motor_velocity",
    "load_velocity",
    "motor_torque",
    "motor_current",
    "joint_torque",
    "load_torque",
    "temperature",
    "forcing",
)
# A reduced log has a forcing, a quasi-static one a joint torque.
_EITHER = ("forcing", "joint_torque")

# Log odds, assumed; meaning beside each.
_WORST_NAME = -5.0  # a column whose name contradicts a signal more than this is not a candidate for it
_WORST_RELATION = -1.0  # friction and noise mask relations: their absence is weak evidence
_FAR_FETCHED = -3.0  # a forcing beside a drive's angles, a torque without any
# Where the drive moves as a rigid body, joint torque and motor torque both accelerate it.
_AS_ONE_MASS = {"motor_torque": -0.3, "joint_torque": -1.0}
_RATIO_FITS, _RATIO_BESIDE, _RATIO_ONE, _RATIO_WRONG = 0.0, -2.0, -2.5, -6.0
_NO_WHOLE_RATIO = -1.5
_MIXED, _OTHER_COUNTS = -4.0, -1.5
_RATE_FITS, _RATE_CONTRADICTS = 0.0, -4.0
_TWIST_UNITS = (1.0, float(np.pi / 180.0), 1e-3)  # rad, deg, mrad
_USUAL_RATIOS, _POSSIBLE_RATIOS = (25.0, 330.0), (4.0, 1100.0)
_RATE_TOLERANCE = 0.03
_ABOUT_ONE = 0.15  # limits of reduction ratios
_WHOLE_TOLERANCE = 2e-3
COPY = 5.0
"""Log odds of proportionality above which a column counts as a copy of another."""
_MOST_FRAMES = 2000  # likeliest assignments of angles that are weighed with the other columns; all of twelve columns
_NEARLY = 12.0  # hypotheses less likely than the best by this much are dropped


@dataclass(frozen=True)
class Hypothesis:
    """An assignment of columns to signals.

    Attributes:
        columns: number of the column of each assigned signal.
        odds: total log odds.
    """

    columns: dict[str, int]
    odds: float


class Evidence:
    """Evidence on the columns of one joint.

    Attributes:
        columns: of the joint.
        relations: between them, by the same numbers.
    """

    def __init__(self, columns: Sequence[Column], relations: Relations):
        self.columns, self.relations = tuple(columns), relations
        senses = in_context(self.columns)
        self.names: dict[str, list[NameEvidence]] = {
            signal: [name_evidence(c, s, signal) for c, s in zip(self.columns, senses, strict=True)]
            for signal in (*ANGLES, *OTHERS)
        }
        self.angle_choices = [angle_units(c) for c in self.columns]
        self.velocity_choices = [velocity_units(c) for c in self.columns]
        self._cache: dict[tuple, tuple[RelationEvidence, ...]] = {}

    def candidates(self, signal: str) -> list[int]:
        """Columns that may be a signal, by their names."""
        return [k for k, name in enumerate(self.names[signal]) if name.odds > _WORST_NAME]

    def told(self, relation: str, *angles: int) -> tuple[RelationEvidence, ...]:
        """A relation of all columns to some angles; see [`Relations`][]."""
        key = (relation, *angles)
        if key not in self._cache:
            found = getattr(self.relations, relation)
            self._cache[key] = found(angles) if relation == "accelerates" else found(*angles)
        return self._cache[key]

    def geometry(self, motor: int | None, load: int | None, twist: int | None) -> float:
        """Log odds of the angles: names, ratio, and a twist computed from them."""
        chosen = zip(ANGLES, (motor, load, twist), strict=True)
        odds = sum(self.names[signal][k].odds for signal, k in chosen if k is not None)
        if motor is not None and load is not None:
            told = self.relations.proportional(motor, load)
            odds += max(told.odds, _WORST_RELATION)
            if told.odds > 0:
                odds += max(self.ratios(motor, load, told.slope), key=lambda choice: choice[2])[2]
            if twist is not None:
                made = self.told("difference", motor, load)[twist]
                odds += max(made.odds, _WORST_RELATION) + self._scale_of_twist(made, told, load)
        return odds

    def _scale_of_twist(self, made: RelationEvidence, together: RelationEvidence, load: int) -> float:
        """Log odds of the scale of a twist: it contains the load's angle once, in its unit."""
        if made.odds <= 0 or together.odds <= 0:
            return 0.0
        times = abs(made.slope * together.slope)
        units = [f.size / t for f in self.angle_choices[load] for t in _TWIST_UNITS]
        return 0.0 if min(abs(times / unit - 1.0) for unit in units) < _RATE_TOLERANCE else _RATE_CONTRADICTS

    def ratios(self, motor: int, load: int, slope: float) -> list[tuple[UnitChoice, UnitChoice, float]]:
        """Units of both angles with the log odds of the resulting reduction ratio."""
        return [
            (m, f, m.odds + f.odds + ratio_odds(abs(slope) * m.size / f.size) + _beside(m, f))
            for m, f in product(self.angle_choices[motor], self.angle_choices[load])
        ]

    def other(self, signal: str, column: int, motor: int | None, load: int | None, twist: int | None) -> float:
        """Log odds of a column for a signal other than angles, given the angles."""
        return self.names[signal][column].odds + self._related(signal, column, motor, load, twist)

    def _related(self, signal: str, column: int, motor: int | None, load: int | None, twist: int | None) -> float:
        angles = [k for k in (motor, load) if k is not None]
        if signal.endswith("_velocity"):
            side = motor if signal.startswith("motor") else load
            return self._of_velocity(column, side, angles)
        if signal in ("motor_torque", "motor_current"):
            return self._of_motor(column, angles) if angles else _FAR_FETCHED
        if signal == "joint_torque":
            together = self.accelerated(column, angles[-1:]).odds + _AS_ONE_MASS[signal] if angles else 0.0
            # A torque that accelerates the motor against the spring is not that of the spring.
            apart = self.accelerated(column, angles).odds if len(angles) == 2 else 0.0
            held = max(self.held(column, motor, load, twist).odds, together)
            return max(held - max(apart, 0.0), 0.0)
        if signal == "forcing":
            if twist is None:
                return _FAR_FETCHED
            # A relation that holds in both directions is no evidence, as for the two angles of a drive.
            driven = max(self._oscillates(twist, column) - self._oscillates(column, twist), 0.0)
            return driven + (_FAR_FETCHED if angles else 0.0)
        return 0.0

    def _of_motor(self, column: int, angles: Sequence[int]) -> float:
        apart = self.accelerated(column, angles).odds
        together = self.accelerated(column, angles[:1]).odds
        odds = max(apart, together + _AS_ONE_MASS["motor_torque"], 0.0)
        # A single angle with a restoring torque is a twist, and its input a forcing.
        return odds - (max(self.told("pulled_back", angles[0])[column].odds, 0.0) if len(angles) == 1 else 0.0)

    def accelerated(self, column: int, angles: Sequence[int]) -> RelationEvidence:
        """Evidence that a torque accelerates the first angle."""
        return self.told("accelerates", *angles)[column]

    def held(self, column: int, motor: int | None, load: int | None, twist: int | None) -> RelationEvidence:
        """Evidence that a torque twists the drive."""
        if twist is not None:
            return self.told("holds", twist)[column]
        if motor is not None and load is not None:
            return self.told("springs", motor, load)[column]
        return NOTHING

    def _oscillates(self, twist: int, forcing: int) -> float:
        """Log odds that a channel is an oscillator under a forcing: with inertia and spring."""
        told = (self.told(relation, twist)[forcing].odds for relation in ("drives", "pulled_back"))
        return sum(max(odds, 0.0) for odds in told)

    def _of_velocity(self, column: int, side: int | None, angles: Sequence[int]) -> float:
        if side is None:
            # The rate of the other side's angle more likely belongs to that side.
            return _FAR_FETCHED if angles else 0.0
        told = self.relations.is_rate_of(column, side)
        if told.odds <= 0:
            return max(told.odds, _WORST_RELATION)
        return told.odds + max(odds for _, _, odds in self.rate_units(column, side, told.slope))

    def rate_units(self, velocity: int, angle: int, slope: float) -> list[tuple[UnitChoice, UnitChoice, float]]:
        """Units of an angle and of its rate, with log odds from the derivative in SI."""
        found = []
        for a, v in product(self.angle_choices[angle], self.velocity_choices[velocity]):
            off = abs(abs(slope) * a.size / v.size - 1.0)
            found.append((a, v, a.odds + v.odds + (_RATE_FITS if off < _RATE_TOLERANCE else _RATE_CONTRADICTS)))
        return found


def _beside(one: UnitChoice, other: UnitChoice) -> float:
    """Log odds of two units in one log: where neither is stated, they are mostly equal; encoders differ."""
    if one.unit == other.unit or "stated" in (one.reason, other.reason):
        return 0.0
    return _OTHER_COUNTS if one.unit.startswith("rev /") and other.unit.startswith("rev /") else _MIXED


def ratio_odds(ratio: float) -> float:
    """Log odds of a reduction ratio, from those of real gears."""
    off = abs(ratio - round(ratio)) > max(_WHOLE_TOLERANCE * ratio, 0.1)
    broken = _NO_WHOLE_RATIO if off else 0.0
    if _USUAL_RATIOS[0] <= ratio <= _USUAL_RATIOS[1]:
        return _RATIO_FITS + broken
    if abs(ratio - 1.0) < _ABOUT_ONE:
        return _RATIO_ONE
    return (_RATIO_BESIDE if _POSSIBLE_RATIOS[0] <= ratio <= _POSSIBLE_RATIOS[1] else _RATIO_WRONG) + broken


def hypotheses(evidence: Evidence) -> list[Hypothesis]:
    """The likely assignments, the best first."""
    motors, loads, twists = ([None, *evidence.candidates(signal)] for signal in ANGLES)
    pairs = [(m, f) for m, f in product(motors, loads) if _distinct(m, f)]
    # Twists of the likeliest pairs alone: with all, the time would grow with the cube of the number of columns.
    pairs = sorted(pairs, key=lambda pair: -evidence.geometry(*pair, None))[:_MOST_FRAMES]
    frames = [(m, f, x) for (m, f), x in product(pairs, twists) if _distinct(m, f, x)]
    weighed = sorted(((evidence.geometry(*frame), frame) for frame in frames), key=lambda pair: -pair[0])[:_MOST_FRAMES]
    found = []
    for odds, frame in weighed:
        rest, columns = _rest(evidence, *frame)
        angles = {signal: k for signal, k in zip(ANGLES, frame, strict=True) if k is not None}
        found.append(Hypothesis(angles | columns, odds + rest))
    found.sort(key=lambda h: -h.odds)
    return [h for h in found if h.odds > found[0].odds - _NEARLY]


def _distinct(*columns: int | None) -> bool:
    used = [k for k in columns if k is not None]
    return len(used) == len(set(used))


def _rest(evidence: Evidence, motor: int | None, load: int | None, twist: int | None) -> tuple[float, dict[str, int]]:
    """The best assignment of the columns other than angles, and its log odds."""
    taken = {motor, load, twist}
    free = [k for k in range(len(evidence.columns)) if k not in taken]
    odds = np.zeros((len(OTHERS), len(free)))
    for row, signal in enumerate(OTHERS):
        for column, k in enumerate(free):
            if evidence.names[signal][k].odds > _WORST_NAME:
                odds[row, column] = max(0.0, evidence.other(signal, k, motor, load, twist))
    return max((_assigned(odds, free, without) for without in _EITHER), key=lambda found: found[0])


def _assigned(odds: np.ndarray, free: Sequence[int], without: str) -> tuple[float, dict[str, int]]:
    """The best assignment without one signal."""
    odds = odds * (np.array(OTHERS) != without)[:, None]
    rows, columns = linear_sum_assignment(odds, maximize=True)
    chosen = {OTHERS[r]: free[c] for r, c in zip(rows, columns, strict=True) if odds[r, c] > 0}
    return float(odds[rows, columns].sum()), chosen


def _weights(found: Sequence[Hypothesis]) -> np.ndarray:
    """Weights of the hypotheses, with sum 1."""
    odds = np.array([h.odds for h in found])
    weights = np.exp(odds - odds.max())
    return weights / weights.sum()


def weighed(found: Sequence[Hypothesis], evidence: Evidence) -> dict[int, dict[str, float]]:
    """For each column its possible signals, with the total weight of their hypotheses, 0 to 1.

    A hypothesis with a copy of the column counts for it as well.
    """
    weights = _weights(found)
    shares: dict[int, dict[str, float]] = {}
    for hypothesis, weight in zip(found, weights, strict=True):
        for signal, k in hypothesis.columns.items():
            for column in {k, found[0].columns.get(signal, k)}:
                if column == k or evidence.relations.proportional(column, k).odds > COPY:
                    own = shares.setdefault(column, {})
                    own[signal] = own.get(signal, 0.0) + float(weight)
    best = found[0]
    frame = tuple(best.columns.get(signal) for signal in ANGLES)
    for signal in OTHERS:
        if signal in best.columns:
            k = best.columns[signal]
            margin = _margin(evidence, best, signal, k, frame)
            shares[k][signal] *= 1.0 / (1.0 + float(np.exp(-margin)))
    return shares


def readings(found: Sequence[Hypothesis], evidence: Evidence, column: int) -> dict[str, float]:
    """Possible signals of a column other than angles, with confidence, the most likely first: all under the best
    hypothesis, and that of each other hypothesis."""
    best, weights = found[0], _weights(found)
    frame = tuple(best.columns.get(signal) for signal in ANGLES)
    idle = [s for s in OTHERS if s not in best.columns or best.columns[s] == column]
    odds = {s: evidence.other(s, column, *frame) for s in idle if evidence.names[s][column].odds > _WORST_NAME}
    total = 1.0 + sum(np.exp(list(odds.values())))
    shares = {s: float(weights[0] * np.exp(o) / total) for s, o in odds.items()}
    for hypothesis, weight in zip(found[1:], weights[1:], strict=True):
        for signal, k in hypothesis.columns.items():
            if k == column and signal in OTHERS:
                shares[signal] = shares.get(signal, 0.0) + float(weight)
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _margin(evidence: Evidence, best: Hypothesis, signal: str, column: int, frame: tuple) -> float:
    """Loss of log odds if a column is not the signal: no other column is, or it is another signal."""
    own = evidence.other(signal, column, *frame)
    free = [k for k in range(len(evidence.columns)) if k not in best.columns.values()]
    heirs = [evidence.other(signal, k, *frame) for k in free if evidence.names[signal][k].odds > _WORST_NAME]
    idle = [s for s in OTHERS if s not in best.columns and evidence.names[s][column].odds > _WORST_NAME]
    elsewhere = [evidence.other(s, column, *frame) for s in idle]
    return own - max([0.0, *heirs, *elsewhere])
