"""Several harmonics at once, off resonance and where they combine, against scipy and a harmonic balance in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from phasors import balanced
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hdjax.drive import ReducedDrive
from hdjax.forcing import MultiHarmonic
from hdjax.response.several_harmonics import (
    CombinationResonance,
    OffResonance,
    combination_resonances,
    forced_response,
    forced_shift,
    harmonics_and_load,
)

W0 = 2.0


def test_error_of_the_off_resonance_transient_falls_with_epsilon():
    forcing = MultiHarmonic(jnp.array([1.5, 0.8]), jnp.array([1.1, 4.5]), jnp.array([0.3, -1.0]))
    errors = []
    epsilons = np.array([0.04, 0.02, 0.01])
    for epsilon in epsilons:
        drive = ReducedDrive(mu=epsilon, omega_0=W0, alpha=epsilon)
        response = OffResonance(drive, forcing, x_0=0.7, v_0=-0.4)

        def motion(t, y, epsilon=epsilon):
            push = 1.5 * np.cos(1.1 * t + 0.3) + 0.8 * np.cos(4.5 * t - 1.0)
            return [y[1], push - epsilon * y[1] - W0**2 * (y[0] + epsilon * y[0] ** 3)]

        t = np.linspace(0, 2 / epsilon, 400)
        y = solve_ivp(motion, (0, t[-1]), [0.7, -0.4], "DOP853", t, rtol=1e-10, atol=1e-12).y[0]
        found = jax.vmap(response)(jnp.asarray(t))
        np.testing.assert_allclose(found[0], 0.7, rtol=1e-14)
        errors.append(np.max(np.abs(found - y)))
    slopes = np.diff(np.log(errors)) / np.diff(np.log(epsilons))
    np.testing.assert_allclose(slopes, 1, atol=0.2)
    # The frequency shift matters: without it the phase is off by order one.
    assert errors[-1] < 0.05


def test_constant_load_shifts_the_frequency():
    """Small vibrations about the equilibrium `x_s` of a constant load have the stiffness `1 + 3 alpha x_s^2`."""
    drive = ReducedDrive(mu=0.0, omega_0=W0, alpha=1e-3)
    load = harmonics_and_load(1.0, 0.0, 0.0, 0.0, 4.0)
    x_s = brentq(lambda x: W0**2 * (x + 1e-3 * x**3) - 4.0, 0, 2)
    exact = W0 * np.sqrt(1 + 3e-3 * x_s**2) - W0
    np.testing.assert_allclose(forced_shift(drive, load), exact, rtol=5e-3)


@pytest.mark.parametrize(
    ("multiples", "name"),
    [((3, 5), "2 w_1 + w_l"), ((3, 5, 7), "3 w_2 = w_1 + w_2 + w_l"), ((5, 17), "w_l - 2 w_1"), ((5, 9, 13), None)],
)
def test_combination_resonance_agrees_with_harmonic_balance(multiples, name):
    """Amplitude and phase against harmonic balance of the whole multi-frequency response, to O(epsilon)."""
    response = {(3, 5): 11, (3, 5, 7): 15, (5, 17): 7, (5, 9, 13): 1}[multiples]
    A = np.array({(5, 17): [1.5, 6.0]}.get(multiples, [3.0, 2.5, 2.0]))[: len(multiples)]
    phi = np.array([0.4, -0.9, 1.3])[: len(multiples)]
    errors = []
    epsilons = np.array([1e-2, 3e-3, 1e-3])
    for epsilon in epsilons:
        drive = ReducedDrive(mu=0.5 * epsilon, omega_0=W0, alpha=epsilon)
        unit = (W0 + 0.3 * epsilon) / response
        forcing = MultiHarmonic(jnp.asarray(A), unit * jnp.asarray(multiples, dtype=float), jnp.asarray(phi))
        names = [*(f"w_{i + 1}" for i in range(len(A) - 1)), "w_l"]
        nearest = combination_resonances(drive, forcing, names)[0]
        if name:
            assert nearest.name == name
        assert nearest.kind == "additive"
        np.testing.assert_allclose(nearest.sigma, 0.3 * epsilon, rtol=1e-6)
        branches = CombinationResonance(drive, forcing, nearest.multiples).branches()
        branch = int(jnp.argmax(branches.stable))
        start = np.zeros(63, complex)
        forced = forced_response(drive, forcing)
        start[np.array(multiples) - 1] = np.asarray(forced.amplitudes) * np.exp(1j * phi)
        found = complex(branches.amplitude[branch]) * np.exp(1j * float(branches.phase[branch]))
        start[response - 1] = found
        push = {m: a * np.exp(1j * p) for m, a, p in zip(multiples, A, phi, strict=True)}
        exact = balanced(drive, unit, push, start)[response - 1]
        errors.append(abs(found / exact - 1))
    slopes = np.diff(np.log(errors)) / np.diff(np.log(epsilons))
    np.testing.assert_allclose(slopes, 1, atol=0.25)


def test_combination_resonances_are_listed_by_detuning():
    drive = ReducedDrive(mu=0.1, omega_0=10.0, alpha=0.1)
    forcing = harmonics_and_load(3.4, [1.0, 1.0], [0.0, 0.0], 30.5, 1.0)
    found = combination_resonances(drive, forcing, ["w_1", "w_2", "w_l"])
    sigmas = [abs(c.sigma) for c in found]
    assert sigmas == sorted(sigmas)
    by_name = {c.name: c for c in found}
    np.testing.assert_allclose(by_name["w_l / 3"].omega, 30.5 / 3)
    assert by_name["w_l / 3"].kind == "sub-harmonic"
    # Two ways to 3 omega, as the second harmonic is there: one entry.
    assert by_name["3 w_1 = 2 w_2 - w_1"].multiples == ((3, 0, 0), (-1, 2, 0))
    assert by_name["w_2"].kind == "primary"
    assert by_name["(w_l - w_2) / 2"].kind == "parametric"
    assert all(c.omega > 0 for c in found)
    with pytest.raises(ValueError, match="`names` must be 3"):
        combination_resonances(drive, forcing, ["w_1"])
