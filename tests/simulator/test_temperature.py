"""Temperature law of the mesh against its formulas, for both kinds of drive."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdjax import ReducedDrive, hdc_40_050
from hdjax.parameters import own_parameters
from hdjax.temperature import TemperatureLaw, resonance_drift

LAW = TemperatureLaw(k_T=-5e-4, kappa=0.03, T_0=298.15)


def test_temperature_law_scales_stiffness_and_damping_by_its_formula():
    drive = hdc_40_050()
    warm = LAW.at(drive, 318.15)
    assert float(warm.K) == pytest.approx(7160.0 * 0.99, rel=1e-14)
    assert float(warm.B_sp) == pytest.approx(0.017 * np.exp(-0.6), rel=1e-14)
    for name in ("N", "J_m", "J_l", "alpha"):
        assert float(getattr(warm, name)) == float(getattr(drive, name))


def test_drive_is_unchanged_at_the_reference_or_without_coefficients():
    drive = hdc_40_050()
    for same in (LAW.at(drive, 298.15), TemperatureLaw().at(drive, 400.0), TemperatureLaw().at(drive, 200.0)):
        assert eqx.tree_equal(same, drive)


def test_warm_drive_is_softer_and_less_damped_than_a_cold_one():
    cold, drive, warm = (LAW.at(hdc_40_050(), t) for t in (273.15, 298.15, 338.15))
    assert cold.K > drive.K > warm.K
    assert cold.B_sp > drive.B_sp > warm.B_sp
    assert cold.omega_0 > drive.omega_0 > warm.omega_0


@pytest.mark.parametrize("temperature", (263.0, 298.15, 350.0))
def test_temperature_law_commutes_with_the_reduction(temperature):
    warm_first = LAW.at(hdc_40_050(), temperature).reduced()
    reduced_first = LAW.at(hdc_40_050().reduced(), temperature)
    assert isinstance(reduced_first, ReducedDrive)
    for name in ("mu", "omega_0", "alpha", "gain"):
        assert float(getattr(warm_first, name)) == pytest.approx(float(getattr(reduced_first, name)), rel=1e-14)


@pytest.mark.parametrize("drive", (hdc_40_050(), hdc_40_050().reduced()))
def test_law_referred_to_another_temperature_gives_the_same_drives(drive):
    warm, law = LAW.at(drive, 330.0), LAW.referred_to(330.0)
    for temperature in (270.0, 298.15, 360.0):
        found, expected = (jax.tree.leaves(m.at(d, temperature)) for m, d in ((law, warm), (LAW, drive)))
        np.testing.assert_allclose(found, expected, rtol=1e-14)
    np.testing.assert_allclose(jax.tree.leaves(law.referred_to(298.15)), jax.tree.leaves(LAW), rtol=1e-13)


def test_resonance_drift_agrees_with_its_formulas():
    temperatures = jnp.linspace(278.15, 338.15, 7)
    drive, forcing = hdc_40_050(), 2.5
    found = resonance_drift(drive, LAW, temperatures, forcing=forcing)
    dT = np.asarray(temperatures) - 298.15
    np.testing.assert_array_equal(found.temperature, temperatures)
    np.testing.assert_allclose(found.omega_0, float(drive.omega_0) * np.sqrt(1 - 5e-4 * dT), rtol=1e-13)
    np.testing.assert_allclose(found.mu, float(drive.mu) * np.exp(-0.03 * dT), rtol=1e-13)
    np.testing.assert_allclose(found.peak, forcing / (np.asarray(found.mu) * np.asarray(found.omega_0)), rtol=1e-13)
    # A loop gives the same, and so does the reduced drive under jit.
    alone = [float(LAW.at(drive, t).omega_0) for t in temperatures]
    np.testing.assert_allclose(found.omega_0, alone, rtol=1e-15)
    compiled = eqx.filter_jit(resonance_drift)(drive.reduced(), LAW, temperatures, forcing=jnp.asarray(forcing))
    np.testing.assert_allclose(compiled.peak, found.peak, rtol=1e-13)


def test_resonance_peak_of_an_undamped_drive_is_infinite():
    undamped = ReducedDrive(mu=0.0, omega_0=50.0)
    for forcing in (0.0, 1.0):
        found = resonance_drift(undamped, LAW, jnp.asarray([290.0, 300.0]), forcing=forcing)
        np.testing.assert_array_equal(found.peak, np.inf)


def test_derivatives_at_the_reference_are_the_coefficients():
    """K' = k_T K, mu' = -kappa mu, and half of k_T for the frequency."""
    drive = hdc_40_050()
    slopes = jax.jacfwd(lambda t: jnp.stack([(d := LAW.at(drive, t)).K, d.mu, d.omega_0]))(jnp.asarray(298.15))
    values = np.array([drive.K, drive.mu, drive.omega_0])
    np.testing.assert_allclose(slopes / values, [-5e-4, -0.03, -2.5e-4], rtol=1e-12)


def test_law_that_leaves_no_stiffness_is_refused():
    law = TemperatureLaw(k_T=-1e-2, T_0=300.0)
    with pytest.raises(ValueError, match="`k_T` must leave a positive stiffness at 401.0 K, but is -0.01 1/K"):
        law.at(hdc_40_050(), 401.0)
    with pytest.raises(ValueError, match="`k_T` must leave a positive stiffness at 400.0 K"):
        resonance_drift(hdc_40_050(), law, jnp.asarray([300.0, 400.0, 350.0]), forcing=1.0)
    # Also where the values are traced.
    with pytest.raises(RuntimeError, match="`k_T` must leave a positive stiffness"):
        jax.block_until_ready(eqx.filter_jit(lambda t: law.at(hdc_40_050(), t).K)(jnp.asarray(401.0)))


def test_temperature_law_parameters_have_units():
    assert {name: info.unit for name, info in own_parameters(LAW)} == {"k_T": "1/K", "kappa": "1/K", "T_0": "K"}
