"""Initial states of segments where not all states are measured: least squares with the linear drive."""

import numpy as np
from jaxtyping import Float

from fitting.estimation.linear_drive import over_a_step, readings
from fitting.estimation.segments import Segments
from hdjax import TwoInertiaModel

# Periods of the slower resonance from which an initial state is estimated.
_PERIODS = 1.0
_MOST_SAMPLES = 256
# Singular values below this share are cut off: weakly observable directions of the state stay at zero.
_BLIND = 1e-9


def observed_states(model: TwoInertiaModel, segments: Segments) -> Float[np.ndarray, "segments 4"]:
    """The initial state (theta_m, theta_l, omega_m, omega_l) of each segment, fitted to its first samples with the
    drive without effects.

    Args:
        model: supplies the drive and the outputs.
        segments: the data.
    """
    load = segments.load_torque
    data = [segments.measured, segments.weight, segments.torque.coefficients[:, segments.halo :]]
    data = [np.asarray(a) for a in (*data, *([] if load is None else [load.coefficients]))]
    steps = np.median(segments.width, axis=1)
    # Logs may have different sample rates.
    rates = np.round(100.0 * np.log(steps))
    states = np.zeros((len(steps), 4))
    for own in (rates == rate for rate in np.unique(rates)):
        states[own] = _at_one_rate(model, float(np.median(steps[own])), *(a[own] for a in data))
    return states


def _at_one_rate(
    model: TwoInertiaModel,
    step: float,
    measured: Float[np.ndarray, "segments samples outputs"],
    weight: Float[np.ndarray, "segments samples"],
    torque: Float[np.ndarray, "segments intervals powers"],
    load: Float[np.ndarray, "segments intervals powers"] | None = None,
) -> Float[np.ndarray, "segments 4"]:
    """[`observed_states`][] of segments with the same sample interval."""
    drive, N = model.drive, float(model.drive.N)
    slowest = float(np.sqrt(drive.K / drive.J_l))
    samples = int(np.clip(np.ceil(2 * np.pi * _PERIODS / slowest / step), 8, _MOST_SAMPLES))
    samples = min(samples, weight.shape[1])
    # Angles are relative to the segment's start: over many turns rounding would spoil the twist.
    scale = {"motor_turn": 1.0, "motor_angle": N, "load_angle": 1.0}
    turns = np.array([scale.get(name, 0.0) for name in model.measured])
    angles = np.flatnonzero(turns)
    begin = measured[:, 0, angles[0]] / turns[angles[0]] if angles.size else np.zeros(len(measured))
    measured = measured[:, :samples] - begin[:, None, None] * turns
    across, pushes = over_a_step(drive, step)
    reads = readings(model)
    powers, forced = [np.eye(4)], np.zeros((len(measured), samples, 4))
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
    """Change of the state over a step by a torque's value and slope."""
    count = min(coefficients.shape[-1], 2)
    return coefficients[:, :count] @ by[:, :count].T


def _noise(values: Float[np.ndarray, "segments samples outputs"]) -> Float[np.ndarray, " outputs"]:
    """Rms of each output's high-frequency noise, from differences of neighbouring samples."""
    third = np.diff(values, n=3, axis=1) if values.shape[1] > 3 else values
    size = np.sqrt(np.mean(third**2, axis=(0, 1)) / 20.0)
    return np.where(size > 0, size, 1.0)
