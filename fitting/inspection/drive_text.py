"""Text of a drive file: guesses from a log with their reasons, and lines to fill in for unknown values."""

import json
from collections.abc import Iterable
from typing import Any

from fitting.inspection.inspection import Inspection, SignalGuess, confidence_percent
from fitting.inspection.unit_evidence import is_counts
from fitting.logs.channels import SI

_ANGLES = ("motor_angle", "load_angle")
_ORDER = (
    *_ANGLES,
    "motor_velocity",
    "load_velocity",
    "motor_torque",
    "motor_current",
    "joint_torque",
    "load_torque",
    "twist",
    "dynamic_error",
    "forcing",
    "temperature",
)
_INERTIAS = {
    "motor_inertia": 'rotor, wave generator and brake about the motor\'s axis, e.g. "5.26 kg cm^2"',
    "load_inertia": "everything that moves with the output, about its axis [kg m^2]",
}
_WHERE_TO_FILL = "FILL IN"
_WHY_NO_ANGLE = "no column was recognised as this angle, which is needed for the twist"


def drive_tables(inspection: Inspection) -> dict[str, Any]:
    """The known tables of a drive file, without values that must be filled in."""
    joint = inspection.joint
    drive: dict[str, Any] = {"name": _name(inspection)}
    if joint.ratio is not None and joint.ratio.sure and not joint.ratio.inverted:
        drive["reduction_ratio"] = _number(joint.ratio.value)
    columns = {s: column_place(inspection, joint.signals[s]) for s in _written(inspection)}
    if inspection.time.column is not None:
        columns = {"time": _time_place(inspection)} | columns
    return {"drive": drive, "columns": columns}


def unknowns(inspection: Inspection) -> dict[str, str]:
    """Values that must be filled in before a fit, by their place in the drive file, with the reason."""
    joint = inspection.joint
    missing: dict[str, str] = {}
    if (_both_angles(inspection) or joint.kind == "motor side") and "reduction_ratio" not in drive_tables(inspection)[
        "drive"
    ]:
        missing["[drive] reduction_ratio"] = _why_no_ratio(inspection)
    if joint.kind in ("drive", "motor side"):
        missing |= {f"[drive] {key}": what for key, what in _INERTIAS.items()}
    if inspection.time.column is None and inspection.rates[0] is None:
        missing["[signals] sample_rate"] = "in Hz; no column is a clock"
    missing |= {f"[columns] {signal}": _WHY_NO_ANGLE for signal in _unseen_angles(inspection)}
    written = _written(inspection)
    for signal in _in_order(joint.signals):
        if signal not in written and not _spare(inspection, signal):
            missing[f"[columns] {signal}"] = _why_not_written(joint.signals[signal])
    for column, shares in joint.open.items():
        missing[f"[columns] for '{column}'"] = f"it may be {_listed(shares)}"
    if joint.kind is None and not joint.open:
        missing["[columns]"] = "no column was recognised as an angle and a torque, or as a twist and a forcing"
    return missing


def drive_file_text(inspection: Inspection) -> str:
    """The drive file."""
    tables = drive_tables(inspection)
    names = ", ".join(table.path.name for table in inspection.tables)
    head = [
        f"# Written by `hdjax init` from {names}.",
        "# Each guess is followed by its reason: check it. Lines with FILL IN are not known from the logs:",
        "# complete them and remove the # before them.",
    ]
    lines = [*head, "", "[drive]", f"name = {_toml(tables['drive']['name'])}"]
    lines += [*_ratio_lines(inspection), *_inertia_lines(inspection), "", "[signals]", *_sampling_lines(inspection)]
    lines += ["", "[columns]", *_time_lines(inspection)]
    written = _written(inspection)
    for signal in _in_order(inspection.joint.signals):
        guess = inspection.joint.signals[signal]
        place, open_place = _toml(column_place(inspection, guess)), _open_place(inspection, guess)
        if signal in written:
            lines.append(_with_reason(f"{signal} = {place}", guess))
        elif _spare(inspection, signal):
            lines.append(f"# {signal} = {place}  # not needed in addition to the motor torque")
        else:
            lines.append(f"# {signal} = {open_place}  # {_WHERE_TO_FILL}: {_why_not_written(guess)}")
    lines += [f"# {signal} = ...  # {_WHERE_TO_FILL}: {_WHY_NO_ANGLE}" for signal in _unseen_angles(inspection)]
    lines += _open_lines(inspection)
    return "\n".join(lines) + "\n"


def _name(inspection: Inspection) -> str:
    stem = inspection.tables[0].path.name.partition(".")[0] or "drive"
    return f"{stem}, joint {inspection.joint.label}" if inspection.joint.label else stem


def _in_order(signals: Iterable[str]) -> list[str]:
    return sorted(signals, key=_ORDER.index)


def _written(inspection: Inspection) -> list[str]:
    """The signals whose lines are complete."""
    signals = inspection.joint.signals
    return [s for s in _in_order(signals) if not _spare(inspection, s) and s != "motor_current" and signals[s].is_read]


def _spare(inspection: Inspection, signal: str) -> bool:
    return signal == "motor_current" and "motor_torque" in inspection.joint.signals


