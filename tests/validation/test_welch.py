"""Spectral densities, compared with those of scipy."""

import numpy as np
import pytest
from scipy.signal import csd, welch

from fitting.validation.welch import cross_density, density

STEP = 0.004


@pytest.mark.parametrize("window", [128, 129, 1000])
def test_spectral_densities_equal_those_of_scipy(window: int):
    random = np.random.default_rng(0)
    one = 3.0 + random.normal(size=1000)
    other = np.convolve(one, [0.2, 0.5, -0.3], mode="same") + random.normal(size=1000)
    settings = {"fs": 1.0 / STEP, "nperseg": window, "detrend": "constant"}
    frequency, truth = csd(one, other, **settings)
    own_frequency, found = cross_density(one, other, step=STEP, window=window)
    np.testing.assert_allclose(own_frequency, frequency, rtol=1e-13)
    # Rounding of the transforms, relative to the largest line.
    np.testing.assert_allclose(found, truth, atol=1e-13 * np.max(np.abs(truth)), rtol=0)
    _, truth = welch(one, **settings)
    np.testing.assert_allclose(density(one, step=STEP, window=window)[1], truth, atol=1e-13 * np.max(truth), rtol=0)
