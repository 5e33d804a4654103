"""Simulations that follow the log closely give the true motion where those of the model diverge from it."""

import numpy as np

import joints
from fitting.estimation.estimate import Strategy, fit
from fitting.estimation.experiment import experiment_from_log, whole
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.estimation.whole_log_fit import follows
from fitting.first_order.close_following import followed_closely
from fitting.first_order.linearised_fit import motion_states
from hdjax import Drive, TwoInertiaModel

COUNT = 1500


def test_closely_followed_motor_speed_is_accurate_under_missing_friction():
    joint = joints.with_friction(joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, rms=0.05), 0.5, 0.5)
    torque = joints.torque_of(joint, count=COUNT)
    truth = joints.motion_of(joint, torque)[:, 2]
    experiment = experiment_from_log(joints.log_of(joint, count=COUNT), hold="zero-order", N=joint.N)
    model = TwoInertiaModel(Drive(N=joint.N, J_m=joint.J_m, J_l=joint.J_l, K=joint.K, B_sp=joint.B_sp))
    # Horizons of 1024 samples in segments of 256; the data fill the last segment only in part.
    found = fit(
        model,
        whole([experiment]),
        base_paths(model),
        Segmentation(1024, 256),
        strategy=Strategy(hold_parameters=True),
    )
    assert not follows(found)
    lost, close = motion_states(found), followed_closely(found)
    assert close.states.shape == lost.shape

    def off(states: np.ndarray) -> float:
        speed = states[:, :-1, 2].ravel()[:COUNT]
        return float(np.std(speed - truth) / np.std(truth))

    assert off(lost) > 0.3
    assert off(close.states) < 0.1
