"""Readings of a late encoder: whole rows of the delay are found, and moved."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import joints
import rig
from fitting.estimation.encoder_delay import delay_of_load
from fitting.estimation.experiment import Experiment, Moved, Stretch, experiment_from_log, whole
from fitting.estimation.late_readings import aligned, is_aligned, moved_to, unaligned
from hdjax import Drive, TwoInertiaModel
from hdjax.effects.sensing import LoadEncoderDelay, MotorEncoderDelay, SensorDelay

COUNT = 1500
MODEL = rig.drive_model()
PHYSICS = {
    "nothing": {},
    "friction of the motor": {"motor_friction": (0.2, 1.0)},
    "kinematic error": {"kinematic": (1e-4, 0.0)},
    "weight on the load": {"gravity": 5.0},
    "backlash": {"gap": 3e-4},
}


@functools.cache
def log_with(effect: str) -> Experiment:
    return rig.drive_experiment(COUNT, **PHYSICS[effect])


def with_late_load(experiment: Experiment, rows: int) -> Experiment:
    """The load's angle read some rows late, or early."""
    turn, x = experiment.measured.T
    load = (turn - x)[np.clip(np.arange(COUNT) - rows, 0, COUNT - 1)]
    return replace(experiment, measured=np.stack([turn, turn - load], axis=1))


@pytest.mark.parametrize("beside", PHYSICS)
@pytest.mark.parametrize("rows", [-7, 0, 10])
def test_whole_rows_between_the_encoders_are_found_beside_any_effect(beside: str, rows: int):
    """To a row where the effect bends the phase of the load as well; no delay is claimed where there is none."""
    late = with_late_load(log_with(beside), rows)
    found = delay_of_load(MODEL, (Stretch(late, 20, COUNT - 20),)) / rig.STEP
    off = 1 if rows and beside in ("kinematic error", "backlash") else 0
    assert abs(found - rows) < off + 1e-6


@pytest.mark.parametrize("first", ["slow", "quick"])
def test_delay_is_found_in_logs_of_different_rates(first: str):
    late, torque = 3 * rig.STEP, np.repeat(rig.drive_torque(COUNT), 4)
    fine = rig.drive_motion(torque, step=rig.STEP / 4)
    load = np.concatenate([np.full(12, fine[0, 1]), fine[:-12, 1]])
    stretches = {}
    for name, every in (("slow", 4), ("quick", 1)):
        own = slice(None, None, every)
        log = rig.log_of_angles(fine[own, 0], load[own], torque[own], ratio=rig.N, step=every * rig.STEP / 4, name=name)
        stretches[name] = whole([experiment_from_log(log, hold="zero-order", N=rig.N)])
    both = stretches[first] + stretches["quick" if first == "slow" else "slow"]
    assert delay_of_load(MODEL, both) == pytest.approx(late)


@pytest.mark.parametrize("share", [0.3, 0.8, 1.5])
def test_friction_of_the_load_with_a_memory_is_no_delay(share: float):
    """It shifts the load's phase, but the motor's equation does not contain it."""
    joint = joints.Joint(N=50.0, J_m=7.2e-5, J_l=0.03, K=630.0, B_sp=0.09, rms=0.06)
    torque = share * joint.rms * joint.N
    joint = replace(joint, load_friction=torque, bend=torque / (0.5 * joint.K))
    model = TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))
    experiment = experiment_from_log(joints.log_of(joint), hold="zero-order", N=joint.N)
    assert delay_of_load(model, whole([experiment])) == 0.0


