"""Steady states of many points against polynomial roots and against harmonic balance of one drive."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from hdjax import Harmonic, ReducedDrive, ReducedModel, harmonic_series
from hdjax.effects import BY_NAME
from hdjax.response.harmonic_balance import balance, solve
from hdjax.sweep.balance import amplitude_roots
from hdjax.sweep.outputs import answers, plan, variables
from hdjax.sweep.points import Points
from hdjax.sweep.request import Case, Request
from hdjax.sweep.steady_states import SteadyRoute, choose_steady, steady_states
from hdjax.sweep.twist_equation import twist_equation

AMPLITUDE = 0.3


def case(*effects) -> Case:
    return Case(ReducedModel(ReducedDrive(mu=0.1, omega_0=1.0, alpha=0.5)).with_effects(*effects), Harmonic(0.3, 1.0))


def request_of(points: int) -> Request:
    alphas = np.array([-0.02, 0.0, 0.5, 1.0])
    return Request(Points({"alpha": alphas, "forcing.omega": np.linspace(0.4, 2.2, points)}), outputs=("harmonics",))


def test_one_harmonic_amplitudes_are_the_roots_of_the_cubic():
    random = np.random.default_rng(0)
    n = 400
    mu, alpha, omega = random.uniform(0.01, 0.3, n), random.uniform(-0.1, 1.0, n), random.uniform(0.5, 2.0, n)
    alpha[:10] = 0.0
    model = case().model
    drive = (jnp.asarray(mu), jnp.ones(n), jnp.asarray(alpha), jnp.ones(n))
    lanes = eqx.tree_at(lambda m: (m.drive.mu, m.drive.omega_0, m.drive.alpha, m.drive.gain), model, drive)
    found, exists = amplitude_roots(twist_equation(lanes), jnp.full(n, AMPLITUDE), jnp.asarray(omega))
    assert set(np.sum(np.asarray(exists), axis=1).tolist()) == {1, 3}
    for i in range(n):
        c, d = 0.75 * alpha[i], 1.0 - omega[i] ** 2
        z = np.roots([c * c, 2 * c * d, d * d + (mu[i] * omega[i]) ** 2, -(AMPLITUDE**2)])
        true = np.sort(np.sqrt(z.real[np.abs(z.imag) < 1e-7 * np.abs(z)]))
        np.testing.assert_allclose(np.asarray(found[i])[np.asarray(exists[i])], true, rtol=1e-6)


@pytest.mark.parametrize("effects", [(), (BY_NAME["quadratic_damping"](c2=0.1),)], ids=["cubic", "damped by the rate"])
def test_points_agree_with_the_harmonic_balance_of_one_drive(effects):
    given, request = case(*effects), request_of(9)
    values = request.points.values(np.arange(request.points.size))
    found = steady_states(given, SteadyRoute(9, True, 0.0), values)
    # One-harmonic motions beyond the saddles of a softening spring have no counterpart with more harmonics.
    assert found.exists.any(axis=1).all()
    # Samples of a force with corners are not exact.
    tolerance = 1e-3 if effects else 1e-9
    for i in range(0, request.points.size, 4):
        model = given.model.replace({"alpha": values["alpha"][i]})
        one = solve(balance(model, harmonic_series(1.0, AMPLITUDE), harmonics=9), values["forcing.omega"][i])
        assert bool(one.converged)
        true = np.asarray(one.x.cosine)[::2]
        # That solver finds one of several motions.
        nearest = np.nanmin(np.max(np.abs(found.cosine[i] - true), axis=-1))
        assert nearest < tolerance


def test_steady_motion_between_the_folds_is_unstable():
    given, request = case(), request_of(150)
    route, check = choose_steady(given, request)
    assert 0.0 < check.error <= request.tolerance
    found = steady_states(given, route, request.points.values(np.arange(request.points.size)))
    several = found.exists.sum(axis=1) == 3
    assert several.sum() > 10
    assert not found.stable[several, 1].any() and found.stable[several][:, [0, 2]].all()


@pytest.mark.parametrize("omega", [0.0, -1.0])
@pytest.mark.parametrize("settings", [{}, {"response": "transient", "outputs": ("peak",), "periods": 3.0}])
def test_fixed_frequency_that_is_not_positive_is_refused(settings, omega):
    request = Request(Points({"alpha": np.array([0.0, 0.5])}), **settings)
    with pytest.raises(ValueError, match="`forcing.omega` must lie between 0 and inf"):
        Case(case().model, Harmonic(0.3, omega)).require(request)


@pytest.mark.slow
def test_harmonic_phases_follow_the_phase_of_the_forcing():
    request = Request(Points({"forcing.phase": np.array([0.0, 0.7]), "forcing.omega": np.array([0.6, 1.9])}))
    request = Request(request.points, outputs=("harmonics",))
    found = answers(case(), request, plan(case(), request), request.points.values(np.arange(4)))
    assert {v.name for v in variables(request)} == set(found)
    phase, there = found["harmonic_phase"].reshape(2, 2, 3, -1), ~np.isnan(found["mean"]).reshape(2, 2, 3)[0]
    turned = np.exp(1j * (phase[1] - phase[0]))[there]
    orders = np.arange(1, 2 * turned.shape[-1], 2)
    np.testing.assert_allclose(turned, np.exp(0.7j * orders)[None] * np.ones_like(turned), atol=1e-9)


def test_drive_at_rest_is_checked_like_others():
    points = Points({"forcing.amplitude": np.array([0.0, 0.3]), "forcing.omega": np.array([0.6, 1.9])})
    request = Request(points, outputs=("harmonics",))
    _, check = choose_steady(case(), request)
    assert check.unfinished == 0 and 0.0 < check.error <= request.tolerance


def test_even_harmonics_are_kept_where_any_point_has_an_offset():
    """The pilot may hold points without one only."""
    points = Points({"forcing.omega": np.linspace(0.4, 2.2, 50), "forcing.offset": np.array([0.0, 0.2])})
    route, _ = choose_steady(case(), Request(points, outputs=("harmonics",)))
    assert not route.odd


def test_motions_of_a_negative_gain_are_in_antiphase():
    given, request = case(), request_of(9)
    values = request.points.values(np.arange(request.points.size))
    turned = eqx.tree_at(lambda c: c.model.drive.gain, given, -given.model.drive.gain)
    one, other = (steady_states(c, SteadyRoute(9, True, 0.0), values) for c in (given, turned))
    np.testing.assert_array_equal(one.exists, other.exists)
    np.testing.assert_allclose(one.cosine[one.exists], -other.cosine[one.exists], atol=1e-9)


def test_sweep_without_steady_motions_has_nothing_to_check():
    """A spring that softens so early that no motion exists at resonance."""
    points = Points({"alpha": np.full(4, -50.0), "forcing.omega": np.linspace(0.95, 1.0, 16)})
    _, check = choose_steady(case(), Request(points, outputs=("harmonics",)))
    assert check.points >= 0 and (check.points or np.isnan(check.error))


@pytest.mark.parametrize(
    "name", ["bouc_wen", "input_delay", "position_dependent_stiffness", "position_dependent_mesh_friction"]
)
def test_effects_without_a_harmonic_balance_are_refused(name):
    from hdjax.effects.catalogue import BY_NAME as forms
    from hdjax.effects.effect import Scales

    effect = forms[name].proposals(Scales(1e-3, 1e-3, 0.1, 1.0, 1.0, 1e-3))[0]
    with pytest.raises(ValueError, match=name):
        choose_steady(case(effect), request_of(3))
