"""Text files: delimiters, decimal signs, encodings, headers, units, dates and invalid cells."""

from pathlib import Path

import numpy as np
import pytest

from fitting.errors import InputError
from fitting.logs.plain_numbers import plain_columns
from fitting.logs.raw_table import RawTable, split_unit
from fitting.logs.text import read_text
from fitting.logs.text_cells import cells, column_from_text
from fitting.logs.units import convert

TIME = [0.0, 0.5, 1.0, 1.5]
A = [1.5, -2.25, 3.0, 1e-3]


def read(text: str | bytes, encoding: str = "utf-8", wanted: tuple[str, ...] = ("time", "a")) -> RawTable:
    return read_text(Path("log.csv"), text if isinstance(text, bytes) else text.encode(encoding), wanted)


def table(
    delimiter: str, *, decimal: str = ".", quote: str = "", end: str = "\n", head: str = "", tail: str = ""
) -> str:
    rows = [("time", "a", "b"), *((repr(t), repr(a), "7") for t, a in zip(TIME, A, strict=True))]
    cells = [[quote + (c.replace(".", decimal) if i else c) + quote for c in row] for i, row in enumerate(rows)]
    return head + end.join(delimiter.join(row) + tail for row in cells) + end


def pd_text() -> str:
    """A table as pandas prints it."""
    lines = ["    time       a", *(f"{i:3} {t:5} {a:8}" for i, (t, a) in enumerate(zip(TIME, A, strict=True)))]
    return "\n".join(lines) + "\n"


DIALECTS: dict[str, str | bytes] = {
    "comma": table(","),
    "semicolon": table(";"),
    "tab": table("\t"),
    "pipe": table("|"),
    "blanks": table("   "),
    "quoted, between blanks": table("  ", quote='"'),
    "row names of R": '"time" "a"\n'
    + "".join(f'"{i}" {t} {a}\n' for i, (t, a) in enumerate(zip(TIME, A, strict=True))),
    "row names of R, between commas": "time,a\n"
    + "".join(f"{i},{t},{a}\n" for i, (t, a) in enumerate(zip(TIME, A, strict=True))),
    "row names and units": "time;a\ns;N m\n"
    + "".join(f"{i};{t};{a}\n" for i, (t, a) in enumerate(zip(TIME, A, strict=True))),
    "index of pandas": pd_text(),
    "delimiters at the ends of rows alone": table(",", tail=",").replace("b,", "b", 1),
    "flags": "time,a,on,homed,fault\n" + "".join(f"{t},{a},True,FALSE,true\n" for t, a in zip(TIME, A, strict=True)),
    "decimal comma": table(";", decimal=","),
    "decimal comma and tabs": table("\t", decimal=","),
    "decimal comma and blanks": table(" ", decimal=","),
    "quoted": table(",", quote='"'),
    "quoted decimal comma": table(",", quote='"', decimal=","),
    "trailing delimiter": table(",", tail=","),
    "trailing semicolon": table(";", decimal=",", tail=";"),
    "blank after delimiter": table(", "),
    "Windows": table(",", end="\r\n"),
    "old Mac": table(",", end="\r"),
    "blank lines": table(",", end="\n\n"),
    "BOM": table(",").encode("utf-8-sig"),
    "UTF-16": table(";", decimal=",").encode("utf-16"),
    "UTF-16 without BOM": table(",").encode("utf-16-le"),
    "UTF-16 without BOM, high bytes first": table(",").encode("utf-16-be"),
    "Latin-1": table(",", head="# Prüfstand, 20 °C\n").encode("latin-1"),
    "comments": table(",", head="# rig\n# second line, with comma\n\n"),
    "preamble": table(";", head="Export of rig 7\nDate;21.11.2026 10:00\nOperator: N. N.\n\nRate;2 kHz\n"),
    "preamble with numbers": table(",", head="Serial 4711\nGain,5\nrig, no. 3\n"),
    "unit row": table(",").replace("b\n", "b\ns,N m,rad\n", 1),
    "bracketed unit row": table(";").replace("b\n", "b\n[s];[N m];[rad]\n", 1),
    "units in the header": table(",").replace("time,a", "time [s],a (N m)"),
    "commented header": "# " + table(","),
    "MATLAB's comment": "% " + table(","),
    "comment inside": table(",").replace("1.0,", "# paused\n1.0,", 1),
    "zeros behind the end": table(",").encode() + bytes(200),
    "stray quote": table(",").replace(",7\n", ',"\n', 1),
    "plus and exponents": "time,a\n+0,1.5E0\n5D-1,-2.25\n1.0e+00,3\n1.5,1d-3\n",
    "typeset": "time;a\n0,0;1,5\n0,5;\u22122,25\n1,0;3,0\n1,5;0,001\n",
}


