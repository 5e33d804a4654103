"""Friction that is most of the motor's torque is named, and K is right beside it."""

import pytest

import joints
from fitting.estimation.experiment import experiment_from_log
from fitting.loop import close_loop
from hdjax import Drive, TwoInertiaModel


def loop_on(seed: int):
    joint = joints.drawn(seed)
    experiment = experiment_from_log(joints.log_of(joint, seed=seed), hold="zero-order", N=joint.N)
    model = TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=1.0))
    return joint, close_loop(model, {"zero-order": (experiment,)}, hold="zero-order")


def check(seed: int):
    joint, loop = loop_on(seed)
    assert loop.decision == "effect_found"
    assert [f.family for f in loop.findings] == ["motor_friction"]
    found = loop.after.model
    assert float(found.get("K")) == pytest.approx(joint.K, rel=0.02)
    assert float(found.get(f"{loop.findings[0].name}.b")) == pytest.approx(joint.viscous, rel=0.05)


def test_named():
    # Coulomb 57 %, viscous 35 % of the rms torque.
    check(13)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [seed for seed in range(40) if seed != 13])
def test_named_in_more_joints(seed):
    check(seed)
