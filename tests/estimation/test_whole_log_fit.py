"""The fit over whole logs is accepted only where simulations follow them."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.estimation.whole_log_fit import long_fit, without_gaps
from fitting.uncertainty.standard_errors import uncertainty
from hdjax.effects.backlash import Backlash

COUNT, HORIZON, GAP = 8000, 128, 2e-4
PATHS = ("K", "alpha", "B_sp", "backlash.b")


@pytest.fixture(
    scope="module",
    params=[pytest.param(0.1, marks=pytest.mark.slow), 0.3],
    ids=["long simulations lose their way", "gaps stay open"],
)
def found(request: pytest.FixtureRequest) -> Fit:
    """A drive with a dead zone: its motion is chaotic."""
    logged = rig.drive_experiment(COUNT, gap=GAP, rms=request.param)
    start = rig.drive_model().with_effects(Backlash(b=jnp.asarray(GAP)))
    return fit(start, [Stretch(logged, 0, COUNT)], PATHS, Segmentation(HORIZON, substeps=2))


def test_long_fit_keeps_short_segments_for_a_chaotic_motion(found: Fit):
    kept = long_fit(found)
    assert found.converged and kept.horizon == HORIZON and kept.objective < found.objective + 1e-3
    # A long fit would report errors forty times as small without moving.
    K = uncertainty(kept).estimates["K"]
    assert abs(K.value - rig.K) < 4.0 * K.std


def test_long_fit_reduces_standard_errors_for_a_smooth_motion():
    logged = rig.drive_experiment(COUNT)
    short = fit(rig.drive_model(), [Stretch(logged, 0, COUNT)], PATHS[:3], Segmentation(HORIZON, substeps=1))
    long = long_fit(short)
    before, after = (uncertainty(f).estimates["K"] for f in (short, long))
    assert after.std < 0.2 * before.std
    assert abs(after.value - rig.K) < 4.0 * after.std


def test_errors_without_gaps_are_those_of_one_simulation():
    """A wrong stiffness hardly shows over short segments that start anew."""
    stretch = Stretch(rig.drive_experiment(COUNT), 0, COUNT)
    wrong = rig.drive_model().replace({"K": 1.02 * rig.K})
    held = Strategy(hold_parameters=True)
    short = fit(wrong, [stretch], (), Segmentation(HORIZON, substeps=2), strategy=held)
    whole = Segmentation(COUNT, COUNT, substeps=2)
    start = Start(short.covariance, short.unknowns.states[:1])
    alone = fit(wrong, [stretch], (), whole, start=start, strategy=replace(held, max_steps=0))
    gapless = without_gaps(short)
    assert gapless.objective > short.objective + 1.0
    np.testing.assert_allclose(np.asarray(gapless.covariance), np.asarray(alone.covariance), rtol=1e-6)


def test_free_parameters_that_do_not_move_are_not_held():
    """A fit that starts at its solution ends there; selection data must still move its parameters."""
    experiment, model = rig.reduced_experiment(1024, noise=1e-3), rig.reduced_model()
    stretches, segmentation = [Stretch(experiment, 0, 1024)], Segmentation(1024, 128, substeps=2)
    first = fit(model, stretches, base_paths(model), segmentation)
    again = fit(
        first.model,
        stretches,
        base_paths(model),
        segmentation,
        start=Start(first.covariance, first.unknowns.states),
        strategy=Strategy(reweigh=False),
    )
    assert float(again.model.get("omega_0")) == pytest.approx(float(first.model.get("omega_0")), rel=1e-9)
    assert not again.was_held and not again.with_all_free().was_held
    held = fit(first.model, stretches, base_paths(model), segmentation, strategy=Strategy(hold_parameters=True))
    assert held.was_held and held.with_all_free().was_held
