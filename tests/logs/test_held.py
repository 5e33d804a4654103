"""Channels that are refreshed at a lower rate than the log is written, and channels that are not."""

from dataclasses import replace

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

import rig
from fitting.estimation.base_fit import base_fit
from fitting.estimation.experiment import experiments_from_log, whole
from fitting.logs.checks import examine
from fitting.logs.drive_file import drive_of
from fitting.logs.held import without_repeats
from fitting.logs.log import Log
from fitting.logs.masks import masked
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, TwoInertiaModel

COUNT = 4000
TORQUE = rig.drive_torque(COUNT)
MOTION = rig.drive_motion(TORQUE)
LOG = rig.drive_log(MOTION, TORQUE)
FORCING = rig.reduced_forcing(COUNT)
REDUCED = rig.reduced_log(rig.reduced_motion(FORCING)[:, 0], FORCING, noise=1e-3)


def with_held_channel(log: Log, name: str, fresh: np.ndarray) -> Log:
    """The log with a channel that keeps its value until it is refreshed."""
    fresh = fresh.copy()
    fresh[0] = True
    rows = np.maximum.accumulate(np.where(fresh, np.arange(len(log)), 0))
    log = replace(log, **{name: getattr(log, name)[rows]})
    if log.kind == "drive":
        log = replace(log, dynamic_error=log.motor_angle / rig.N - log.load_angle)
    return log


def every(period: int, first: int = 0) -> np.ndarray:
    return (np.arange(COUNT) - first) % period == 0


def own_clock(period: float, jitter: float, seed: int = 0) -> np.ndarray:
    """Rows refreshed by a separate clock with jitter, whose period is no multiple of the log's."""
    when = np.arange(0.3, COUNT, period)
    when = when + jitter * period * np.random.default_rng(seed).uniform(-0.5, 0.5, size=len(when))
    fresh = np.zeros(COUNT, dtype=bool)
    fresh[np.minimum(np.ceil(np.maximum(when, 0.0)).astype(int), COUNT - 1)] = True
    return fresh


REFRESHED = {
    "every tenth row": every(10, 3),
    "every other row": every(2),
    "a clock of its own": own_clock(7.3, 0.0),
    "a clock of its own, with jitter": own_clock(10.0, 0.6),
    "a clock little slower than the log's": own_clock(1.4, 0.0),
    "packets lost": np.random.default_rng(0).uniform(size=COUNT) > 0.1,
}


@pytest.mark.parametrize("fresh", REFRESHED.values(), ids=REFRESHED.keys())
@pytest.mark.parametrize("name", ["load_angle", "motor_angle", "dynamic_error"])
def test_stale_rows_of_a_held_channel_are_masked(name: str, fresh: np.ndarray):
    log = with_held_channel(REDUCED if name == "dynamic_error" else LOG, name, fresh)
    found = masked(log)
    assert found.trusted is not None
    stale = ~fresh
    stale[0] = False
    assert not (found.trusted & stale).any()
    assert found.trusted.sum() > 0.97 * fresh.sum()
    (finding,) = found.findings
    assert finding.severity == "warning" and "refreshed about every" in finding.what and name in finding.where
    # Fresh values are kept; stale ones are replaced, so that no check reports a fault.
    np.testing.assert_allclose(getattr(found, name)[fresh], getattr(log, name)[fresh])


@pytest.mark.parametrize(("a", "b"), [(every(4), every(4, 2)), (own_clock(2.6, 0.3), own_clock(3.7, 0.3, 1))])
def test_two_held_angles_are_valid_at_fresh_rows_of_the_slower_one(a: np.ndarray, b: np.ndarray):
    found = masked(with_held_channel(with_held_channel(LOG, "motor_angle", a), "load_angle", b))
    assert found.trusted is not None
    slow = min((a, b), key=np.sum) | (np.arange(COUNT) == 0)
    assert not (found.trusted & ~slow).any() and found.trusted.sum() > 0.9 * slow.sum()
    twist = MOTION[:, 0] / rig.N - MOTION[:, 1]
    left = (found.dynamic_error - twist)[found.trusted]
    assert np.std(left) < 0.05 * np.std(twist)
    assert sum("refreshed about" in f.what for f in found.findings) == 2


def test_outputs_after_the_known_samples_are_not_masked():
    log = with_held_channel(LOG, "load_angle", every(10))
    found = without_repeats(replace(log, outputs_until=1500))
    assert found.trusted is not None and found.trusted[1500:].all() and found.trusted[:1500].sum() == 150


SLOW = rig.drive_motion(0.02 * TORQUE)
STOPS = np.where((np.arange(COUNT) // 500) % 2 == 0, np.arange(COUNT), 500 * (np.arange(COUNT) // 500))


@hypothesis.settings(max_examples=40, deadline=None)
@hypothesis.given(
    step=st.floats(-7.0, -3.0),
    noise=st.sampled_from([0.0, 0.3, 1.0]),
    size=st.floats(-2.5, 0.0),
    seed=st.integers(0, 9),
)
def test_coarse_encoder_is_not_detected_as_held(step: float, noise: float, size: float, seed: int):
    width = 10.0**step
    random = np.random.default_rng(seed)
    load = 10.0**size * MOTION[:, 1] + noise * width * random.normal(size=COUNT)
    log = replace(LOG, load_angle=np.rint(load / width) * width)
    found = without_repeats(log)
    assert found is log


@pytest.mark.parametrize("name", ["load_angle", "motor_angle"])
def test_standstill_is_not_detected_as_held(name: str):
    stopped = replace(LOG, **{name: getattr(LOG, name)[STOPS]})
    assert without_repeats(stopped) is stopped
    slow = rig.drive_log(SLOW, TORQUE, noise=0.0)
    assert without_repeats(slow) is slow


def test_fit_with_a_held_encoder_recovers_the_parameters():
    log = with_held_channel(rig.drive_log(MOTION, TORQUE, noise=20.0), "load_angle", every(10, 4))
    ready = masked(log)
    tables = {"drive": {"reduction_ratio": rig.N, "motor_inertia": rig.J_M, "load_inertia": rig.J_L}}
    assert not [f for f in examine(ready, drive_of(tables, log.path)) if f.severity == "refusal"]
    model = TwoInertiaModel(Drive(N=rig.N, J_m=rig.J_M, J_l=rig.J_L, K=1.0))
    found = base_fit(model, whole(experiments_from_log(ready, hold="zero-order", N=rig.N))).fit
    estimates = uncertainty(found, torque_noise=False).estimates
    for path, truth in {"K": rig.K, "alpha": rig.ALPHA, "B_sp": rig.B_SP}.items():
        assert abs(estimates[path].value - truth) < 4 * estimates[path].std, path
    assert estimates["K"].std < 0.01 * rig.K
