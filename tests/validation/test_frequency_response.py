"""The frequency response equals the closed form, and states which resonances a log excites."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

import rig
from fitting.estimation.experiment import Experiment, experiment_from_log
from fitting.validation.frequency_response import (
    FrequencyResponse,
    antiresonance_seen,
    coherent_band,
    excites_antiresonance,
    excites_resonance,
    frequency_response,
    resonance_seen,
    unexplained_band,
)
from hdjax import Drive, Hold, TwoInertiaModel

MU, OMEGA_0, GAIN, STEP = 12.0, 200.0, 50.0, 1e-3
F_0 = OMEGA_0 / (2 * np.pi)
COUNT = 40_000


def stepped(hold: Hold) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact update `y' = A y + b u + c u_next` of `x'' + mu x' + omega_0^2 x = gain u`.

    It follows from one matrix exponential of oscillator and input (Van Loan).
    """
    matrix = np.zeros((4, 4))
    matrix[:2, :2] = [[0.0, 1.0], [-(OMEGA_0**2), -MU]]
    matrix[1, 2] = GAIN
    matrix[2, 3] = 1.0 / STEP if hold == "linear" else 0.0
    whole = expm(matrix * STEP)
    return whole[:2, :2], whole[:2, 2] - whole[:2, 3], whole[:2, 3]


def exact_response(frequency: np.ndarray, hold: Hold) -> np.ndarray:
    """Exact response from samples of the input to samples of x."""
    A, b, c = stepped(hold)
    z = np.exp(2j * np.pi * frequency * STEP)
    return np.array([np.linalg.solve(k * np.eye(2) - A, b + k * c)[0] for k in z])


def simulated(u: np.ndarray, *, alpha: float = 0.0, noise: float = 0.0) -> Experiment:
    """A log of the linear oscillator, exact from sample to sample, or of the cubic one by the rig's Runge-Kutta."""
    if alpha:
        x = rig.reduced_motion(u, mu=MU, omega_0=OMEGA_0, alpha=alpha, gain=GAIN, step=STEP, substeps=2)[:, 0]
    else:
        A, b, _ = stepped("zero-order")
        states = np.zeros((u.size, 2))
        for k in range(u.size - 1):
            states[k + 1] = A @ states[k] + b * u[k]
        x = states[:, 0]
    return experiment_from_log(rig.reduced_log(x, u, noise=noise, step=STEP), hold="zero-order")


def response_of(experiment: Experiment, *, alpha: float = 0.0, hold: Hold = "zero-order", noise: float = 0.0):
    model = rig.reduced_model(mu=MU, omega_0=OMEGA_0, alpha=alpha, gain=GAIN)
    return frequency_response(model, [experiment], hold=hold, noise=noise)


@pytest.fixture(scope="module")
def white() -> np.ndarray:
    return np.random.default_rng(0).normal(size=COUNT)


@pytest.fixture(scope="module")
def linear_response(white: np.ndarray) -> FrequencyResponse:
    found = response_of(simulated(white))
    assert found is not None
    return found


@pytest.mark.parametrize("hold", ["zero-order", "linear"])
def test_model_response_equals_the_closed_form(white: np.ndarray, hold: Hold):
    found = response_of(simulated(white), hold=hold)
    assert found is not None
    # Far above the resonance the transfer function is a small difference of large terms.
    np.testing.assert_allclose(found.model, exact_response(found.frequency, hold), rtol=1e-9, atol=1e-13)


def test_band_limited_input_has_the_continuous_time_response(white: np.ndarray):
    found = response_of(simulated(white), hold="band-limited")
    assert found is not None
    s = 2j * np.pi * found.frequency
    np.testing.assert_allclose(found.model, GAIN / (s**2 + MU * s + OMEGA_0**2), rtol=1e-12)