@pytest.mark.parametrize("text", DIALECTS.values(), ids=DIALECTS.keys())
def test_every_text_dialect_gives_the_same_columns(text: str | bytes):
    found = read(text)
    np.testing.assert_array_equal(found.columns["time"].values, TIME)
    np.testing.assert_array_equal(found.columns["a"].values, A)
    assert len(found.columns["a"].text_rows) == 0


@pytest.mark.parametrize("name", ["unit row", "bracketed unit row", "units in the header"])
def test_units_of_text_columns_are_read(name: str):
    found = read(DIALECTS[name])
    assert (found.columns["time"].unit, found.columns["a"].unit) == ("s", "N m")


def test_units_that_were_encoded_twice_are_read():
    found = read("time [s];a (NÂ·m);b (Â°)\n0;1;2\n1;2;3\n".encode())
    assert found.columns["a"].unit == "N·m"


@pytest.mark.parametrize("wanted", [(), ("a",)])
def test_decimal_commas_between_commas_are_refused(wanted: tuple[str, ...]):
    with pytest.raises(InputError, match="semicolons between cells"):
        read_text(Path("log.csv"), b"time,a\n" + b"0,5,1,25\n" * 9, wanted)


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["1.234,5", "12,25"], [1234.5, 12.25]),
        (["1,234.5", "12.25"], [1234.5, 12.25]),
        (["1.234.567", "2.000"], [1234567, 2000]),
        (["1'234.5", "12.25"], [1234.5, 12.25]),
        (["1 234,5", "12,25"], [1234.5, 12.25]),
        # Where semicolons separate the cells, one comma before three digits is a decimal comma.
        (["1,234", "12,345"], [1.234, 12.345]),
    ],
)
def test_thousands_separators_are_read(cells: list[str], expected: list[float]):
    found = read("time;a\n" + "".join(f"{i};{c}\n" for i, c in enumerate(cells)))
    np.testing.assert_allclose(found.columns["a"].values, expected, rtol=1e-15)


def test_quoted_thousands_separators_are_read():
    found = read('time,a\n0,"1,234"\n1,"12,345,678"\n')
    np.testing.assert_array_equal(found.columns["a"].values, [1234, 12345678])


def test_quoted_decimals_of_three_digits_are_no_thousands():
    found = read('time,a\n"0,001","0,168"\n"0,002","-0,250"\n')
    np.testing.assert_array_equal(found.columns["a"].values, [0.168, -0.25])


def test_torn_cell_keeps_the_decimal_points_of_its_column():
    column = read("time;a\n0;0.1682942\n1;0.0120.013\n2;0.25\n").columns["a"]
    np.testing.assert_array_equal(column.values, [0.1682942, np.nan, 0.25])
    np.testing.assert_array_equal(column.text_rows, [1])


def test_column_named_with_its_unit_has_that_unit():
    found = read("time [ms];a [deg]\n0;1\n1;2\n", wanted=("time [ms]", "a [deg]"))
    assert [column.unit for column in found.columns.values()] == ["ms", "deg"]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("2026-11-21T23:59:59.750", "2026-11-22T00:00:00.250"),
        ("2026-11-21 23:59:59.75Z", "2026-11-22 00:00:00.25Z"),
        ("2026-11-21T23:59:59,75+01:00", "2026-11-22T00:00:00,25+01:00"),
        ("21.11.2026 23:59:59.75", "22.11.2026 00:00:00.25"),
        ("23:59:59.75", "00:00:00.25"),
        ("20261121_23:59:59.75", "20261122_00:00:00.25"),
        ("11/21/2026 11:59:59.75 PM", "11/22/2026 12:00:00.25 AM"),
        ("21/11/2026 11:59:59.75 AM", "21/11/2026 12:00:00.25 PM"),
        ("21-Nov-2026 23:59:59.75", "22-Nov-2026 00:00:00.25"),
        ("Nov 21, 2026 23:59:59.75", "Nov 22, 2026 00:00:00.25"),
    ],
)
def test_dates_and_times_of_day_become_seconds(first: str, second: str):
    column = read(f"time;a\n{first};1,5\n{second};2,5\n").columns["time"]
    assert column.unit == "s"
    # 2026 is 1.8e9 s from 1970, where doubles lie 0.24 us apart.
    np.testing.assert_allclose(np.diff(column.values), 0.5, atol=1e-6)


