"""Encoder delays: their estimates from logs together with stiffness and damping, and their effect on readings."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rig
from fitting.estimation.base_fit import base_fit
from fitting.estimation.encoder_delay import delay_of_load
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import Stretch, experiment_from_log
from fitting.estimation.free_parameters import base_paths, effect_paths
from fitting.estimation.free_run import free_run
from fitting.estimation.late_readings import unaligned
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, TwoInertiaModel
from hdjax.effects.sensing import EncoderDelay, LoadEncoderDelay, MotorEncoderDelay

COUNT, FINER = 2000, 5
TORQUE = rig.drive_torque(COUNT)
FINE = rig.drive_motion(np.repeat(TORQUE, FINER), step=rig.STEP / FINER, substeps=2)
MODEL = TwoInertiaModel(Drive(N=rig.N, J_m=rig.J_M, J_l=rig.J_L, K=1.0))


def log_with_late_encoder(side: int, steps: int) -> Stretch:
    """The rig's log with one encoder read some fifths of a sample late."""
    rows = np.arange(COUNT) * FINER
    motion = FINE[rows].copy()
    motion[:, side] = FINE[np.maximum(rows - steps, 0), side]
    log = rig.drive_log(motion, TORQUE, noise=10.0)
    return Stretch(experiment_from_log(log, hold="zero-order", N=rig.N), 0, COUNT)


@pytest.mark.parametrize(
    "form, side, steps", [(MotorEncoderDelay, 0, 17), (LoadEncoderDelay, 1, 4), (LoadEncoderDelay, 1, 17)]
)
def test_encoder_delay_is_estimated_from_a_log(form: type[EncoderDelay], side: int, steps: int):
    """A delay within a row, and one of several rows, a tenth of a natural period."""
    stretch = log_with_late_encoder(side, steps)
    base = base_fit(MODEL, (stretch,)).fit
    model = base.model.with_effects(form(delay=max(1e-5, form.side * delay_of_load(MODEL, (stretch,)))))
    paths = (*base_paths(base.model), *effect_paths(model.effects[0]))
    segmentation = dataclasses.replace(base.segmentation, halo=5)
    found: Fit = fit(model, base.stretches, paths, segmentation)
    assert found.objective < base.objective - 1.0
    estimates = uncertainty(found, torque_noise=False).estimates
    delay = steps * rig.STEP / FINER
    assert estimates[f"{form.name}.delay"].std < 1e-3 * delay
    for path, true in {"K": rig.K, "alpha": rig.ALPHA, "B_sp": rig.B_SP, f"{form.name}.delay": delay}.items():
        assert abs(estimates[path].value - true) < 4 * estimates[path].std
    # Free runs of the model as it is stored predict the readings as they were logged.
    (run,) = free_run(unaligned(found.model), (stretch,), covariance=found.covariance, halo=5)
    # The fitted initial state adds to the noise.
    assert run.rmse < 2.0 * 10.0 * np.hypot(rig.MOTOR_NOISE / rig.N, rig.LOAD_NOISE)


def test_load_encoder_delay_reads_the_earlier_state():
    """Against the motion of the drive without a torque, integrated backwards in time."""
    drive = eqx.tree_at(lambda d: (d.K, d.B_sp), MODEL.drive, (jnp.asarray(rig.K), jnp.asarray(rig.B_SP)))
    model = TwoInertiaModel(drive)
    state, delay = jnp.asarray(np.array([1.0, 0.018, 3.0, -0.4])), 0.1 / float(drive.omega_0)
    zero = jnp.zeros(())
    earlier = solve_ivp(
        lambda _, y: np.asarray(model.rates(jnp.asarray(y), zero, zero)), (0.0, -delay), np.asarray(state), rtol=1e-10
    ).y[:, -1]
    read = TwoInertiaModel(drive, (LoadEncoderDelay(delay=delay),), ("load_angle", "load_velocity"))
    moved = np.abs(earlier - np.asarray(state))[[1, 3]]
    # The remainder of the rate, of third order in the delay.
    np.testing.assert_allclose(read.outputs(state), earlier[[1, 3]], rtol=0, atol=3e-3 * moved.max())


def test_encoder_delays_shift_the_dynamic_error_to_first_order():
    """The simulation's time is that of the motor's reading, so that a motor delay advances the load's reading."""
    state = jnp.asarray(np.array([1.0, 0.01, 3.0, -0.4]))
    rest = TwoInertiaModel(MODEL.drive).outputs(state)
    for form, moved in ((MotorEncoderDelay, (0.0, -1e-6 * -0.4)), (LoadEncoderDelay, (0.0, 1e-6 * -0.4))):
        change = TwoInertiaModel(MODEL.drive, (form(delay=1e-6),)).outputs(state) - rest
        np.testing.assert_allclose(change, moved, atol=1e-10)
