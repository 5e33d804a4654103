"""Meaning of a column's name: quantity, side of the gear, command or measurement, joint, unit."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, cast

from fitting.logs.raw_table import split_unit
from fitting.logs.units import is_unit

Quantity = Literal[
    "time", "counter", "angle", "velocity", "torque", "current", "temperature", "twist", "input", "other"
]
Side = Literal["motor", "joint", "load"]

QUANTITY: dict[str, Quantity] = {
    "time": "time",
    "motor_angle": "angle",
    "load_angle": "angle",
    "motor_velocity": "velocity",
    "load_velocity": "velocity",
    "motor_torque": "torque",
    "motor_current": "current",
    "joint_torque": "torque",
    "load_torque": "torque",
    "temperature": "temperature",
    "dynamic_error": "twist",
    "twist": "twist",
    "forcing": "input",
}
"""Quantity of each signal."""

# Words in English and German column names, by meaning. Single letters are in `_LETTERS`.
_QUANTITY_WORDS: dict[Quantity, str] = {
    "time": """
        time timestamp stamp zeit zeitstempel sec secs seconds nsecs nanosec msec usec millis micros tout
        clock uhrzeit datetime elapsed date rosbagtimestamp
    """,
    "counter": "index idx seq sequence sample samples counter count row frame id",
    "angle": """
        angle angles ang pos position positions theta phi enc encoder encoders inc incs increments counts
        ticks winkel stellung lage resolver rotation degrees
    """,
    "velocity": """
        velocity velocities vel velo speed speeds omega geschwindigkeit drehzahl rpm dq qd dtheta dphi qdot
        thetadot phidot winkelgeschwindigkeit
    """,
    "torque": "torque torques trq tq tau effort efforts moment moments drehmoment mom trqs",
    "current": "current currents cur iq iqs strom amps ampere motorstrom",
    "temperature": "temperature temperatures temp temps temperatur",
    "twist": "twist torsion deflection windup verdrehung verdrillung dynamicerror torsionswinkel deformation",
    "input": "forcing force excitation input anregung kraft",
    "other": """
        acceleration acc accel accelerations beschleunigung ddq qdd qddot ddtheta jerk ruck voltage volt
        volts spannung power leistung status state mode flag flags pose wrench tcp quaternion fts gripper
        digital analog error errors err fehler following schleppfehler control pwm duty id checksum comment
        bit bits name energy humidity pressure dtau elbow collision contact success rate brake bremse pid
        gain kp kd ki imu gyro vibration tx ty tz rx ry rz qw qx qy qz fx fy fz mx my mz
    """,
}
_SIDE_WORDS: dict[Side, str] = {
    "motor": "motor mot mtr rotor antrieb antriebs drive wavegenerator wg inputshaft servo actuator",
    "joint": "joint gelenk axis achse jnt",
    "load": "load link output abtrieb abtriebs last arm flange flansch outputshaft lnk secondary",
}
_COMMAND_WORDS = (
    "target targets set cmd command commanded desired des ref reference setpoint soll demand goal planned ff"
)
_MEASURED_WORDS = """
    actual act measured meas msr ist fbk feedback filtered filt raw value values data average averaged
    est estimate estimated sensor sens