@pytest.mark.parametrize("stamp", ["2024-05-01 10:00:{:06.3f}", "10:00:{:06.3f}"])
def test_torn_stamp_is_one_invalid_cell(stamp: str):
    stamps = [stamp.format(0.5 * i) for i in range(60)]
    stamps[30] = stamps[30][:-11]
    column = read("time;a\n" + "".join(f"{cell};1\n" for cell in stamps)).columns["time"]
    np.testing.assert_array_equal(column.text_rows, [30])
    np.testing.assert_allclose(np.diff(column.values)[:29], 0.5, atol=1e-6)
    assert column.values[31] - column.values[29] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    "cells",
    [
        ("0.25 sec", "0.75 sec"),
        ("250 ms", "750 ms"),
        ("250ms", "750ms"),
        ("999.75 ms", "1.49975 s"),
        ("00:00:01.250", "00:00:01.750"),
        ("00:01.250", "00:01.750"),
        ("1:00:01.250", "1:00:01.750"),
        ("100:00:01.250", "100:00:01.750"),
        ("0 days 00:00:01.250000", "0 days 00:00:01.750000"),
        ("1 day, 23:59:59.750", "2 days, 0:00:00.250"),
    ],
)
def test_durations_as_text_are_read(cells: tuple[str, str]):
    column = read(f'time;a\n"{cells[0]}";1\n"{cells[1]}";2\n').columns["time"]
    assert column.unit is not None and len(column.text_rows) == 0
    np.testing.assert_allclose(np.diff(convert(column.values, column.unit, "s")), 0.5, rtol=1e-12)


def test_numbers_with_a_unit_in_each_cell_are_read():
    column = read("time;a\n0;1.5 N m\n1;250 mN m\n2;overload\n3;-0,5 N m\n".replace("1.5", "1,5")).columns["a"]
    assert column.unit == "N m" and column.text == "overload"
    np.testing.assert_allclose(column.values, [1.5, 0.25, np.nan, -0.5])
    np.testing.assert_array_equal(column.text_rows, [2])


def test_columns_are_selected_by_number():
    rows = "0,1.5,7\n0.5,-2.25,7\n"
    for head in ("", "# no names here\n", "time,a,b\n"):
        found = read(head + rows, wanted=("column 1", "column 2", "column 9"))
        assert set(found.columns) == {"column 1", "column 2"}
        np.testing.assert_array_equal(found.columns["column 2"].values, [1.5, -2.25])
    assert read(rows, wanted=()).names == ("column 1", "column 2", "column 3")


def test_repeated_column_names_are_numbered():
    found = read("time [s],a,time [ms],a\n0,1,2,3\n1,2,3,4\n", wanted=("time", "time (2)", "a (2)", "column 4"))
    assert found.names == ("time [s]", "a", "time (2) [ms]", "a (2)") and found.repeated == {"time", "a"}
    assert (found.columns["time"].unit, found.columns["time (2)"].unit) == ("s", "ms")
    for name in ("a (2)", "column 4"):
        np.testing.assert_array_equal(found.columns[name].values, [3, 4])


@pytest.mark.parametrize("above", ["Samples\t9\t9\nDelta\t1\t1\n***\t\n", "x\t1\t2\n", ""])
def test_numeric_lines_above_the_header_are_skipped(above: str):
    found = read(above + "time\ta\tb\tComment\n0\t1,5\t7\n1\t2,5\t7\tstart\n2\t3,5\t7\n")
    np.testing.assert_array_equal(found.columns["a"].values, [1.5, 2.5, 3.5])
    np.testing.assert_array_equal(found.columns["time"].values, [0, 1, 2])


def test_invalid_row_does_not_discard_the_rows_above():
    found = read("time,a\n0,1\n1,2\n,overload\n3,4\n4,5\n5,6\n")
    np.testing.assert_array_equal(found.columns["a"].values, [1, 2, np.nan, 4, 5, 6])
    np.testing.assert_array_equal(found.columns["a"].text_rows, [2])


def test_ambiguous_date_is_read_as_text():
    column = read("time;a\n09/10/2026 10:00:00;1\n10/10/2026 10:00:01;2\n").columns["time"]
    assert len(column.text_rows) == 2


def test_blank_cells_are_distinguished_from_text():
    column = read("time,a\n0,1\n1,\n2,NaN\n3,n/a\n4,OVLD\n5,-\n6,2\n").columns["a"]
    np.testing.assert_array_equal(np.isnan(column.values), [False, True, True, True, True, True, False])
    np.testing.assert_array_equal(column.text_rows, [4])
    assert column.text == "OVLD"


def test_rows_of_wrong_length_are_padded_or_truncated():
    found = read("time,a,b\n0,1,2\n1\n2,3,4,5,6\n3,4,5\n")
    np.testing.assert_array_equal(found.columns["time"].values, [0, 1, 2, 3])
    np.testing.assert_array_equal(found.columns["a"].values, [1, np.nan, 3, 4])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,1\n1,2\n", ["no header line"]),
        ("time,a\n0,0,1,5\n0,5,2,5\n1,0,3,0\n", ["no header line", "semicolons"]),
        ("", ["empty"]),
        ("\n \n", ["empty"]),
        (b"time,a\n\x00\x01\x02,3\n", ["not text"]),
    ],
)
def test_text_without_a_table_is_refused(text: str | bytes, words: list[str]):
    with pytest.raises(InputError) as error:
        read(text)
    for word in words:
        assert word in str(error.value)


