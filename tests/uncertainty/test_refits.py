"""Refits with sensitivities computed once, against fits of the same data."""

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
def found() -> Fit:
    return fitted(rig.reduced_experiment(COUNT, noise=NOISE))


@pytest.fixture(scope="module")
def others() -> list[Experiment]:
    return [rig.reduced_experiment(COUNT, noise=NOISE, seed=0)] + [noisy(seed) for seed in range(1, DRAWS)]


def noisy(seed: int) -> Experiment:
    """The same motion with other noise."""
    clean = rig.reduced_experiment(COUNT, noise=0.0)
    random = np.random.default_rng(seed)
    return eqx.tree_at(lambda e: e.measured, clean, clean.measured + NOISE * random.normal(size=clean.measured.shape))


def test_refits_agree_with_fits(found: Fit, others: list[Experiment]):
    measured = jnp.stack([e.measured.reshape(found.problem.segments.measured.shape) for e in others])
    vectors, moved = refits(found, measured)
    free, estimates = found.free, uncertainty(found).estimates
    assert np.asarray(moved).max() < 1e-3
    apart = []
    for vector, experiment in zip(vectors, others, strict=True):
        again = fitted(experiment)
        for path in free.paths:
            value = float(free.unpack(found.model, vector).get(path))
            assert value == pytest.approx(float(again.model.get(path)), abs=0.02 * estimates[path].std), path
            apart.append(abs(value - float(found.model.get(path))) / estimates[path].std)
    # The data do differ: else a refit that does nothing would pass.
    assert np.median(apart[len(free.paths) :]) > 0.3


def test_the_same_data_change_nothing(found: Fit):
    vectors, moved = refits(found, found.problem.segments.measured[None])
    np.testing.assert_allclose(vectors[0], found.unknowns.parameters, rtol=1e-6)
    assert moved[0] < 0.05
