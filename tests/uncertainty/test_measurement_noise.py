"""Measurement noise of the outputs, estimated with a true model, a wrong one and one that lacks a force."""

import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.measurement_noise import _MOTION, measurement_noise

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


@pytest.mark.parametrize(("bias", "most"), [(0.0, 1.0), (1.0, _MOTION), (5.0, 1.0)])
def test_measurement_noise_excludes_a_missing_force(bias: float, most: float):
    """Within half a period, the strongest force moves the drive by sixty times the noise; a weak one may pass."""
    assert (1.0 - CLOSE) * NOISE < rms(fit_with_held_parameters(bias=bias)) < (1.0 + CLOSE) * most * NOISE


def test_measurement_noise_is_the_smallest_over_models():
    right, off = fit_with_held_parameters(), fit_with_held_parameters(omega_0=1.2 * rig.OMEGA_0)
    assert rms(off, right) == rms(right, off) == min(rms(right), rms(off))
    noise = measurement_noise(right).and_beside(off)
    assert noise.and_beside(right) is noise is noise.and_beside(off)


@pytest.mark.parametrize("samples", [6, 12, 24])
def test_measurement_noise_keeps_coloured_noise(samples: int):
    """Two more powers of time reduce a random walk by less than the factor that is taken for motion."""
    walks = np.cumsum(np.random.default_rng(0).normal(size=(20000, samples)), axis=1)
    time = np.linspace(-1.0, 1.0, samples)
    left = []
    for powers in (2, 4):
        seen = np.linalg.qr(np.vander(time, powers))[0]
        left.append(np.sum((walks - walks @ seen @ seen.T) ** 2) / (samples - powers))
    assert 1.2 < np.sqrt(left[0] / left[1]) < _MOTION
