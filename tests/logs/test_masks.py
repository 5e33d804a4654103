"""Wrong samples of a sensor are found and lose their weight; right ones, however odd, keep it."""

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


def untrusted(log: Log) -> np.ndarray:
    found = masked(log)
    return np.zeros(0, dtype=int) if found.trusted is None else np.flatnonzero(~found.trusted)


def spoilt(log: Log, name: str, change) -> Log:
    values = getattr(log, name).copy()
    change(values)
    return replace(log, **{name: values})


@pytest.mark.parametrize("log", [DRIVE_LOG, REDUCED_LOG], ids=["drive", "reduced"])
def test_good_logs_stay_as_they_are(log: Log):
    assert masked(log) is log


@pytest.mark.parametrize("physics", [{"mesh_friction": (2.0, 1e-3)}, {"gravity": 20.0}, {"kinematic": (3e-4, 0.0)}])
def test_odd_physics_is_no_fault(physics: dict):
    log = rig.drive_log(rig.drive_motion(TORQUE, **physics), TORQUE)
    assert masked(log) is log


@pytest.mark.parametrize(("name", "size"), [("load_angle", 5e-5), ("load_angle", 0.5), ("motor_angle", 1e-3)])
def test_lone_wrong_samples(name: str, size: float):
    rows = np.array([40, 700, 1500, 1503, 3900])

    def change(values: np.ndarray) -> None:
        values[rows] += size * np.array([1, -1, 1, 1, -1])

    log = spoilt(DRIVE_LOG, name, change)
    np.testing.assert_array_equal(untrusted(log), rows)
    (finding,) = masked(log).findings
    assert "5 samples differ" in finding.what and f"{name}, first in data row 41" in finding.where


@pytest.mark.parametrize("length", [2, 3, 5])
def test_dropouts_to_zero(length: int):
    def change(values: np.ndarray) -> None:
        values[1000 : 1000 + length] = 0.0
        values += 1.0
        values[1000 : 1000 + length] = 0.0

    np.testing.assert_array_equal(untrusted(spoilt(DRIVE_LOG, "load_angle", change)), np.arange(1000, 1000 + length))


def test_wrong_samples_of_a_reduced_log():
    def change(values: np.ndarray) -> None:
        values[[500, 501, 2000]] += 1.0

    np.testing.assert_array_equal(untrusted(spoilt(REDUCED_LOG, "dynamic_error", change)), [500, 501, 2000])


def test_late_samples_are_no_glitches():
    """Where the sampling itself was late, the motion went on meanwhile."""
    late = DRIVE_LOG.time + np.where(np.arange(COUNT) % 97 == 50, 0.9 * rig.STEP, 0.0)
    smooth = np.sin(300 * late)
    assert len(glitches(smooth, late)) == 0
    assert len(glitches(smooth, DRIVE_LOG.time)) > 0


def test_an_impact_is_no_glitch():
    time = np.arange(COUNT) * rig.STEP
    bounces = np.abs(np.sin(20 * time)) + 1e-6 * np.random.default_rng(0).normal(size=COUNT)
    assert len(glitches(bounces, time)) == 0


@pytest.mark.parametrize("step", [1e-5, 1e-4])
def test_a_coarse_encoder_makes_no_glitches(step: float):
    log = spoilt(DRIVE_LOG, "load_angle", lambda v: np.copyto(v, np.rint(v / step) * step))
    assert len(untrusted(log)) == 0


def test_clipped_samples():
    top = 0.8 * np.max(REDUCED_LOG.dynamic_error)
    log = spoilt(REDUCED_LOG, "dynamic_error", lambda v: np.copyto(v, np.minimum(v, top)))
    beyond = np.flatnonzero(REDUCED_LOG.dynamic_error >= top)
    found = untrusted(log)
    # Runs of one or two samples at the limit are not told from a peak.
    assert np.isin(found, beyond).all() and len(found) > 0.7 * len(beyond)
    (finding,) = masked(log).findings
    assert "clipped" in finding.consequence and f"at {top:g}" in finding.what


def test_a_clipped_angle_and_a_stuck_one():
    log = spoilt(DRIVE_LOG, "load_angle", lambda v: np.copyto(v, np.minimum(v, np.quantile(v, 0.9))))
    assert len(untrusted(log)) > 0.05 * COUNT

    def stick(values: np.ndarray) -> None:
        values[1000:1400] = values[1000]

    np.testing.assert_array_equal(untrusted(spoilt(DRIVE_LOG, "motor_angle", stick)), np.arange(1000, 1400))


def test_standstill_is_not_stuck():
    log = DRIVE_LOG
    for name in ("motor_angle", "load_angle"):
        log = spoilt(log, name, lambda v: np.copyto(v[3000:], v[3000]))
    assert masked(log) is log


def test_what_was_masked_before_stays_masked():
    blank = np.ones(COUNT, dtype=bool)
    blank[:10] = False

    def change(values: np.ndarray) -> None:
        values[700] += 0.1

    log = replace(spoilt(DRIVE_LOG, "load_angle", change), trusted=blank)
    np.testing.assert_array_equal(untrusted(log), [*range(10), 700])


def test_later_outputs_are_not_looked_at():
    def change(values: np.ndarray) -> None:
        values[[30, 700]] += 0.1

    log = replace(spoilt(DRIVE_LOG, "load_angle", change), outputs_until=50)
    np.testing.assert_array_equal(untrusted(log), [30])


def test_a_piece_without_believable_outputs_is_left_out():
    trusted = np.ones(COUNT, dtype=bool)
    trusted[1050:2000] = False
    log = replace(DRIVE_LOG, trusted=trusted, pieces=((0, 1000), (1000, 2000), (2000, COUNT)))
    found = masked(log)
    assert found.pieces == ((0, 1000), (2000, COUNT))
    assert "1 of 3 stretches" in found.findings[-1].what
    with pytest.raises(DataError, match="50 of 4000 rows"):
        masked(replace(log, trusted=np.arange(COUNT) < 50, findings=found.findings))
