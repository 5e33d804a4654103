"""A fit linearised along its motion."""

import numpy as np

import rig
from fitting.estimation.estimate import Strategy, fit
from fitting.estimation.experiment import whole
from fitting.estimation.free_parameters import fitted_paths
from fitting.estimation.problem import Segmentation, stable_substeps
from fitting.first_order.linearised_fit import fitted_motion
from hdjax.effects import DahlMotorFriction


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
