"""Reasons for a guess, as text."""

from collections.abc import Mapping

from fitting.inspection.hypotheses import Evidence

_TOLD = 1.0  # log odds above which a relation is mentioned


def physical_reasons(signal: str, columns: Mapping[str, int], evidence: Evidence) -> tuple[str, ...]:
    """The relations to other columns that support a guess.

    Args:
        signal: of the guess.
        columns: number of the column of each signal.
        evidence: on these columns.
    """
    motor, load, twist = (columns.get(s) for s in ("motor_angle", "load_angle", "dynamic_error"))
    k = columns[signal]
    if signal in ("motor_angle", "load_angle"):
        return _of_angle(signal, motor, load, evidence)
    if signal.endswith("_velocity"):
        side = motor if signal.startswith("motor") else load
        if side is not None and evidence.relations.is_rate_of(k, side).odds > _TOLD:
            return (f"it is the rate of {_called(evidence, side)}",)
    if signal in ("motor_torque", "motor_current"):
        angles = [a for a in (motor, load) if a is not None]
        told = [evidence.accelerated(k, chosen).odds for chosen in (angles, angles[:1]) if chosen]
        if max(told, default=0.0) > _TOLD:
            return (f"it accelerates {_called(evidence, angles[0])}",)
    if signal == "joint_torque" and evidence.held(k, motor, load, twist).odds > _TOLD:
        return ("it is proportional to the twist",)
    if signal in ("forcing", "dynamic_error"):
        return _of_oscillator(columns, evidence)
    return ()


def _called(evidence: Evidence, column: int) -> str:
    return f"'{evidence.columns[column].name}'"


def _of_angle(signal: str, motor: int | None, load: int | None, evidence: Evidence) -> tuple[str, ...]:
    if motor is None or load is None:
        return ()
    told = evidence.relations.proportional(motor, load)
    if told.odds < _TOLD:
        return ()
    times = abs(told.slope)
    if signal == "motor_angle":
        return (f"its values vary {times:.4g} times as much as those of {_called(evidence, load)}",)
    return (f"it moves with {_called(evidence, motor)}",)


def _of_oscillator(columns: Mapping[str, int], evidence: Evidence) -> tuple[str, ...]:
    twist, forcing = columns.get("dynamic_error"), columns.get("forcing")
    if twist is None or forcing is None:
        motor, load = columns.get("motor_angle"), columns.get("load_angle")
        if twist is None or motor is None or load is None:
            return ()
        made = evidence.told("difference", motor, load)[twist].odds > _TOLD
        return ("it is a combination of both angles",) if made else ()
    driven = [evidence.told(r, twist)[forcing].odds for r in ("drives", "pulled_back")]
    words = f"{_called(evidence, twist)} responds to {_called(evidence, forcing)} like an oscillator"
    return (words,) if max(driven) > _TOLD else ()