def test_header_without_rows_gives_the_column_names():
    found = read("time;a;b\n")
    assert found.names == ("time", "a", "b") and found.columns == {}


def test_quoted_names_between_blanks_may_hold_blanks():
    assert read('"time" "motor angle"\n0 1\n1 2\n', wanted=()).names == ("time", "motor angle")


def test_row_of_words_and_numbers_is_no_header():
    found = read("time;mode;state\n0;ready;on\n", wanted=())
    assert found.names == ("time", "mode", "state")


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("torque [N m]", ("torque", "N m")),
        ("time (ms)", ("time", "ms")),
        ("phi [°]", ("phi", "°")),
        ("joint(2)", ("joint(2)", None)),
        ("data(:,3)", ("data(:,3)", None)),
        ("x", ("x", None)),
    ],
)
def test_unit_is_split_from_the_column_name(header: str, expected: tuple[str, str | None]):
    assert split_unit(header) == expected


PLAIN = {
    "comma": ("0,1.5,7\n0.5,-2.25e-3,8\n", ","),
    "blanks": (" 0  1.5 7\n0.5 -2.25E-3   8\n", " "),
    "tab": ("0\t1.5\t7\n\n0.5\t-2.25e-3\t8\n", "\t"),
    "blank after delimiter": ("0; 1.5;7 \n0.5 ;-2.25e-3; 8\n", ";"),
    "row too long": ("0,1.5,7\n0.5,-2.25e-3,8,9\n", ","),
}
OTHER = {
    "empty cell": ("0,1.5,7\n0.5,,8\n", ","),
    "word": ("0,1.5,7\n0.5,nan,8\n", ","),
    "row too short": ("0,1.5,7\n0.5\n", ","),
    "decimal comma": ("0;1,5;7\n0,5;-2,25;8\n", ";"),
    "thousands": ("0;1.500.000;7\n0.5;2.250;8\n", ";"),
    "hash": ("0,1.5,7\n#0.5,2,8\n", ","),
    "quotation mark": ('0,"1.5",7\n0.5,2,8\n', ","),
    "beyond all numbers": ("0,1e999,7\n0.5,2,8\n", ","),
    "lone sign": ("0,-,7\n0.5,2,8\n", ","),
    "two numbers": ("0;1 5;7\n0.5;2;8\n", ";"),
}


@pytest.mark.parametrize(("text", "delimiter"), PLAIN.values(), ids=PLAIN.keys())
def test_plain_number_reader_agrees_with_the_general_reader(text: str, delimiter: str):
    lines, places = text.splitlines(), [0, 1]
    plain = plain_columns(lines, delimiter, places)
    assert plain is not None
    frame = cells(lines, delimiter, 3, places)
    for place in places:
        other = column_from_text(frame[f"c{place}"], comma_parts_cells=delimiter == ",")
        np.testing.assert_array_equal(plain[place], other.values)
        assert len(other.text_rows) == 0
    np.testing.assert_array_equal(plain, [[0.0, 0.5], [1.5, -2.25e-3]])


@pytest.mark.parametrize(("text", "delimiter"), OTHER.values(), ids=OTHER.keys())
def test_plain_number_reader_declines_other_spellings(text: str, delimiter: str):
    assert plain_columns(text.splitlines(), delimiter, [0, 1]) is None


def test_names_above_properties_of_each_channel_are_those_of_the_columns():
    head = "Name;Axis 1.Pos;Name;Axis 1.Torque\nSymbolComment;;SymbolComment;\nData-Type;REAL64;Data-Type;REAL64\n"
    head += "SampleTime[ms];1;SampleTime[ms];1\nOffset;0;Offset;0\nBitMask;0x0;BitMask;0x0\nUnit;(None);Unit;(None)\n\n"
    found = read(head + "0,0;1,5;0,0;-0,1\n1,0;2,5;1,0;-0,2\n2,0;3,5;2,0;-0,3\n", wanted=("Axis 1.Torque", "Name"))
    assert found.names == ("Name", "Axis 1.Pos", "Name (2)", "Axis 1.Torque")
    np.testing.assert_array_equal(found.columns["Axis 1.Torque"].values, [-0.1, -0.2, -0.3])
    np.testing.assert_array_equal(found.columns["Name"].values, [0.0, 1.0, 2.0])
