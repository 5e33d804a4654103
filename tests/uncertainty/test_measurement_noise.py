"""Measurement noise of the outputs, estimated with a true model, a wrong one and one that lacks a force."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import joints
import rig
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.measurement_noise import _MOTION, measurement_noise
from hdjax import Drive, TwoInertiaModel

COUNT = 1000
NOISE = 1e-3
# 1000 samples less two states in nine: 2.6 % of a standard deviation.
CLOSE = 0.08


def fit_with_held_parameters(*, noise: float = NOISE, omega_0: float = rig.OMEGA_0, **physics) -> Fit:
    """Fit the initial states only, to a log that may contain physics missing from the model."""
    experiment = rig.reduced_experiment(COUNT, noise=noise, **physics)
    model = rig.reduced_model(omega_0=omega_0)
    stretches = [Stretch(experiment, 0, len(experiment))]
    return fit(
        model,
        stretches,
        base_paths(model),
        Segmentation(128, substeps=2, count=8),
        strategy=Strategy(hold_parameters=True),
    )


def rms(first: Fit, *others: Fit) -> float:
    noise = measurement_noise(first)
    for other in others:
        noise = noise.and_beside(other)
    return float(np.sqrt(noise.covariance[0, 0]))


def test_measurement_noise_is_estimated_despite_a_wrong_frequency():
    right, off = fit_with_held_parameters(), fit_with_held_parameters(omega_0=1.02 * rig.OMEGA_0)
    assert rms(right) == pytest.approx(NOISE, rel=CLOSE)
    # A frequency error of 2 % leaves a far larger residual over many periods than over half of one.
    assert off.principal_std > 1e-2
    assert rms(off) < 0.2 * off.principal_std


def test_measurement_noise_of_a_short_log_with_gaps_is_finite():
    """Two invalid samples in each first part of a segment leave no piece there."""
    experiment = rig.reduced_experiment(200, noise=NOISE)
    weight = np.ones(200)
    weight[10:12] = 0.0
    model, stretches = rig.reduced_model(), [Stretch(replace(experiment, weight=weight), 0, 200)]
    held = fit(model, stretches, base_paths(model), Segmentation(256), strategy=Strategy(hold_parameters=True))
    assert rms(held) == pytest.approx(NOISE, rel=0.3)


def test_measurement_noise_is_estimated_where_only_a_short_log_has_a_load_torque():
    """Pieces further on are cut from the other log alone, which has none."""
    joint = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, rms=0.05)
    logs = [joints.log_of(joint, count=2000), joints.log_of(joint, count=180, seed=1, name="short")]
    logs[1] = replace(logs[1], load_torque=np.zeros(180))
    stretches = whole([experiment_from_log(log, hold="zero-order", N=joint.N) for log in logs])
    drive = Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=joint.K, B_sp=joint.B_sp)
    model = TwoInertiaModel(drive)
    held = fit(model, stretches, base_paths(model), Segmentation(256), strategy=Strategy(hold_parameters=True))
    noise = np.sqrt(np.diag(measurement_noise(held).covariance))
    np.testing.assert_allclose(noise, np.sqrt(np.diag(held.covariance)), rtol=0.1)


@pytest.mark.parametrize(("bias", "most"), [(0.0, 1.0), (1.0, _MOTION), (5.0, 1.0)])
def test_measurement_noise_excludes_a_missing_force(bias: float, most: float):
    """Within half a period, the strongest force moves the drive by sixty times the noise; a weak one may pass."""
    assert (1.0 - CLOSE) * NOISE < rms(fit_with_held_parameters(bias=bias)) < (1.0 + CLOSE) * most * NOISE


def test_measurement_noise_is_the_smallest_over_models():
    right, off = fit_with_held_parameters(), fit_with_held_parameters(omega_0=1.2 * rig.OMEGA_0)
    assert rms(off, right) == rms(right, off) == min(rms(right), rms(off))
    noise = measurement_noise(right).and_beside(off)
    assert noise.and_beside(right) is noise is noise.and_beside(off)


@pytest.mark.parametrize(("samples", "degree"), [(6, 2), (9, 3), (24, 3)])
def test_measurement_noise_keeps_coloured_noise(samples: int, degree: int):
    """A polynomial reduces noise with a correlation of 0.5 by less than the factor that is taken for motion."""
    pushed = np.random.default_rng(0).normal(size=(20000, samples))
    pushed[:, 1:] *= np.sqrt(1.0 - 0.5**2)
    noise = lfilter([1.0], [1.0, -0.5], pushed)
    seen = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, samples), 1 + degree))[0]
    left = np.sum((noise - noise @ seen @ seen.T) ** 2) / (samples - degree - 1) / len(noise)
    assert 1.1 < np.sqrt(1.0 / left) < _MOTION


def test_measurement_noise_excludes_the_slow_error_of_an_encoder():
    """No initial state describes a constant error of the load's angle, since the twist drives the load."""
    torque = rig.drive_torque(2 * COUNT)
    motion = rig.drive_motion(torque)
    motion[:, 1] += 100.0 * rig.LOAD_NOISE * np.cos(motion[:, 1])
    experiment = experiment_from_log(rig.drive_log(motion, torque), hold="zero-order", N=rig.N)
    model = rig.drive_model()
    options = {"strategy": Strategy(hold_parameters=True)}
    found = fit(model, whole([experiment]), base_paths(model), Segmentation(128), **options)
    assert found.principal_std > 20.0 * rig.LOAD_NOISE
    assert 0.9 < float(measurement_noise(found).covariance[1, 1]) ** 0.5 / rig.LOAD_NOISE < 2.0
