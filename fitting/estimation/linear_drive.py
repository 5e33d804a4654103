"""The drive without effects and without alpha as a linear system of the state (theta_m, theta_l, omega_m, omega_l)."""

import numpy as np
from jaxtyping import Float
from scipy.linalg import expm

from hdjax import Drive, TwoInertiaModel


def rates_of(drive: Drive) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 2"]]:
    """Derivatives of the state's rate by the state, and by the torques on motor and load."""
    N, J_m, J_l, K, B, k_T = (float(getattr(drive, p)) for p in ("N", "J_m", "J_l", "K", "B_sp", "k_T"))
    mesh = np.array([K / N, -K, B / N, -B])
    by_state, by_torque = np.zeros((4, 4)), np.zeros((4, 2))
    by_state[0, 2] = by_state[1, 3] = 1.0
    by_state[2], by_state[3] = -mesh / (N * J_m), mesh / J_l
    by_torque[2, 0], by_torque[3, 1] = k_T / J_m, 1.0 / J_l
    return by_state, by_torque


def over_a_step(drive: Drive, step: float) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """Derivatives of the state after a step by the state before it; and by value and slope of motor torque, then of
    load torque."""
    by_state, by_torque = rates_of(drive)
    rates = np.zeros((8, 8))
    rates[:4, :4], rates[:4, [4, 6]] = by_state, by_torque
    rates[4, 5] = rates[6, 7] = 1.0
    across = expm(step * rates)
    return across[:4, :4], across[:4, 4:]


def readings(model: TwoInertiaModel) -> Float[np.ndarray, "outputs 4"]:
    """Derivatives of the outputs by the state."""
    N, K, B = (float(getattr(model.drive, p)) for p in ("N", "K", "B_sp"))
    rows = {
        "motor_turn": [1.0 / N, 0.0, 0.0, 0.0],
        "motor_angle": [1.0, 0.0, 0.0, 0.0],
        "load_angle": [0.0, 1.0, 0.0, 0.0],
        "dynamic_error": [1.0 / N, -1.0, 0.0, 0.0],
        "motor_velocity": [0.0, 0.0, 1.0, 0.0],
        "load_velocity": [0.0, 0.0, 0.0, 1.0],
        "joint_torque": [K / N, -K, B / N, -B],
    }
    return np.array([rows[name] for name in model.measured])
