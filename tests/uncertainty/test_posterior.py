"""Posterior draws, compared with the Gaussian limit and with quadrature."""

import importlib.util
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import rig
from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from fitting.estimation.residual import Unknowns
from fitting.uncertainty.posterior import Posterior, posterior
from fitting.uncertainty.standard_errors import Uncertainty, uncertainty

COUNT, HORIZON = 256, 64

needs_blackjax = pytest.mark.skipif(
    importlib.util.find_spec("blackjax") is None, reason="needs blackjax, the extra `posterior`"
)


def reduced_fit(paths: tuple[str, ...], noise: float) -> Fit:
    experiment = rig.reduced_experiment(COUNT, noise=noise)
    return fit(rig.reduced_model(), [Stretch(experiment, 0, COUNT)], paths, Segmentation(HORIZON, substeps=2, count=4))


@pytest.fixture(scope="module")
def well_identified() -> tuple[Fit, Uncertainty]:
    found = reduced_fit(("mu", "omega_0", "alpha", "gain"), 2e-3)
    return found, uncertainty(found)


def flat(found: Posterior) -> np.ndarray:
    return found.vectors.reshape(-1, len(found.paths))


@pytest.mark.slow
@needs_blackjax
def test_posterior_of_a_well_identified_fit_equals_the_laplace_approximation(well_identified: tuple[Fit, Uncertainty]):
    found, known = well_identified
    white = posterior(found, known, seed=0, coloured=False)
    assert white.settled, (white.r_hat, white.divergences)
    draws = flat(white)
    expected = np.sqrt(np.diag(known.unit_covariance))
    # n effective draws determine a mean to 1/sqrt(n), a standard deviation to 1/sqrt(2 n); the curvature adds some.
    count = white.effective_samples.min()
    assert count > 400
    offset = (draws.mean(axis=0) - np.asarray(found.unknowns.parameters)) / expected
    np.testing.assert_allclose(offset, 0.0, atol=4 / np.sqrt(count) + 0.1)
    np.testing.assert_allclose(draws.std(axis=0) / expected, 1.0, atol=4 / np.sqrt(2 * count) + 0.05)
    low, high = np.array(list(white.quantiles(0.025, 0.975).values())).T
    value = np.array([known.estimates[p].value for p in white.paths])
    assert (low < value).all() and (value < high).all()
    # Scaled for the residual's colour, draws have the robust covariance.
    coloured = posterior(found, known, seed=0)
    ratio = flat(coloured).std(axis=0) / np.sqrt(np.diag(known.covariance))
    np.testing.assert_allclose(ratio, 1.0, atol=4 / np.sqrt(2 * count) + 0.08)


@pytest.mark.slow
@needs_blackjax
def test_posterior_of_one_parameter_equals_quadrature():
    """A damping that a noisy log hardly determines; scipy fits the initial states at every node."""
    found = reduced_fit(("mu",), 0.1)
    known = uncertainty(found)
    drawn = posterior(found, known, seed=1, coloured=False, draws=400, warmup=200)
    assert drawn.divergences == 0 and drawn.r_hat.max() < 1.03
    centre = float(found.unknowns.parameters[0])
    std = float(np.sqrt(known.unit_covariance[0, 0]))
    shape = found.unknowns.states.shape

    def rows(states: np.ndarray, entry: float):
        at = linearise(found.problem, Unknowns(jnp.asarray([entry]), jnp.asarray(states.reshape(shape))))
        return np.asarray(at.residual), np.asarray(at.by_state)

    def jacobian(states: np.ndarray, entry: float) -> np.ndarray:
        _, by_state = rows(states, entry)
        dense = np.zeros((shape[0], by_state.shape[1], *shape))
        for i in range(shape[0]):
            dense[i, :, i] = by_state[i]
        return dense.reshape(-1, shape[0] * shape[1])

    nodes = centre + std * np.linspace(-5, 5, 41)
    states = np.asarray(found.unknowns.states).ravel()
    squares = [
        2 * least_squares(lambda s, e: rows(s, e)[0].ravel(), states, jac=jacobian, args=(e,), x_scale="jac").cost
        for e in nodes
    ]
    density = np.exp(-0.5 * (np.array(squares) - min(squares)))
    density /= density.sum()
    mean = density @ nodes
    spread = np.sqrt(density @ (nodes - mean) ** 2)
    draws = flat(drawn)[:, 0]
    count = float(drawn.effective_samples[0])
    assert draws.mean() == pytest.approx(mean, abs=4 * spread / np.sqrt(count))
    assert draws.std() == pytest.approx(spread, rel=4 / np.sqrt(2 * count))
    np.testing.assert_allclose(drawn.values[..., 0], drawn.vectors[..., 0] * float(found.free.scale[0]), rtol=1e-12)


def test_missing_blackjax_raises_an_import_error_that_names_the_extra(
    well_identified: tuple[Fit, Uncertainty], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(ImportError, match=r"hdjax\[posterior\]"):
        posterior(*well_identified, seed=0)
