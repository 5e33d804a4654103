"""Inspection of logs without a drive file."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from fitting.errors import InputError
from fitting.inspection.columns import Column, Table
from fitting.inspection.hypotheses import ANGLES, COPY, OTHERS, Evidence, hypotheses, readings, weighed
from fitting.inspection.reasons import physical_reasons
from fitting.inspection.relations import Relations
from fitting.inspection.settling import SURE, RatioGuess, UnitGuess, ratio_of, signs_of, units_of
from fitting.inspection.time_column import Clock, TimeGuess, clock_of, guess_time
from fitting.inspection.unit_evidence import is_counts, si_size
from fitting.inspection.windows import Uniform, scales, uniform
from fitting.logs.channels import SI
from fitting.logs.units import convert
from fitting.logs.unwrapping import unwrapped_angle

_RIVAL, _WORTH_A_WORD = (
    0.05,
    0.3,
)  # confidence below which a possible signal is not reported, and a column counts as none
_TOLD_UNIT, _SURE_UNIT = 0.5, 0.95  # confidence below which a unit is not reported, or reported as assumed
_WITHOUT_SIGN = ("temperature", "load_torque")
_SHARED = ("angle", "velocity", "torque", "current", "twist")


@dataclass(frozen=True, eq=False)
class SignalGuess:
    """A signal and its column.

    Attributes:
        signal: Of a drive file.
        column: Name of the column.
        unit: Stated or guessed, or None if unknown.
        size: Of the unit in SI.
        sign: +1 or -1.
        confidence: 0 to 1.
        reasons: As text.
        unit_reason: For the unit, where it is guessed.
        doubts: Uncertainty of the unit.
    """

    signal: str
    column: str
    unit: str | None
    size: float
    sign: int
    confidence: float
    reasons: tuple[str, ...]
    unit_reason: str = ""
    doubts: tuple[str, ...] = ()

    @property
    def is_read(self) -> bool:
        """Whether the unit is known; SI is assumed where the file states none, other than for angles."""
        if self.unit is None:
            return not self.signal.endswith("_angle")
        return self.signal not in SI or si_size(self.unit, SI[self.signal]) is not None

    def in_si(self, values: np.ndarray) -> np.ndarray:
        """Values of the column in SI, without the sign; as logged in a unit of another quantity."""
        if self.unit is None or self.signal not in SI or not self.is_read:
            return self.size * values
        return convert(values, self.unit, SI[self.signal])

    @property
    def why(self) -> str:
        """All evidence for the guess and against it."""
        unit = (f"{self.unit}: {self.unit_reason}",) if self.unit_reason and self.unit else ()
        return "; ".join((*self.reasons, *unit, *self.doubts))


@dataclass(frozen=True, eq=False)
class JointInspection:
    """The columns of one joint of a robot, or of the only drive.

    Attributes:
        label: Of the joint, or None.
        signals: Recognised ones, by name.
        open: Columns with several possible signals, with the confidence of each.
        copies: Columns proportional to another one, with its name and the factor.
        ratio: The reduction ratio, or None if unknown.
        span: Range of the output's angle, or else of the motor's or the twist, in the column's unit.
    """

    label: str | None
    signals: dict[str, SignalGuess]
    open: dict[str, dict[str, float]]
    copies: dict[str, tuple[str, float]]
    ratio: RatioGuess | None
    span: float

    @property
    def travel(self) -> float:
        """Range of the output's angle, or else of the motor's or the twist, in SI if the unit is known."""
        found = [self.signals[s].size for s in ("load_angle", "motor_angle") if s in self.signals]
        return self.span * (found or [1.0])[0]

    @property
    def kind(self) -> str | None:
        """Kind of log of the joint's columns: "drive", "reduced", "quasi-static", "motor side"; None for none."""
        found = set(self.signals)
        driven = found & {"motor_torque", "motor_current"}
        if {"motor_angle", "load_angle"} <= found and driven:
            return "drive"
        if {"dynamic_error", "forcing"} <= found:
            return "reduced"
        if "joint_torque" in found and (found & {"twist", "dynamic_error"} or {"motor_angle", "load_angle"} <= found):
            return "quasi-static"
        return "motor side" if driven and found & {"motor_angle", "motor_velocity", "load_angle"} else None


