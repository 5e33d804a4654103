"""Logs with blank samples, text, gaps or too few rows: masked, split into stretches or refused."""

from pathlib import Path

import numpy as np
import pytest
from log_files import DRIVE, ROWS, N, drive_table, one_sentence, read_drive, save, save_text

from fitting.errors import DataError, InputError
from fitting.logs.channels import without_fill_values
from fitting.logs.log import read_log


@pytest.mark.parametrize("value", [np.nan, np.inf, 9.96920996838687e36])
@pytest.mark.parametrize("kind", ["csv", "mat5", "hdf5", "parquet"])
def test_blank_outputs_are_masked_and_counted(tmp_path: Path, kind: str, value: float) -> None:
    table = drive_table()
    table["motor_angle"][[16, 99]] = value
    table["load_angle"][[99, 300]] = value
    log = read_log(save(tmp_path, table, kind), read_drive(tmp_path))
    assert log.trusted is not None
    np.testing.assert_array_equal(np.flatnonzero(~log.trusted), [16, 99, 300])
    assert np.isfinite(log.dynamic_error).all()
    first, second = log.findings
    assert "motor_angle is blank or not finite in 2 rows" in first.what and "row 17" in first.where
    assert first.severity == "warning" and "row 100" in second.where


@pytest.mark.parametrize("fill", [-999.0, 9999.0])
def test_fill_values_of_nines_count_as_blank(tmp_path: Path, fill: float) -> None:
    table = drive_table()
    table["load_angle"][[99, *range(300, 340)]] = fill
    log = read_log(save(tmp_path, table), read_drive(tmp_path))
    assert log.trusted is not None
    np.testing.assert_array_equal(np.flatnonzero(~log.trusted), [99, *range(300, 340)])
    assert f"41 cells hold the fill value {fill:g}" in log.findings[0].what and "row 100" in log.findings[0].where


@pytest.mark.parametrize("values", [np.linspace(0.0, 1998.0, 1999), np.array([0.0, 999.0] * 9)])
def test_value_of_nines_among_others_is_kept(values: np.ndarray) -> None:
    assert 999.0 in values
    np.testing.assert_array_equal(without_fill_values(values)[0], values)


@pytest.mark.parametrize("kind", ["csv", "hdf5"])
def test_blank_torque_splits_the_log(tmp_path: Path, kind: str) -> None:
    """White torque can't be interpolated: the log ends before the blank sample and begins again after it."""
    table = drive_table(1000)
    table["motor_torque"][500] = np.nan
    log = read_log(save(tmp_path, table, kind), read_drive(tmp_path))
    assert log.pieces == ((0, 500), (501, 1000))
    assert log.input_known is not None and not log.input_known[500] and log.input_known.sum() == 999
    (finding,) = log.findings
    assert "fitted as 2 stretches" in finding.consequence


def test_blank_time_stamp_of_steady_sampling_is_reconstructed(tmp_path: Path) -> None:
    table = drive_table()
    table["time"][[16, 99]] = np.nan
    log = read_log(save(tmp_path, table), read_drive(tmp_path))
    np.testing.assert_allclose(log.time, drive_table()["time"], rtol=1e-12)
    (finding,) = log.findings
    assert "2 stamps are blank" in finding.what and "row 17" in finding.where


def test_empty_cells_and_text_are_masked(tmp_path: Path) -> None:
    def spoil(cells: list[list[str]]) -> None:
        cells[5][1] = ""
        cells[7][2] = "overload"

    log = read_log(save_text(tmp_path, spoil), read_drive(tmp_path))
    assert log.trusted is not None
    np.testing.assert_array_equal(np.flatnonzero(~log.trusted), [4, 6])
    assert any("'overload'" in f.what and "row 7" in f.where for f in log.findings)


def test_column_with_much_text_is_refused(tmp_path: Path) -> None:
    def spoil(cells: list[list[str]]) -> None:
        for row in cells[100:200]:
            row[2] = "overload"

    with pytest.raises(InputError) as error:
        read_log(save_text(tmp_path, spoil), read_drive(tmp_path))
    one_sentence(error, "'load_angle'", "'overload'", "100 rows", "row 100", "mend")


def test_blank_rows_at_the_ends_are_left_out_and_counted(tmp_path: Path) -> None:
    def pad(cells: list[list[str]]) -> None:
        cells[1:1] = [["", "", "", ""]] * 2
        cells.extend([[""] * 4] * 3)

    log = read_log(save_text(tmp_path, pad), read_drive(tmp_path))
    np.testing.assert_array_equal(log.motor_angle, drive_table()["motor_angle"])
    (finding,) = log.findings
    assert "2 blank rows before" in finding.what and "3 after" in finding.what


