"""Delays of sensors: their estimates from logs together with stiffness and damping, and their effect on readings."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter

import joints
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
from hdjax.dynamics import Inputs
from hdjax.effects import Conditions
from hdjax.effects.friction import ViscousMotorFriction
from hdjax.effects.sensing import JointTorqueDelay, LoadEncoderDelay, LoadEncoderLag, MotorEncoderDelay, SensorDelay

COUNT, FINER = 2000, 5
TORQUE = rig.drive_torque(COUNT)
FINE = rig.drive_motion(np.repeat(TORQUE, FINER), step=rig.STEP / FINER, substeps=2)
MODEL = TwoInertiaModel(Drive(N=rig.N, J_m=rig.J_M, J_l=rig.J_L, K=1.0))


def log_with_late_encoder(form: type[SensorDelay], side: int, steps: int) -> Stretch:
    """The rig's log with one encoder read some fifths of a sample late, or behind a filter of that time constant."""
    rows = np.arange(COUNT) * FINER
    motion = FINE[rows].copy()
    if form is LoadEncoderLag:
        # Exact for an input that is linear within a step.
        numerator, denominator, _ = cont2discrete(([1.0], [float(steps), 1.0]), 1.0, method="foh")
        motion[:, side] = lfilter(np.ravel(numerator), denominator, FINE[:, side])[rows]
    else:
        motion[:, side] = FINE[np.maximum(rows - steps, 0), side]
    log = rig.drive_log(motion, TORQUE, noise=10.0)
    return Stretch(experiment_from_log(log, hold="zero-order", N=rig.N), 0, COUNT)


@pytest.mark.parametrize(
    "form, side, steps",
    [(MotorEncoderDelay, 0, 17), (LoadEncoderDelay, 1, 4), (LoadEncoderDelay, 1, 17), (LoadEncoderLag, 1, 6)],
)
def test_encoder_delay_is_estimated_from_a_log(form: type[SensorDelay], side: int, steps: int):
    """A delay within a row, and one of several rows, a tenth of a natural period."""
    stretch = log_with_late_encoder(form, side, steps)
    base = base_fit(MODEL, (stretch,)).fit
    model = base.model.with_effects(form(delay=max(1e-5, form.of_load * delay_of_load(MODEL, (stretch,)))))
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


@eqx.filter_jit
def rates(model: TwoInertiaModel, state: jax.Array, T_m: jax.Array, T_l: jax.Array) -> jax.Array:
    return model.rates(jnp.asarray(state), T_m, T_l)


def test_load_encoder_delay_reads_the_earlier_state():
    """Against the motion of the drive without a torque, integrated backwards in time."""
    drive = eqx.tree_at(lambda d: (d.K, d.B_sp), MODEL.drive, (jnp.asarray(rig.K), jnp.asarray(rig.B_SP)))
    model = TwoInertiaModel(drive)
    state, delay = jnp.asarray(np.array([1.0, 0.018, 3.0, -0.4])), 0.1 / float(drive.omega_0)
    zero = jnp.zeros(())
    earlier = solve_ivp(lambda _, y: rates(model, y, zero, zero), (0.0, -delay), np.asarray(state), rtol=1e-10).y[:, -1]
    read = TwoInertiaModel(drive, (LoadEncoderDelay(delay=delay),), ("load_angle", "load_velocity"))
    moved = np.abs(earlier - np.asarray(state))[[1, 3]]
    # The remainder of the rate, of third order in the delay.
    np.testing.assert_allclose(read.outputs(state), earlier[[1, 3]], rtol=0, atol=3e-3 * moved.max())


@pytest.mark.parametrize("moved", [0.0, 0.5])
def test_load_encoder_lag_errs_by_the_fourth_order_of_a_sine(moved: float):
    """Against the exact low-pass of the free oscillation, part of which a log's readings have been moved by."""
    model = TwoInertiaModel(eqx.tree_at(lambda d: d.K, MODEL.drive, jnp.asarray(rig.K)))
    omega = float(model.drive.omega_0)
    x = 1e-3 * np.exp(0.7j)
    load = -rig.K / (rig.J_L * omega**2) * x
    angles = np.array([rig.N * (x + load), load])
    state = jnp.asarray(np.real(np.concatenate([angles, 1j * omega * angles])))

    def error(turn: float) -> float:
        lag = turn / omega
        lagged = TwoInertiaModel(model.drive, (LoadEncoderLag(delay=lag, moved=moved * lag),), ("load_angle",))
        exact = load * np.exp(1j * moved * turn) / (1.0 + 1j * turn)
        return abs(float(lagged.outputs(state)[0]) - exact.real)

    assert error(0.02) < 1e-3 * abs(load) * 0.02**2
    assert error(0.02) / error(0.01) == pytest.approx(16.0, rel=0.1)


