"""Time stamps that are rounded, wrapped, restarted, repeated, out of order or blank: the clock is reconstructed."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from fitting.errors import InputError
from fitting.logs.steady_clock import steady_clock
from fitting.logs.time_stamps import TimeBase, time_base

COUNT, STEP = 4000, 5e-4
CLOCK = np.arange(COUNT) * STEP
SAMPLES = np.random.default_rng(0).normal(size=(COUNT, 2))


def time_base_of(stamps: np.ndarray, samples: np.ndarray = SAMPLES, second: float = 1.0) -> TimeBase:
    found = time_base(stamps, samples, path="log.csv", name="t", second=second, first_row=0)
    assert (np.diff(found.time) > 0).all()
    assert len(found.time) == len(found.rows)
    return found


def assert_one_finding(found: TimeBase, severity: str, *words: str):
    (finding,) = found.findings
    assert finding.severity == severity
    for word in words:
        assert word in str(finding)


def stamps_with(**places: float) -> np.ndarray:
    stamps = CLOCK.copy()
    for row, value in places.items():
        stamps[int(row[1:])] = value
    return stamps


@pytest.mark.parametrize("stamps", [CLOCK, CLOCK + 1.7e9, CLOCK * 1e-3, np.sort(CLOCK + 2e-4 * SAMPLES[:, 0])])
def test_valid_stamps_are_unchanged(stamps: np.ndarray):
    found = time_base_of(stamps)
    np.testing.assert_array_equal(found.time, stamps)
    assert found.findings == () and len(found.restarts) == 0


COARSE = {
    "milliseconds, cut": (STEP, lambda t: np.floor(t * 1e3) / 1e3, 1e-3),
    "milliseconds, rounded": (STEP, lambda t: np.round(t, 3), 1e-3),
    "milliseconds of 250.3 Hz": (1 / 250.3, lambda t: np.round(t, 3), 1e-3),
    "tenths of milliseconds of 2048 Hz": (1 / 2048, lambda t: np.round(t, 4), 1e-4),
    "a tick of 3 kHz": (STEP, lambda t: np.floor(t * 3e3) / 3e3, 1 / 3e3),
    "single precision after an hour": (STEP, lambda t: (t + 5000).astype("f4").astype(float) - 5000, 2.0**-11),
    "single precision after a day": (STEP, lambda t: (t + 90000).astype("f4").astype(float) - 90000, 2.0**-7),
}


@pytest.mark.parametrize(("step", "rounded", "quantum"), COARSE.values(), ids=COARSE.keys())
def test_rounded_stamps_of_a_steady_clock_are_reconstructed(step: float, rounded, quantum: float):
    clock = np.arange(COUNT) * step
    found = time_base_of(rounded(clock))
    assert_one_finding(found, "note", "rounded", "steady sampling")
    assert len(found.time) == COUNT
    np.testing.assert_allclose(np.diff(found.time), step, rtol=quantum / step / COUNT)
    # Truncation can't be distinguished from rounding: half a quantum of shift.
    np.testing.assert_allclose(found.time, clock, atol=0.6 * quantum)


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    interval=st.floats(3e-4, 3e-3),
    width=st.floats(1.5, 800.0),
    phase=st.floats(0.0, 1.0),
    late=st.sampled_from([0.0, 0.0, 0.01, 0.1]),
    cut=st.booleans(),
    seed=st.integers(0, 99),
)
def test_sample_rate_error_is_bounded_by_its_standard_deviation(interval, width, phase, late, cut, seed):
    quantum, count = width * interval, max(COUNT, int(6 * width))
    clock = (phase * width + np.arange(count)) * interval
    stamps = clock + late * quantum * np.random.default_rng(seed).uniform(size=count)
    found = steady_clock(
        np.maximum.accumulate((np.floor if cut else np.rint)(stamps / quantum) * quantum), np.zeros(count, int), quantum
    )
    assert found is not None
    # Stamps bound the rate to an interval, whose ends are within 3.5 standard deviations.
    assert abs(found.interval / interval - 1.0) < 3.5 * found.rate_std
    # Over the log, the clock error is then a fraction of the rounding or of the delay of stamps.
    assert found.rate_std * count * interval < (0.5 + 2.0 * late) * quantum + 3.0 * interval
    np.testing.assert_allclose(np.diff(found.time), found.interval, rtol=1e-6)


def test_standard_deviation_of_the_sample_rate_agrees_with_its_errors():
    random, errors = np.random.default_rng(0), []
    for k in range(200):
        interval, width = 10 ** random.uniform(-3.5, -2.5), 10 ** random.uniform(0.2, 2.8)
        count = max(COUNT, int(6 * width))
        clock = (random.uniform(0, width) + np.arange(count)) * interval
        quantum = width * interval
        stamps = (np.floor if k % 2 else np.rint)(clock / quantum) * quantum
        found = steady_clock(stamps, np.zeros(count, int), quantum)
        assert found is not None
        errors.append((found.interval / interval - 1.0) / found.rate_std)
    # The mean square of 200 such errors has a standard deviation of 0.1 at most (a normal law's).
    assert abs(np.mean(np.square(errors)) - 1.0) < 0.3


@pytest.mark.parametrize("quantum", [1.0, 0.1, 0.01])
def test_stamps_in_whole_seconds_or_fractions_give_the_sample_rate(quantum: float):
    clock = 1e-3 * np.arange(5000)
    found = time_base_of(
        np.floor((clock + 0.54) / quantum) * quantum + 1.7e9, np.random.default_rng(0).normal(size=(5000, 1))
    )
    assert_one_finding(found, "note", "rounded", "standard errors")
    # Stamps change first and last at least four seconds apart, each known to one sample.
    assert 1e-6 < found.rate_std < 1.1e-3 / 4
    assert abs(np.median(np.diff(found.time)) / 1e-3 - 1) < 1e-3


def test_fractions_of_a_second_alone_are_unwrapped():
    for unit, second in ((1e-6, 1.0), (1.0, 1e6)):
        stamps = np.rint(np.mod(CLOCK + 0.6789, 1.0) * 1e6) * unit / (1.0 if second == 1.0 else 1e6)
        found = time_base_of(stamps, second=second)
        assert_one_finding(found, "note", "wraps", "unwrapped")
        np.testing.assert_allclose(np.diff(found.time), STEP, atol=1.1e-6)


def test_recordings_of_one_second_are_restarts_and_not_wraps():
    found = time_base_of(np.mod(np.arange(COUNT), 1000) * 1e-3)
    assert_one_finding(found, "warning", "restarts")
    assert len(found.restarts) == 3


def test_rounded_stamps_with_pause_and_missing_samples_are_reconstructed():
    stamps = np.round(CLOCK + np.where(np.arange(COUNT) > 1999, 0.25, 0.0), 3)
    kept = np.delete(np.arange(COUNT), [100, 101, 102, 103])
    found = time_base_of(stamps[kept], SAMPLES[kept])
    usual = np.delete(np.diff(found.time), [99, 1995])
    np.testing.assert_allclose(usual, STEP, rtol=1e-3)
    assert np.diff(found.time)[1995] == pytest.approx(0.25 + STEP, abs=2e-3)


def test_single_precision_stamps_that_step_by_their_last_digit_are_reconstructed_beside_a_pause():
    """The last digit is just below the sampling interval, so that some steps are of two."""
    kept = np.delete(np.arange(COUNT), np.arange(3000, 3010))
    found = time_base_of((CLOCK + 5000).astype("f4").astype(float)[kept], SAMPLES[kept])
    assert_one_finding(found, "note", "rounded", "steady sampling")
    np.testing.assert_allclose(np.delete(np.diff(found.time), 2999), STEP, rtol=1e-4)


@pytest.mark.parametrize(("start", "step", "told"), [(1000.0, 5e-4, True), (63.0, 5e-4, True), (0.0, 2.0**-10, False)])
def test_stamps_counted_up_in_single_precision_are_warned_of(start: float, step: float, told: bool):
    count = 100_000 if start == 0.0 else COUNT
    stamps = np.cumsum(np.append(np.float32(start), np.full(count - 1, step, np.float32)), dtype=np.float32)
    found = time_base_of(stamps.astype(float), np.arange(count)[:, None] * 1.0)
    assert [finding.severity for finding in found.findings] == ["warning"] * told
    assert all("single precision" in finding.what for finding in found.findings)


def test_missing_samples_of_an_exact_clock_are_not_detected_as_rounding():
    kept = np.delete(np.arange(COUNT), [100, 101, 700, 1500, 2000, 2900, 3100])
    found = time_base_of(CLOCK[kept], SAMPLES[kept])
    np.testing.assert_array_equal(found.time, CLOCK[kept])
    assert found.findings == ()


@pytest.mark.parametrize(
    ("span", "second"), [(2.0**32, 1e6), (2.0**32 * 1e-6, 1.0), (2.0**16, 1e3), (86400.0, 1.0), (2.0**31, 1e6)]
)
def test_wrapped_counter_is_unwrapped(span: float, second: float):
    # Each clock wraps in the middle of the log, and that of milliseconds twice more.
    step = 1.0 / second if span == 2.0**16 else STEP
    ticks = np.rint((np.arange(COUNT) - COUNT / 2) * step * second * (15 if span == 2.0**16 else 1) * 1e6) / 1e6
    found = time_base_of(np.mod(ticks, span) / second, second=second)
    assert_one_finding(found, "note", "wraps")
    np.testing.assert_allclose(np.diff(found.time), np.diff(ticks) / second, atol=1e-9 * span / second)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 1e9, -5.0, 1e300])
def test_wrong_stamp_is_interpolated_between_its_neighbours(value: float):
    found = time_base_of(stamps_with(r100=value))
    assert_one_finding(found, "warning", "1 stamps are blank or out of order", "row 101")
    np.testing.assert_allclose(found.time, CLOCK, atol=1e-12)


def test_blank_stamp_of_unsteady_sampling_leaves_other_stamps_unchanged():
    stamps = np.cumsum(np.random.default_rng(1).uniform(0.2, 3.0, COUNT)) * STEP
    found = time_base_of(np.where(np.arange(COUNT) == 100, np.nan, stamps))
    kept = np.arange(COUNT) != 100
    if len(found.rows) < COUNT:
        np.testing.assert_array_equal(found.time, stamps[kept])
    else:
        np.testing.assert_array_equal(found.time[kept], stamps[kept])


@pytest.mark.parametrize("order", [[*range(100), 101, 100, *range(102, COUNT)], [*range(2000, COUNT), *range(2000)]])
def test_late_rows_are_sorted_by_time(order: list[int]):
    found = time_base_of(CLOCK[order], SAMPLES[order])
    assert_one_finding(found, "warning", "a row comes late")
    np.testing.assert_array_equal(found.time, CLOCK)
    np.testing.assert_array_equal(np.asarray(order)[found.rows], np.arange(COUNT))


def test_reversed_log_is_sorted_by_time():
    np.testing.assert_array_equal(time_base_of(CLOCK[::-1], SAMPLES[::-1]).time, CLOCK)


def test_repeated_buffer_is_removed():
    order = [*range(200), *range(150, COUNT)]
    found = time_base_of(CLOCK[order], SAMPLES[order])
    assert_one_finding(found, "warning", "50 times", "row 201")
    np.testing.assert_array_equal(found.time, CLOCK)
    np.testing.assert_array_equal(np.asarray(order)[found.rows], np.arange(COUNT))


def test_restart_of_the_clock_is_detected():
    stamps = np.concatenate([CLOCK[:2500], CLOCK[:1500]])
    found = time_base_of(stamps)
    assert_one_finding(found, "warning", "restarts", "row 2501")
    np.testing.assert_array_equal(found.restarts, [2500])
    np.testing.assert_array_equal(found.time[:2500], CLOCK[:2500])
    np.testing.assert_allclose(np.diff(found.time[2500:]), STEP)


def test_rows_with_a_repeated_stamp_are_dropped():
    stamps = np.cumsum(np.random.default_rng(1).uniform(0.9, 1.1, COUNT)) * STEP
    stamps[[70, 900]] = stamps[[69, 899]]
    found = time_base_of(stamps)
    assert_one_finding(found, "warning", "2 rows repeat", "row 71")
    np.testing.assert_array_equal(found.rows, np.delete(np.arange(COUNT), [70, 900]))


@pytest.mark.parametrize(
    "stamps",
    [np.ones(COUNT), np.full(COUNT, np.nan), SAMPLES[:, 0], CLOCK * 1e300, np.where(CLOCK < 1.5, 0.0, CLOCK)],
    ids=["stands", "blank", "noise", "huge", "stands for long"],
)
def test_column_that_is_not_a_clock_is_refused(stamps: np.ndarray):
    with np.errstate(all="ignore"), pytest.raises(InputError, match="is not a clock") as error:
        time_base_of(stamps)
    assert "log.csv" in str(error.value) and "'t'" in str(error.value) and "sample_rate" in str(error.value)


def test_equal_rows_under_coarse_stamps_are_not_detected_as_repeated():
    """Rows of a coarse encoder are equal at rest, and so are rows with unknown outputs."""
    at_rest = np.where((np.arange(COUNT) % 500 < 200)[:, None], 0.0, SAMPLES)
    unknown = np.where((np.arange(COUNT) < 300)[:, None], SAMPLES, [np.nan, 1.0])
    for samples in (at_rest, unknown):
        found = time_base_of(np.floor(CLOCK * 10.0) / 10.0, samples)
        assert_one_finding(found, "note", "steady sampling")
        assert len(found.time) == COUNT
