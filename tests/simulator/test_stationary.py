"""Stationary laws of motions under random torque against closed forms and scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from noisy_oscillator import MU, OMEGA_0, S, oscillator, pair
from scipy.integrate import quad
from scipy.linalg import solve_continuous_lyapunov
from scipy.special import gamma, kve

from hdjax import ReducedDrive
from hdjax.noise import ColouredNoise, WhiteNoise
from hdjax.stationary import coloured_variance, linearised_variance, stationary_density, stationary_variance


def test_variances_of_a_linear_drive_agree_with_the_closed_form():
    np.testing.assert_allclose(pair(stationary_variance(oscillator(), 3.0)), [3 / (2 * MU * 2500), 3 / (2 * MU)])


def potential(x, alpha):
    return OMEGA_0**2 * (x**2 / 2 + alpha * x**4 / 4)


def average(g, alpha: float) -> float:
    """Mean of g(x) under the unnormalised law, by scipy; at S, alpha is also the nonlinearity alpha sigma^2."""
    end = 9.0 * min(1.0, max(alpha, 1e-9) ** -0.25)

    def integral(h):
        return quad(lambda x: h(x) * np.exp(-2 * MU / S * potential(x, alpha)), -end, end, epsabs=0, epsrel=1e-12)[0]

    return integral(g) / integral(lambda x: 1.0)


@pytest.mark.parametrize("alpha", (0.0, 1e-3, 1.0, 1e3, 1e8))
def test_variances_agree_with_scipy_equipartition_and_virial(alpha):
    found = stationary_variance(oscillator(alpha), S)
    assert float(found.x) == pytest.approx(average(lambda x: x**2, alpha), rel=1e-10)
    assert float(found.v) == pytest.approx(S / (2 * MU), rel=1e-13)
    # <x V'(x)> = <v^2>, with the fourth moment from scipy.
    virial = OMEGA_0**2 * (float(found.x) + alpha * average(lambda x: x**4, alpha))
    assert virial == pytest.approx(S / (2 * MU), rel=1e-9)


def test_variance_of_a_purely_cubic_spring_agrees_with_the_limit():
    """sigma^2/sqrt(epsilon) 2 Gamma(3/4)/Gamma(1/4) is the limit; the remainder is proportional to 1/sqrt(epsilon)."""
    limit = 2 * gamma(0.75) / gamma(0.25)
    assert float(stationary_variance(oscillator(1e16), S).x) * 1e8 == pytest.approx(limit, rel=1e-7)
    linearised = float(linearised_variance(oscillator(1e16), S).x) * 1e8
    assert linearised / limit - 1 == pytest.approx(-0.146, abs=1e-3)  # the 15 % of its docstring


def test_exact_and_linearised_variances_agree_with_their_expansions():
    """1 - 3 eps + 18 eps^2 against the exact 1 - 3 eps + 24 eps^2."""
    epsilon = 1e-3
    exact, linearised = (float(f(oscillator(epsilon), S).x) for f in (stationary_variance, linearised_variance))
    assert exact == pytest.approx(1 - 3 * epsilon + 24 * epsilon**2, abs=400 * epsilon**3)
    assert linearised == pytest.approx(1 - 3 * epsilon + 18 * epsilon**2, abs=400 * epsilon**3)
    np.testing.assert_allclose(linearised_variance(oscillator(epsilon), S).v, S / (2 * MU))


@pytest.mark.parametrize("alpha", (1e-3, 0.3, 1.0, 1e2))
def test_density_agrees_with_its_normalisation_by_bessel_functions(alpha):
    norm = kve(0.25, 1 / (8 * alpha)) / np.sqrt(2 * alpha) * np.sqrt(2 * np.pi) * OMEGA_0
    x, v = jnp.asarray([0.0, 0.4, -1.3]), jnp.asarray([0.0, -60.0, 20.0])
    exact = np.exp(-2 * MU / S * (np.asarray(v) ** 2 / 2 + potential(np.asarray(x), alpha))) / norm
    np.testing.assert_allclose(stationary_density(oscillator(alpha), S, x, v), exact, rtol=1e-12)


@pytest.mark.parametrize("alpha", (0.0, 2.0))
def test_density_integrates_to_one_and_to_the_variances(alpha):
    # The trapezoidal rule on a grid at whose edge the density is 1e-18: exact to rounding.
    x, v = np.meshgrid(np.linspace(-9, 9, 181), np.linspace(-9, 9, 181) * OMEGA_0, indexing="ij")
    weight = np.asarray(stationary_density(oscillator(alpha), S, x, v)) * 0.1 * 0.1 * OMEGA_0
    assert weight.sum() == pytest.approx(1.0, rel=1e-12)
    moments = [(weight * x**2).sum(), (weight * v**2).sum()]
    np.testing.assert_allclose(pair(stationary_variance(oscillator(alpha), S)), moments, rtol=1e-12)


def test_density_far_from_the_origin_is_zero():
    for alpha in (0.0, 1.0):
        found = stationary_density(oscillator(alpha), S, jnp.asarray([1e200, 0.0]), jnp.asarray([0.0, -1e300]))
        np.testing.assert_array_equal(found, 0.0)


def linear_covariance(rms: float, correlation_time: float) -> np.ndarray:
    A = np.array([[0, 1, 0], [-(OMEGA_0**2), -MU, 1], [0, 0, -1 / correlation_time]])
    return solve_continuous_lyapunov(A, -np.diag([0, 0, 2 * rms**2 / correlation_time]))


@pytest.mark.parametrize("correlation_time", (1e-4, 0.02, 3.0))
def test_coloured_variance_solves_the_lyapunov_equation(correlation_time):
    exact = linear_covariance(7.0, correlation_time)
    np.testing.assert_allclose(
        pair(coloured_variance(oscillator(), 7.0, correlation_time)), np.diag(exact)[:2], rtol=1e-9
    )


def test_coloured_variance_with_short_memory_tends_to_that_of_white_noise():
    for time in (1e-4, 1e-5):
        noise = ColouredNoise(rms=3.0, correlation_time=time)
        white = pair(stationary_variance(oscillator(), noise.white.error_intensity(oscillator())))
        coloured = pair(coloured_variance(oscillator(), noise.error_rms(oscillator()), time))
        # To first order in t_c, x keeps its variance and v loses mu t_c; (omega_0 t_c)^2 follows.
        np.testing.assert_allclose(coloured / white, [1.0, 1.0 - MU * time], rtol=2 * (OMEGA_0 * time) ** 2)


def test_gradients_of_the_variances_agree_with_differences():
    values = jnp.asarray([MU, OMEGA_0, 0.8, S])

    def variances(p):
        found = stationary_variance(ReducedDrive(mu=p[0], omega_0=p[1], alpha=p[2]), p[3])
        return jnp.stack([found.x, found.v])

    # Central differences of relative step 1e-5: errors of 1e-10 from the step and 1e-11 from rounding.
    h = 1e-5 * np.asarray(values)
    differences = [(variances(values + d) - variances(values - d)) / (2 * d.sum()) for d in np.diag(h)]
    found = jax.jacfwd(variances)(values)
    scale = np.asarray(values)[None, :] / np.asarray(variances(values))[:, None]
    np.testing.assert_allclose(found * scale, np.stack(differences, axis=1) * scale, atol=1e-8)
    np.testing.assert_allclose(jax.jacrev(variances)(values), found, rtol=1e-10, atol=1e-13)
    for p in (values.at[2].set(0.0), values.at[3].set(0.0)):
        assert np.isfinite(np.asarray(jax.jacrev(variances)(p))).all()
    # alpha = 0: <x^2> = sigma^2 (1 - 3 alpha sigma^2).
    assert float(jax.jacrev(variances)(values.at[2].set(0.0))[0, 2]) == pytest.approx(-3.0, rel=1e-10)


@pytest.mark.parametrize(
    ("drive", "intensity", "message"),
    (
        (oscillator(-0.1), S, "`drive.alpha` must not be negative for a stationary law, but is -0.1"),
        (oscillator(mu=0.0), S, "`drive.mu` must be above zero"),
        (oscillator(), -1.0, "`S` must not be negative"),
    ),
)
def test_drive_without_a_stationary_law_is_refused_or_has_infinite_variance(drive, intensity, message):
    """Refused where values are known; an infinite variance, never a NaN, where they are traced."""
    with pytest.raises(ValueError, match=message):
        stationary_variance(drive, intensity)
    with pytest.raises(ValueError, match="`"):
        stationary_density(drive, intensity, 0.0, 0.0)

    def lane(mu, alpha, s):
        bare = ReducedDrive(mu=mu, omega_0=OMEGA_0, alpha=alpha)
        found, linear = stationary_variance(bare, s), linearised_variance(bare, s)
        return jnp.stack([found.x, found.v, linear.x, linear.v]), stationary_density(bare, s, 0.1, 0.1)

    columns = [
        jnp.stack([jnp.asarray(bad, dtype=float), good])
        for bad, good in zip((drive.mu, drive.alpha, intensity), jnp.asarray([MU, 0.5, S]), strict=True)
    ]
    variances, density = jax.jit(jax.vmap(lane))(*columns)
    np.testing.assert_array_equal(variances[0], np.inf)
    assert float(density[0]) == 0.0
    assert np.isfinite(np.asarray(variances[1])).all() and float(density[1]) > 0.0
    slopes = jax.vmap(jax.grad(lambda *p: lane(*p)[0][0], argnums=(0, 1, 2)))(*columns)
    assert np.isfinite(np.asarray(slopes)).all()


def test_variance_without_noise_is_zero():
    np.testing.assert_array_equal(pair(stationary_variance(oscillator(1.0), 0.0)), 0.0)
    with pytest.raises(ValueError, match="`S` must be above zero"):
        stationary_density(oscillator(), 0.0, 0.0, 0.0)


def test_coloured_variance_refuses_nonlinear_and_undamped_drives():
    with pytest.raises(ValueError, match="`drive.alpha` must be zero"):
        coloured_variance(oscillator(0.1), 1.0, 1.0)
    with pytest.raises(ValueError, match="`drive.mu` must be above zero"):
        coloured_variance(oscillator(mu=0.0), 1.0, 1.0)


def test_invalid_noise_is_refused():
    with pytest.raises(ValueError, match="`intensity` must not be negative, but is -1"):
        WhiteNoise(intensity=-1)
    with pytest.raises(ValueError, match="`load_rms` must not be negative"):
        ColouredNoise(load_rms=-1, correlation_time=1)
    with pytest.raises(ValueError, match="`correlation_time` must be above zero"):
        ColouredNoise(rms=1, correlation_time=0)
