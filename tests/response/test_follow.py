"""Branches in other parameters, of effects and of sub-harmonics: each motion against scipy's integration."""

from math import cos

import jax.numpy as jnp
import numpy as np
import pytest
from branches import assert_whole, left_over, path, row, turns
from orbits import duffing, duffing_rates, duffing_slope, multipliers, period_error

from hdjax import Drive, TwoInertiaModel
from hdjax.effects.stiffness import QuadraticStiffness, QuinticStiffness
from hdjax.fourier import FourierSeries, harmonic_series
from hdjax.response.continuation import Branch, follow, frequency_response
from hdjax.response.fold import folds
from hdjax.response.harmonic_balance import balance


def same_multipliers(branch: Branch, i: int, rates, slope) -> bool:
    found, other = (np.sort_complex(m) for m in (branch.multipliers[i], multipliers(rates, slope, row(branch, i))))
    return bool(np.abs(found - other).max() < 1e-6)


# -- a sub-harmonic, which is a closed curve --

MU, ALPHA, LEVEL = 0.1, 1.0, 3.0


@pytest.fixture(scope="module")
def subharmonic() -> Branch:
    omega = 4.0
    # One term beside the forced motion A cos(omega t) / (1 - omega^2).
    wave = FourierSeries(1.0, jnp.zeros(()), jnp.asarray([1.0, 0.0, -LEVEL / (omega**2 - 1)]), jnp.asarray([0.1, 0, 0]))
    system = (duffing(MU, ALPHA), harmonic_series(1.0, LEVEL), omega, 12.0)
    return frequency_response(*system, points=200, harmonics=21, subharmonic=3, guess=wave)


def test_subharmonic_branch_is_a_closed_curve(subharmonic):
    branch = subharmonic
    assert bool(branch.complete) and np.asarray(branch.valid).all()
    assert left_over(branch).max() < 1e-8
    chords = np.linalg.norm(np.diff(path(branch), axis=0), axis=1)
    assert chords.max() < 1.2 * np.median(chords)
    assert np.linalg.norm(path(branch)[0] - path(branch)[-1]) < 1.5 * chords.max() + 0.1
    assert len(turns(branch)) == 2
    # About half of it is stable, and no motion has the period of the forcing.
    stable = np.asarray(branch.stable)
    assert 0.2 < stable.mean() < 0.8
    assert np.asarray(branch.steady_states.x.amplitudes)[:, 0].min() > 0.3


def test_subharmonic_motions_and_multipliers_agree_with_time_integration(subharmonic):
    """Over three forcing periods, on the stable and the unstable side and beside the folds."""
    first, second = turns(subharmonic)
    sides = set()
    for i in (0, first, (first + second) // 2, second, 180):
        x, omega = row(subharmonic, i), float(subharmonic.omega[i])
        rates = duffing_rates(MU, ALPHA, LEVEL, omega)
        assert float(x.omega) == pytest.approx(omega / 3)
        assert period_error(rates, x) < 1e-8, i
        assert same_multipliers(subharmonic, i, rates, duffing_slope(MU, ALPHA)), i
        sides.add(bool(subharmonic.stable[i]))
    assert sides == {True, False}


# -- other parameters --

K_2, K_5, OMEGA = 0.3, 0.4, 1.5


@pytest.mark.slow
def test_branch_in_forcing_amplitude_of_an_asymmetric_quintic_spring_has_two_folds():
    """The even term shifts the mean of the motion to one side."""
    model = duffing(MU, 0.3).with_effects(QuinticStiffness(k5=K_5), QuadraticStiffness(k2=K_2))
    system = balance(model, harmonic_series(1.0, 0.1), harmonics=21)
    branch = follow(system, "amplitude", 0.5, 12.0, omega=OMEGA, points=200)
    assert_whole(branch, 0.5, 12.0)
    first, second = turns(branch)

    def slope(y):
        x = y[0]
        return np.array([[0.0, 1.0], [-(1 + 2 * K_2 * x + 0.9 * x**2 + 5 * K_5 * x**4), -MU]])

    for i in (0, first, (first + second) // 2, second, 199):
        level = 0.1 * float(branch.value[i])

        def rates(t, y, level=level):
            x, v = y
            return v, level * cos(OMEGA * t) - MU * v - (x + K_2 * x**2 + 0.3 * x**3 + K_5 * x**5)

        assert period_error(rates, row(branch, i)) < 1e-8, i
        assert same_multipliers(branch, i, rates, slope), i
    assert abs(float(row(branch, first).mean)) > 0.05
    found = folds(branch, at_most=2)
    assert np.asarray(found.exists).all()
    assert float(found.value[1]) < float(found.value[0])


@pytest.mark.slow
def test_branch_in_stiffness_of_two_inertias_agrees_with_the_closed_form():
    """Without a cubic term the response has a closed form."""
    drive = Drive(N=2.0, J_m=1.0, J_l=3.0, K=5.0, B_sp=0.6)
    system = balance(TwoInertiaModel(drive), harmonic_series(1.0, 0.8), harmonics=2)
    branch = follow(system, "K", 1.0, 9.0, omega=1.5, points=30)
    assert bool(branch.complete) and np.asarray(branch.valid).all()
    c = (4 * 1.0 + 3.0) / (4 * 1.0 * 3.0)
    exact = 0.4 / np.abs(c * np.asarray(branch.value) - 1.5**2 + 1.5j * c * 0.6)
    np.testing.assert_allclose(branch.steady_states.x.amplitudes[:, 0], exact, rtol=1e-9)
    assert float(branch.value[0]) == pytest.approx(1.0) and float(branch.value[-1]) == pytest.approx(9.0, rel=1e-3)


@pytest.mark.slow
def test_branch_in_the_cubic_coefficient_agrees_with_time_integration():
    system = balance(duffing(0.1, 0.0), harmonic_series(1.0, 0.1), harmonics=11)
    branch = follow(system, "alpha", 0.0, 2.0, omega=0.9, points=40)
    assert bool(branch.complete) and np.asarray(branch.valid).all()
    for i in (0, 13, 39):
        assert period_error(duffing_rates(0.1, float(branch.value[i]), 0.1, 0.9), row(branch, i)) < 1e-8, i


@pytest.mark.slow
def test_branch_of_too_few_steps_is_reported_as_incomplete():
    branch = frequency_response(duffing(0.1, 1.0), harmonic_series(1.0, 0.08), 0.35, 2.0, points=20, steps=4)
    assert not bool(branch.complete)
    assert left_over(branch)[np.asarray(branch.valid)].max() < 1e-8
    assert float(branch.value[-1]) < 1.9
