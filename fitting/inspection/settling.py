"""Units, signs and reduction ratio of the recognised signals, determined together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from fitting.inspection.hypotheses import Evidence
from fitting.inspection.relations import NOTHING, RelationEvidence
from fitting.inspection.unit_evidence import UnitChoice
from fitting.inspection.windows import Uniform

SURE = 0.8
"""Confidence above which a guess is written to the drive file; below, the possible signals are listed. Assumed."""

_NOTED = 0.02  # least share of a unit to be mentioned
_SIGN_ODDS = 1.0  # log odds of a relation for its sign to be used
_COPIES = ("load_angle", "motor_velocity", "load_velocity", "joint_torque")  # proportional to an angle, a rate, a twist
_CORRELATED = 0.3  # unexplained share below which the sign of a correlation is used
_SEEN_RATIO = 0.02  # largest share of non-common motion for the ratio to be determined
_LARGEST_TWIST, _SOFT_TWIST = (
    0.02,
    0.2,
)  # rad; larger than any gear's twist, though not than that of a series elastic joint
_TWIST_ODDS = (0.0, -0.5, -5.0)
_HIDDEN = 3.0  # largest ratio of the twist correlated with the motion to that which is not; assumed
_ROUNDED = 1e-3  # relative error of a ratio due to a twist along one slow motion; assumed
_CATALOGUE = (30.0, 50.0, 80.0, 100.0, 120.0, 160.0)  # ratios in vendors' catalogues


@dataclass(frozen=True)
class UnitGuess:
    """The unit of one signal.

    Attributes:
        unit: in drive-file notation.
        size: in SI.
        confidence: 0 to 1.
        reason: in words.
        rivals: other possible units.
    """

    unit: str
    size: float
    confidence: float
    reason: str
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True)
class RatioGuess:
    """The reduction ratio.

    Attributes:
        value: most likely; an integer if one fits. low, high: admissible range from the angles.
        sure: whether exactly one integer fits.
    """

    value: float
    low: float
    high: float
    sure: bool

    @property
    def inverted(self) -> bool:
        """Whether the load angle moves farther than the motor angle, as in no gear."""
        return self.value < 1.0


def units_of(
    columns: Mapping[str, int], evidence: Evidence, logs: Sequence[Uniform]
) -> tuple[dict[str, UnitGuess], float]:
    """The units of angles and velocities, chosen together from stated units, ratio, rates and twist.

    Returns:
        The units by signal, and the confidence in the factor between the units of both angles, 0 to 1.
    """
    motor, load = columns.get("motor_angle"), columns.get("load_angle")
    twist = _twist(logs, motor, load)
    combined = []
    for m, f in product(_choices(evidence, motor), _choices(evidence, load)):
        odds = 0.0 if m is None else m.odds
        odds += 0.0 if f is None else f.odds
        if motor is not None and load is not None:
            assert m is not None and f is not None
            told = evidence.relations.proportional(motor, load)
            if told.odds > 0:
                odds = next(o for a, b, o in evidence.ratios(motor, load, told.slope) if a is m and b is f)
            odds += _twist_odds(twist * f.size)
        rates = {}
        for signal, side, choice in (("motor_velocity", motor, m), ("load_velocity", load, f)):
            if signal in columns and side is not None:
                told = evidence.relations.is_rate_of(columns[signal], side)
                if told.odds > 0:
                    fitting = [r for r in evidence.rate_units(columns[signal], side, told.slope) if r[0] is choice]
                    rates[signal] = max(fitting, key=lambda r: r[2])[1]
                    odds += max(r[2] for r in fitting) - (choice.odds if choice else 0.0)
        combined.append((odds, {"motor_angle": m, "load_angle": f} | rates))
    odds = np.array([o for o, _ in combined])
    weights = np.exp(odds - odds.max())
    weights /= weights.sum()
    best = combined[int(np.argmax(odds))][1]
    angles = [s for s in ("motor_angle", "load_angle") if s in columns]
    rates = [s for s in ("motor_velocity", "load_velocity") if s in columns]
    guesses = {s: _marginal(s, best, combined, weights) for s in (*angles, *rates) if best.get(s) is not None}
    factors = np.array([_factor(units) for _, units in combined])
    alike = float(weights[np.isclose(factors, _factor(best), rtol=1e-6)].sum())
    # A velocity without a related angle.
    return guesses | {s: _alone(evidence.velocity_choices[columns[s]]) for s in rates if s not in guesses}, alike


def _factor(units: Mapping[str, UnitChoice | None]) -> float:
    """Unit of the motor's angle over that of the load's."""
    motor, load = units["motor_angle"], units["load_angle"]
    return 1.0 if motor is None or load is None else motor.size / load.size


def _choices(evidence: Evidence, column: int | None) -> Sequence[UnitChoice | None]:
    return (None,) if column is None else evidence.angle_choices[column]


def _marginal(signal: str, best: Mapping[str, UnitChoice], combined: list, weights: np.ndarray) -> UnitGuess:
    shares: dict[str, float] = {}
    for (_, units), weight in zip(combined, weights, strict=True):
        unit = units[signal].unit
        shares[unit] = shares.get(unit, 0.0) + float(weight)
    return _guess(best[signal], shares)


def _alone(choices: Sequence[UnitChoice]) -> UnitGuess:
    weights = np.exp([choice.odds for choice in choices])
    shares = {choice.unit: float(w) for choice, w in zip(choices, weights / weights.sum(), strict=True)}
    return _guess(choices[0], shares)


def _guess(choice: UnitChoice, shares: Mapping[str, float]) -> UnitGuess:
    rivals = [u for u in sorted(shares, key=lambda u: -shares[u]) if u != choice.unit and shares[u] > _NOTED]
    return UnitGuess(choice.unit, choice.size, shares[choice.unit], choice.reason, tuple(rivals[:3]))


def _twist(logs: Sequence[Uniform], motor: int | None, load: int | None) -> float:
    """Range of the difference of both angles, in the load's unit; 0 without any."""
    if motor is None or load is None:
        return 0.0
    return max(_left_over(log.values[log.inside, motor], log.values[log.inside, load])[1] for log in logs)