"""
_EXTERNAL_WORDS = "ext external extern disturbance brake bremse stoer hat"
# A single letter, also with marks, is a symbol from the literature; upper and lower case differ.
_LETTERS: dict[str, tuple[Quantity, ...]] = {
    "t": ("time",),
    "T": ("torque", "time", "temperature"),
    "q": ("angle",),
    "w": ("velocity",),
    "n": ("velocity", "counter"),
    "i": ("current",),
    "I": ("current",),
    "u": ("input", "torque"),
    "U": ("input", "other"),
    "F": ("input",),
    "x": ("twist", "other"),
    "y": ("twist", "other"),
    "M": ("torque",),
    "θ": ("angle",),
    "φ": ("angle",),
    "ϕ": ("angle",),
    "ω": ("velocity",),
    "τ": ("torque",),
    "Δ": ("twist",),
}
_LETTER_SIDES: dict[str, Side] = {"m": "motor", "M": "motor", "l": "load", "L": "load", "J": "joint", "j": "joint"}
_UNIT_WORDS = {
    "deg": "deg",
    "degs": "deg",
    "degree": "deg",
    "degrees": "deg",
    "rad": "rad",
    "mrad": "mrad",
    "urad": "urad",
    "arcmin": "arcmin",
    "arcsec": "arcsec",
    "rev": "rev",
    "revs": "rev",
    "revolutions": "rev",
    "turns": "rev",
    "rpm": "rpm",
    "rps": "rev/s",
    "nm": "N m",
    "mnm": "mN m",
    "ma": "mA",
    "amps": "A",
    "ms": "ms",
    "msec": "ms",
    "millis": "ms",
    "us": "us",
    "usec": "us",
    "micros": "us",
    "ns": "ns",
    "nsec": "ns",
    "nsecs": "ns",
    "nanosec": "ns",
    "degc": "degC",
    "celsius": "degC",
    "kelvin": "K",
    "rads": "rad/s",
    "radps": "rad/s",
    "degps": "deg/s",
    "dps": "deg/s",
    "counts": "counts",
    "ticks": "counts",
    "inc": "counts",
    "incs": "counts",
    "increments": "counts",
    "motorinc": "counts",
}
# After a quantity these state the unit: "pos_s" has none.
_TIME_SUFFIX = {"s": "s", "sec": "s", "secs": "s", "seconds": "s"}


@dataclass(frozen=True)
class NameSense:
    """Meaning of a column's name.

    Attributes:
        stem: the name without joint and unit.
        quantities: possible quantities, the most likely first; empty where the name has no known meaning.
        side: of the gear, or None.
        commanded: whether it is a command, not a measurement.
        external: whether it is an external action, or an estimate of one.
        joint: label of the robot's joint, or None.
        unit: as stated in the name, or None; "counts" where it counts increments.
    """

    stem: str
    quantities: tuple[Quantity, ...]
    side: Side | None
    commanded: bool
    external: bool
    joint: str | None
    unit: str | None


@cache
def _vocabulary() -> dict[str, tuple[str, str]]:
    """Each word with its kind and meaning."""
    words: dict[str, tuple[str, str]] = {}
    for side, listed in _SIDE_WORDS.items():
        words |= dict.fromkeys(listed.split(), ("side", side))
    for quantity, listed in _QUANTITY_WORDS.items():
        words |= dict.fromkeys(listed.split(), ("quantity", quantity))
    words |= dict.fromkeys(_COMMAND_WORDS.split(), ("role", "commanded"))
    words |= dict.fromkeys(_MEASURED_WORDS.split(), ("role", "measured"))
    return words | dict.fromkeys(_EXTERNAL_WORDS.split(), ("role", "external"))


@cache
def _long_words() -> tuple[str, ...]:
    """Words that are recognised inside compounds such as `motorinc` or `Antriebsdrehzahl`."""
    return tuple(sorted((w for w in _vocabulary() if len(w) >= 3), key=len, reverse=True))


def _tokens(name: str) -> list[str]:
    """Words and numbers of a name, split at marks, digits and capitals."""
    parts = re.findall(r"[^\W\d_]+|[0-9]+", name)
    tokens: list[str] = []
    for part in parts:
        tokens += re.findall(r"[A-ZÄÖÜ]+(?![a-zäöüß])|[A-ZÄÖÜ]?[a-zäöüß]+|[^A-Za-zÄÖÜäöüß]+", part)
    return tokens


def _compound(word: str) -> list[str]:
    """The known words of a compound; the word itself where it is none."""
    found, rest = [], word
    while rest:
        known = next((w for w in _long_words() if rest.startswith(w)), None)
        if known is None:
            # A joint of German compounds, or a plural.
            if rest == "s" or (found and rest.startswith("s") and len(rest) > 3):
                rest = rest[1:]
                continue
            return [word]
        found.append(known)
        rest = rest[len(known) :]
    return found


def _stated_unit(name: str) -> tuple[str, str | None]:
    """Name and unit of "T [N m]", "Drehzahl / rpm" or "angle in deg"."""
    name, unit = split_unit(name)
    if unit is not None:
        return name, unit
    match = re.fullmatch(r"(.+?)(?:\s+/\s*|\s*/\s+|\s+in\s+|\s*,\s+)([A-Za-zµ°%][^\s\[\]]*(?: m)?)", name)
    return (match[1], match[2]) if match else (name, None)


@cache
def sense(name: str) -> NameSense:
    """Meaning of a column's name.

    Args:
        name: as in the file.
    """
    plain, unit = _stated_unit(name)
    plain, bracketed = _bracketed(plain)
    quantities: tuple[Quantity, ...] = ()
    side: Side | None = None
    roles: set[str] = set()
    joint, suffix, stems = bracketed, "", []
    # The last part of a path states the quantity; those before it the side or joint.
    for part in reversed(re.split(r"[./]", plain)):
        label, tokens = _joint(_tokens(part)) if joint is None else (joint, _tokens(part))
        joint = joint if label is None else label
        own, own_side, own_roles, last = _read([word for token in tokens for word in _words(token)])
        # "joint" before a path's last part is a group name.
        own_side = None if own_side == "joint" and stems else own_side
        side = own_side if side is None or (side == "joint" and own_side) else side
        roles |= own_roles
        quantities, suffix = (quantities, suffix) if quantities else (own, last)
        stems.insert(0, "_".join(token.lower() for token in tokens))
    if side is not None:
        # Time and temperature belong to no side, and a column named after a side is most often its angle.
        bare: tuple[Quantity, ...] = () if side == "joint" else ("angle", "velocity", "torque")
        quantities = ("torque",) if "torque" in quantities else quantities or bare
    unit = unit or _unit_of(suffix, quantities)
    return NameSense(".".join(stems), quantities, side, "commanded" in roles, "external" in roles, joint, unit)


def _bracketed(name: str) -> tuple[str, str | None]:
    """A name such as "tau_J[3]" without its index, and the index."""
    match = re.fullmatch(r"(.*?)\s*[\[({]\s*([0-9]{1,2})\s*[\])}](.*)", name)
    return (match[1] + match[3], match[2]) if match else (name, None)


def _words(token: str) -> list[str]:
    """The words in a token: a compound's parts, a symbol and its side (`qm`)."""
    if len(token) == 2 and token[0] in "qTwnθφωτI" and token[1] in _LETTER_SIDES:
        return [token[0], token[1]]
    return [token] if len(token) < 5 or token.lower() in _vocabulary() else _compound(token.lower())