@pytest.mark.parametrize("turn", [0.02, 0.1])
def test_joint_torque_delay_reads_the_earlier_torque(turn: float):
    """Against the motion of a drive with friction under a torque, integrated backwards in time."""
    drive = eqx.tree_at(
        lambda d: (d.K, d.alpha, d.B_sp), MODEL.drive, [jnp.asarray(v) for v in (rig.K, rig.ALPHA, rig.B_SP)]
    )
    outputs, friction = ("motor_angle", "joint_torque"), ViscousMotorFriction(b=0.01)
    model = TwoInertiaModel(drive, (friction,), outputs)
    state, delay = jnp.asarray(np.array([1.0, 0.018, 3.0, -0.4])), turn / float(drive.omega_0)
    T_m, T_l = jnp.asarray(0.5), jnp.asarray(-1.0)
    earlier = solve_ivp(lambda _, y: rates(model, y, T_m, T_l), (0.0, -delay), np.asarray(state), rtol=1e-12).y[:, -1]
    inputs = Inputs(T_m, T_l, Conditions())
    read = model.with_effects(JointTorqueDelay(delay=delay)).outputs(state, inputs)
    # A motor's encoder that is late sees the torque as much too early.
    ahead = model.with_effects(MotorEncoderDelay(delay=delay)).outputs(jnp.asarray(earlier), inputs)
    now, before = float(model.outputs(state)[1]), float(model.outputs(jnp.asarray(earlier))[1])
    assert read[0] == state[0] and ahead[0] == earlier[0]
    # Only friction's part of the second order and the fourth order are left out.
    assert float(read[1]) == pytest.approx(before, abs=0.1 * turn * abs(now - before))
    assert float(ahead[1]) == pytest.approx(now, abs=0.1 * turn * abs(now - before))


@pytest.mark.parametrize("steps", [2, 17])
def test_joint_torque_delay_is_estimated_from_a_log(steps: int):
    """Of less than a row and of several, beside friction of the motor; with the motor's angle alone."""
    joint = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, viscous=2e-4, rms=0.05)
    torque, step = joints.torque_of(joint, count=COUNT), joints.STEP
    fine = joints.motion_of(joint, np.repeat(torque, FINER), step=step / FINER, substeps=2)
    rows = np.arange(COUNT) * FINER
    x, v = (fine[:, i] / joint.N - fine[:, i + 1] for i in (0, 2))
    tau = (joint.K * x + joint.B_sp * v)[np.maximum(rows - steps, 0)]
    random = np.random.default_rng(3)
    noise = [1e-3 * np.std(signal) * random.normal(size=COUNT) for signal in (joint.N * x, tau)]
    columns = {"motor_angle": fine[rows, 0] + noise[0], "joint_torque": tau + noise[1]}
    log = rig.log_of_angles(*fine[rows].T[:2], torque, ratio=joint.N, step=step, name="late")
    log = dataclasses.replace(log, dynamic_error=None, load_angle=None, **columns)
    stretch = Stretch(experiment_from_log(log, hold="zero-order", N=joint.N), 0, COUNT)
    drive = Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0)
    base = base_fit(TwoInertiaModel(drive, measured=stretch.experiment.outputs), (stretch,)).fit
    model = base.model.with_effects(ViscousMotorFriction(b=1e-5), JointTorqueDelay(delay=1e-5))
    paths = (*base_paths(base.model), *(path for effect in model.effects for path in effect_paths(effect)))
    found: Fit = fit(model, base.stretches, paths, base.segmentation)
    estimates = uncertainty(found, torque_noise=False).estimates
    true = {"K": joint.K, "B_sp": joint.B_sp, "viscous_motor_friction.b": joint.viscous}
    for path, value in (true | {"joint_torque_delay.delay": steps * step / FINER}).items():
        assert abs(estimates[path].value - value) < 4 * estimates[path].std < 0.02 * value
    # Free runs of the model as it is stored predict the readings as they were logged.
    (run,) = free_run(unaligned(found.model), (stretch,), covariance=found.covariance)
    assert run.rmse < 1.5e-3 * np.std(tau)


def test_encoder_delays_shift_the_dynamic_error_to_first_order():
    """The simulation's time is that of the motor's reading, so that a motor delay advances the load's reading."""
    state = jnp.asarray(np.array([1.0, 0.01, 3.0, -0.4]))
    rest = TwoInertiaModel(MODEL.drive).outputs(state)
    for form, moved in ((MotorEncoderDelay, (0.0, -1e-6 * -0.4)), (LoadEncoderDelay, (0.0, 1e-6 * -0.4))):
        change = TwoInertiaModel(MODEL.drive, (form(delay=1e-6),)).outputs(state) - rest
        np.testing.assert_allclose(change, moved, atol=1e-10)
