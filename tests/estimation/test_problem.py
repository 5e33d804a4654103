"""Set-up of a fit: initial states, solver steps and horizons."""

import jax.numpy as jnp
import numpy as np

import rig
from fitting.estimation.experiment import Stretch, experiment_from_log
from fitting.estimation.problem import (
    Segmentation,
    initial_states,
    pose,
    short_horizon,
    states_from,
    suggested_substeps,
)
from fitting.estimation.segments import cut
from hdjax.effects.creep import Creep
from hdjax.effects.hysteresis import BoucWen, Dahl


def whole(*experiments) -> list[Stretch]:
    return [Stretch(e, 0, len(e)) for e in experiments]


def test_initial_states_of_a_smooth_motion_equal_the_truth():
    torque = rig.drive_torque(200)
    segments = cut(whole(rig.drive_experiment(200, noise=0.0)), 50)
    states = initial_states(rig.drive_model(), segments)
    expected = rig.drive_motion(torque)[::50]
    # A cubic through eight intervals, a quarter of a period: a few percent of the rates.
    off = np.max(np.abs(np.asarray(states) - expected), axis=0) / np.max(np.abs(expected), axis=0)
    np.testing.assert_array_less(off, [0.01, 0.01, 0.15, 0.15])


def test_initial_speeds_of_a_noisy_oversampled_motion_are_near_the_truth():
    forcing = np.repeat(rig.reduced_forcing(100), 20)
    step = rig.REDUCED_STEP / 20
    motion = rig.reduced_motion(forcing, step=step)
    log = rig.reduced_log(motion[:, 0], forcing, noise=0.1 * np.std(motion[:, 0]), step=step)
    segments = cut(whole(experiment_from_log(log, hold="zero-order")), 200, count=10)
    states = np.asarray(initial_states(rig.reduced_model(), segments))
    off = np.sqrt(np.mean((states - motion[::200]) ** 2, axis=0)) / np.std(motion, axis=0)
    # 87 samples in a quarter period; a speed from nine of them would be noise.
    np.testing.assert_array_less(off, [0.2, 0.5])


def test_horizon_and_solver_steps_follow_the_natural_frequency():
    stretches = whole(rig.drive_experiment(400))
    slow, fast = rig.drive_model(K=rig.K / 100, alpha=0.0), rig.drive_model(K=100 * rig.K, alpha=0.0)
    assert suggested_substeps(slow, stretches) == 1
    # omega_0 h = 3855 * 5e-4 = 1.93, at most 0.15 a step.
    assert suggested_substeps(fast, stretches) == 13
    # Six periods of 2 pi / (38.55 * 5e-4) = 326 samples, to the next power of two.
    assert short_horizon(slow, stretches) == 2048
    assert short_horizon(rig.drive_model(alpha=0.0), stretches) == 256


def test_states_are_transferred_between_models_by_name():
    bare = rig.drive_model()
    moving = jnp.asarray(np.random.default_rng(0).normal(size=(8, 4)) * [10.0, 0.1, 5.0, 0.1])
    hidden = BoucWen(k=10.0, memory_twist=1e-3)
    model = bare.with_effects(hidden)
    states = np.asarray(states_from(model, bare, moving))
    np.testing.assert_array_equal(states[:, :4], moving)
    # A new hidden state starts at zero, as in a steady motion.
    np.testing.assert_array_equal(states[:, 4], 0.0)
    creeping = bare.with_effects(Creep(tau=0.1, k=700.0, span=1e-3), hidden)
    mixed = np.asarray(states_from(creeping, model, jnp.asarray(states + 1.0)))
    assert creeping.state_names[4:] == ("creep.z", "bouc_wen.z")
    np.testing.assert_array_equal(mixed[:, [0, 1, 2, 3, 5]], states + 1.0)


def test_solver_steps_keep_fast_bristles_stable():
    """Four settling times in a sample interval need two steps, however slow the oscillation is."""
    stretches = [Stretch(rig.drive_experiment(64), 0, 64)]
    model = rig.drive_model().with_effects(Dahl(k=1.0, yield_twist=1e-9, settling=0.25 * rig.STEP))
    assert pose(model, stretches, (), Segmentation(64, substeps=1))[0].substeps == 2
    assert pose(rig.drive_model(), stretches, (), Segmentation(64, substeps=1))[0].substeps == 1
