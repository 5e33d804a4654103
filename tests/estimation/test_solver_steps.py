"""Steps are as fine as what the data tell of the parameters asks for."""

from dataclasses import replace

import numpy as np

import rig
from fitting.estimation.estimate import Fit, Start, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from fitting.estimation.solver_steps import needed_substeps
from fitting.uncertainty.standard_errors import uncertainty

COUNT, SEGMENT = 1500, 128
PATHS = ("K", "alpha", "B_sp")


def refitted(found: Fit, substeps: int) -> Fit:
    start = Start(found.covariance, found.unknowns.states)
    return fit(found.model, found.stretches, PATHS, replace(found.segmentation, substeps=substeps), start=start)


def distance(one: Fit, other: Fit) -> float:
    """Between the parameters of two fits: the largest in standard errors."""
    apart = np.asarray(one.unknowns.parameters) - np.asarray(other.unknowns.parameters)
    return float(np.max(np.abs(apart) / np.sqrt(np.diag(uncertainty(one).unit_covariance))))


def test_the_shift_of_the_parameters_is_what_a_refit_with_finer_steps_shows():
    """Where segments are joined, what a step leaves at the end of one goes on through all that follow."""
    log = rig.drive_experiment(COUNT)
    segmentation = Segmentation(COUNT, SEGMENT, substeps=1)
    found = fit(rig.drive_model(), [Stretch(log, 0, COUNT)], PATHS, segmentation)
    found = refitted(found, 1)
    shift = distance(found, refitted(found, 2))
    # Second orders of the shift, and where the iteration ends.
    assert needed_substeps(found, tolerance=np.inf, shift=1.1 * shift) == 1
    assert needed_substeps(found, tolerance=np.inf, shift=0.9 * shift) > 1
