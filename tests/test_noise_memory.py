"""Noise with a memory is known for what it is and in its true size, and what is missing does not pass for it."""

from typing import Any

import numpy as np
import pytest
from jaxtyping import Float
from scipy.signal import lfilter

import rig
from fitting.estimate import Fit, Strategy, fit
from fitting.experiment import Stretch, experiment_from_log
from fitting.long_fit import over_whole_stretches, with_gaps_closed
from fitting.noise_memory import _described, _drawn, _taken_by_states, noise_with_memory
from fitting.posing import Segmentation

COUNT, HORIZON = 8000, 128
# Of the motor's and of the load's encoder [rad].
SIZES = 3.0 * np.array([rig.MOTOR_NOISE, rig.LOAD_NOISE])


def slow_noise(correlation: float, *, seed: int = 5) -> Float[np.ndarray, "samples encoders"]:
    """Of unit variance, each sample correlated with the one before."""
    pushed = np.random.default_rng(seed).normal(size=(COUNT, 2))
    pushed[1:] *= np.sqrt(1.0 - correlation**2)
    return np.asarray(lfilter([1.0], [1.0, -correlation], pushed, axis=0))


def fitted(correlation: float, *, hold_parameters: bool = False, **missing: Any) -> Fit:
    """The base model's fit of a drive with such encoders and something missing in it, or its true parameters."""
    torque = rig.drive_torque(COUNT, rms=0.3, seed=5)
    motion = rig.drive_motion(torque, **missing)
    motion[:, :2] += slow_noise(correlation) * SIZES
    logged = experiment_from_log(rig.drive_log(motion, torque, noise=0.0), hold="zero-order", N=rig.N)
    return fit(
        rig.drive_model(),
        [Stretch(logged, 0, COUNT)],
        ("K", "alpha", "B_sp"),
        Segmentation(HORIZON, substeps=1),
        strategy=Strategy(hold_parameters=hold_parameters),
    )


@pytest.mark.parametrize("correlation", [0.0, 0.8, 0.98])
def test_noise_is_known_with_its_memory_and_its_size(correlation: float):
    noise = noise_with_memory(fitted(correlation, hold_parameters=True))
    assert noise is not None
    # So many samples of white noise would tell as much.
    counts = COUNT * (1.0 - correlation) / (1.0 + correlation)
    twist = np.hypot(SIZES[0] / rig.N, SIZES[1])
    assert float(noise.covariance[-1, -1]) ** 0.5 == pytest.approx(twist, rel=3.0 / np.sqrt(2.0 * counts))
    assert noise.correlation * (1.0 - noise.white) == pytest.approx(correlation, abs=0.05)
    if correlation:
        assert noise.memory(rig.STEP) == pytest.approx(-rig.STEP / np.log(correlation), rel=0.4)


@pytest.mark.parametrize("correlation", [0.0, 0.8, 0.98])
def test_what_initial_states_take_off_is_what_such_noise_leads_to_expect(correlation: float):
    short = fitted(correlation, hold_parameters=True)
    whole = over_whole_stretches(short)
    segments, samples = short.problem.segments.weight.shape
    error = np.asarray(whole.error)[np.asarray(whole.problem.segments.weight) > 0]
    expected = _taken_by_states(short, _drawn(_described(error), segments * samples))
    assert with_gaps_closed(whole) - short.objective == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize(
    "missing",
    [
        {"motor_friction": (2e-3, 1.0)},
        {"mesh_friction": (0.5, 1e-2)},
        {"tether": 20.0},
        {"kinematic": (1e-4, 0.0)},
        {"gap": 5e-5},
    ],
    ids=lambda missing: next(iter(missing)),
)
def test_what_is_missing_does_not_pass_for_noise(missing: dict[str, Any]):
    assert noise_with_memory(fitted(0.95, **missing)) is None
