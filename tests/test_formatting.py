"""Formatting of numbers: significant digits, powers of ten and relative changes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitting import formatting


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (None, "—"),
        (9.996e-4, "0.00100"),
        (9.996e-5, "1.00 × 10⁻⁴"),
        (999.6, "1000"),
        (999_999.0, "1.00 × 10⁶"),
        (-12_345.6, "−12\u202f300"),
        (0.123456, "0.123"),
    ],
)
def test_number_has_three_significant_digits(value, text):
    assert formatting.number(value) == text


@given(st.floats(1e-12, 1e12))
def test_formatted_number_reads_back_within_its_digits(value: float):
    text = formatting.number(value).replace("\u202f", "")
    mantissa, _, power = text.partition(" × 10")
    exponent = int(power.translate(str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")) or 0)
    assert float(mantissa) * 10.0**exponent == pytest.approx(value, rel=5.01e-3)
    assert not power or 1.0 <= float(mantissa) < 10.0


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.5, "50 % smaller"), (-1.55, "155 % larger"), (0.0, "0 % smaller"), (None, "— smaller")],
)
def test_risen_error_is_called_larger(share, text):
    assert formatting.smaller(share) == text
