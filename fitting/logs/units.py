"""Conversion of unit strings to SI: common ones by a table, all others by pint."""

import math
import re
from functools import cache
from typing import Any

import numpy as np

# Names of coherent SI units, where pint would write kg m^2/(A s^3).
_SHOWN = ("V", "N", "N m", "Pa", "W", "ohm", "T", "C")
# Units in logs that pint does not know or misinterprets.
_SPELLINGS = {
    "-": "1",
    "sec": "s",
    "secs": "s",
    "msec": "ms",
    "usec": "us",
    "nsec": "ns",
    "deg.": "deg",
    "1/min": "rpm",
    "min-1": "rpm",
    "min^-1": "rpm",
    "U/min": "rpm",
    "r/min": "rpm",
    "rev/min": "rpm",
    "NM": "N m",
    "amps": "A",
}
# Coherent SI unit and factor of common units, since importing pint takes as long as jax.
USUAL: dict[str, tuple[str, float]] = {
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "rad": ("rad", 1.0),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", math.pi / 180.0),
    "arcmin": ("rad", math.pi / 180.0 / 60.0),
    "arcsec": ("rad", math.pi / 180.0 / 3600.0),
    "rev": ("rad", 2.0 * math.pi),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "rpm": ("rad/s", math.pi / 30.0),
    "N m": ("N m", 1.0),
    "Nm": ("N m", 1.0),
    "mN m": ("N m", 1e-3),
    "mNm": ("N m", 1e-3),
    "kg m^2": ("kg m^2", 1.0),
    "g m^2": ("kg m^2", 1e-3),
    "kg cm^2": ("kg m^2", 1e-4),
    "g cm^2": ("kg m^2", 1e-7),
}
# A unit, perhaps with a number before it and a number of counts below it: 5.26 g m^2, rev / 65536, rev / 2^17.
_PRODUCT = re.compile(
    r"(?P<number>[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]{1,2})?)?\s*(?P<unit>.*?)"
    r"(?:\s*/\s*(?P<counts>[0-9]{1,15})(?:(?:\^|\*\*)(?P<power>[0-9]{1,2}))?)?"
)
# Newton metre in one word or with marks; pint takes "Nm" for the textile unit number_meter, and a hyphen for a minus.
_NEWTON_METRE = re.compile(r"\b([nµμumkM]?)(?:N|newtons?)(?:\s?[-.·⋅]\s?)?([cmk]?)(?:m|met(?:er|re)s?)\b")
# Pounds and ounces beside a length are those of force.
_POUND_LENGTH = re.compile(r"(in|ft)[-. ·]?(lb|oz)f?s?|(lb|oz)f?s?[-. ·]?(in|ft)", re.IGNORECASE)
_LONGEST = 80
_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


class UnitError(ValueError):
    """A unit string that is not understood or of the wrong quantity."""


@cache
def _pint() -> Any:
    """pint, imported on demand: with its units it takes as long as a fit."""
    import pint

    return pint


@cache
def _registry() -> Any:
    registry = _pint().UnitRegistry()
    registry.define("@alias revolution = rev")
    return registry


def _usual(text: str) -> tuple[str, float] | None:
    """SI unit and factor of a common unit string, or None."""
    spelled = _SPELLINGS.get(text.strip(), text.strip())
    if spelled in USUAL:
        return USUAL[spelled]
    found = _PRODUCT.fullmatch(spelled) if len(spelled) <= _LONGEST else None
    if found is None or found["unit"] not in USUAL:
        return None
    target, factor = USUAL[found["unit"]]
    factor *= float(found["number"] or 1.0)
    counts = int(found["counts"] or 1) ** int(found["power"] or 1)
    # pint refuses zero and infinite factors.
    return (target, factor / counts) if factor and 0 < counts < 1e15 else None