def _joint(tokens: list[str]) -> tuple[str | None, list[str]]:
    """The label of a joint, and the tokens without it: "joint 3", "A3", "J3", or a number at the end."""
    for at, token in enumerate(tokens[:-1]):
        number = tokens[at + 1]
        if number.isdigit() and token.lower() in ("joint", "axis", "achse", "gelenk", "jnt", "j", "a"):
            named = tokens[at - 1].lower() if at else ""
            whole = token.lower() in ("j", "a") and named in ("joint", "axis", "achse", "gelenk")
            return number, tokens[: at - 1 if whole else at] + tokens[at + 2 :]
    numbers = [at for at, token in enumerate(tokens) if token.isdigit()]
    if not numbers or not (last := numbers[-1]):
        return None, tokens
    return tokens[last], tokens[:last] + tokens[last + 1 :]


def _read(words: Sequence[str]) -> tuple[tuple[Quantity, ...], Side | None, set[str], str]:
    """Quantities, side, roles, and the word that could be a unit, from the words of a name."""
    quantities: tuple[Quantity, ...] = ()
    sides: list[str] = []
    roles: set[str] = set()
    for at, word in enumerate(words):
        kind, says = _vocabulary().get(word.lower(), ("", "")) if len(word) > 1 else ("", "")
        if kind == "quantity":
            quantities = _stronger(quantities, (cast(Quantity, says),))
        elif kind == "side":
            sides.append(says)
        elif kind == "role":
            roles.add(says)
        elif word in _LETTER_SIDES and quantities and quantities != ("time",):
            sides.append(_LETTER_SIDES[word])
        elif word.lower() == "dynamic" and words[at + 1 :] and words[at + 1].lower() == "error":
            return ("twist",), None, roles, words[-1]
        elif word == "d" and quantities and at == len(words) - 1:
            roles.add("commanded")
        elif word in ("d", "dot") and (at == 0 or word == "dot") and (quantities == ("angle",) or len(words) > 1):
            # d q, d theta: a rate.
            quantities = ("velocity",) if quantities in ((), ("angle",)) else ("other",)
        elif word in _LETTERS and not quantities:
            quantities = _LETTERS[word]
    # A named side takes precedence over its joint.
    side = next((s for s in sides if s != "joint"), sides[0] if sides else None)
    return quantities, cast(Side | None, side), roles, words[-1] if words else ""


def _stronger(old: tuple[Quantity, ...], new: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
    """Meaning of two words together: `encoder torque` is a torque, `dynamic error` a twist, `position error`
    neither."""
    if not old or old == new:
        return new
    if "other" in (*old, *new):
        return ("other",)
    ranks = ("counter", "input", "angle", "time", "current", "velocity", "torque", "twist", "temperature")
    return max(old, new, key=lambda q: ranks.index(q[0]))


def _unit_of(word: str, quantities: tuple[Quantity, ...]) -> str | None:
    if quantities[:1] == ("time",) and word.lower() in _TIME_SUFFIX:
        return _TIME_SUFFIX[word.lower()]
    if word == "A" and "current" in quantities:
        return "A"
    return _UNIT_WORDS.get(word.lower())


def is_likely(name: str, signal: str) -> bool:
    """Whether a column may be a signal, by its name."""
    found = sense(name)
    other_side = {"motor": "load", "load": "motor"}.get(signal.partition("_")[0])
    return (
        QUANTITY.get(signal) in found.quantities
        and not found.commanded
        and not (signal.endswith(("angle", "velocity", "torque")) and found.side == other_side)
    )


def likely_columns(signal: str, names: Iterable[str]) -> list[str]:
    """The columns of a file that may be a signal, by their names."""
    return [name for name in names if is_likely(name, signal)]


def unit_in_name(name: str, asked: str) -> str | None:
    """The unit in a column's name.

    Args:
        name: Of the column, such as "torque [N m]".
        asked: The name by which it was requested. If in full, what stands behind it may be an explanation.
    """
    unit = split_unit(name)[1]
    return None if unit is not None and name == asked and not is_unit(unit) else unit
