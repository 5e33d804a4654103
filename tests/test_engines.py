"""Which engine evaluates a residual, and that all give the same drive."""

import dataclasses
import sys

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting import engines
from fitting.estimate import fit
from fitting.experiment import Stretch
from fitting.free import fitted_paths
from fitting.posing import pose
from hdjax import TwoInertiaModel
from hdjax.effects.effect import MeshTorqueEffect, Motion
from hdjax.parameters import Scalar, parameter


class BesselTorque(MeshTorqueEffect):
    """A torque by a function that the translator does not know."""

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


OPTIONS = {"horizon": 128, "length": None, "halo": 4, "substeps": 1, "hold_parameters": False, "count": None}


def test_a_function_that_is_not_known_is_named_and_left_to_xla(stretches: tuple[Stretch, ...]):
    model = TwoInertiaModel(rig.drive_model().drive, (BesselTorque(),))
    problem, unknowns = pose(model, stretches, fitted_paths(model), states=None, **OPTIONS)
    assert problem.kernel is None
    assert "bessel_i0e" in str(engines.why_not(problem))
    assert np.isfinite(np.asarray(engines.linearise(problem, unknowns).residual)).all()


def test_without_llvmlite_xla_does_it(stretches: tuple[Stretch, ...], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "hdjax.engine.handler", None)
    engines.unusable.cache_clear()
    try:
        model = rig.drive_model()
        problem, _ = pose(model, stretches, fitted_paths(model), states=None, **OPTIONS)
        assert problem.kernel is None and engines.why_not(problem) == "llvmlite is not installed"
    finally:
        monkeypatch.undo()
        engines.unusable.cache_clear()


def test_three_routes_give_one_drive(stretches: tuple[Stretch, ...]):
    """Machine code, XLA, and a plain `diffeqsolve` of each segment give the same residual at the fitted parameters."""
    model = rig.drive_model()
    found = fit(model, stretches, fitted_paths(model), horizon=128, halo=4, substeps=1)
    assert found.problem.kernel is not None
    problem = dataclasses.replace(found.problem, model=found.model)
    by_code, _ = engines.simulate(problem, found.unknowns)
    by_xla = engines.linearise(dataclasses.replace(problem, kernel=None), found.unknowns)
    np.testing.assert_allclose(by_xla.residual, engines.linearise(problem, found.unknowns).residual, rtol=0, atol=1e-9)
    segments, halo = problem.segments, problem.segments.halo
    torque = np.asarray(segments.torque.coefficients)[:, halo:, 0]
    knots = np.asarray(segments.torque.knots)[:, halo:]

    @jax.jit
    @jax.vmap
    def solved(values, times, state):
        def field(t, y, args):
            return found.model.rates(y, values[jnp.searchsorted(times, t, side="right") - 1], jnp.zeros(()))

        solution = dfx.diffeqsolve(
            dfx.ODETerm(field),
            dfx.Tsit5(),
            times[0],
            times[-1],
            None,
            state,
            saveat=dfx.SaveAt(ts=times[:-1]),
            stepsize_controller=dfx.ClipStepSizeController(dfx.PIDController(rtol=1e-10, atol=1e-13), jump_ts=times),
            max_steps=100_000,
        )
        return jax.vmap(found.model.outputs)(solution.ys)

    outputs = np.asarray(solved(jnp.asarray(torque), jnp.asarray(knots), found.unknowns.states))
    counts = np.asarray(segments.weight) > 0
    # One step of Tsit5 to a sample errs by some 1e-7 of the motion.
    np.testing.assert_allclose(np.asarray(by_code)[counts], outputs[counts], rtol=0, atol=1e-5 * np.abs(outputs).max())