def test_gaps_split_the_log(tmp_path: Path) -> None:
    table = drive_table(1000)
    table["time"][300:] += 0.25
    table["time"][950:] += 0.1
    log = read_log(save(tmp_path, table), read_drive(tmp_path))
    assert log.pieces == ((0, 300), (300, 950))
    (finding,) = log.findings
    assert finding.severity == "warning" and "row 301" in finding.where
    assert "0.2505 s" in finding.what and "50 rows between gaps" in finding.consequence


def test_log_without_a_long_stretch_is_refused(tmp_path: Path) -> None:
    table = drive_table(1000)
    table["time"] += 0.25 * (np.arange(1000) // 100)
    with pytest.raises(DataError) as error:
        read_log(save(tmp_path, table), read_drive(tmp_path))
    one_sentence(error, "9 gaps", "no stretch of 200 rows")


def test_log_of_fewer_than_200_rows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError) as error:
        read_log(save(tmp_path, drive_table(199)), read_drive(tmp_path))
    one_sentence(error, "199 rows", "200")
    assert len(read_log(save(tmp_path, drive_table(200)), read_drive(tmp_path))) == 200


def test_prediction_ignores_outputs_after_the_initial_state_window(tmp_path: Path) -> None:
    full = read_log(save(tmp_path, drive_table()), read_drive(tmp_path))

    def spoil(cells: list[list[str]]) -> None:
        for number, row in enumerate(cells[51:]):
            row[1] = ["", "nan", "withheld", "1e9"][number % 4]
            row[2] = ""

    path = save_text(tmp_path, spoil)
    log = read_log(path, read_drive(tmp_path), outputs_until=50)
    assert len(log) == ROWS and log.outputs_until == 50
    np.testing.assert_array_equal(log.dynamic_error[:50], full.dynamic_error[:50])
    np.testing.assert_array_equal(log.motor_torque, full.motor_torque)
    np.testing.assert_array_equal(log.time, full.time)
    assert log.trusted is not None and log.trusted[:50].all() and not log.trusted[50:].any()
    assert np.isfinite(log.dynamic_error).all() and log.findings == ()
    # Outputs that are not known are constant, whatever the file holds.
    assert np.ptp(log.dynamic_error[50:]) == 0
    with pytest.raises(InputError) as error:
        read_log(path, read_drive(tmp_path))
    one_sentence(error, "'motor_angle'", "'withheld'")


def test_prediction_without_the_whole_torque_is_refused(tmp_path: Path) -> None:
    table = drive_table()
    table["motor_torque"][300:330] = np.nan
    with pytest.raises(DataError) as error:
        read_log(save(tmp_path, table), read_drive(tmp_path), outputs_until=50)
    one_sentence(error, "motor_torque", "throughout")


def smooth_table(rows: int = 1000) -> dict[str, np.ndarray]:
    """A drive log of an encoder far from zero and one that passes zero and rests there."""
    time = np.arange(rows) * 5e-4
    sway = np.round(1e5 * np.where(40.0 * time < 4 * np.pi, np.sin(40.0 * time), 0.0)) / 1e5
    return {"time": time, "motor_angle": 7.0 + sway, "load_angle": sway / N, "motor_torque": 0.1 + np.cos(40.0 * time)}


def test_zeros_far_from_their_neighbours_are_dropouts(tmp_path: Path) -> None:
    """Singly, in long runs and at the ends; a row that is zero throughout also lacks its torque."""
    table = smooth_table()
    lost = [0, 1, 250, *range(300, 312), 999]
    table["motor_angle"][lost] = 0.0
    table["load_angle"][250] = table["motor_torque"][250] = 0.0
    log = read_log(save(tmp_path, table), read_drive(tmp_path))
    assert log.trusted is not None and log.input_known is not None
    np.testing.assert_array_equal(np.flatnonzero(~log.trusted), lost)
    np.testing.assert_array_equal(np.flatnonzero(~log.input_known), [250])
    assert "16 samples are exactly zero" in log.findings[0].what and "row 1" in log.findings[0].where


def test_zeros_of_motion_rest_and_wraps_are_kept(tmp_path: Path) -> None:
    table = smooth_table()
    # Counts that jitter about their wrap, and counts that move through it.
    for counts in (np.random.default_rng(0).integers(-2, 3, 1000), 16000 + 32 * np.arange(1000)):
        table["motor_angle"] = np.mod(counts, 16384).astype(float)
        assert (table["motor_angle"] == 0.0).any()
        text = DRIVE + '[columns]\nmotor_angle = { column = "motor_angle", unit = "rev / 16384" }\n'
        log = read_log(save(tmp_path, table), read_drive(tmp_path, text))
        assert log.trusted is None and not any("exactly zero" in finding.what for finding in log.findings)
