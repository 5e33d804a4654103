"""Encoders without a common zero: the zero of the twist is estimated from the motion."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rig
from fitting.logs.drive_file import DriveFile
from fitting.logs.log import Log
from fitting.logs.zeroing import zeroed

DRIVE = DriveFile(Path("drive.toml"), "rig", rig.N, rig.J_M, rig.J_L, "zero-order", None, {})
COUNT = 6000


def drive_log(seed: int = 0, **physics) -> Log:
    torque = rig.drive_torque(COUNT, seed=seed)
    return rig.drive_log(rig.drive_motion(torque, **physics), torque, seed=seed)


def with_offset(log: Log, offset: float) -> Log:
    load = None if log.load_angle is None else log.load_angle - offset
    return replace(log, load_angle=load, dynamic_error=log.dynamic_error + offset)


@pytest.mark.parametrize("offset", [0.7, -2.0, 24.0, 5e-3])
@pytest.mark.parametrize("seed", [0, 1])
def test_zero_of_a_drive_log_is_estimated(offset: float, seed: int):
    log = drive_log(seed)
    found = zeroed(with_offset(log, offset), DRIVE)
    # The mean of the motion has an error of 1e-6 rad; the zero is known to 1 % of one sample's noise.
    assert found.zero == pytest.approx(offset, abs=1e-7)
    np.testing.assert_allclose(found.dynamic_error, log.dynamic_error, atol=1e-7)
    (finding,) = found.findings
    assert "off zero" in finding.what and "not zeroed together" in finding.consequence


def test_zero_of_a_strongly_nonlinear_drive_is_estimated():
    """A preload by gravity shifts the median of the twist, but not the zero of the spring."""
    log = drive_log(alpha=4e5)
    found = zeroed(with_offset(log, 0.3), DRIVE)
    assert found.zero == pytest.approx(0.3, abs=1e-6)


def test_zero_of_a_reduced_log_is_estimated():
    forcing = rig.reduced_forcing(4000)
    log = rig.reduced_log(rig.reduced_motion(forcing)[:, 0], forcing, noise=1e-3)
    offset = 5 * np.std(log.dynamic_error)
    found = zeroed(with_offset(log, offset), replace(DRIVE, reduction_ratio=None))
    # A thousandth of the motion, which is a tenth of the noise of one sample.
    assert found.zero == pytest.approx(offset, abs=1e-3 * np.std(log.dynamic_error))


@pytest.mark.parametrize("physics", [{}, {"gravity": 20.0}, {"torque_bias": 0.05}, {"mesh_friction": (2.0, 1e-3)}])
def test_offset_that_a_load_explains_is_not_removed(physics: dict):
    log = drive_log(**physics)
    assert zeroed(log, DRIVE) is log


def test_offset_that_a_motor_torque_explains_is_not_removed():
    log = drive_log()
    held = replace(log, motor_torque=log.motor_torque + 5.0, dynamic_error=log.dynamic_error + 5e-3)
    assert zeroed(held, DRIVE) is held


def test_logs_of_one_drive_share_a_zero_where_it_explains_their_offset():
    first, second = (with_offset(drive_log(seed), 0.7) for seed in (0, 1))
    zero = zeroed(first, DRIVE).zero
    assert zeroed(second, DRIVE, zeros=[zero]).zero == zero
    # Of a log for a prediction, 50 samples tell far less of the zero.
    assert zeroed(replace(second, outputs_until=50), DRIVE, zeros=[zero]).zero == zero
    assert zeroed(drive_log(1), DRIVE, zeros=[zero]).zero == 0.0
    moved = zeroed(with_offset(drive_log(1), -0.2), DRIVE, zeros=[zero])
    assert moved.zero == pytest.approx(-0.2, abs=1e-7)


@pytest.mark.parametrize(
    ("offset", "zeros", "own"),
    [
        (0.7, [], True),
        (0.7, [0.7], False),
        (0.7, [0.7, 0.7], False),
        (0.7, [0.0], True),
        (0.7, [0.7, 0.71], True),
        (0.0, [0.7], True),
        (0.0, [], False),
        (0.0, [0.0], False),
    ],
)
def test_first_samples_have_a_zero_of_their_own_where_other_logs_do_not_tell_it(offset, zeros, own):
    log = with_offset(drive_log(), offset)
    assert zeroed(replace(log, outputs_until=50), DRIVE, zeros=zeros).has_own_zero is own
    assert not zeroed(log, DRIVE, zeros=zeros).has_own_zero


def test_masked_samples_do_not_change_the_zero():
    log = with_offset(drive_log(), 0.7)
    spoilt = log.dynamic_error.copy()
    spoilt[::50] += 0.1
    trusted = np.arange(COUNT) % 50 != 0
    # Each window holds a masked row, so that the zero follows from the median.
    assert zeroed(replace(log, dynamic_error=spoilt, trusted=trusted), DRIVE).zero == pytest.approx(0.7, abs=1e-4)
    spoilt = log.dynamic_error.copy()
    spoilt[::500] += 0.1
    trusted = np.arange(COUNT) % 500 != 0
    assert zeroed(replace(log, dynamic_error=spoilt, trusted=trusted), DRIVE).zero == pytest.approx(0.7, abs=1e-6)


def test_zero_for_a_prediction_follows_from_the_known_samples():
    log = with_offset(drive_log(), 1.5)
    found = zeroed(replace(log, outputs_until=50), DRIVE)
    assert found.zero == pytest.approx(1.5, abs=0.05 * np.std(log.dynamic_error))
    spoilt = log.dynamic_error.copy()
    spoilt[50:] = 7.0
    assert zeroed(replace(log, dynamic_error=spoilt, outputs_until=50), DRIVE).zero == found.zero
