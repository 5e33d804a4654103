"""Units as commonly written: the table of common units against pint, and expressions with factors."""

import subprocess
import sys

import numpy as np
import pint
import pytest

from fitting.logs.units import USUAL, UnitError, convert, parse_number, to_base


@pytest.fixture(scope="module")
def registry() -> pint.UnitRegistry:
    return pint.UnitRegistry()


# pint reads these two spellings as other units.
@pytest.mark.parametrize("unit", [u for u in USUAL if u not in ("Nm", "mNm")])
def test_common_units_agree_with_pint(unit: str, registry: pint.UnitRegistry):
    target, factor = USUAL[unit]
    assert factor == pytest.approx(float(registry.Quantity(1.0, unit.replace("rev", "turn")).m_as(target)), rel=1e-15)
    values = np.array([-1.5, 0.0, 2.0])
    np.testing.assert_allclose(convert(values, unit, target), factor * values, rtol=1e-15)
    # With a factor the expression is not in the table, so that pint converts it.
    slow, name = to_base(values, f"1 * ({unit})")
    quick, quick_name = to_base(values, unit)
    assert quick_name == name == target
    np.testing.assert_allclose(quick, slow, rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "target", "value"),
    [
        ("5.26 g m^2", "kg m^2", 5.26e-3),
        ("5.26e-4 kg m^2", "kg m^2", 5.26e-4),
        ("-3deg", "rad", -np.pi / 60.0),
        ("rev / 65536", "rad", 2.0 * np.pi / 65536),
        ("rev/2^17", "rad", 2.0 * np.pi / 2**17),
        ("rev / 2**17", "rad", 2.0 * np.pi / 2**17),
        ("1/16777216 revolution", "rad", 2.0 * np.pi / 16777216),
        ("1/min", "rad/s", np.pi / 30.0),
        ("5 rad / 100", "rad", 0.05),
        ("mNm", "N m", 1e-3),
        ("10 N cm", "N m", 0.1),
        ("Degrees", "rad", np.pi / 180.0),
        ("RPM", "rad/s", np.pi / 30.0),
        ("min⁻¹", "rad/s", np.pi / 30.0),
        ("Sec", "s", 1.0),
        ("MS", "s", 1e-3),
        ("Deg C", "K", 274.15),
        ("Amps", "A", 1.0),
        ("NM", "N m", 1.0),
        ("Newton-meters", "N m", 1.0),
        ("N.m", "N m", 1.0),
        ("Ncm", "N m", 0.01),
        # Pound and ounce of force: 0.45359237 kg and a sixteenth of it, at 9.80665 m/s^2.
        ("in-lb", "N m", 0.0254 * 0.45359237 * 9.80665),
        ("ft lbs", "N m", 0.3048 * 0.45359237 * 9.80665),
        ("oz-in", "N m", 0.0254 * 0.45359237 / 16 * 9.80665),
        ("lb in^2", "kg m^2", 0.45359237 * 0.0254**2),
    ],
)
def test_number_with_unit_is_converted(text: str, target: str, value: float):
    assert parse_number(text, target) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    "text", ["0 deg", "rev / 0", "N m / deg", "Nm / 2 / 3 furlong", "5 kg m^2", "deg deg", "1e999 rad"]
)
def test_unit_that_is_not_an_angle_is_refused(text: str):
    with pytest.raises(UnitError):
        convert(np.ones(2), text, "rad")


def test_common_units_do_not_import_pint():
    program = (
        "import sys, numpy\n"
        "from fitting.logs.units import convert, to_base\n"
        "convert(numpy.ones(2), 'rev / 2^17', 'rad'), convert(numpy.ones(2), 'ms', 's')\n"
        "to_base(numpy.ones(2), 'deg')\n"
        "assert 'pint' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
