"""Evidence of a column's name and stated unit for each signal, in log odds against no signal."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from fitting.inspection.columns import Column
from fitting.inspection.unit_evidence import is_counts, si_size
from fitting.logs.channels import SI
from fitting.logs.column_names import QUANTITY, NameSense
from fitting.logs.units import is_unit

# Log odds, assumed; meaning beside each.
_OWN_NAME = 9.0  # name equal to the signal's
_SAME, _FIRST, _PERHAPS = 2.5, 1.5, 0.3  # quantity is the name's only one, the first of several, or another
_OTHER = -8.0  # another quantity
_SILENT = -0.5  # a name without known meaning
_SIDE, _WRONG_SIDE = 2.5, -6.0
_JOINT_SIDE, _NO_MOTOR = 1.0, -2.0  # "joint" is most often the output
_COMMAND, _COMMANDED_TORQUE = -12.0, -3.0  # a command is not a measurement
_UNIT, _WRONG_UNIT = 1.5, -10.0
_EXTERNAL = 2.0
_RARE: dict[str, float] = {"load_torque": -1.5}  # rare signals
_UNNAMED: dict[str, float] = dict.fromkeys(
    ("motor_current", "load_torque", "temperature"), -6.0
)  # signals that only name or unit identify
_OF_THE_JOINT = -1.0  # a torque named after the joint that is the motor's
_CONSTANT, _LOCKED = -5.0, -2.0  # a constant channel, or a constant angle: one side may be locked
_BARE_TORQUE = {"motor_torque": 0.5, "joint_torque": -0.5, "load_torque": -2.5}  # a torque without a side
# Inputs and outputs of a system.
_SYSTEM = {"u": "u", "y": "y", "input_data": "u", "output_data": "y"}

_SI = SI | {"motor_current": "A"}


@dataclass(frozen=True)
class NameEvidence:
    """Evidence of a name for one signal.

    Attributes:
        odds: log odds.
        reasons: as text; empty without evidence.
    """

    odds: float
    reasons: tuple[str, ...]


def in_context(columns: Sequence[Column]) -> tuple[NameSense, ...]:
    """Meaning of the names, each in context of the others.

    In a robot's log `theta` is the motor's angle where `q` is the link's, and so are their rates. In a system's log `u`
    is the input and `y` the output: of a joint its torque and angle. MATLAB's `iddata` calls them `InputData` and
    `OutputData`.
    """
    leaves = [column.sense.stem.rpartition(".")[2] for column in columns]
    robot = any("theta" in leaf for leaf in leaves) and "q" in leaves
    roles = [_SYSTEM.get(leaf) or _SYSTEM.get(leaf.partition("_")[0]) for leaf in leaves]
    roles = roles if {"u", "y"} <= set(roles) else [None] * len(roles)
    # Several outputs are angles, those of one drive or of a robot's joints.
    joints = any(role == "y" and column.sense.joint is not None for role, column in zip(roles, columns, strict=True))
    return tuple(
        _beside(column.sense, leaf, robot, role, joints)
        for column, leaf, role in zip(columns, leaves, roles, strict=True)
    )


def _beside(sense: NameSense, leaf: str, robot: bool, role: str | None, joints: bool) -> NameSense:
    if role is not None and (leaf in _SYSTEM or sense.quantities[:1] in (("input",), ("twist",))):
        of = ("torque", "angle") if joints else ("input", "twist")
        return replace(sense, quantities=of[:1] if role == "u" else of[1:], side=None)
    if robot and sense.side is None and sense.quantities[:1] in (("angle",), ("velocity",)):
        side = "motor" if "theta" in leaf else "load" if leaf in ("q", "dq", "qd", "q_dot") else None
        return replace(sense, side=side)
    return sense


def name_evidence(column: Column, sense: NameSense, signal: str) -> NameEvidence:
    """Evidence of name and unit that a column is a signal.

    Args:
        column: for its name and unit.
        sense: of its name, in context of the others.
        signal: one of a drive file's.
    """
    odds, reasons = 0.0, []
    if column.name.lower() in (signal, signal.replace("_", " ")):
        return NameEvidence(_OWN_NAME + _of_unit(column, signal)[0], ("the signal's own name",))
    odds += _RARE.get(signal, 0.0)
    quantity = QUANTITY[signal]
    if not sense.quantities:
        odds += _SILENT + _UNNAMED.get(signal, 0.0)
    elif quantity in sense.quantities:
        first = _SAME if len(sense.quantities) == 1 else _FIRST
        odds += first if quantity == sense.quantities[0] else _PERHAPS
        reasons.append(f"the name says {quantity if quantity != 'input' else 'forcing'}")
    else:
        odds += _OTHER
    side, said = _of_side(sense, signal)
    odds += side
    reasons += said
    if sense.commanded:
        odds += _COMMANDED_TORQUE if signal == "motor_torque" else _COMMAND
        reasons.append("but it is a command")
    if sense.external and signal != "load_torque":
        odds += _OTHER
    if column.constant:
        odds += _LOCKED if signal.endswith("_angle") else _CONSTANT
    unit, stated = _of_unit(column, signal)
    return NameEvidence(odds + unit, (*reasons, *stated))


def _of_side(sense: NameSense, signal: str) -> tuple[float, Iterable[str]]:
    wanted = signal.partition("_")[0] if signal in _SIDED else None
    if wanted is None:
        return 0.0, ()
    if sense.external:
        return (_EXTERNAL if signal == "load_torque" else _WRONG_SIDE), ()
    if signal.endswith("_torque"):
        return _of_torque_side(sense, signal, wanted)
    if sense.side is None:
        return 0.0, ()
    if sense.side == wanted:
        return _SIDE, (f"of the {wanted} side",)
    if sense.side == "joint":
        return (_JOINT_SIDE if wanted == "load" else _NO_MOTOR), ()
    return _WRONG_SIDE, ()


def _of_torque_side(sense: NameSense, signal: str, wanted: str) -> tuple[float, Iterable[str]]:
    if sense.side is None:
        return _BARE_TORQUE[signal], ()
    if sense.side == wanted:
        return _SIDE, (f"of the {wanted}",)
    # A torque sensor behind the gear is named after the joint or the link.
    if sense.side in ("joint", "load") and signal == "joint_torque":
        return _JOINT_SIDE, ()
    if sense.side == "joint" and signal == "motor_torque":
        return _OF_THE_JOINT, ()
    return _WRONG_SIDE, ()


_SIDED = ("motor_angle", "load_angle", "motor_velocity", "load_velocity", "motor_torque", "joint_torque", "load_torque")


def _of_unit(column: Column, signal: str) -> tuple[float, Iterable[str]]:
    if column.unit is None:
        return 0.0, ()
    if signal in ("dynamic_error", "forcing"):
        # In a reduced log units are arbitrary.
        return (_UNIT if si_size(column.unit, "rad") is not None and signal == "dynamic_error" else 0.0), ()
    if is_counts(column.unit):
        return (_UNIT, (f"its unit '{column.unit}'",)) if signal.endswith("_angle") else (_WRONG_UNIT, ())
    if column.unit == "%":
        return (0.0 if QUANTITY[signal] in ("torque", "current") else _WRONG_UNIT), ()
    if si_size(column.unit, _SI[signal]) is not None:
        return _UNIT, (f"its unit '{column.unit}'",)
    # A unit that is not understood contradicts nothing.
    return (_WRONG_UNIT if is_unit(column.unit) else 0.0), ()
