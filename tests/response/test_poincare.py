"""Poincare sections and bifurcations against adaptive steps, shooting, closed forms and the literature."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from orbits import duffing

from hdjax import TwoInertiaModel, hdc_40_050
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.hysteresis import BoucWen
from hdjax.fourier import harmonic_series
from hdjax.response.poincare import bifurcation_diagram, period_of, poincare_section
from hdjax.response.shooting import period_map, shoot

# -- marching --


@pytest.mark.parametrize("omega", (0.4, 2.5))
def test_default_steps_of_a_section_give_four_digits(omega):
    """Against tight adaptive steps, below and above the natural frequency."""
    model, forcing = duffing(0.2, 0.5), harmonic_series(omega, np.array([0.5, 0.3]), np.array([0.2, 1.0]), mean=0.1)
    state = jnp.asarray([0.5, -0.5])
    section = poincare_section(model, forcing, state[None], transient_periods=0, kept_periods=2)
    np.testing.assert_allclose(section.states[0, 0], period_map(model, forcing, state), atol=2e-5)


def test_integration_of_a_section_is_of_fourth_order():
    model, forcing, state = duffing(0.2, 0.5), harmonic_series(0.9, 0.5), jnp.asarray([0.5, -0.5])
    exact = period_map(model, forcing, state)
    errors = []
    for steps in (32, 128):
        section = poincare_section(
            model, forcing, state[None], transient_periods=0, kept_periods=1, steps_per_period=steps
        )
        errors.append(np.abs(section.states[0, 0] - exact).max())
    assert np.log2(errors[0] / errors[1]) / 2 == pytest.approx(4, abs=0.3)


def test_section_amplitudes_of_a_linear_drive_agree_with_the_closed_form():
    """Both measures, of two harmonics: peak to peak between the steps, and the first harmonic alone."""
    model = duffing(0.2, 0.0)
    forcing = harmonic_series(0.7, np.array([0.5, 0.6]))
    section = poincare_section(model, forcing, jnp.zeros((1, 2)), kept_periods=2)
    rates = 0.7j * np.array([1, 2])
    phasors = np.array([0.5, 0.6]) / (1 + 0.2 * rates + rates**2)
    x = (phasors[:, None] * np.exp(1j * np.outer([1, 2], np.linspace(0, 2 * np.pi, 20_001)))).real.sum(axis=0)
    # Taking the largest of 128 samples as the peak would err by a thousandth.
    assert float(section.amplitude[0]) == pytest.approx(np.ptp(x) / 2, rel=1e-5)
    assert float(section.fundamental[0]) == pytest.approx(abs(phasors[0]), rel=1e-5)


@pytest.mark.slow
def test_hysteresis_settles_onto_the_orbit_found_by_shooting():
    model = duffing(0.1, 0.0).with_effects(BoucWen(k=0.5, memory_twist=0.05))
    forcing = harmonic_series(0.7, 0.5)
    section = poincare_section(model, forcing, model.rest()[None], steps_per_period=512)
    assert int(period_of(section)[0]) == 1
    orbit = shoot(model, forcing, model.rest())
    assert bool(orbit.stable) and orbit.multipliers.shape == (3,)
    np.testing.assert_allclose(section.states[0, -1], orbit.state, atol=1e-4)


# -- period doubling and chaos --

PARLITZ = duffing(0.2, 1.0)


def test_bifurcation_diagram_has_the_published_periods_and_chaos():
    """x'' + 0.2 x' + x + x^3 = f cos t: Parlitz, Lauterborn (1985), Phys. Lett. A 107, 351."""
    forces = jnp.asarray([30.0, 33.5, 34.75, 36.0, 36.85, 37.5, 42.0])
    forcings = jax.vmap(lambda f: harmonic_series(1.0, f))(forces)
    diagram = bifurcation_diagram(PARLITZ, forcings, kept_periods=16, transient_periods=300, steps_per_period=256)
    assert np.asarray(period_of(diagram)).tolist() == [1, 1, 2, 2, 4, 0, 3]
    assert not np.asarray(diagram.escaped).any()


@pytest.mark.slow
def test_floquet_multiplier_passes_minus_one_at_period_doubling():
    def multiplier(force: float, guess: Array) -> tuple[float, Array]:
        orbit = shoot(PARLITZ, harmonic_series(1.0, force), guess)
        assert bool(orbit.converged)
        return float(np.real(orbit.multipliers).min()), orbit.state

    forcings = jax.vmap(lambda f: harmonic_series(1.0, f))(jnp.asarray([33.5]))
    start = bifurcation_diagram(PARLITZ, forcings, transient_periods=200, steps_per_period=256).states[0, -1]
    before, state = multiplier(33.5, start)
    after, _ = multiplier(34.75, state)
    assert -1 < before < 0 and after < -1