@pytest.mark.parametrize("seed", [0, 1])
def test_friction_of_the_mesh_over_many_turns_is_no_delay(seed: int):
    """A controller lets the motor follow steps, and the mesh rubs in proportion to its teeth's ripple."""
    N, J_m, J_l, K = 80.0, 8.3e-5, 0.055, 9650.0
    random = np.random.default_rng(seed)
    size, change = random.normal(size=6000), random.uniform(size=6000) < 0.005

    def torque(theta_m, omega_m, wanted):
        return wanted - 0.02 * theta_m - 0.01 * omega_m

    def rates(y, wanted):
        x, v = y[0] / N - y[1], y[2] / N - y[3]
        tau = K * (x + 9e3 * x**3) + 0.6 * v + 0.7 * (1.0 + 0.6 * math.sin(2 * y[0])) * math.tanh(v / 1e-3)
        return y[2], y[3], (torque(y[0], y[2], wanted) - tau / N) / J_m, tau / J_l

    wanted = 0.5 * np.cumsum(size * change)
    theta_m, theta_l, omega_m, _ = rig.rk4(rates, (0.0,) * 4, wanted, 1e-3, 20).T
    motor, load = (a + noise * random.normal(size=6000) for a, noise in ((theta_m, 1e-4), (theta_l, 1.3e-6)))
    log = rig.log_of_angles(motor, load, torque(theta_m, omega_m, wanted), ratio=N, step=1e-3, name="mesh")
    model = TwoInertiaModel(Drive(N=N, J_m=J_m, J_l=J_l, K=1.0))
    assert delay_of_load(model, whole([experiment_from_log(log, hold="linear", N=N)])) == 0.0


def test_delay_is_not_looked_for_where_the_twist_was_not_measured():
    both = log_with("nothing")
    motor = replace(both, measured=both.measured[:, :1], outputs=("motor_angle",))
    model = TwoInertiaModel(MODEL.drive, measured=("motor_angle",))
    assert delay_of_load(model, (Stretch(motor, 0, COUNT),)) == 0.0


@settings(max_examples=10)
@given(rows=st.integers(-9, 9), invalid=st.integers(20, COUNT - 20))
def test_moved_readings_are_those_of_the_undelayed_encoder(rows: int, invalid: int):
    """Rows whose reading lies beyond the log or is invalid are invalid; moving back restores the others."""
    logged = log_with("nothing")
    weight = np.ones(COUNT)
    weight[invalid] = 0.0
    late = replace(with_late_load(logged, rows), weight=weight)
    moved = moved_to(late, Moved(rows * rig.STEP))
    assert moved.weight is not None and moved.weight[invalid] == moved.weight[invalid - rows] == 0.0
    assert COUNT - 4 - abs(rows) <= np.sum(moved.weight) <= COUNT - 1 - abs(rows)
    valid = moved.weight > 0
    np.testing.assert_allclose(moved.measured[valid], logged.measured[valid], atol=1e-12)
    back = moved_to(moved, Moved())
    valid = np.asarray(back.weight) > 0
    np.testing.assert_allclose(back.measured[valid], late.measured[valid], atol=1e-12)


@pytest.mark.parametrize("load, motor", [(0.0, 0.0), (3.4, 0.0), (0.0, 3.6), (7.9, 2.6)])
def test_laws_of_aligned_delays_span_at_most_half_a_row(load: float, motor: float):
    effects = LoadEncoderDelay(delay=load * rig.STEP), MotorEncoderDelay(delay=motor * rig.STEP)
    late = MODEL.with_effects(*effects)
    model, (stretch,) = aligned(late, (Stretch(log_with("nothing"), 0, COUNT),))
    assert is_aligned(model, (stretch,))
    own = [e for e in model.effects if isinstance(e, SensorDelay)]
    assert all(abs(float(e.load_delay())) <= 0.5001 * rig.STEP for e in own)
    rows = round(load) - round(motor)
    assert stretch.experiment.moved == pytest.approx((rows * rig.STEP, -round(motor) * rig.STEP))
    assert [float(e.moved) for e in unaligned(model).effects if isinstance(e, SensorDelay)] == [0.0, 0.0]
    assert aligned(MODEL, (stretch,))[1][0].experiment.moved == Moved()
