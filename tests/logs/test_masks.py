"""Wrong samples of a sensor are masked; correct samples are not, even where an effect is unusual."""

from dataclasses import replace

import numpy as np
import pytest

import rig
from fitting.errors import DataError
from fitting.logs.log import Log
from fitting.logs.masks import glitches, masked

COUNT = 4000
TORQUE = rig.drive_torque(COUNT)
DRIVE_LOG = rig.drive_log(rig.drive_motion(TORQUE), TORQUE)
FORCING = rig.reduced_forcing(COUNT)
REDUCED_LOG = rig.reduced_log(rig.reduced_motion(FORCING)[:, 0], FORCING, noise=1e-3)


def invalid_rows(log: Log) -> np.ndarray:
    found = masked(log)
    return np.zeros(0, dtype=int) if found.trusted is None else np.flatnonzero(~found.trusted)


def changed(log: Log, name: str, change) -> Log:
    values = getattr(log, name).copy()
    change(values)
    return replace(log, **{name: values})


@pytest.mark.parametrize("log", [DRIVE_LOG, REDUCED_LOG], ids=["drive", "reduced"])
def test_log_without_invalid_samples_is_unchanged(log: Log):
    assert masked(log) is log


@pytest.mark.parametrize("physics", [{"mesh_friction": (2.0, 1e-3)}, {"gravity": 20.0}, {"kinematic": (3e-4, 0.0)}])
def test_missing_effects_are_not_masked(physics: dict):
    log = rig.drive_log(rig.drive_motion(TORQUE, **physics), TORQUE)
    assert masked(log) is log


@pytest.mark.parametrize(("name", "size"), [("load_angle", 5e-5), ("load_angle", 0.5), ("motor_angle", 1e-3)])
def test_isolated_wrong_samples_are_masked(name: str, size: float):
    rows = np.array([40, 700, 1500, 1503, 3900])

    def change(values: np.ndarray) -> None:
        values[rows] += size * np.array([1, -1, 1, 1, -1])

    log = changed(DRIVE_LOG, name, change)
    np.testing.assert_array_equal(invalid_rows(log), rows)
    (finding,) = masked(log).findings
    assert "5 samples differ" in finding.what and f"{name}, first in data row 41" in finding.where


@pytest.mark.parametrize("length", [2, 3, 5])
def test_dropouts_to_zero_are_masked(length: int):
    def change(values: np.ndarray) -> None:
        values[1000 : 1000 + length] = 0.0
        values += 1.0
        values[1000 : 1000 + length] = 0.0

    np.testing.assert_array_equal(
        invalid_rows(changed(DRIVE_LOG, "load_angle", change)), np.arange(1000, 1000 + length)
    )


def test_wrong_samples_of_a_reduced_log_are_masked():
    def change(values: np.ndarray) -> None:
        values[[500, 501, 2000]] += 1.0

    np.testing.assert_array_equal(invalid_rows(changed(REDUCED_LOG, "dynamic_error", change)), [500, 501, 2000])


def test_late_samples_are_not_detected_as_glitches():
    """A late sample differs because the motion continues until it is taken."""
    late = DRIVE_LOG.time + np.where(np.arange(COUNT) % 97 == 50, 0.9 * rig.STEP, 0.0)
    smooth = np.sin(300 * late)
    assert len(glitches(smooth, late)) == 0
    assert len(glitches(smooth, DRIVE_LOG.time)) > 0


def test_impacts_are_not_detected_as_glitches():
    time = np.arange(COUNT) * rig.STEP
    bounces = np.abs(np.sin(20 * time)) + 1e-6 * np.random.default_rng(0).normal(size=COUNT)
    assert len(glitches(bounces, time)) == 0


@pytest.mark.parametrize("step", [1e-5, 1e-4])
def test_coarse_encoder_has_no_masked_samples(step: float):
    log = changed(DRIVE_LOG, "load_angle", lambda v: np.copyto(v, np.rint(v / step) * step))
    assert len(invalid_rows(log)) == 0


def test_clipped_samples_are_masked():
    top = 0.8 * np.max(REDUCED_LOG.dynamic_error)
    log = changed(REDUCED_LOG, "dynamic_error", lambda v: np.copyto(v, np.minimum(v, top)))
    beyond = np.flatnonzero(REDUCED_LOG.dynamic_error >= top)
    found = invalid_rows(log)
    # One or two samples at the limit can't be distinguished from a peak.
    assert np.isin(found, beyond).all() and len(found) > 0.7 * len(beyond)
    (finding,) = masked(log).findings
    assert "clipped" in finding.consequence and f"at {top:g}" in finding.what


def test_clipped_and_stuck_angles_are_masked():
    log = changed(DRIVE_LOG, "load_angle", lambda v: np.copyto(v, np.minimum(v, np.quantile(v, 0.9))))
    assert len(invalid_rows(log)) > 0.05 * COUNT

    def stick(values: np.ndarray) -> None:
        values[1000:1400] = values[1000]

    np.testing.assert_array_equal(invalid_rows(changed(DRIVE_LOG, "motor_angle", stick)), np.arange(1000, 1400))


def test_short_stuck_runs_are_masked():
    """The sensor holds its value while the drive moves on, and then gives the right one again."""
    held = [*range(801, 812), *range(2401, 2550)]

    def stick(values: np.ndarray) -> None:
        values[801:812], values[2401:2550] = values[800], values[2400]

    log = changed(DRIVE_LOG, "load_angle", stick)
    np.testing.assert_array_equal(invalid_rows(log), held)
    assert "160 samples hold one value until it jumps" in masked(log).findings[-1].what


def test_standstill_of_both_sides_is_not_masked():
    log = DRIVE_LOG
    for name in ("motor_angle", "load_angle"):
        log = changed(log, name, lambda v: np.copyto(v[3000:], v[3000]))
    assert masked(log) is log


def test_samples_masked_before_stay_masked():
    blank = np.ones(COUNT, dtype=bool)
    blank[:10] = False

    def change(values: np.ndarray) -> None:
        values[700] += 0.1

    log = replace(changed(DRIVE_LOG, "load_angle", change), trusted=blank)
    np.testing.assert_array_equal(invalid_rows(log), [*range(10), 700])


def test_outputs_after_the_known_samples_are_not_masked():
    def change(values: np.ndarray) -> None:
        values[[30, 700]] += 0.1

    log = replace(changed(DRIVE_LOG, "load_angle", change), outputs_until=50)
    np.testing.assert_array_equal(invalid_rows(log), [30])


def test_piece_with_mostly_invalid_outputs_is_left_out():
    trusted = np.ones(COUNT, dtype=bool)
    trusted[1050:2000] = False
    log = replace(DRIVE_LOG, trusted=trusted, pieces=((0, 1000), (1000, 2000), (2000, COUNT)))
    found = masked(log)
    assert found.pieces == ((0, 1000), (2000, COUNT))
    assert "1 of 3 stretches" in found.findings[-1].what
    with pytest.raises(DataError, match="50 of 4000 rows"):
        masked(replace(log, trusted=np.arange(COUNT) < 50, findings=found.findings))