def test_uedas_attractor_is_chaotic():
    """x'' + 0.05 x' + x^3 = 7.5 cos t: Ueda (1979), J. Stat. Phys. 20, 181; its largest exponent is 0.10 per second.

    The linear stiffness is 1e-6 of the cubic's: a natural frequency of 1e-3 with alpha = 1e6.
    """
    model, forcing = duffing(0.05, 1e6, 1e-3), harmonic_series(1.0, 7.5)
    starts = jnp.asarray([[2.5, 0.0], [2.5 + 1e-9, 0.0]])
    section = poincare_section(model, forcing, starts, transient_periods=0, kept_periods=200, steps_per_period=256)
    assert np.asarray(period_of(section, max_period=12)).tolist() == [0, 0]
    x = np.asarray(section.states)[:, :, 0]
    assert x.max() < 4.0 and np.ptp(x[:, 50:]) > 1.5
    distance = np.linalg.norm(np.diff(np.asarray(section.states), axis=0)[0], axis=-1)
    grown = np.flatnonzero(distance > 1e-2)[0]
    exponent = np.log(distance[grown] / 1e-9) / (2 * np.pi * (grown + 1))
    assert exponent == pytest.approx(0.10, abs=0.05)
    assert distance[60:].max() > 1.0


# -- lanes, jit, refusals --


def test_section_is_the_same_in_lanes_in_a_loop_and_under_jit():
    model, forcing = duffing(0.2, 0.5), harmonic_series(1.3, 0.4)
    starts = jnp.asarray([[0.0, 0.0], [1.0, -1.0], [2.0, 2.0]])
    options = {"transient_periods": 3, "kept_periods": 8, "steps_per_period": 64}
    together = poincare_section(model, forcing, starts, **options)
    for k in range(3):
        alone = poincare_section(model, forcing, starts[k : k + 1], **options)
        np.testing.assert_allclose(together.states[k], alone.states[0], atol=1e-12)
    compiled = eqx.filter_jit(lambda m: poincare_section(m, forcing, starts, **options))(model)
    np.testing.assert_allclose(compiled.states, together.states, atol=1e-12)
    assert np.asarray(period_of(together, tolerance=1.0)).tolist() == [1, 1, 1]


def test_gradients_of_a_section_agree_with_differences():
    """In reverse mode, through the fixed steps."""
    forcing = harmonic_series(1.3, 0.4)
    options = {"transient_periods": 2, "kept_periods": 1, "steps_per_period": 64}

    def end(alpha: Array) -> Array:
        model = duffing(0.2, 0.5).replace({"alpha": alpha})
        return poincare_section(model, forcing, jnp.ones((1, 2)), **options).states[0, -1, 0]

    at, h = jnp.asarray(0.5), 1e-5
    difference = (end(at + h) - end(at - h)) / (2 * h)
    assert float(jax.grad(end)(at)) == pytest.approx(float(difference), rel=1e-6)


def test_unsupported_models_and_settings_of_a_section_are_refused():
    forcing, starts = harmonic_series(1.3, 0.4), jnp.zeros((1, 2))
    with pytest.raises(ValueError, match="`model` must be a ReducedModel"):
        poincare_section(TwoInertiaModel(hdc_40_050()), forcing, jnp.zeros((1, 4)))
    with pytest.raises(ValueError, match="`transient_periods` must be given where mu is not positive"):
        poincare_section(duffing(0.0, 0.5), forcing, starts)
    with pytest.raises(ValueError, match="`model` must be without effects on a sampled signal.*torque_bias"):
        poincare_section(duffing(0.1, 0.5).with_effects(TorqueBias(bias=1.0)), forcing, starts)
    with pytest.raises(ValueError, match="`transient_periods` must be given where the drive .* is traced"):
        jax.jit(lambda omega: poincare_section(duffing(0.1, 0.5), harmonic_series(omega, 0.4), starts))(
            jnp.asarray(1.0)
        )
    section = poincare_section(duffing(0.1, 0.5), forcing, starts, kept_periods=3)
    with pytest.raises(ValueError, match="`section` must keep more than 6 periods, but keeps 3"):
        period_of(section)
