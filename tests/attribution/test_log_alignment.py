"""Logs with a spectral line of unknown origin: their clocks are shifted until the line is in phase."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.attribution.candidate_fit import Trial, attempt, halo_for
from fitting.attribution.log_alignment import Phasors, clock_shifts, with_clocks_set
from fitting.attribution.study import Data, Setting, Study
from fitting.estimation.base_fit import base_fit
from fitting.estimation.experiment import Experiment, experiment_from_log, split
from fitting.first_order.gains import linearise_along, products
from hdjax import Hold
from hdjax.effects.learned import LEARNED_TORQUES, LearnedLoadTorque, LearnedMeshTorque

HOLDS: tuple[Hold, ...] = ("zero-order", "linear")
COUNT, NOISE = 3000, 1e-3
OMEGA, LINE = 41.3, 400.0
"""Frequency of the disturbance, not one of the forcing, and its acceleration."""


def experiment(seed: int, hold: Hold, phase: float | None) -> Experiment:
    """A log of the reduced oscillator with an unlogged line; None for one without."""
    forcing = rig.reduced_forcing(COUNT, seed=seed)
    acting = forcing
    if phase is not None:
        # Constant over a sample, as the rig holds it: half a sample late, which is the same in all logs.
        acting = forcing + LINE / rig.GAIN * np.sin(OMEGA * np.arange(COUNT) * rig.REDUCED_STEP + phase)
    log = rig.reduced_log(rig.reduced_motion(acting)[:, 0], forcing, noise=NOISE, seed=seed)
    # Time stamps have arbitrary origins; only the start of each log counts.
    return experiment_from_log(replace(log, name=f"log {seed}", time=log.time + 7.0 * seed), hold=hold)


TrialAndStudy = tuple[Trial, Study]


@pytest.fixture(scope="module")
def fitted_to_phases() -> Callable[..., TrialAndStudy]:
    """A function that fits the base model to logs whose lines have given initial phases."""

    @cache
    def fitted(*phases: float | None) -> TrialAndStudy:
        data: Data = {h: split([experiment(i, h, phase) for i, phase in enumerate(phases)]) for h in HOLDS}
        training = data[HOLDS[0]][0]
        found = base_fit(rig.reduced_model(), training, halo=halo_for(training)).fit
        study = Study(data, Setting(found.segmentation))
        return attempt(found.model, study, HOLDS[0]), study

    return fitted


def test_clock_of_the_second_log_is_shifted_into_phase(fitted_to_phases):
    """The second log's clock is shifted by the delay of its line after that of the first log.

    Parameters stay, and one torque then explains both logs down to the noise.
    """
    first, second = 0.4, 2.3
    base, study = fitted_to_phases(first, second)
    told = []
    after, clocked = with_clocks_set(base, replace(study, progress=told.append))
    for hold in HOLDS:
        for old, new in zip(study.data[hold], clocked.data[hold], strict=True):
            assert clock_shifts(old, new) == (0.0, pytest.approx((first - second) / OMEGA, abs=1e-4))
    assert len(told) == 1
    assert after.training.objective == pytest.approx(base.training.objective, abs=1e-3)
    for path, (value, _) in base.model.parameters().items():
        assert float(after.model.get(path)) == pytest.approx(float(value), rel=1e-9)

    def with_line(study: Study) -> Trial:
        line = Phasors(LearnedMeshTorque, OMEGA, np.full(2, 1j * LINE), np.ones(2), 1.0).effect
        return attempt(base.model.with_effects(line), study, HOLDS[0], start=base)

    assert with_line(clocked).training.principal_std == pytest.approx(NOISE, rel=0.05)
    assert with_line(study).training.principal_std > 2 * NOISE


@pytest.mark.parametrize(("phases", "logs"), [((0.4, 0.4), 2), ((None, None), 2), ((None, 0.4), 2), ((0.4, 2.3), 1)])
def test_clocks_stay_without_a_line_out_of_phase(fitted_to_phases, phases: tuple[float | None, ...], logs: int):
    """Cases: lines in phase, no line, a line in one log only, and a single log."""
    base, study = fitted_to_phases(*phases)
    data = {hold: (training[:logs], selection[:logs]) for hold, (training, selection) in study.data.items()}
    after, clocked = with_clocks_set(base, replace(study, data=data))
    assert after is base and clocked.data is data


def line(*torque: complex) -> Phasors:
    return Phasors(LearnedLoadTorque, 10.0, np.array(torque), np.full(len(torque), 100.0), 1000.0)


def test_time_offsets_refer_to_the_first_log_with_the_line():
    """Offsets are within half a period; a log without the line keeps its clock."""
    seen = line(0.001, 1.0, np.exp(0.5j), np.exp(-3.0j), 0.3j)
    np.testing.assert_allclose(seen.late, [0.0, 0.0, 0.05, -0.3, 0.0], atol=1e-15)
    np.testing.assert_allclose(seen.in_phase.torque, [0.001, 1.0, 1.0, 1.0, 0.3j], atol=1e-15)
    assert abs(seen.in_phase.mean) > abs(seen.mean)


def test_share_explained_by_a_line_follows_from_its_standard_errors():
    """Ten standard errors in each of ten logs of a hundred values have the power of the noise."""
    assert line(*np.exp(1j * np.arange(10.0))).share == pytest.approx(0.5)


@pytest.mark.parametrize("place", LEARNED_TORQUES)
def test_line_becomes_a_sinusoidal_learned_torque_at_its_place(place):
    """The torque is `C cos + S sin`."""
    effect = replace(line(3.0 + 4.0j), place=place).effect
    assert isinstance(effect, place)
    assert [float(c) for c in effect.c] == [3.0, 4.0]


def test_diverged_segment_is_excluded_from_the_line_estimate(fitted_to_phases):
    """The linearisation gives the whole diverged segment weight zero and keeps the others."""
    base, _ = fitted_to_phases(0.4, 2.3)
    fit = base.training
    states = np.array(fit.unknowns.states)
    states[2] = np.nan
    broken = replace(
        fit,
        unknowns=replace(fit.unknowns, states=jnp.asarray(states)),
        error=jnp.asarray(np.where(np.arange(len(states))[:, None, None] == 2, np.inf, np.asarray(fit.error))),
    )
    look = linearise_along(broken)
    weight = np.asarray(look.problem.segments.weight)
    assert not weight[2].any() and weight[[1, 3]].all()
    time = np.asarray(look.conditions.time)
    size = np.stack([np.cos(OMEGA * time), np.sin(OMEGA * time)], axis=-1)
    found = products(look, look.acting(LearnedMeshTorque.name), (size,))
    for part in vars(found).values():
        assert np.isfinite(part).all() and not part[2].any() and part[1].any()
