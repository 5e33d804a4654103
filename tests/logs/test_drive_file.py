"""Drive files: values in SI units, and one sentence for each mistake."""

from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import pytest
from log_files import one_sentence, read_drive, sixty_examples

from fitting.errors import InputError
from fitting.logs.drive_file import read_drive_file

GOOD = """
[drive]
name = "rig"
reduction_ratio = 50
motor_inertia = "5.26 g m^2"
load_inertia = "500 kg cm^2"
[signals]
torque_hold = "linear"
sample_rate = "2 kHz"
[columns]
motor_angle = { column = "a", unit = "deg", sign = -1 }
time = "t"
"""


def test_drive_file_is_read_in_si_units(tmp_path: Path) -> None:
    read = read_drive(tmp_path, GOOD)
    assert read.name == "rig" and read.reduction_ratio == 50 and read.torque_hold == "linear"
    assert read.motor_inertia == pytest.approx(5.26e-3, rel=1e-14)
    assert read.load_inertia == pytest.approx(0.05, rel=1e-14)
    assert read.sample_rate == pytest.approx(2000.0)
    place = read.columns["motor_angle"]
    assert (place.column, place.unit, place.sign) == ("a", "deg", -1.0)
    assert read.column_of("time").column == "t"
    assert read.column_of("load_angle").column == "load_angle"


def test_empty_drive_file_leaves_all_values_unset(tmp_path: Path) -> None:
    read = read_drive(tmp_path, "")
    assert read.name == "drive" and read.columns == {}
    assert read.reduction_ratio is None and read.torque_hold is None and read.sample_rate is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[drive]", "[drives]", ["'drives'", "did you mean 'drive'?"]),
        ("reduction_ratio", "reducton_ratio", ["did you mean 'reduction_ratio'?"]),
        (
            "[drive]",
            "[drive]\ntorque_constant = 0.1",
            ["'torque_constant'", "it belongs to motor_current in [columns]"],
        ),
        ("[drive]", "[drive]\nsample_rate = 1e3", ["'sample_rate'", "it belongs to [signals]"]),
        ("reduction_ratio = 50", "reduction_ratio = 0", ["reduction_ratio", "positive"]),
        ("reduction_ratio = 50", "reduction_ratio = 0.0125", ["write 80 if it is inverted"]),
        ("reduction_ratio = 50", "reduction_ratio = true", ["reduction_ratio", "True"]),
        ("reduction_ratio = 50", "reduction_ratio = nan", ["reduction_ratio"]),
        ("reduction_ratio = 50", "reduction_ratio = [50]", ["reduction_ratio"]),
        ('"5.26 g m^2"', "-1.0", ["motor_inertia", "kg m^2"]),
        ('"5.26 g m^2"', '"5.26 g m"', ["motor_inertia", "does not measure"]),
        ('"5.26 g m^2"', '"heavy"', ["motor_inertia", "not understood"]),
        ('"linear"', '"zero order"', ["torque_hold", "did you mean 'zero-order'?"]),
        ('"linear"', "1", ["torque_hold"]),
        ('"2 kHz"', "inf", ["sample_rate"]),
        ('name = "rig"', "name = 7", ["name"]),
        ("motor_angle =", "motor_angel =", ["'motor_angel'", "did you mean 'motor_angle'?"]),
        ("sign = -1", "sign = 2", ["sign", "1 or -1"]),
        ("sign = -1", "sgn = -1", ["'sgn'", "did you mean 'sign'?"]),
        ('unit = "deg"', "unit = 3", ["unit", "string"]),
        ('column = "a"', "column = 0", ["column", "number from 1 on"]),
        ('column = "a"', "column = 3.5", ["column", "string"]),
        ('time = "t"', "time = -3", ["time", "number from 1 on"]),
        ("[columns]", "[columns", ["TOML"]),
        ("[drive]", "signals = 3\n[drive]", ["TOML"]),
        ("[signals]", "[other]", ["'other'"]),
    ],
)
def test_mistake_in_a_drive_file_is_refused_in_one_sentence(
    tmp_path: Path, old: str, new: str, words: list[str]
) -> None:
    assert old in GOOD
    with pytest.raises(InputError) as error:
        read_drive(tmp_path, GOOD.replace(old, new))
    one_sentence(error, "drive.toml", *words)


def test_table_of_a_drive_file_given_as_a_number_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        read_drive(tmp_path, "drive = 3")
    one_sentence(error, "[drive]")


def test_missing_drive_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        read_drive_file(tmp_path / "no.toml")
    one_sentence(error, "no.toml", "--drive")
    with pytest.raises(InputError):
        read_drive_file(tmp_path)


@sixty_examples
@hypothesis.given(raw=st.binary(max_size=100) | st.text(max_size=100).map(str.encode))
def test_arbitrary_bytes_as_drive_file_are_read_or_refused_in_one_line(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "drive.toml"
    path.write_bytes(raw)
    try:
        read_drive_file(path)
    except InputError as error:
        assert "\n" not in str(error)
