"""First states of segments whose sensors do not see all of the motion: least squares of the linear drive."""

import numpy as np
from jaxtyping import Float

from fitting.estimation.experiment import Segments
from fitting.estimation.linear_drive import over_a_step, readings
from hdjax import TwoInertiaModel

# Periods of the slower resonance over which a first state shows.
_PERIODS = 1.0
_MOST_SAMPLES = 256
# Directions of the state that outputs hardly see stay at zero.
_BLIND = 1e-9


def observed_states(model: TwoInertiaModel, segments: Segments) -> Float[np.ndarray, "segments 4"]:
    """The first state (theta_m, theta_l, omega_m, omega_l) of each segment, as the drive without effects explains the
    segment's first samples by it.

    Args:
        model: supplies the drive, and says what was measured.
        segments: the data.
    """
    drive, N = model.drive, float(model.drive.N)
    measured, weight = np.array(segments.measured), np.asarray(segments.weight)
    step = float(np.median(segments.width))
    slowest = float(np.sqrt(drive.K / drive.J_l))
    samples = int(np.clip(np.ceil(2 * np.pi * _PERIODS / slowest / step), 8, _MOST_SAMPLES))
    samples = min(samples, weight.shape[1])
    # Angles are counted from where the segment begins: many turns would cost the digits of a twist.
    scale = {"motor_turn": 1.0, "motor_angle": N, "load_angle": 1.0}
    turns = np.array([scale.get(name, 0.0) for name in model.measured])
    angles = np.flatnonzero(turns)
    begin = measured[:, 0, angles[0]] / turns[angles[0]] if angles.size else np.zeros(len(measured))
    measured = measured[:, :samples] - begin[:, None, None] * turns
    across, pushes = over_a_step(drive, step)
    reads = readings(model)
    powers, forced = [np.eye(4)], np.zeros((len(measured), samples, 4))
    torque = np.asarray(segments.torque.coefficients)[:, segments.halo :]
    load = None if segments.load_torque is None else np.asarray(segments.load_torque.coefficients)
    for i in range(samples - 1):
        powers.append(across @ powers[-1])
        forced[:, i + 1] = forced[:, i] @ across.T + _pushed(torque[:, i], pushes[:, :2])
        if load is not None:
            forced[:, i + 1] += _pushed(load[:, i], pushes[:, 2:])
    left = (measured - forced @ reads.T) * weight[:, :samples, None]
    size = _noise(left)
    columns = (reads @ np.stack(powers))[None] * weight[:, :samples, None, None]
    columns = (columns / size[:, None]).reshape(len(measured), -1, 4)
    norm = np.linalg.norm(columns, axis=1, keepdims=True)
    norm[norm == 0] = 1.0
    inverse = np.linalg.pinv(columns / norm, rcond=_BLIND) / np.swapaxes(norm, 1, 2)
    states = np.einsum("spr,sr->sp", inverse, (left / size).reshape(len(measured), -1))
    return states + begin[:, None] * np.array([N, 1.0, 0.0, 0.0])


def _pushed(coefficients: np.ndarray, by: np.ndarray) -> np.ndarray:
    """What a torque does to the state over a step: its value and slope."""
    count = min(coefficients.shape[-1], 2)
    return coefficients[:, :count] @ by[:, :count].T


def _noise(values: Float[np.ndarray, "segments samples outputs"]) -> Float[np.ndarray, " outputs"]:
    """Size of what neighbouring samples do not share, by output."""
    third = np.diff(values, n=3, axis=1) if values.shape[1] > 3 else values
    size = np.sqrt(np.mean(third**2, axis=(0, 1)) / 20.0)
    return np.where(size > 0, size, 1.0)
