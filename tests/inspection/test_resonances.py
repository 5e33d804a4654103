"""What the motor's response to its torque shows, without a model."""

import numpy as np
import pytest
from simulated_joint import simulated

import fitting
from fitting.inspection.resonances import resonances

J_M, J_L, N = 3e-4, 1.2, 100.0


def responded(K: float) -> tuple[np.ndarray, np.ndarray]:
    """Torque up to 1.5 times the resonance, and differences of the motor's velocity."""
    motion = simulated(N=N, J_m=J_M, J_l=J_L, K=K, B_sp=0.08 * np.sqrt(K))
    return motion.motor_torque[1:], np.diff(motion.motor_velocity)


@pytest.mark.parametrize("K", [2e4, 8e4])
def test_dip_and_peak_are_those_of_the_drive(K: float):
    found = resonances(*responded(K), 1000.0)
    assert found is not None and found.antiresonance is not None and found.resonance is not None
    # Lines lie 0.7 Hz apart, and a Hann window is two of them wide.
    assert found.antiresonance == pytest.approx(np.sqrt(K / J_L) / (2 * np.pi), abs=1.4)
    assert found.resonance == pytest.approx(np.sqrt(K * (1 / J_L + 1 / (N**2 * J_M))) / (2 * np.pi), abs=1.4)


def test_a_rigid_drive_and_noise_show_none():
    random = np.random.default_rng(0)
    torque = np.convolve(random.normal(size=6000), np.ones(8), mode="same")
    for response in (torque + random.normal(size=6000), random.normal(size=6000)):
        found = resonances(torque, response, 1000.0)
        assert found is not None and found.antiresonance is None and found.resonance is None
    assert resonances(torque[:200], torque[:200], 1000.0) is None


@pytest.mark.parametrize("signal", ["motor_angle", "motor_velocity"])
def test_inspection_tells_what_shows(signal: str):
    motion = simulated(N=N, J_m=J_M, J_l=J_L)
    columns = {name: getattr(motion, name) for name in ("time", "motor_torque", signal)}
    (sentence,) = [s for s in fitting.inspect(columns).told if "The motor's response shows" in s]
    assert "an antiresonance at about" in sentence and "a resonance at" in sentence
    # In slow motion the drive turns as one.
    slow = np.fft.rfft(motion.motor_torque)
    slow[np.fft.rfftfreq(6000, 1e-3) > 6.0] = 0.0
    torque = np.fft.irfft(slow, 6000)
    velocity = np.cumsum(torque) * 1e-3 / (J_M + J_L / N**2)
    rigid = {"motor_angle": np.cumsum(velocity) * 1e-3, "motor_velocity": velocity}[signal]
    found = fitting.inspect({"time": motion.time, "motor_torque": torque, signal: rigid})
    assert any("shows neither antiresonance nor resonance" in s for s in found.told)