def _unseen_angles(inspection: Inspection) -> list[str]:
    """Missing angles of a log of the load side, for which there is no uncertain column."""
    joint = inspection.joint
    if joint.kind != "motor side" or {"motor_angle", "motor_velocity"} & set(joint.signals):
        return []
    maybe = {signal for shares in joint.open.values() for signal in shares}
    return [signal for signal in _ANGLES if signal not in joint.signals and signal not in maybe]


def _both_angles(inspection: Inspection) -> bool:
    return set(_ANGLES) <= set(inspection.joint.signals)


def column_place(inspection: Inspection, guess: SignalGuess) -> dict[str, Any]:
    """Column, unit and sign of a signal, as in a drive file."""
    place: dict[str, Any] = {"column": inspection.unique(guess.column)}
    if guess.unit is not None:
        place["unit"] = guess.unit
    return place | ({"sign": -1} if guess.sign < 0 else {})


def _open_place(inspection: Inspection, guess: SignalGuess) -> str:
    """A place in which the unknown part is left to fill in."""
    column = _toml(inspection.unique(guess.column))
    sign = ", sign = -1" if guess.sign < 0 else ""
    if guess.signal == "motor_current":
        unit = f", unit = {_toml(guess.unit)}" if guess.unit else ""
        return f"{{ column = {column}{unit}{sign}, torque_constant = ... }}"
    return f'{{ column = {column}, unit = "..."{sign} }}'


def _why_not_written(guess: SignalGuess) -> str:
    if guess.signal == "motor_current":
        return "the torque constant [N m / A] is not known from a log"
    if guess.unit is not None:
        return f"write the size of one '{guess.unit}', such as \"0.27 {SI[guess.signal]}\""
    return 'the unit is unknown; for counts write "rev / 65536" with the counts of a revolution'


def _with_reason(line: str, guess: SignalGuess) -> str:
    return f"{line}  # guess, {confidence_percent(guess.confidence)}: {_plain(guess.why)}"


def _ratio_lines(inspection: Inspection) -> list[str]:
    ratio = inspection.joint.ratio
    known = "reduction_ratio" in drive_tables(inspection)["drive"]
    if ratio is not None and known:
        said = f"reduction_ratio = {_toml(_number(ratio.value))}"
        if ratio.value == 1:
            why = "both angles move equally, so that motor inertia and torque are referred to the output"
        else:
            why = f"the angles admit {ratio.low:.4g} to {ratio.high:.4g}"
        return [f"{said}  # guess: {why}"]
    if inspection.joint.kind == "reduced" or (inspection.joint.kind == "quasi-static" and not _both_angles(inspection)):
        return []
    likely = f" {_toml(_number(ratio.value))}" if ratio is not None and not ratio.inverted else ""
    return [f"# reduction_ratio ={likely or ' ...'}  # {_WHERE_TO_FILL}: {_why_no_ratio(inspection)}"]


def _why_no_ratio(inspection: Inspection) -> str:
    ratio = inspection.joint.ratio
    if ratio is None:
        return "motor revolutions per output revolution; the log does not determine it"
    return f"motor revolutions per output revolution; the angles admit {ratio.low:.4g} to {ratio.high:.4g}"


def _inertia_lines(inspection: Inspection) -> list[str]:
    if inspection.joint.kind in ("reduced", "quasi-static"):
        return []
    return [f"# {key} = ...  # {_WHERE_TO_FILL}: {what}" for key, what in _INERTIAS.items()]


def _sampling_lines(inspection: Inspection) -> list[str]:
    lines = []
    if inspection.time.column is None and inspection.rates[0] is None:
        lines.append(f"# sample_rate = ...  # {_WHERE_TO_FILL}: Hz; no column is a clock")
    hold = '# torque_hold = "zero-order"  # inter-sample behaviour of the torque, if known'
    return [*lines, hold] if inspection.joint.kind != "quasi-static" else lines


def _time_place(inspection: Inspection) -> dict[str, Any]:
    time = inspection.time
    fraction = {} if time.fraction is None else {"fraction": dict(zip(("column", "unit"), time.fraction, strict=True))}
    return {"column": time.column, "unit": time.unit} | fraction


def _time_lines(inspection: Inspection) -> list[str]:
    time = inspection.time
    if time.column is None:
        return [f"# time: {_plain('; '.join(time.reasons))}"]
    place = _time_place(inspection)
    return [f"time = {_toml(place)}  # guess, {confidence_percent(time.confidence)}: {_plain('; '.join(time.reasons))}"]


def _open_lines(inspection: Inspection) -> list[str]:
    lines = []
    for column, shares in inspection.joint.open.items():
        lines.append(f"# {_WHERE_TO_FILL}: {_plain(repr(column))} may be {_listed(shares)}; remove the # from one line")
        unit = inspection.tables[0].column(column).unit
        place = {"column": inspection.unique(column)} | ({} if unit is None or is_counts(unit) else {"unit": unit})
        lines += [f"# {signal} = {_toml(place)}" for signal in shares]
    return lines


def _listed(shares: dict[str, float]) -> str:
    return ", ".join(f"{signal} ({confidence_percent(share)})" for signal, share in shares.items())


def _number(value: float) -> int | float:
    return int(value) if value == int(value) else float(f"{value:.6g}")


def _plain(text: str) -> str:
    """Text for a comment: names of columns may contain line ends."""
    return "".join(c if c.isprintable() else " " for c in text)


def _toml(value: Any) -> str:
    """A value in TOML notation; its strings are those of JSON."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, str):
        # JSON does not escape the delete character, TOML does.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