def _parse(text: str) -> Any:
    """The pint quantity of one unit, e.g. 1/16777216 revolution."""
    spelled = re.sub(r"[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda m: "^" + m[0].translate(_RAISED), text.strip())
    spelled = _SPELLINGS.get(spelled, spelled)
    if len(text) > _LONGEST or _is_tower(spelled):
        raise UnitError(f"unit {text[:_LONGEST]!r} is not understood")
    spelled = re.sub(r"°(?![CFK])", "deg", spelled)
    spelled = re.sub(r"\b[Dd]eg(?:rees?|\.)?\s*C\b", "degC", spelled)
    spelled = _NEWTON_METRE.sub(r"\1N \2m", spelled) or "1"
    pounds = _POUND_LENGTH.fullmatch(spelled)
    if pounds is not None:
        spelled = f"force_{'ounce' if 'oz' in spelled.lower() else 'pound'} {(pounds[1] or pounds[4]).lower()}"
    try:
        quantity = _registry().Quantity(spelled)
        finite = bool(np.isfinite(float(quantity.magnitude)))
    except Exception as error:
        # pint raises tokenizer, syntax, arithmetic and attribute errors for malformed strings.
        raise UnitError(f"unit {text!r} is not understood") from error
    if not finite or quantity.magnitude == 0:
        raise UnitError(f"unit {text!r} is not a finite number other than zero")
    return quantity


def _is_tower(text: str) -> bool:
    """Whether a text has nested powers such as 9**9**9, which pint would evaluate."""
    powers = re.findall(r"(?:\*\*|\^)", text)
    # Counts per revolution may be 2**24; other powers have one digit.
    plain = re.sub(
        r"\b[0-9]{1,2}\s*(?:\*\*|\^)\s*[0-9]{1,2}(?![0-9.])|(?:\*\*|\^)\s*\(?[-+]?[0-9](?:\.[0-9]{1,2})?(?![0-9.])",
        " ",
        text,
    )
    chained = re.search(r"(?:\*\*|\^)[\s(+-]*[0-9.]+[\s)]*(?:\*\*|\^)", text)
    return len(powers) > 4 or bool(re.search(r"\*\*|\^", plain)) or bool(chained)


def _base_powers(quantity: Any) -> dict[str, float]:
    """Exponents of the base units, radian included, counts left out."""
    units = _registry().get_base_units(quantity.units)[1]
    return {str(n): float(p) for n, p in units._units.items() if n != "count"}


def _spelled(text: str, target: str | None = None) -> Any:
    """The pint quantity of a unit, of what a target measures if one is given; in small letters where it is none as
    written: "Degrees", "RPM"."""
    errors = []
    for spelled in dict.fromkeys((text, text.lower())):
        try:
            quantity = _parse(spelled)
        except UnitError as error:
            errors.append(error)
            continue
        if target is None or _base_powers(quantity) == _base_powers(_parse(target)):
            return quantity
        errors.append(UnitError(f"unit {text!r} does not measure what {target!r} does"))
    raise errors[0]


def convert(values: np.ndarray, unit: str, target: str) -> np.ndarray:
    """Values in `target` units.

    Args:
        values: Numbers in `unit`, any shape.
        unit: Unit of the numbers, e.g. "rev / 16777216", "mN m", "degC".
        target: Wanted unit, e.g. "rad".

    Returns:
        Numbers in `target`, float64, same shape.

    Raises:
        UnitError: `unit` is not understood, or does not measure what `target` measures. Unlike
            pint's own conversion, a bare number or a count is not taken for an angle.
    """
    if unit == target:
        return np.array(values, dtype=np.float64)
    usual = _usual(unit)
    if usual is not None and usual[0] == target:
        return np.asarray(usual[1] * np.asarray(values, dtype=np.float64))
    quantity, wanted = _spelled(unit, target), _parse(target)
    try:
        scaled = np.asarray(values, dtype=np.float64) * float(quantity.magnitude)
        return np.asarray(_registry().Quantity(scaled, quantity.units).m_as(wanted.units))
    except (_pint().PintError, ArithmeticError) as error:
        raise UnitError(f"unit {unit!r} does not convert to {target!r}") from error


def is_unit(text: str) -> bool:
    """Whether a text is the name of a unit."""
    try:
        to_base(np.array(1.0), text)
    except UnitError:
        return False
    return True


def to_base(values: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """Values in coherent SI units, and that unit's name.

    Args:
        values: Numbers in `unit`, any shape.
        unit: Unit of the numbers.

    Returns:
        Numbers in the coherent SI unit, and its name, e.g. "V", "rad/s^2", "1".

    Raises:
        UnitError: `unit` is not understood.
    """
    usual = _usual(unit)
    if usual is not None:
        return np.asarray(usual[1] * np.asarray(values, dtype=np.float64)), usual[0]
    quantity = _spelled(unit)
    registry = _registry()
    base = registry.get_base_units(quantity.units)[1]
    scaled = np.asarray(values, dtype=np.float64) * float(quantity.magnitude)
    try:
        converted = np.asarray(registry.Quantity(scaled, quantity.units).m_as(base))
    except (_pint().PintError, ArithmeticError) as error:
        raise UnitError(f"unit {unit!r} does not convert to SI base units") from error
    for shown in _SHOWN:
        if registry.get_base_units(registry.Unit(shown))[1] == base:
            return converted, shown
    name = f"{base:~D}".replace(" ** ", "^").replace(" / ", "/").replace(" * ", " ")
    return converted, name or "1"


def parse_number(text: str, target: str) -> float:
    """One physical number with its unit, e.g. "5.26 g m^2", in `target` units.

    Args:
        text: Number and unit.
        target: Wanted unit, e.g. "kg m^2"; "1" for a pure number.

    Returns:
        The number in `target`.

    Raises:
        UnitError: The text is not understood or measures something else.
    """
    return float(convert(np.array(1.0), text, target))
