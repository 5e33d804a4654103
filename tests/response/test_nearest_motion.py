"""The nearest stable motion among several, against scipy's integration of motion and variation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orbits import duffing_rates, duffing_slope, multipliers, period_error

from hdjax import ReducedDrive
from hdjax.fourier import FourierSeries
from hdjax.response.nearest_motion import NearestMotions, largest, largest_of, nearest_motions

MU, ALPHA, A = 0.05, 1.0, 6.0
# At 3.6: the lower and the upper branch, a sub-harmonic, and beside the unstable branch; at 40 is one motion alone.
OMEGA = np.array([3.6, 3.6, 3.6, 3.6, 40.0])
SIZE = np.array([0.4, 4.5, 1.3, 3.7, 1.0])


@pytest.fixture(scope="module")
def found() -> NearestMotions:
    drive = ReducedDrive(mu=MU, omega_0=1.0, alpha=ALPHA)
    return nearest_motions(drive, A, jnp.asarray(OMEGA), jnp.asarray(SIZE))


def motion(found: NearestMotions, i: int) -> FourierSeries:
    return jax.tree.map(lambda leaf: leaf[i], found.motion)


@pytest.mark.slow
def test_nearest_motions_are_stable_periodic_solutions(found):
    assert np.asarray(found.exists).all()
    for i, omega in enumerate(OMEGA):
        assert period_error(duffing_rates(MU, ALPHA, A, omega), motion(found, i)) < 1e-5
        moduli = np.abs(multipliers(duffing_rates(MU, ALPHA, A, omega), duffing_slope(MU, ALPHA), motion(found, i)))
        assert moduli.max() < 1.0


def test_nearest_motions_lie_on_the_expected_branches(found):
    size, waves = np.asarray(found.size), np.asarray(found.motion.amplitudes)
    assert size[0] < 0.6 < size[2] < 1.0
    assert size[1] == size[3] > 4.0
    third = waves[:, 0] / waves[:, 2]
    assert third[2] > 0.5 and np.delete(third, 2).max() < 1e-12
    # Far above the resonance: A over omega squared.
    assert size[4] == pytest.approx(A / 40.0**2, rel=1e-3)


def test_nearest_motion_size_is_the_largest_twist(found):
    np.testing.assert_allclose(found.size, jax.vmap(FourierSeries.largest)(found.motion), rtol=0.01)


def test_largest_of_a_single_harmonic_is_its_amplitude():
    single = FourierSeries(jnp.ones(()), jnp.asarray(0.5), jnp.asarray([3.0]), jnp.asarray([4.0]))
    assert largest(single) == pytest.approx(5.5)
    assert largest_of(np.array([3.0 - 4.0j])) == pytest.approx(5.0)
