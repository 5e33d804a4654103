"""Formatting of numbers and units: significant digits, prefixes, superscripts."""

import math
import re
from collections.abc import Sequence
from typing import Literal

Place = Literal["drive", "mesh", "actuator"]
Ends = Sequence[float | None]
"""Lower and upper end of an interval; None for an open end."""

_MINUS, _NARROW = "\N{MINUS SIGN}", "\N{NARROW NO-BREAK SPACE}"
_SUPERSCRIPT = str.maketrans("0123456789-n", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻ⁿ")
_LEAST_CHANCE = 1e-9
# Units that take a prefix; `m(N m/rad)` would be unclear.
_PREFIXED = ("rad", "rad/s", "s", "m", "m/s", "V", "V/s", "A", "N", "N m", "Hz")
_PREFIXES = {0: "", -3: "m", -6: "µ", -9: "n", -12: "p"}


def pretty_unit(unit: str) -> str:
    """A unit with superscripts; empty for a pure number."""
    return "" if unit == "1" else superscripts(unit)


def superscripts(text: str) -> str:
    """Text with integer powers as superscripts."""
    return re.sub(r"\^(-?[0-9n]+)(?![0-9.])", lambda m: m.group(1).translate(_SUPERSCRIPT), text)


def scaled_unit(magnitude: float, unit: str) -> tuple[float, str]:
    """The factor and prefixed unit for numbers of about this magnitude.

    Args:
        magnitude: a typical or the largest absolute value, in `unit`.
        unit: SI unit.

    Returns:
        The factor, and the resulting unit: `(1e6, "µrad")` for 3e-5 rad.
    """
    if unit not in _PREFIXED or not math.isfinite(magnitude) or magnitude <= 0:
        return 1.0, pretty_unit(unit)
    power = int(min(max(3 * math.floor(math.log10(magnitude) / 3), -12), 0))
    return 10.0**-power, _PREFIXES[power] + pretty_unit(unit)


def axis_label(name: str, unit: str) -> str:
    """An axis label, with the unit in brackets if any."""
    return f"{name} [{unit}]" if unit else name


def number(value: float | None, digits: int = 3) -> str:
    """A number to so many significant digits; an em dash for None."""
    if value is None or not math.isfinite(value):
        return "—"
    if value == 0:
        return "0"
    # After rounding: 9.996e-4 is 0.00100, not 10.00 x 10^-4.
    power = int(f"{value:.{digits - 1}e}".partition("e")[2])
    if -4 < power < 6:
        return _fixed(value, digits - 1 - power)
    return f"{_fixed(value / 10.0**power, digits - 1)} × 10{_superscript(power)}"


def plain(value: float | None, digits: int = 4) -> str:
    """A number in ASCII; n/a for None."""
    return "n/a" if value is None else f"{value:.{digits}g}"


def quantity(value: float | None, unit: str, *, digits: int = 3, like: float | None = None) -> str:
    """A number with its unit, prefixed if suitable: `quantity(1.05e-6, "rad")` is "1.05 µrad".

    Args:
        value: in `unit`; None if unknown.
        unit: SI unit.
        digits: significant digits.
        like: a number for comparison, which determines the prefix.
    """
    if value is None or not math.isfinite(value):
        return "—"
    factor, shown = scaled_unit(abs(value if like is None else like), unit)
    return f"{number(factor * value, digits)} {shown}".strip()


def measured(value: float | None, std: float | None, unit: str) -> str:
    """A value with its standard error, both to the digits justified by the error: "17 432 ± 12 N m/rad"."""
    if std is None or not math.isfinite(std) or std <= 0:
        return quantity(value, unit, digits=4)
    return _together((value,), std, unit, "{0} ± {1}")


def interval(ends: Ends, std: float | None, unit: str) -> str:
    """An interval, to the digits justified by the standard error."""
    if std is None or not math.isfinite(std) or std <= 0:
        return f"{quantity(ends[0], unit)} to {quantity(ends[1], unit)}"
    return _span(ends, std, unit)


def in_factor(value: float | None, std: float | None, factor: float) -> str:
    """[`measured`][] for a column whose header states the unit: "17 432 ± 12" in units of `1 / factor`."""
    if value is None or not math.isfinite(value):
        return "—"
    if std is None or not math.isfinite(std) or std <= 0:
        return number(factor * value, 4)
    return _together((value,), std, "1", "{0} ± {1}", factor)


def interval_in_factor(ends: Ends, std: float | None, factor: float) -> str:
    """[`interval`][] for a column whose header states the unit."""
    if std is None or not math.isfinite(std) or std <= 0:
        return "—"
    return _span(ends, std, "1", factor)


def _span(ends: Ends, std: float, unit: str, factor: float | None = None) -> str:
    known = [e for e in ends if e is not None]
    return _together(known, std, unit, open_interval(ends), factor) if known else open_interval(ends)


def open_interval(ends: Ends) -> str:
    """A pattern for the known ends of an interval: "{0} to {1}", or a statement of the open end."""
    low, high = (e is not None for e in ends)
    if low and high:
        return "{0} to {1}"
    return "above {0}" if low else "below {0}" if high else "unbounded"


def value_in_factor(value: float | None, std: float | None, factor: float) -> str:
    """A value without error for such a column, to the digits justified by the standard error."""
    if value is None or std is None or not math.isfinite(std) or std <= 0:
        return number(None if value is None else factor * value, 4)
    return _together((value,), std, "1", "{0}", factor)


def percent(share: float | None) -> str:
    """A share as a percentage, without rounding 99.96 up to 100."""
    if share is None or not math.isfinite(share):
        return "—"
    value = 100.0 * share
    if 99.0 < value < 100.0:
        # Enough decimals to show a digit other than nine.
        decimals = min(max(math.ceil(-math.log10(100.0 - value)), 0), 4)
        value = math.floor(value * 10**decimals) / 10**decimals
        return f"{_fixed(value, decimals)} %"
    return f"{number(value, 2) if abs(value) < 99.5 else number(value, 3)} %"


def smaller(share: float | None) -> str:
    """Comparison of an error that is smaller by a share."""
    if share is not None and share < 0:
        return f"{percent(-share)} larger"
    return f"{percent(share)} smaller"


def p_value(chance: float | None) -> str:
    """A p-value; below a billionth only that bound."""
    if chance is not None and chance < _LEAST_CHANCE:
        return "< 1e-9"
    return plain(chance, 2)


def words(names: list[str]) -> str:
    """Names as a list in prose."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def in_log_units(unit: str, *, response: str, forcing: str, place: Place = "mesh") -> str:
    """The unit of a parameter of a reduced drive, whose response and forcing have arbitrary units.

    Args:
        unit: in the parameter's metadata, in SI or with `[x]` and `[u]`.
        response: unit of the dynamic error.
        forcing: unit of the forcing.
        place: where it acts. In the mesh a twist corresponds to the response and a torque to its acceleration; at the
            actuator a torque corresponds to the forcing; a radian of the drive is an angle.
    """
    if "^-n" in unit:
        return unit.replace("rad", response)
    powers = _powers(unit)
    torque = powers.get("N", 0)
    for name in ("N", "m"):
        if torque:
            powers[name] = powers.get(name, 0) - torque
    twist = "rad" if place == "drive" else response
    replaced: dict[str, int] = {}
    for name, power in powers.items():
        inner = _powers({"rad": twist, "[x]": response, "[u]": forcing}.get(name, name))
        _multiply(replaced, inner, power)
    mesh = {"s": -2}
    _multiply(mesh, _powers(response), 1)
    _multiply(replaced, _powers(forcing) if place == "actuator" else mesh, torque)
    return _spell(replaced)


def in_log_words(sentence: str, *, response: str, forcing: str) -> str:
    """A sentence about a reduced drive, with the log's units in place of `[x]` and `[u]`."""
    for symbol, unit in (("[x]", response), ("[u]", forcing)):
        sentence = sentence.replace(symbol, f"({unit})" if re.search(r"[ /^]", unit) else unit)
    return sentence


def _powers(unit: str) -> dict[str, int]:
    """Exponents of `N m s^2/rad^2` or `[x]/s^2/[u]`."""
    found: dict[str, int] = {}
    for i, part in enumerate(unit.replace("(", "").replace(")", "").split("/")):
        for factor in part.split():
            name, _, power = factor.partition("^")
            if name != "1":
                _multiply(found, {name: int(power or 1)}, -1 if i else 1)
    return found


def _multiply(into: dict[str, int], powers: dict[str, int], exponent: int) -> None:
    for name, power in powers.items():
        into[name] = into.get(name, 0) + exponent * power


def _spell(powers: dict[str, int]) -> str:
    above = [n if p == 1 else f"{n}^{p}" for n, p in powers.items() if p > 0]
    below = [n if p == -1 else f"{n}^{-p}" for n, p in powers.items() if p < 0]
    if not below:
        return " ".join(above) or "1"
    divisor = below[0] if len(below) == 1 else f"({' '.join(below)})"
    return f"{' '.join(above) or '1'}/{divisor}"


def _fixed(value: float, decimals: int) -> str:
    """Fixed point with a typographic minus sign and grouped thousands."""
    rounded = round(value, decimals)
    text = f"{rounded:,.{max(decimals, 0)}f}"
    if abs(rounded) < 10_000:
        text = text.replace(",", "")
    return text.replace(",", _NARROW).replace("-", _MINUS)


def _superscript(power: int) -> str:
    return str(power).translate(_SUPERSCRIPT)


def _together(values: Sequence[float | None], std: float, unit: str, pattern: str, factor: float | None = None) -> str:
    """Values and their standard error with one power of ten and one unit."""
    known = [abs(v) for v in values if v is not None and math.isfinite(v)]
    largest = max([*known, std])
    suited, shown = scaled_unit(largest, unit)
    factor = suited if factor is None else factor
    power = math.floor(math.log10(largest * factor))
    if -4 < power < 6:
        power = 0
    factor *= 10.0**-power
    decimals = min(max(1 - math.floor(math.log10(std * factor)), 0), 12)
    if len(known) < len(values):
        return "—"
    numbers = [_fixed(v * factor, decimals) for v in (*values, std) if v is not None]
    text = pattern.format(*numbers)
    if power:
        return f"({text}) × 10{_superscript(power)} {shown}".strip()
    return f"{text} {shown}".strip()
