"""Detection of signals, units and signs from the equations of motion where channel names are arbitrary."""

import hypothesis.strategies as st
import numpy as np
from hypothesis import given, settings
from simulated_joint import Motion, simulated

import fitting

ANGLES = {"rad": 1.0, "deg": 180 / np.pi}
VELOCITIES = {"rad/s": 1.0, "deg/s": 180 / np.pi, "rpm": 30 / np.pi}
CHANNELS = ("motor_angle", "load_angle", "motor_velocity", "motor_torque")


def exported(
    motion: Motion, angle: str, velocity: str, load_sign: int, torque_sign: int, order: tuple[str, ...]
) -> tuple[dict[str, np.ndarray], dict[str, tuple[str, str | None, int]]]:
    """Channels under arbitrary names, and the signal, unit and sign of each."""
    truth = {
        "motor_angle": (ANGLES[angle] * motion.motor_angle, angle, 1),
        "load_angle": (load_sign * ANGLES[angle] * motion.load_angle, angle, load_sign),
        "motor_velocity": (VELOCITIES[velocity] * motion.motor_velocity, velocity, 1),
        "motor_torque": (torque_sign * motion.motor_torque, None, torque_sign),
    }
    columns = {"ch1": motion.time} | {f"ch{k + 2}": truth[signal][0] for k, signal in enumerate(order)}
    return columns, {f"ch{k + 2}": (signal, *truth[signal][1:]) for k, signal in enumerate(order)}


@settings(max_examples=8)
@given(
    N=st.sampled_from([30.0, 50.0, 80.0, 101.0, 121.0]),
    inertias=st.floats(0.2, 2.0),
    K=st.floats(2e4, 8e4),
    angle=st.sampled_from(sorted(ANGLES)),
    velocity=st.sampled_from(sorted(VELOCITIES)),
    load_sign=st.sampled_from([-1, 1]),
    torque_sign=st.sampled_from([-1, 1]),
    order=st.permutations(CHANNELS),
    seed=st.integers(0, 5),
)
def test_signals_units_and_signs_are_detected_without_names(
    N, inertias, K, angle, velocity, load_sign, torque_sign, order, seed
):
    J_m = 3e-4
    motion = simulated(N=N, J_m=J_m, J_l=inertias * N**2 * J_m, K=K, B_sp=1e-3 * K, seed=seed, count=4000)
    columns, truth = exported(motion, angle, velocity, load_sign, torque_sign, tuple(order))
    found = fitting.inspect(columns).inspection
    assert found.time.column == "ch1"
    guesses = {guess.column: guess for guess in found.joint.signals.values()}
    # A wrong signal is worse than none; angles and velocity must be detected.
    for column, guess in guesses.items():
        signal, unit, sign = truth[column]
        assert guess.signal == signal, (column, guess.why)
        assert guess.sign == sign or guess.doubts, (column, guess.why)
        assert guess.unit == unit or guess.doubts, (column, guess.unit, unit)
    assert {truth[column][0] for column in guesses} >= {"motor_angle", "load_angle", "motor_velocity"}
    ratio = found.joint.ratio
    assert ratio is not None and ratio.low <= N <= ratio.high
    assert ratio.value == N or not ratio.sure


@settings(max_examples=5)
@given(seeds=st.lists(st.integers(0, 1000), min_size=4, max_size=4, unique=True), walks=st.booleans())
def test_unrelated_channels_are_not_detected_as_signals(seeds: list[int], walks: bool):
    columns: dict[str, np.ndarray] = {"t": np.arange(3000) / 500.0}
    for k, seed in enumerate(seeds):
        noise = np.random.default_rng(seed).normal(size=3000)
        columns[f"ch{k}"] = np.cumsum(noise) if walks else noise
    joint = fitting.inspect(columns).inspection.joint
    assert joint.signals == {} and joint.ratio is None and joint.kind is None