@dataclass(frozen=True, eq=False)
class Inspection:
    """Inspected logs of one drive or robot.

    Attributes:
        tables: The logs' columns.
        clocks: The logs' stamps.
        time: The clock column.
        joints: Of the robot; one without a label for a single drive.
        joint: The one that moves the most, or the requested one.
    """

    tables: tuple[Table, ...]
    clocks: tuple[Clock, ...] = field(repr=False)
    time: TimeGuess
    joints: tuple[JointInspection, ...]
    joint: JointInspection

    @cached_property
    def rates(self) -> tuple[float | None, ...]:
        """Samples per second of each log [Hz]; None without a known time unit."""
        return tuple(1.0 / float(np.median(np.diff(c.base.time))) if c.known else None for c in self.clocks)

    def unique(self, column: str) -> str:
        """The name of a column, numbered where others have the same name."""
        first = self.tables[0]
        return f"{column} (1)" if f"{column} (2)" in first.names | first.left_out.keys() else column

    def samples(self, signal: str, log: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Stamps [s] and values of a signal of the chosen joint, in SI as guessed, (n,) each, if both are known."""
        guess = self.joint.signals[signal]
        values, own = _samples(self.tables[log], guess.column, self.clocks[log])
        stamps = self.clocks[log].base.time if own is None else own
        known = np.isfinite(values) & np.isfinite(stamps)
        return stamps[known], guess.sign * guess.in_si(values[known])


def inspect_tables(tables: Sequence[Table], *, joint: str | None = None) -> Inspection:
    """Inspect logs of one drive or robot.

    Args:
        tables: All columns of each.
        joint: Label of the joint; if None, the one that moves the most.

    Raises:
        InputError: The logs have different columns, or there is no such joint.
    """
    first = tables[0]
    others = [table for table in tables[1:] if table.names != first.names]
    if others:
        differing = ", ".join(sorted(first.names ^ others[0].names)[:4])
        raise InputError(
            f"{others[0].path}: its columns are not those of {first.path} ({differing}); give logs of one drive that "
            "were recorded alike, or one at a time"
        )
    # Files may contain numbers of any size; those that overflow carry no information.
    with np.errstate(all="ignore"):
        return _inspected(tables, joint)


def _inspected(tables: Sequence[Table], joint: str | None) -> Inspection:
    first = tables[0]
    time = guess_time(first)
    clocks = tuple(clock_of(table, time) for table in tables)
    labels = joint_labels(first.columns)
    joints = tuple(_joint(tables, clocks, time, label, labels) for label in labels or (None,))
    joints = tuple(_as_others(joint, joints, first) for joint in joints)
    return Inspection(tuple(tables), clocks, time, joints, _chosen(joints, joint, first.path))


def confidence_percent(share: float) -> str:
    """A confidence as text; nothing is certain."""
    return f"{100 * min(share, 0.99):.0f} %"


def alike(tables: Sequence[Table]) -> list[tuple[Table, ...]]:
    """Tables in groups with the same columns."""
    groups: dict[frozenset[str], list[Table]] = {}
    for table in tables:
        groups.setdefault(table.names, []).append(table)
    return [tuple(group) for group in groups.values()]


def joint_labels(columns: Sequence[Column]) -> tuple[str, ...]:
    """The labels of a robot's joints, from repeated column names; empty for one drive."""
    stems: dict[str, set[str]] = {}
    for column in columns:
        if column.sense.joint is not None and set(column.sense.quantities) & set(_SHARED):
            stems.setdefault(column.sense.joint, set()).add(column.sense.stem)
    bare = [c.sense for c in columns if c.sense.joint is None]
    # Two encoders of one drive may also be numbered, but not its torque.
    one_torque = any(s.quantities[:1] in (("torque",), ("current",)) for s in bare)
    labelled = any("torque" in c.sense.quantities or "current" in c.sense.quantities for c in columns if c.sense.joint)
    if one_torque and not labelled:
        return ()
    several = [label for label, found in stems.items() if len(found) > 1]
    return tuple(sorted(several, key=lambda label: (len(label), label))) if len(several) > 1 else ()


def _chosen(joints: tuple[JointInspection, ...], wanted: str | None, path: Path) -> JointInspection:
    if wanted is None:
        return max(joints, key=lambda j: (len(j.signals) > 0, j.travel))
    found = next((j for j in joints if j.label == wanted), None)
    if found is None:
        known = ", ".join(j.label for j in joints if j.label) or "no joints, since the log is of one drive"
        raise InputError(f"{path}: there is no joint '{wanted}'; the log has {known}")
    return found


def _unwrapped(column: Column) -> np.ndarray:
    """The values, unwrapped."""
    said = column.sense.quantities
    if said and "angle" not in said:
        return column.values
    values = column.values
    for revolution in (2 * np.pi, 360.0):
        values, _, rows = unwrapped_angle(values, revolution)
        if len(rows):
            break
    return values


def _joint(
    tables: Sequence[Table], clocks: Sequence[Clock], time: TimeGuess, label: str | None, labels: tuple[str, ...]
) -> JointInspection:
    clocks_of = {time.column, *time.clocks.values(), *(time.fraction or ())}
    columns = [c for c in tables[0].columns if c.name not in clocks_of and _is_of(c, label, labels)]
    if not columns:
        return JointInspection(label, {}, {}, {}, None, 0.0)
    logs = [
        uniform(clock.base.time, [_samples(table, c.name, clock) for c in columns])
        for table, clock in zip(tables, clocks, strict=True)
    ]
    moves = np.array([any(not table.column(c.name).constant for table in tables) for c in columns], dtype=bool)
    evidence = Evidence(columns, Relations(scales(logs), moves))
    return _settled(label, evidence, logs)


def _as_others(joint: JointInspection, joints: Sequence[JointInspection], table: Table) -> JointInspection:
    """A joint with unknown units taken from the same channel of another joint."""

    def known(guess: SignalGuess) -> SignalGuess:
        others = [other.signals[guess.signal] for other in joints if guess.signal in other.signals]
        stem = table.column(guess.column).sense.stem
        like = next((o for o in others if o.unit is not None and table.column(o.column).sense.stem == stem), None)
        if like is None or guess.unit is not None or not guess.signal.endswith("_angle"):
            return guess
        return replace(guess, unit=like.unit, size=like.size, unit_reason=f"as '{like.column}'", doubts=())

    return replace(joint, signals={name: known(guess) for name, guess in joint.signals.items()})


def _samples(table: Table, name: str, clock: Clock) -> tuple[np.ndarray, np.ndarray | None]:
    """The values of a column and its stamps, or those of the table's clock."""
    values, own = _unwrapped(table.column(name)), clock.own.get(name)
    return (values[clock.base.rows], None) if own is None else (values[own.rows], own.time)


def _is_of(column: Column, label: str | None, labels: tuple[str, ...]) -> bool:
    """Whether a column belongs to a joint, or to none, and may be a signal."""
    if column.sense.quantities[:1] in (("other",), ("time",), ("counter",)):
        return False
    return label is None or column.sense.joint == label or column.sense.joint not in labels


def _settled(label: str | None, evidence: Evidence, logs: Sequence[Uniform]) -> JointInspection:
    found = hypotheses(evidence)
    best, shares = found[0].columns, weighed(found, evidence)
    sure = {s: k for s, k in best.items() if shares[k].get(s, 0.0) >= SURE}
    if {"motor_torque", "motor_current"} <= set(sure) and evidence.columns[sure["motor_torque"]].sense.commanded:
        # A measured current is better evidence of the torque than a command.
        del sure["motor_torque"]
    # Guesses that are too uncertain to report still affect units and signs of the others.
    (units, alike), signs = units_of(best, evidence, logs), signs_of(best, evidence)
    ratio = ratio_of(sure, (units, alike), evidence, logs)
    names = _names(sure)
    signals = {
        names[s]: _signal(names[s], s, sure, evidence, shares[k][s], (units.get(s), signs.get(s)))
        for s, k in sure.items()
    }
    taken = set(sure.values())
    maybe = {}
    for k, column in enumerate(evidence.columns):
        angles = {s: w for s, w in shares.get(k, {}).items() if s in ANGLES and w > _RIVAL}
        others = {s: w for s, w in readings(found, evidence, k).items() if w > _RIVAL}
        if k not in taken and max([*angles.values(), *others.values()], default=0.0) > _WORTH_A_WORD:
            maybe[column.name] = dict(sorted((angles | others).items(), key=lambda item: -item[1]))
    copies = _copies(evidence, taken)
    maybe = {name: own for name, own in maybe.items() if own and name not in copies}
    angle = sure.get("load_angle", sure.get("motor_angle", sure.get("dynamic_error")))
    span = max(float(np.ptp(log.values[:, angle])) for log in logs) if angle is not None else 0.0
    return JointInspection(label, signals, maybe, copies, ratio, span)


def _names(sure: dict[str, int]) -> dict[str, str]:
    """Signal names for drive files: the twist of a quasi-static log is not the dynamic error of a reduced one."""
    slow = "joint_torque" in sure and "forcing" not in sure
    return {s: "twist" if s == "dynamic_error" and slow else s for s in (*ANGLES, *OTHERS)}


def _copies(evidence: Evidence, taken: set[int]) -> dict[str, tuple[str, float]]:
    """Columns that are not a signal, but proportional to one."""
    copies = {}
    for k, column in enumerate(evidence.columns):
        if k in taken:
            continue
        told = {i: evidence.relations.proportional(k, i) for i in taken}
        i = max(told, key=lambda i: told[i].odds, default=None)
        if i is not None and told[i].odds > COPY:
            copies[column.name] = (evidence.columns[i].name, told[i].slope)
    return copies


def _signal(
    name: str,
    signal: str,
    columns: dict[str, int],
    evidence: Evidence,
    confidence: float,
    settled: tuple[UnitGuess | None, tuple[int, str] | None],
) -> SignalGuess:
    (unit, sign), k = settled, columns[signal]
    reference = next((s for s in ANGLES if s in columns), None)
    column = evidence.columns[k]
    reasons = [*evidence.names[signal][k].reasons, *physical_reasons(signal, columns, evidence)]
    if sign is not None and sign[1]:
        reasons.append(sign[1])
    guess = SignalGuess(
        signal=name,
        column=column.name,
        unit=column.unit,
        size=1.0 if column.unit is None else si_size(column.unit, SI.get(signal, "A")) or 1.0,
        sign=sign[0] if sign else 1,
        confidence=confidence,
        reasons=tuple(reasons),
    )
    doubts = () if sign is not None or signal in _WITHOUT_SIGN or signal == reference else ("its sign is unknown",)
    # A stated unit that is none of an angle must not be replaced by a guess.
    if unit is None or unit.reason == "stated" or not (column.unit is None or is_counts(column.unit)):
        return replace(guess, doubts=doubts)
    rivals = " or ".join(unit.rivals)
    if unit.confidence < _TOLD_UNIT:
        doubts = (f"its unit may be {unit.unit} or {rivals}", *doubts)
        return replace(guess, unit=None, size=unit.size, doubts=doubts)
    if unit.confidence < _SURE_UNIT:
        doubts = (f"{unit.unit} is assumed" + (f", {rivals} is possible" if rivals else ""), *doubts)
    return replace(guess, unit=unit.unit, size=unit.size, unit_reason=unit.reason, doubts=doubts)
