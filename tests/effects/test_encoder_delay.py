"""An encoder that is read late: recovered from logs, beside stiffness and damping."""

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation.base_fit import base_fit
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import Stretch, experiment_from_log
from fitting.estimation.free_parameters import base_paths, effect_paths
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, TwoInertiaModel
from hdjax.effects.sensing import LoadEncoderDelay, MotorEncoderDelay

COUNT, FINER = 2000, 5
TORQUE = rig.drive_torque(COUNT)
FINE = rig.drive_motion(np.repeat(TORQUE, FINER), step=rig.STEP / FINER, substeps=2)
MODEL = TwoInertiaModel(Drive(N=rig.N, J_m=rig.J_M, J_l=rig.J_L, K=1.0))


def late(side: int, steps: int) -> Stretch:
    """The rig's log with one encoder read some fifths of a sample late."""
    rows = np.arange(COUNT) * FINER
    motion = FINE[rows].copy()
    motion[:, side] = FINE[np.maximum(rows - steps, 0), side]
    log = rig.drive_log(motion, TORQUE, noise=10.0)
    return Stretch(experiment_from_log(log, hold="zero-order", N=rig.N), 0, COUNT)


def test_a_late_encoder_is_recovered():
    form, steps = LoadEncoderDelay, 2
    stretch = late(1, steps)
    base = base_fit(MODEL, (stretch,))
    model = base.model.with_effects(form(delay=1e-5))
    paths = (*base_paths(base.model), *effect_paths(model.effects[0]))
    found: Fit = fit(model, base.stretches, paths, base.segmentation)
    assert found.objective < base.objective - 1.0
    estimates = uncertainty(found, torque_noise=False).estimates
    delay = estimates[f"{form.name}.delay"]
    # What is left of second order moves the delay by a share of (w d)^2 / 2, 0.4 % at the resonance.
    assert delay.value == pytest.approx(steps * rig.STEP / FINER, rel=5e-3)
    assert abs(estimates["K"].value - rig.K) < 4 * estimates["K"].std


def test_each_delay_moves_its_own_reading():
    state = jnp.asarray(np.array([1.0, 0.02, 3.0, -0.4]))
    drive = MODEL.drive
    for form, moved in ((MotorEncoderDelay, (0.01 * 3.0 / rig.N,) * 2), (LoadEncoderDelay, (0.0, -0.01 * -0.4))):
        change = TwoInertiaModel(drive).outputs(state) - TwoInertiaModel(drive, (form(delay=0.01),)).outputs(state)
        np.testing.assert_allclose(change, moved, atol=1e-15)
