"""Rows that were lost or repeat, without a trace in the time stamps."""

from dataclasses import fields, replace

import numpy as np
import pytest
from checked_logs import ROWS, STEP, angles, drive_log

from fitting.logs.findings import Finding
from fitting.logs.log import Log
from fitting.logs.lost_rows import lost_rows


def with_rows(log: Log, rows: np.ndarray) -> Log:
    """The log with other rows at the same clock."""
    changed = {f.name: getattr(log, f.name) for f in fields(log)}
    changed = {name: values[rows] for name, values in changed.items() if isinstance(values, np.ndarray)}
    return replace(log, **changed | {"time": np.arange(len(rows)) * STEP})


def places(count: int) -> np.ndarray:
    return 100 + 29 * np.arange(count) * 100 // max(count, 1)


def changed(log: Log, count: int, copies: int) -> Log:
    copied = np.ones(ROWS, dtype=int)
    copied[places(count)] = copies
    return with_rows(log, np.repeat(np.arange(ROWS), copied))


@pytest.mark.parametrize(("copies", "words"), [(0, "rows were lost"), (2, "rows repeat")])
@pytest.mark.parametrize(("count", "severity"), [(0, []), (3, ["warning"]), (40, ["refusal"])])
def test_lost_and_repeated_rows_are_found(copies: int, words: str, count: int, severity: list[str]):
    found: list[Finding] = list(lost_rows(changed(drive_log(), count, copies)))
    assert [f.severity for f in found] == severity
    assert all(words in f.what for f in found)


def test_rows_whose_stamps_show_the_loss_are_not_reported():
    log = changed(drive_log(), 40, 0)
    kept = np.delete(np.arange(ROWS), places(40))
    assert not list(lost_rows(replace(log, time=kept * STEP)))


def test_stamps_that_double_a_steady_step_are_refused():
    """Rounded to a quantum just below the sampling interval, they show a missing row now and then."""
    log = drive_log()
    (finding,) = lost_rows(replace(log, time=np.floor(log.time / (0.98 * STEP)) * 0.98 * STEP))
    assert finding.severity == "refusal" and "stamps go twice as far" in finding.what
    assert "sample_rate" in finding.consequence


def test_coarse_encoder_and_impacts_are_no_lost_rows():
    """Steps of a coarse encoder double by chance, and an impact changes the speed for good."""
    log = drive_log()
    motor, _ = angles(log)
    coarse = np.rint(motor / 0.02) * 0.02
    assert not list(lost_rows(replace(log, motor_angle=coarse)))
    speed = np.repeat([0.05, 0.1, 0.0, 0.1, -0.1, 0.05, 0.0, 0.02], ROWS // 8)
    assert not list(lost_rows(replace(log, motor_angle=np.cumsum(speed))))
