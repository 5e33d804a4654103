"""Gaps of the torque: interpolated where the error is small, else a border between two pieces of the log."""

import numpy as np
import pytest

import rig
from fitting.logs.gaps import SHORTEST, Sampling, bridge_error, bridged, pieces

COUNT = 2000
TIME = np.arange(COUNT) * rig.STEP
SMOOTH = np.sin(2 * np.pi * 40 * TIME) + np.cos(2 * np.pi * 17 * TIME)
WHITE = np.random.default_rng(0).normal(size=COUNT)
KNOWN = np.ones(COUNT, dtype=bool)


def rows_without(*rows: int) -> np.ndarray:
    return np.delete(np.arange(COUNT), rows)


def pieces_of(torque: np.ndarray, kept: np.ndarray, known: np.ndarray = KNOWN, restarts=()):
    return pieces(TIME[kept], torque[kept], known[kept], restarts, "motor_torque")


def test_log_without_gaps_is_one_piece():
    assert pieces_of(WHITE, rows_without()) == (((0, COUNT),), ())


def test_late_stamp_is_not_a_gap():
    late = TIME.copy()
    late[700] += 0.8 * rig.STEP
    assert len(Sampling(late).gaps) == 0
    assert pieces(late, WHITE, KNOWN, (), "motor_torque") == (((0, COUNT),), ())


def test_jitter_is_not_a_gap():
    jittering = np.cumsum(np.random.default_rng(1).uniform(0.1, 3.0, COUNT)) * rig.STEP
    assert pieces(jittering, WHITE, KNOWN, (), "motor_torque") == (((0, COUNT),), ())


@pytest.mark.parametrize("missing", [1, 2, 4])
def test_short_gap_in_smooth_torque_is_bridged(missing: int):
    kept = rows_without(*range(700, 700 + missing))
    spans, (finding,) = pieces_of(SMOOTH, kept)
    assert spans == ((0, COUNT - missing),)
    assert finding.severity == "note" and f"{missing} samples of motor_torque" in finding.what
    time, torque = bridged(TIME[kept], SMOOTH[kept])
    np.testing.assert_allclose(time, TIME, atol=1e-12)
    # The error of a cubic through samples 1.5 and more steps away from its middle.
    omega = 2 * np.pi * 40 * rig.STEP
    assert np.max(np.abs(torque - SMOOTH)) < 0.1 * (omega * (missing + 1)) ** 4
    assert bridge_error(SMOOTH, missing) < 0.02


@pytest.mark.parametrize("missing", [1, 2, 3])
def test_bridge_error_agrees_with_the_rms_error_of_bridging(missing: int):
    middle = 2 + (missing - 1) // 2
    errors = []
    for row in range(0, COUNT - 60, 7):
        span = np.arange(row, row + 60)
        kept = np.delete(span, np.arange(28, 28 + missing))
        _, values = bridged(TIME[kept], WHITE[kept])
        errors.append(values[26 + middle] - WHITE[span[26 + middle]])
    rms = np.sqrt(np.mean(np.square(errors))) / np.std(WHITE)
    # Every seventh row is tried, so that both values differ by chance.
    assert bridge_error(WHITE, missing) == pytest.approx(rms, rel=0.1)


@pytest.mark.parametrize("missing", [1, 30, 400])
def test_gap_in_white_torque_splits_the_log(missing: int):
    kept = rows_without(*range(700, 700 + missing))
    spans, (finding,) = pieces_of(WHITE, kept)
    assert spans == ((0, 700), (700, COUNT - missing))
    assert finding.severity == "warning" and "row 701" in finding.where and "2 stretches" in finding.consequence


def test_long_gap_in_smooth_torque_splits_the_log():
    spans, _ = pieces_of(SMOOTH, rows_without(*range(700, 900)))
    assert spans == ((0, 700), (700, COUNT - 200))


def test_blank_torque_sample_is_bridged_or_splits_the_log():
    known = KNOWN.copy()
    known[700] = False
    assert pieces_of(WHITE, rows_without(), known)[0] == ((0, 700), (701, COUNT))
    assert pieces_of(SMOOTH, rows_without(), known)[0] == ((0, COUNT),)


def test_torque_at_a_slower_rate_has_no_gaps():
    known = np.arange(COUNT) % 4 == 0
    assert pieces_of(WHITE, rows_without(), known) == (((0, COUNT - 3),), ())


def test_short_pieces_are_left_out_and_counted():
    spans, (finding,) = pieces_of(WHITE, rows_without(100, *range(1900, 1905)))
    assert spans == ((100, 1899),)
    assert f"{COUNT - 6 - 1799} rows between gaps" in finding.consequence


def test_frequent_gaps_are_bridged_with_a_warning():
    spans, (finding,) = pieces_of(WHITE, rows_without(*range(50, COUNT, 50)))
    assert spans == ((0, COUNT - 39),)
    assert finding.severity == "warning" and "a guess" in finding.consequence


def test_short_gaps_of_a_log_needed_whole_are_bridged_with_a_warning():
    kept = rows_without(700, 701)
    (span,), (finding,) = pieces(TIME[kept], WHITE[kept], KNOWN[kept], (), "motor_torque", whole=True)
    assert span == (0, COUNT - 2) and finding.severity == "warning"


def test_frequent_long_gaps_leave_no_piece():
    spans, findings = pieces_of(WHITE, np.flatnonzero(np.arange(COUNT) % 100 < 50))
    assert spans == () and len(findings) == 1
    assert SHORTEST > 50


def test_restarted_recording_begins_a_new_piece():
    time = np.concatenate([TIME[:900], TIME[900:] + 0.05])
    spans, _ = pieces(time, SMOOTH, KNOWN, np.array([900]), "motor_torque")
    assert spans == ((0, 900), (900, COUNT))
