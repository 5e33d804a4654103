"""Spectral lines of the residual are detected at their frequencies, and none in noise."""

import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import experiment_from_log, split
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.first_order.spectral_lines import spectral_lines


def fit_with_unlogged_forcing(forcing: np.ndarray, hidden: np.ndarray) -> Fit:
    """Fit the base model to a reduced log under a forcing with an unlogged part."""
    motion = rig.reduced_motion(forcing + hidden)
    experiment = experiment_from_log(rig.reduced_log(motion[:, 0], forcing, noise=1e-3), hold="zero-order")
    model = rig.reduced_model()
    return fit(model, split([experiment])[0], base_paths(model), Segmentation(128, substeps=2))


@pytest.mark.parametrize("omega", [7.0, 62.0, 141.0])
def test_unlogged_spectral_line_is_detected(omega: float):
    time = np.arange(2000) * rig.REDUCED_STEP
    lines = spectral_lines(fit_with_unlogged_forcing(rig.reduced_forcing(2000), 1.5 * np.sin(omega * time)))
    resolution = 2 * np.pi / (1600 * rig.REDUCED_STEP)
    assert lines[0] == pytest.approx(omega, abs=0.1 * resolution)


def test_no_line_is_detected_in_noise():
    forcing = rig.reduced_forcing(2000)
    assert spectral_lines(fit_with_unlogged_forcing(forcing, np.zeros(2000))) == ()