def _twist_odds(range_: float) -> float:
    bounds = (_LARGEST_TWIST, _SOFT_TWIST)
    return _TWIST_ODDS[int(np.searchsorted(bounds, range_))]


def _spread(values: np.ndarray) -> float:
    low, high = np.quantile(values, (0.005, 0.995))
    return float(high - low)


def _left_over(motor: np.ndarray, load: np.ndarray) -> tuple[float, float, float]:
    """Ratio of motor and load in common motion, the range of the load angle's remainder, and the load's range."""
    m, f = motor - motor.mean(), load - load.mean()
    norms = float(m @ m), float(f @ f)
    if min(norms) == 0:
        return 0.0, 0.0, 0.0
    # Both angles have errors: the geometric mean of both regressions.
    slope = np.sign(m @ f) * np.sqrt(norms[0] / norms[1])
    return float(slope), _spread(f - m / slope), _spread(f)


def ratio_of(
    columns: Mapping[str, int],
    units: tuple[Mapping[str, UnitGuess], float],
    evidence: Evidence,
    logs: Sequence[Uniform],
) -> RatioGuess | None:
    """The reduction ratio; None without both angles, or if their common motion does not determine it.

    Args:
        columns: number of the column of each signal.
        units: from [`units_of`][].
        evidence: on the columns.
        logs: channels by the same numbers.
    """
    if "motor_angle" not in columns or "load_angle" not in columns:
        return None
    motor, load = columns["motor_angle"], columns["load_angle"]
    views = [log.values[log.inside] for log in logs] + [s.value for s in evidence.relations.scales]
    seen = [_left_over(view[:, motor], view[:, load]) for view in views]
    shares = [(left / span, abs(slope)) for slope, left, span in seen if span > 0]
    # Slow or large motion determines the ratio; fast motion twists the gear.
    share, slope = min(shares, default=(np.inf, 0.0))
    if share > _SEEN_RATIO:
        return None
    known, alike = units
    value = slope * known["motor_angle"].size / known["load_angle"].size
    margin = value * max(_HIDDEN * share, _ROUNDED)
    low, high = value - margin, value + margin
    if margin < 0.5 and value > 0.5:
        # Strain-wave gears have integer ratios.
        return RatioGuess(float(round(value)), low, high, sure=low <= round(value) <= high and alike >= SURE)
    usual = [n for n in _CATALOGUE if low <= n <= high]
    return RatioGuess(min(usual, key=lambda n: abs(n - value)) if len(usual) == 1 else value, low, high, sure=False)


def signs_of(columns: Mapping[str, int], evidence: Evidence) -> dict[str, tuple[int, str]]:
    """The signs of all signals relative to the motor's angle, or else the load's, with reasons."""
    motor, load, twist = (columns.get(s) for s in ("motor_angle", "load_angle", "dynamic_error"))
    signs: dict[str, tuple[int, str]] = {}

    def tell(signal: str, told: RelationEvidence, reference: int, words: str) -> int:
        """The sign of a signal from a relation, 1 without evidence."""
        if told is NOTHING or (told.odds < _SIGN_ODDS and not (signal in _COPIES and told.unexplained < _CORRELATED)):
            return 1
        sign = int(np.sign(told.slope) * reference) or 1
        signs[signal] = (sign, words if sign < 0 else "")
        return sign

    of_load = 1
    if motor is not None and load is not None:
        of_load = tell(
            "load_angle", evidence.relations.proportional(motor, load), 1, "it turns opposite to the motor angle"
        )
    for signal, side, own in (("motor_velocity", motor, 1), ("load_velocity", load, of_load)):
        if signal in columns and side is not None:
            told = evidence.relations.is_rate_of(columns[signal], side)
            tell(signal, told, own, "it is opposite to its angle")
    if twist is not None and motor is not None and load is not None:
        tell("dynamic_error", evidence.told("difference", motor, load)[twist], 1, "it falls where the motor leads")
    _of_torques(columns, evidence, of_load, tell)
    return signs


def _of_torques(columns: Mapping[str, int], evidence: Evidence, of_load: int, tell) -> None:
    motor, load, twist = (columns.get(s) for s in ("motor_angle", "load_angle", "dynamic_error"))
    angles = [k for k in (motor, load) if k is not None]
    for signal in ("motor_torque", "motor_current"):
        if signal in columns and angles:
            reference = 1 if motor is not None else of_load
            both = [evidence.accelerated(columns[signal], chosen) for chosen in (angles, angles[:1])]
            tell(signal, max(both, key=lambda t: t.odds), reference, "it is opposite to the motor's acceleration")
    if "joint_torque" in columns:
        k = columns["joint_torque"]
        tell("joint_torque", evidence.held(k, motor, load, twist), 1, "it falls where the twist rises")
    if "forcing" in columns and twist is not None:
        driven = [evidence.told(r, twist)[columns["forcing"]] for r in ("drives", "pulled_back")]
        tell("forcing", max(driven, key=lambda t: t.odds), 1, "it is opposite to the motion that it causes")