def test_measured_response_of_a_linear_log_equals_the_closed_form(linear_response: FrequencyResponse):
    truth = exact_response(linear_response.frequency, "zero-order")
    error = np.abs(linear_response.measured / truth - 1)
    coherent = linear_response.coherence > 0.99
    assert np.mean(coherent[linear_response.frequency < 3 * F_0]) > 0.9
    # Random error of a line: sqrt((1 - coherence) / (2 averages coherence)), below 1 % here; leakage adds at the peak.
    assert np.median(error[coherent]) < 0.01 and np.max(error[coherent]) < 0.1
    assert linear_response.width == pytest.approx(MU / (2 * np.pi))
    assert linear_response.averages >= 8


def test_resonance_of_a_linear_log_is_detected(linear_response: FrequencyResponse):
    assert excites_resonance(linear_response)
    assert resonance_seen(linear_response) == pytest.approx(F_0, abs=2 * linear_response.resolution)
    band = coherent_band(linear_response)
    assert band is not None and band[0] < 2.0 < 3 * F_0 < band[1]
    assert unexplained_band(linear_response) is None


def test_coherence_decreases_with_noise_as_predicted(white: np.ndarray):
    """With noise on the response only, coherence is 1 - noise power / response power."""
    noise = 2e-4
    found = response_of(simulated(white, noise=noise), noise=noise)
    assert found is not None
    # One-sided densities of white noise; input of unit variance.
    response = np.abs(exact_response(found.frequency, "zero-order")) ** 2 * 2 * STEP
    truth = response / (response + 2 * STEP * noise**2)
    assert truth[-1] < 0.1 and truth[0] > 0.9
    # An estimate from few averages is too large by (1 - c)^2 / averages.
    expected = truth + (1 - truth) ** 2 / found.averages
    for part in np.array_split(np.arange(truth.size), 8):
        assert np.mean(found.coherence[part]) == pytest.approx(np.mean(expected[part]), abs=0.02)
    assert np.mean(np.abs(found.noise_coherence - truth)[truth > 0.5]) < 0.05
    # Noise is not reported as an unexplained band.
    assert unexplained_band(found) is None


def test_resonance_above_the_excited_band_is_not_detected():
    u = rig.multisine(COUNT, STEP, rms=1.0, low=0.5, high=6.0, seed=1)
    # The first samples are cut off because they hold the transient from rest.
    noise = 1e-5
    found = response_of(simulated(u, noise=noise), noise=noise)
    assert found is not None
    tail = response_of(_cut(simulated(u, noise=noise), 4000), noise=noise)
    assert tail is not None and not excites_resonance(tail) and resonance_seen(tail) is None


def test_lines_without_excitation_do_not_mask_the_resonance():
    """The ratio of twist to torque is arbitrary where neither has power."""
    u = rig.multisine(COUNT, STEP, rms=1.0, low=1.0, high=1.3 * F_0, seed=6)
    found = response_of(simulated(u, noise=1e-7), noise=1e-7)
    assert found is not None
    assert resonance_seen(found) == pytest.approx(F_0, abs=2 * found.resolution)


def _cut(experiment: Experiment, start: int) -> Experiment:
    part = rig.reduced_log(
        experiment.measured[start:, -1], np.asarray(experiment.torque.coefficients)[start:, 0], step=STEP
    )
    return experiment_from_log(part, hold="zero-order")


def test_nonlinear_stiffness_lowers_the_coherence():
    u = 4e3 * np.random.default_rng(2).normal(size=20_000)
    experiment = simulated(u, alpha=0.3)
    found = response_of(experiment, alpha=0.3)
    assert found is not None
    x = experiment.measured[:, -1]
    assert 3 * 0.3 * np.mean(x**2) > 0.5
    # The mean slope of the restoring force, as for a Gaussian twist.
    assert found.resonance == pytest.approx(F_0 * np.sqrt(1 + 0.9 * np.mean(x**2)))
    assert unexplained_band(found) is not None


