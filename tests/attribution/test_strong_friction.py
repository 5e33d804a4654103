"""Friction that takes most of the motor torque is identified, and K is correct beside it."""

import numpy as np
import pytest

import joints
from fitting.attribution.effect_search import base_trial
from fitting.attribution.screening import screen
from fitting.estimation.experiment import experiment_from_log, split
from fitting.loop import close_loop
from hdjax import Drive, TwoInertiaModel
from hdjax.drive import Prior
from hdjax.effects.actuation import TorqueGain
from hdjax.effects.friction import MotorFriction


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_strong_motor_friction_is_found(seed: int):
    joint = joints.drawn(seed)
    experiment = experiment_from_log(joints.log_of(joint, seed=seed), hold="zero-order", N=joint.N)
    model = TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))
    loop = close_loop(model, {"zero-order": (experiment,)}, hold="zero-order")
    assert loop.decision == "effect_found"
    assert [f.family for f in loop.findings] == ["motor_friction"]
    found = loop.after.model
    assert float(found.get("K")) == pytest.approx(joint.K, rel=0.02)
    assert float(found.get(f"{loop.findings[0].name}.b")) == pytest.approx(joint.viscous, rel=0.05)


def test_fixed_parameters_do_not_absorb_friction_in_screening():
    """The load's equation fixes the mesh; the free motion of the base model, without friction, strays far off."""
    joint = joints.Joint(N=160.0, J_m=1.087e-7, J_l=0.0136, K=18.52, B_sp=0.00985, rms=5.8e-4)
    joint = joints.with_friction(joint, 0.2, 0.6)
    experiment = experiment_from_log(joints.log_of(joint, count=3000), hold="zero-order", N=joint.N)
    free = Prior("J_m", 1.0, np.inf), Prior("J_l", 1.0, np.inf)
    model = TwoInertiaModel(Drive(N=joint.N, J_m=1.0, J_l=1.0, K=1.0, priors=free))
    base, _ = base_trial(model, {"zero-order": split((experiment,))}, "zero-order")
    leads = screen(base.training, base.held_out, catalogue=(MotorFriction, TorqueGain)).leads
    assert leads[0].effect.name == MotorFriction.name and leads[0].gain > 0.95
    assert float(leads[0].effect.T_c) == pytest.approx(joint.coulomb, rel=0.1)
