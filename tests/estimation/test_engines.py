"""Choice of the engine that evaluates a residual; all engines give the same estimates."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import rig
from fitting.drive_data import read_rig
from fitting.estimation import engines
from fitting.estimation.estimate import fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import fitted_paths
from fitting.estimation.problem import Segmentation, pose
from fitting.estimation.residual import Engine
from fitting.estimation.starting_values import starting_models
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import TwoInertiaModel
from hdjax.effects.effect import MeshTorqueEffect, Motion
from hdjax.parameters import Scalar, parameter


class BesselTorque(MeshTorqueEffect):
    """A torque with a function that the translator to machine code does not support."""

    family = "unknown"
    name = "bessel_torque"

    k: Scalar = parameter(0.1, unit="N m", doc="size", role="strength")

    @classmethod
    def proposals(cls, scales):
        return (cls(),)

    def torque(self, motion: Motion, drive, state):
        return self.k * jax.scipy.special.i0e(motion.x)


@pytest.fixture(scope="module")
def stretches() -> tuple[Stretch, ...]:
    experiment = rig.drive_experiment(600)
    return (Stretch(experiment, 0, len(experiment)),)


SEGMENTATION = Segmentation(128, halo=4, substeps=1)


def test_unsupported_function_is_reported_and_evaluated_by_xla(stretches: tuple[Stretch, ...]):
    model = TwoInertiaModel(rig.drive_model().drive, (BesselTorque(),))
    problem, unknowns = pose(model, stretches, fitted_paths(model), SEGMENTATION)
    assert problem.kernel is None
    assert "bessel_i0e" in str(engines.why_not(problem))
    assert np.isfinite(np.asarray(engines.linearise(problem, unknowns).residual)).all()


def test_engine_falls_back_to_xla_without_llvmlite(stretches: tuple[Stretch, ...], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "hdjax.engine.handler", None)
    engines.unusable.cache_clear()
    try:
        model = rig.drive_model()
        problem, _ = pose(model, stretches, fitted_paths(model), SEGMENTATION)
        assert problem.kernel is None and engines.why_not(problem) == "llvmlite is not installed"
    finally:
        monkeypatch.undo()
        engines.unusable.cache_clear()


@pytest.mark.parametrize("engine", ["XLA", "diffrax"])
def test_all_engines_give_the_same_estimates(shared: Path, engine: Engine):
    """Machine code, the same steps by XLA, and `diffrax.diffeqsolve` with adaptive steps, on a practice log."""
    folder = shared / "logs" / "clean_multisine-7"
    logs = read_rig([folder / "train_1.csv"], folder / "drive.toml")
    experiment = logs.experiments["zero-order"][0]
    base = [Stretch(experiment, 0, 3000)]
    start = starting_models(logs.model, base)[0]
    segmentation = Segmentation(128, substeps=3)
    found = fit(start, base, fitted_paths(start), segmentation)
    assert found.problem.kernel is not None and found.converged
    other = fit(start, base, fitted_paths(start), segmentation, engine=engine)
    assert other.problem.kernel is None and other.converged
    estimates = uncertainty(found, torque_noise=False).estimates
    for path in ("K", "alpha", "B_sp"):
        assert abs(float(other.model.get(path)) - float(found.model.get(path))) < 0.01 * estimates[path].std