def test_jitter_of_time_stamps_does_not_change_the_response(white: np.ndarray, linear_response: FrequencyResponse):
    """Jitter of time stamps by a fifth of the step does not change the response of slow motion."""
    smooth = rig.multisine(COUNT, STEP, rms=1.0, low=2.0, high=60.0, seed=3)
    even = simulated(smooth)
    time = even.time + STEP * np.random.default_rng(4).uniform(-0.2, 0.2, COUNT)
    x, u = (np.interp(time, even.time, v) for v in (even.measured[:, -1], smooth))
    log = dataclasses.replace(rig.reduced_log(x, u, step=STEP), time=time)
    irregular, regular = response_of(experiment_from_log(log, hold="zero-order")), response_of(even)
    assert irregular is not None and regular is not None
    # The median step is that of the grid to a few parts in ten thousand.
    lines = np.flatnonzero((regular.frequency > 3) & (regular.frequency < 50) & (regular.coherence > 0.99))
    found = np.interp(regular.frequency[lines], irregular.frequency, np.abs(irregular.measured))
    np.testing.assert_allclose(found, np.abs(regular.measured[lines]), rtol=0.08)


@pytest.mark.parametrize(("count", "amplitude"), [(300, 1.0), (4000, 0.0)])
def test_short_log_or_constant_torque_has_no_response(count: int, amplitude: float):
    """Neither a log that is too short nor a constant torque gives a frequency response."""
    u = 1.0 + amplitude * np.random.default_rng(5).normal(size=count)
    assert response_of(simulated(u)) is None


def test_response_of_a_drive_log_has_the_motor_torque_as_input():
    """The two-inertia drive's twist obeys the reduced equation, with gain 1 / (N J_m)."""
    experiment = rig.drive_experiment(8000, noise=0.0)
    model = rig.drive_model(alpha=0.0)
    found = frequency_response(model, [experiment], hold="zero-order", noise=1e-9)
    assert found is not None and found.source == "torque"
    c = 1 / (rig.N**2 * rig.J_M) + 1 / rig.J_L
    assert found.resonance == pytest.approx(np.sqrt(c * rig.K) / (2 * np.pi))
    omega = 2 * np.pi * found.frequency[0]
    truth = 1 / (rig.N * rig.J_M) / (c * rig.K - omega**2)
    # The errors by hold and damping are of the order of (omega step)^2 and zeta^2.
    assert abs(found.model[0]) == pytest.approx(truth, rel=1e-4)


def motor_only_log(torque: np.ndarray, *, B_sp: float = 0.4, noise: float = 1e-4) -> tuple[Experiment, TwoInertiaModel]:
    """A log of the motor's angle of a linear drive, exact from sample to sample, and its model."""
    N, J_m, J_l, K = 50.0, 4e-5, 0.2, 300.0
    mesh = np.array([K / N, -K, B_sp / N, -B_sp])  # of the motor's and the load's angle, and of their rates
    rates = np.zeros((5, 5))
    rates[:2, 2:4] = np.eye(2)
    rates[2, :4], rates[2, 4], rates[3, :4] = -mesh / N / J_m, 1.0 / J_m, mesh / J_l
    whole = expm(rates * STEP)
    across, pushed = whole[:4, :4], whole[:4, 4]
    states = np.zeros((torque.size, 4))
    for k in range(torque.size - 1):
        states[k + 1] = across @ states[k] + pushed * torque[k]
    angle = states[:, 0] + noise * np.random.default_rng(8).normal(size=torque.size)
    log = rig.log_of_angles(angle, angle, torque, ratio=N, step=STEP, name="motor")
    log = dataclasses.replace(log, load_angle=None, dynamic_error=None)
    model = TwoInertiaModel(Drive(N=N, J_m=J_m, J_l=J_l, K=K, B_sp=B_sp), measured=("motor_angle",))
    return experiment_from_log(log, hold="zero-order", N=N), model


ANTIRESONANCE = np.sqrt(300.0 / 0.2) / (2 * np.pi)
RESONANCE = ANTIRESONANCE * np.sqrt(1.0 + 0.2 / (50.0**2 * 4e-5))


