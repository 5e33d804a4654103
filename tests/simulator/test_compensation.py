"""Feedforward of the kinematic error, on simulated drives that a servo turns."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

from hdjax import Drive
from hdjax.compensation import Feedforward, MotorServo, feedforward, run_at_speed
from hdjax.dynamics import TwoInertiaModel
from hdjax.effects.actuation import TorqueGain
from hdjax.effects.friction import LoadFriction
from hdjax.effects.hysteresis import BoucWen
from hdjax.effects.kinematic import KinematicError, KinematicHarmonic
from hdjax.effects.learned import LearnedMotorTorque
from hdjax.effects.learned_axes import PowerAxis
from hdjax.effects.load import GravityLoad
from hdjax.simulate import Trajectory

DRIVE = Drive(N=50.0, J_m=5.26e-4, J_l=5e-2, K=7160.0, alpha=1e5, B_sp=0.5)
PLANT = TwoInertiaModel(DRIVE, (KinematicError(cos_2=1.5e-4, sin_1=3e-5, cos_4=2e-5),))
SOFT, STIFF = MotorServo(stiffness=20.0, damping=0.2), MotorServo(stiffness=2000.0, damping=2.0)
TIMES = np.linspace(0.0, 1.5, 3001)
SETTLED = TIMES >= 1.0
OFF = {"K": 1.02, "J_l": 0.98, "alpha": 1.02, "B_sp": 1.02, "kinematic_error.cos_2": 0.98, "J_m": 1.02}


def two_percent_off() -> TwoInertiaModel:
    return PLANT.replace({path: factor * float(PLANT.get(path)) for path, factor in OFF.items()})


def error_deviations(found: Trajectory, speed: float) -> dict[str, float]:
    """Standard deviations of the two errors once the transient has died out."""
    load = np.asarray(found.states[:, 1]) - speed * TIMES / float(DRIVE.N)
    errors = {"dynamic_error": np.asarray(found.dynamic_error), "output": load}
    return {name: float(e[SETTLED].std()) for name, e in errors.items()}


@cache
def deviations_without_feedforward(speed: float, stiff: bool = False) -> dict[str, float]:
    return error_deviations(run_at_speed(PLANT, speed, TIMES, STIFF if stiff else SOFT), speed)


def reduction(correction: Feedforward, target: str, **options) -> float:
    speed = float(correction.speed)
    servo = options.pop("servo", SOFT)
    found = error_deviations(run_at_speed(PLANT, speed, TIMES, servo, correction=correction, **options), speed)
    return deviations_without_feedforward(speed, servo is STIFF)[target] / found[target]


@pytest.mark.parametrize("speed", (60.0, 180.0))
@pytest.mark.parametrize("target", ("dynamic_error", "output"))
def test_feedforward_removes_the_error_and_tolerates_two_percent_of_model_error(target, speed):
    exact = feedforward(PLANT, speed, target=target)
    assert bool(exact.converged)
    assert reduction(exact, target) > 1e3
    near = feedforward(two_percent_off(), speed, target=target)
    assert bool(near.converged)
    assert reduction(near, target) > 5.0


def test_torque_of_the_feedforward_allows_for_the_torque_constant():
    exact, weak = (feedforward(plant, 60.0) for plant in (PLANT, PLANT.replace({"k_T": 0.9})))
    np.testing.assert_allclose(weak.torque.cosine, exact.torque.cosine / 0.9, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(weak.correction.cosine, exact.correction.cosine, rtol=1e-9, atol=1e-12)


def test_servo_turns_a_plant_with_a_torque_constant_and_memory():
    plant = PLANT.with_effects(BoucWen(k=500.0, memory_twist=1e-4)).replace({"k_T": 0.9})
    found = run_at_speed(plant, 60.0, TIMES[:501], STIFF)
    assert float(found.states[-1, 0]) == pytest.approx(60.0 * TIMES[500], rel=1e-3)


def test_feedforward_of_the_angle_alone_suffices_for_a_stiff_servo():
    correction = feedforward(PLANT, 60.0)
    assert reduction(correction, "dynamic_error", servo=STIFF, use=("motor_angle",)) > 10.0


def test_feedforward_makes_its_target_error_zero():
    still = feedforward(PLANT, 60.0)
    assert float(jnp.max(still.dynamic_error.amplitudes)) == 0.0
    assert float(jnp.max(still.output_error.amplitudes)) > 0.0
    uniform = feedforward(PLANT, 60.0, target="output")
    assert float(jnp.max(uniform.output_error.amplitudes)) == 0.0
    # The load turns uniformly without a torque on it: the mesh is not twisted, x = -e(theta_m).
    t = jnp.linspace(0.0, 0.1, 50)
    error = PLANT.effects[0].error(uniform.motor_angle(t))
    np.testing.assert_allclose(uniform.dynamic_error(t), -error, atol=1e-9)
    np.testing.assert_allclose(uniform.correction(t), -float(DRIVE.N) * error, atol=1e-7)


def test_feedforward_without_a_kinematic_error_is_zero():
    for target in ("dynamic_error", "output"):
        found = feedforward(TwoInertiaModel(DRIVE), 60.0, target=target)
        assert bool(found.converged)
        for series in (found.correction, found.torque):
            np.testing.assert_allclose(series.values(64), 0.0, atol=1e-12)


def test_feedforward_carries_a_constant_load():
    """The mesh is twisted against it, `K (x + alpha x^3) = -T_l`, and the motor gives `-T_l / N`."""
    found = feedforward(TwoInertiaModel(DRIVE), 60.0, load_torque=8.0)
    assert bool(found.converged)
    x = found.dynamic_error.mean
    assert float(DRIVE.mesh_torque(x, jnp.zeros(()))) == pytest.approx(-8.0, rel=1e-9)
    assert float(found.torque.mean) == pytest.approx(-8.0 / 50.0, rel=1e-9)
    np.testing.assert_allclose(found.correction.mean, 50.0 * x, rtol=1e-12)


def test_feedforward_overcomes_friction_of_the_load():
    """The load's friction twists the mesh, and the motor gives an N-th of it."""
    rubbed = TwoInertiaModel(DRIVE, (LoadFriction(T_c=3.0, b=0.5, transition=1e-3),))
    found = feedforward(rubbed, 60.0, target="output")
    friction = 3.0 + 0.5 * 60.0 / 50.0
    assert bool(found.converged)
    x = found.dynamic_error.mean
    assert float(DRIVE.mesh_torque(x, jnp.zeros(()))) == pytest.approx(friction, rel=1e-9)
    assert float(found.torque.mean) == pytest.approx(friction / 50.0, rel=1e-9)


def test_feedforward_refuses_what_it_can_not_carry_and_few_samples():
    for effect in (BoucWen(k=500.0, memory_twist=1e-4), TorqueGain(gain_error=0.1), GravityLoad(sine=1.0)):
        with pytest.raises(ValueError, match=effect.name):
            feedforward(PLANT.with_effects(effect), 60.0)
    with pytest.raises(ValueError, match="`kinematic_harmonic` has order 2.5"):
        feedforward(PLANT.with_effects(KinematicHarmonic(cosine=1e-4, n=2.5)), 60.0)
    learned = LearnedMotorTorque(axes=(PowerAxis("T_m", 1.0),), mixing=np.ones((5, 1)), c=(0.1,))
    with pytest.raises(ValueError, match="`learned_motor_torque` is a function of the motor torque"):
        feedforward(PLANT.with_effects(learned), 60.0)
    with pytest.raises(ValueError, match="samples"):
        feedforward(PLANT, 60.0, harmonics=12, samples=24)
