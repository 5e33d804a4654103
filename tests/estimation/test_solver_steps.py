"""Solver steps are as fine as the standard errors of the parameters require."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation import solver_steps
from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, Start, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from fitting.estimation.residual import Blocks, Problem, Unknowns
from fitting.estimation.solver_steps import needed_substeps
from fitting.uncertainty.standard_errors import uncertainty

COUNT, SEGMENT = 1500, 128
PATHS = ("K", "alpha", "B_sp")


def refitted(found: Fit, substeps: int) -> Fit:
    start = Start(found.covariance, found.unknowns.states)
    return fit(found.model, found.stretches, PATHS, replace(found.segmentation, substeps=substeps), start=start)


def distance(one: Fit, other: Fit) -> float:
    """Largest difference between the parameters of two fits, in standard errors."""
    apart = np.asarray(one.unknowns.parameters) - np.asarray(other.unknowns.parameters)
    return float(np.max(np.abs(apart) / np.sqrt(np.diag(uncertainty(one).unit_covariance))))


def test_predicted_parameter_shift_equals_that_of_a_refit_with_finer_steps():
    """The solver error at the end of a joined segment propagates through all later segments."""
    log = rig.drive_experiment(COUNT)
    segmentation = Segmentation(COUNT, SEGMENT, substeps=1)
    found = fit(rig.drive_model(), [Stretch(log, 0, COUNT)], PATHS, segmentation)
    found = refitted(found, 1)
    shift = distance(found, refitted(found, 2))
    # The tolerance of 10 % covers second-order terms of the shift and the end of the iteration.
    assert needed_substeps(found, tolerance=np.inf, shift=1.1 * shift) == 1
    assert needed_substeps(found, tolerance=np.inf, shift=0.9 * shift) > 1


def test_simulation_that_diverges_needs_no_finer_steps(monkeypatch: pytest.MonkeyPatch):
    log = rig.drive_experiment(COUNT)
    found = fit(rig.drive_model(), [Stretch(log, 0, COUNT)], PATHS, Segmentation(COUNT, SEGMENT, substeps=1))

    def diverging(problem: Problem, unknowns: Unknowns) -> Blocks:
        slopes = np.asarray(linearise(problem, unknowns).by_parameter).copy()
        slopes[1] = 1e200
        return replace(linearise(problem, unknowns), by_parameter=jnp.asarray(slopes))

    monkeypatch.setattr(solver_steps, "linearise", diverging)
    assert needed_substeps(found, tolerance=np.inf, shift=0.1) == 1
