"""A fit linearised along its motion."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Stretch, whole
from fitting.estimation.free_parameters import base_paths, fitted_paths
from fitting.estimation.problem import Segmentation, stable_substeps
from fitting.first_order.gains import best_steps, linearise_along, products
from fitting.first_order.linearised_fit import fitted_motion
from fitting.first_order.motion import ERROR, SLOPE
from hdjax import Model, simulate
from hdjax.effects import DahlMotorFriction, QuadraticStiffness
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.learned import LearnedMeshTorque

TORQUE_SENSOR = ("motor_angle", "joint_torque")


def seen_by(model: Model, count: int = 1024) -> tuple[Stretch, ...]:
    """The rig's experiment on a model, without noise."""
    driven = rig.drive_experiment(count)
    outputs = np.asarray(simulate(model, driven.torque, driven.time, rtol=1e-10, atol=1e-13).outputs)
    return whole([replace(driven, measured=outputs, outputs=model.measured)])


def held_fit(model: Model, stretches: tuple[Stretch, ...]) -> Fit:
    strategy = Strategy(20, hold_parameters=True)
    return fit(model, stretches, base_paths(model), Segmentation(256), strategy=strategy)


@pytest.mark.parametrize(
    "measured", [TORQUE_SENSOR, pytest.param(("motor_turn", "dynamic_error"), marks=pytest.mark.slow)]
)
def test_first_order_strengths_of_small_mesh_terms_are_the_true_ones(measured: tuple[str, ...]):
    """A sensor of the joint torque measures the torque of a term in the mesh directly as well."""
    model = replace(rig.drive_model(), measured=measured)
    K, k2, amplitude = float(model.drive.K), 0.2, 1e-8
    found = held_fit(model, seen_by(model.with_effects(QuadraticStiffness(k2=k2))))
    look = linearise_along(found)
    x, theta = np.asarray(look.motion.x), np.asarray(look.motion.theta_m)
    (step,) = best_steps(products(look, look.acting(LearnedMeshTorque.name), (x[..., None] ** 2,)).in_parts(1))
    assert step[-1] == pytest.approx(K * k2, rel=0.02)
    found = held_fit(model, seen_by(model.with_effects(KinematicError(cos_2=amplitude))))
    look = linearise_along(found)
    sizes = np.cos(2 * theta)[..., None], -2 * np.sin(2 * theta)[..., None]
    (step,) = best_steps(products(look, look.acting(ERROR, SLOPE), sizes).in_parts(1))
    assert step[-1] == pytest.approx(amplitude, rel=0.02)


def test_surrogates_are_of_segments_that_do_not_diverge():
    """A lost segment's residual of any size would be noise to all others."""
    stretches = whole([rig.drive_experiment(1024)])
    found = held_fit(rig.drive_model(), stretches)
    error = np.asarray(found.error).copy()
    error[1] = 1e6
    broken = fitted_motion(replace(found, error=jnp.asarray(error)), seed=0).surrogates
    plain = fitted_motion(found, seed=0).surrogates
    size, usual = (np.sqrt(np.mean(np.abs(s.spectrum) ** 2) / s.length) for s in (broken, plain))
    assert 0.5 < size / usual < 2.0


def test_bristles_are_linearised_with_steps_in_which_they_are_stable():
    """Fewer steps diverge: no segment would count, and no effect would have a gain."""
    stretches = whole([rig.drive_experiment(512)])
    friction = DahlMotorFriction(T_c=5e-2, bend=2e-4, settling=0.1 * rig.STEP)
    model = rig.drive_model().with_effects(friction)
    assert stable_substeps(model, rig.STEP) > 1
    found = fit(model, stretches, fitted_paths(model), Segmentation(128), strategy=Strategy(5, hold_parameters=True))
    motion = fitted_motion(found, seed=0)
    assert np.asarray(motion.answers.weight).sum() == 512
    assert np.isfinite(motion.seen.followed.transition).all()