def test_motor_only_log_has_antiresonance_and_resonance():
    experiment, model = motor_only_log(rig.multisine(COUNT, STEP, rms=0.05, low=0.5, high=40.0, seed=1))
    found = frequency_response(model, [experiment], hold="zero-order", noise=1e-4)
    assert found is not None and found.output == "motor_angle"
    assert found.antiresonance == pytest.approx(ANTIRESONANCE) and found.resonance == pytest.approx(RESONANCE)
    assert antiresonance_seen(found) == pytest.approx(ANTIRESONANCE, abs=2 * found.resolution)
    assert resonance_seen(found) == pytest.approx(RESONANCE, abs=2 * found.resolution)


def test_response_of_any_output_is_that_of_the_mean_stiffness():
    experiment, model = motor_only_log(rig.multisine(COUNT, STEP, rms=0.05, low=0.5, high=40.0, seed=1))
    harder = dataclasses.replace(model, drive=dataclasses.replace(model.drive, alpha=1e4))
    found = frequency_response(harder, [experiment], hold="zero-order", noise=1e-4)
    assert found is not None and found.antiresonance is not None and found.antiresonance > 1.05 * ANTIRESONANCE
    near = np.abs(found.frequency - found.antiresonance) < 1.0
    dip = found.frequency[near][np.argmin(np.abs(found.model[near]))]
    assert dip == pytest.approx(found.antiresonance, abs=found.resolution)


def test_model_that_softens_altogether_has_a_response():
    experiment, model = motor_only_log(rig.multisine(COUNT, STEP, rms=0.05, low=0.5, high=40.0, seed=1))
    softer = dataclasses.replace(model, drive=dataclasses.replace(model.drive, alpha=-1e12))
    found = frequency_response(softer, [experiment], hold="zero-order", noise=1e-4)
    assert found is not None and found.resonance > 0.0 and np.isfinite(found.model).all()
    assert unexplained_band(found) is None


@pytest.mark.parametrize(("low", "high"), [(0.5, 0.6 * ANTIRESONANCE), (1.3 * ANTIRESONANCE, 40.0)])
def test_antiresonance_outside_the_excited_band_is_not_detected(low: float, high: float):
    experiment, model = motor_only_log(rig.multisine(COUNT, STEP, rms=0.05, low=low, high=high, seed=2), noise=1e-3)
    found = frequency_response(model, [experiment], hold="zero-order", noise=1e-3)
    assert found is not None and coherent_band(found) is not None
    assert not excites_antiresonance(found) and antiresonance_seen(found) is None


@pytest.mark.parametrize("measured", ["load_velocity", "joint_torque", "dynamic_error"])
def test_outputs_other_than_the_motor_have_no_antiresonance(measured: str):
    experiment = rig.drive_experiment(8000, noise=0.0)
    outputs = ("motor_turn", "dynamic_error") if measured == "dynamic_error" else ("motor_angle", measured)
    model = dataclasses.replace(rig.drive_model(alpha=0.0), measured=outputs)
    experiment = dataclasses.replace(experiment, outputs=outputs)
    found = frequency_response(model, [experiment], hold="zero-order", noise=1e-9)
    assert found is not None and found.antiresonance is None and not excites_antiresonance(found)


def test_low_coherence_at_unresolved_peaks_is_not_unexplained():
    """In a short log with little damping, leakage of the window lowers the coherence at peaks and dips."""
    torque = rig.multisine(8000, STEP, rms=0.05, low=0.5, high=30.0, seed=3)
    experiment, model = motor_only_log(torque, B_sp=0.02)
    found = frequency_response(model, [experiment], hold="zero-order", noise=1e-4)
    assert found is not None and found.width < found.resolution
    beside = np.abs(found.frequency - RESONANCE) < 2 * found.resolution
    assert np.min(found.coherence[beside]) < 0.6
    assert unexplained_band(found) is None
