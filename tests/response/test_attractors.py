"""Coexisting attractors and their basins against shooting and symmetry."""

import jax.numpy as jnp
import numpy as np
import pytest
from orbits import duffing

from hdjax.fourier import harmonic_series
from hdjax.response.attractors import ESCAPED, Basins, attractors
from hdjax.response.shooting import shoot

# Six attractors: two of period 1, a mirrored pair of period 2, one each of period 3 and 5.
RICH, SHAKEN = duffing(0.05, 1.0), (3.6, 6.0)


@pytest.fixture(scope="module")
def basins() -> Basins:
    return attractors(RICH, harmonic_series(*SHAKEN), (-3.0, 3.0), (-6.0, 6.0), 40)


@pytest.mark.slow
def test_attractors_are_stable_orbits_confirmed_by_shooting(basins):
    """Each has the period that is reported."""
    assert sorted(a.period for a in basins.attractors) == [1, 1, 2, 2, 3, 5]
    for found in basins.attractors:
        orbit = shoot(RICH, harmonic_series(*SHAKEN), jnp.asarray(found.states[0]), periods=found.period)
        assert bool(orbit.stable)
        # 64 Runge-Kutta steps in each period of motions with harmonics, against tight adaptive ones.
        np.testing.assert_allclose(found.states[0], orbit.state, atol=5e-3)


def test_basin_shares_add_up_to_one(basins):
    shares = sum(a.fraction for a in basins.attractors) + basins.escaped + basins.unsettled
    assert shares == pytest.approx(1.0)
    for label, found in enumerate(basins.attractors):
        assert found.fraction == pytest.approx(np.mean(basins.labels == label))
    assert all(a.amplitude <= b.amplitude for a, b in zip(basins.attractors, basins.attractors[1:], strict=False))


def test_basins_have_the_symmetry_of_the_equation(basins):
    """(x, v, t) -> (-x, -v, t + T/2) leaves the equation unchanged: half a period later the basins are turned by pi."""
    later = attractors(RICH, harmonic_series(*SHAKEN, jnp.pi), (-3.0, 3.0), (-6.0, 6.0), 40)
    assert len(later.attractors) == len(basins.attractors)
    # The mirrored pair is of one amplitude, in either order: compare amplitudes, not labels.
    ours, theirs = (np.array([a.amplitude for a in b.attractors])[b.labels] * (b.labels >= 0) for b in (basins, later))
    # Starts on a basin's fractal edge may fall to either side by rounding.
    assert np.mean(np.abs(ours - theirs[::-1, ::-1]) > 1e-2) < 5e-3


def test_softening_drive_escapes_from_part_of_the_plane():
    found = attractors(duffing(0.1, -1.0), harmonic_series(0.8, 0.05), (-1.5, 1.5), (-1.5, 1.5), 30)
    assert 0.1 < found.escaped < 0.9
    assert (found.labels[0, 0], found.labels[-1, -1]) == (ESCAPED, ESCAPED)
    assert found.labels[15, 15] >= 0
    assert sum(a.fraction for a in found.attractors) + found.escaped + found.unsettled == pytest.approx(1.0)
    assert all(np.isfinite(a.states).all() for a in found.attractors)
