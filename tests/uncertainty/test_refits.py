"""Refits with sensitivities that are computed once, compared with full fits of the same data."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.refits import refits
from fitting.uncertainty.standard_errors import uncertainty

COUNT, HORIZON, NOISE, DRAWS = 1024, 512, 1e-3, 5


def whole(experiment: Experiment) -> list[Stretch]:
    return [Stretch(experiment, 0, len(experiment))]


def fitted(experiment: Experiment) -> Fit:
    model = rig.reduced_model()
    segmentation, start = Segmentation(HORIZON, 128, substeps=2, count=8), Start(jnp.asarray([[NOISE**2]]))
    strategy = Strategy(reweigh=False)
    return fit(model, whole(experiment), base_paths(model), segmentation, start=start, strategy=strategy)


@pytest.fixture(scope="module")
def original_fit() -> Fit:
    return fitted(rig.reduced_experiment(COUNT, noise=NOISE))


@pytest.fixture(scope="module")
def repetitions() -> list[Experiment]:
    return [rig.reduced_experiment(COUNT, noise=NOISE, seed=0)] + [noisy(seed) for seed in range(1, DRAWS)]


def noisy(seed: int) -> Experiment:
    """The same motion with other noise."""
    clean = rig.reduced_experiment(COUNT, noise=0.0)
    random = np.random.default_rng(seed)
    return eqx.tree_at(lambda e: e.measured, clean, clean.measured + NOISE * random.normal(size=clean.measured.shape))


def test_refits_with_fixed_sensitivities_equal_full_fits(original_fit: Fit, repetitions: list[Experiment]):
    measured = jnp.stack([e.measured.reshape(original_fit.problem.segments.measured.shape) for e in repetitions])
    vectors, moved = refits(original_fit, measured)
    free, estimates = original_fit.free, uncertainty(original_fit).estimates
    assert np.asarray(moved).max() < 1e-3
    apart = []
    for vector, experiment in zip(vectors, repetitions, strict=True):
        again = fitted(experiment)
        for path in free.paths:
            value = float(free.unpack(original_fit.model, vector).get(path))
            assert value == pytest.approx(float(again.model.get(path)), abs=0.02 * estimates[path].std), path
            apart.append(abs(value - float(original_fit.model.get(path))) / estimates[path].std)
    # The data differ, so that a refit without any effect would fail.
    assert np.median(apart[len(free.paths) :]) > 0.3


def test_refit_of_the_same_data_changes_nothing(original_fit: Fit):
    vectors, moved = refits(original_fit, original_fit.problem.segments.measured[None])
    np.testing.assert_allclose(vectors[0], original_fit.unknowns.parameters, rtol=1e-6)
    assert moved[0] < 0.05
