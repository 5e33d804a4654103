"""Friction that is most of the motor's torque is named, and K is right beside it."""

from collections.abc import Sequence

import pytest

import joints
from fitting.estimation.experiment import experiment_from_log
from fitting.loop import close_loop
from hdjax import Drive, TwoInertiaModel
from hdjax.effects import CATALOGUE, Effect
from hdjax.effects.actuation import TorqueGain
from hdjax.effects.friction import CoulombFriction, LoadFriction, MotorFriction, StribeckMotorFriction
from hdjax.effects.kinematic import KinematicError

# With the forms that come nearest to it.
FEW = (MotorFriction, StribeckMotorFriction, LoadFriction, CoulombFriction, KinematicError, TorqueGain)


def check(seed: int, catalogue: Sequence[type[Effect]]) -> None:
    joint = joints.drawn(seed)
    experiment = experiment_from_log(joints.log_of(joint, seed=seed), hold="zero-order", N=joint.N)
    model = TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))
    loop = close_loop(model, {"zero-order": (experiment,)}, hold="zero-order", catalogue=catalogue)
    assert loop.decision == "effect_found"
    assert [f.family for f in loop.findings] == ["motor_friction"]
    found = loop.after.model
    assert float(found.get("K")) == pytest.approx(joint.K, rel=0.02)
    assert float(found.get(f"{loop.findings[0].name}.b")) == pytest.approx(joint.viscous, rel=0.05)


def test_strong_motor_friction_is_named_among_few_forms():
    # Coulomb 57 %, viscous 35 % of the rms torque.
    check(13, FEW)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_strong_motor_friction_is_named_among_all_forms(seed: int):
    check(seed, CATALOGUE)
