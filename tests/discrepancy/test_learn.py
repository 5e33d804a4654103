"""A learned term has the place, variables and function of the missing physics, within its band."""

import math
from dataclasses import replace

import numpy as np
import pytest

import rig
from fitting.attribution.candidate_fit import Trial, attempt
from fitting.attribution.study import Setting, Study
from fitting.discrepancy.closed_forms import shapes
from fitting.discrepancy.curve import LearnedCurve, learned_curve
from fitting.discrepancy.learn import Unknown, is_supported, learn, share_of
from fitting.estimation.experiment import Stretch, experiment_from_log, split
from fitting.estimation.free_run import free_run
from fitting.estimation.problem import Segmentation
from fitting.report.plots import learned_plot
from fitting.uncertainty.standard_errors import uncertainty
from hdjax.effects.actuation import TorqueBias, TorqueGain
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.learned import LearnedLoadReading, LearnedMeshError, LearnedMotorReading, LearnedMotorTorque
from hdjax.effects.learned_axes import LinearAxis, PowerAxis, SignAxis, SplineAxis
from hdjax.effects.sensing import LoadEncoderEccentricity, MotorEncoderEccentricity
from hdjax.effects.stiffness import QuadraticStiffness

COUNT, STEP = 1600, 4e-3
NOISE = 1e-3
FRICTION = (10.0, 0.3)
SETTING = Setting(Segmentation(128, halo=4, substeps=2, count=16))
TRUTH = rig.reduced_model()
TIME = STEP * np.arange(COUNT)
TEMPERATURE = 300.0 + 4.0 * np.sin(4.0 * np.pi * TIME / TIME[-1])


def motion_with_missing_torque(forcing: np.ndarray, torque) -> np.ndarray:
    """Twist of the reduced rig with a torque of twist and rate that is not in the model."""

    def rates(y, u):
        x, v = y
        spring = rig.OMEGA_0**2 * (x + rig.REDUCED_ALPHA * x**3)
        return v, rig.GAIN * u - rig.MU * v - spring - torque(x, v)

    return rig.rk4(rates, (0.0, 0.0), forcing, STEP, 10)[:, 0]


def base_trial(torque, seed: int = 0, *, drift: np.ndarray | None = None) -> tuple[Trial, Study]:
    """Fit the base model to a motion with a missing torque, from the true parameters."""
    forcing = rig.reduced_forcing(COUNT, seed=seed)
    felt = forcing if drift is None else forcing - drift / rig.GAIN
    log = rig.reduced_log(motion_with_missing_torque(felt, torque), forcing, noise=NOISE, seed=seed)
    log = replace(log, temperature=TEMPERATURE)
    study = Study({"zero-order": split([experiment_from_log(log, hold="zero-order")])}, SETTING, seed)
    return attempt(TRUTH, study, "zero-order"), study


def learned_from(torque, **drifting) -> Unknown:
    found = learn(*base_trial(torque, **drifting))
    assert found is not None
    return found


def curve_of(found: Unknown) -> LearnedCurve:
    return learned_curve(found, found.trial.model, uncertainty(found.trial.training))


def misfit(curve: LearnedCurve, wanted: np.ndarray) -> tuple[float, float]:
    """Relative rms difference from the truth, and the share of data with the truth inside the 95 % band.

    Both laws are taken without the part that the drive's own parameters can explain.
    """
    left = wanted - curve.known @ np.linalg.lstsq(curve.known, wanted, rcond=None)[0]
    difference = curve.value - left
    inside = np.mean(np.abs(difference) < 1.96 * curve.std + 0.02 * np.std(left))
    return float(np.sqrt(np.mean(difference**2) / np.mean(left**2))), float(inside)


@pytest.fixture(scope="module")
def learned_friction() -> Unknown:
    return learned_from(lambda x, v: FRICTION[0] * math.tanh(v / FRICTION[1]))


def test_function_of_one_variable_is_recovered(learned_friction: Unknown):
    assert is_supported(learned_friction)
    assert learned_friction.chosen.variables == ("v",)
    curve = curve_of(learned_friction)
    assert (curve.place, curve.known.shape[1]) == ("mesh", 1)
    # Powers do not describe so sharp a change.
    assert [type(axis) for axis in learned_friction.chosen.effect.axes] == [SplineAxis]
    error, inside = misfit(curve, FRICTION[0] * np.tanh(curve.at[:, 0] / FRICTION[1]))
    assert error < 0.15
    assert inside > 0.8


def test_learned_term_explains_selection_data_down_to_the_noise(learned_friction: Unknown):
    before, after = (
        np.sqrt(float(t.held_out.covariance[0, 0])) for t in (learned_friction.before, learned_friction.trial)
    )
    assert before > 2 * NOISE
    assert after < 1.2 * NOISE
    assert learned_friction.gain == pytest.approx(np.log(before / after), rel=1e-3)


def test_learned_friction_is_closest_to_the_sign_of_the_rate(learned_friction: Unknown):
    found = shapes(curve_of(learned_friction))
    best = found.closest[0]
    assert best.expression.split(" ", 1)[1] == "sgn(v)"
    assert best.families == ("coulomb_friction",)
    assert best.explained > 0.95
    assert [s.explained for s in found.closest] == sorted((s.explained for s in found.closest), reverse=True)


@pytest.mark.slow
def test_jump_of_friction_is_distinguished_from_a_slope():
    """Along a motion without friction, both explain the same; the second screening and its refits separate them."""
    level, corner = 10.0, 0.01
    found = learned_from(lambda x, v: level * math.tanh(v / corner))
    assert is_supported(found) and found.chosen.variables == ("v",)
    (axis,) = found.chosen.effect.axes
    assert isinstance(axis, SignAxis) and len(found.chosen.effect.c) <= 4
    assert np.sqrt(float(found.trial.held_out.covariance[0, 0])) < 1.2 * NOISE
    curve = curve_of(found)
    error, inside = misfit(curve, level * np.tanh(curve.at[:, 0] / corner))
    # The jump is determined to a few percent, as with the true form.
    assert error < 0.15 and inside > 0.8
    (best, *_) = shapes(curve).closest
    assert best.families == ("coulomb_friction",) and best.explained > 0.99


@pytest.mark.slow
def test_learned_powers_extrapolate_beyond_the_data():
    """A quadratic spring, and a log of 1.5 times the forcing."""

    def quadratic_spring(x: float, v: float) -> float:
        return 0.2 * rig.OMEGA_0**2 * x**2

    found = learned_from(quadratic_spring)
    assert is_supported(found) and found.chosen.variables == ("x",)
    assert [type(axis) for axis in found.chosen.effect.axes] == [PowerAxis]
    forcing = 1.5 * rig.reduced_forcing(COUNT, seed=1)
    motion = motion_with_missing_torque(forcing, quadratic_spring)
    assert np.ptp(motion) > 1.3 * np.ptp(found.motion.x)
    experiment = experiment_from_log(rig.reduced_log(motion, forcing, noise=NOISE, seed=1), hold="zero-order")

    def error(trial: Trial) -> float:
        (run,) = free_run(trial.model, [Stretch(experiment, 0, COUNT)], covariance=trial.training.covariance, halo=4)
        return run.rmse

    assert error(found.before) > 5 * NOISE
    assert error(found.trial) < 2 * NOISE
    # Most of the error comes from the uncertainty of parameters, also with the true form.
    _, study = base_trial(quadratic_spring)
    true_form = attempt(TRUTH.with_effects(QuadraticStiffness(k2=0.1)), study, "zero-order")
    assert error(found.trial) < 1.1 * error(true_form)


def test_learned_friction_agrees_with_coulomb_friction_only(learned_friction: Unknown):
    right = TRUTH.with_effects(CoulombFriction(T_c=8.0, v_0=FRICTION[1]))
    wrong = TRUTH.with_effects(QuadraticStiffness(k2=1.0))
    assert share_of(right, learned_friction) > 0.95
    assert share_of(wrong, learned_friction) < 0.3
    # An additional torque that is not in the data lowers the share.
    biased = right.with_effects(TorqueBias(bias=1.0))
    assert share_of(biased, learned_friction) < 0.8 * share_of(right, learned_friction)


@pytest.mark.parametrize(
    ("variable", "values"),
    [("time", TIME / TIME[-1] - 0.4), pytest.param("temperature", (TEMPERATURE - 300) / 4, marks=pytest.mark.slow)],
)
def test_drift_is_learned_as_a_function_of_time_or_temperature(variable: str, values: np.ndarray):
    drift = 10 * NOISE * rig.OMEGA_0**2 * values
    found = learned_from(lambda x, v: 0.0, drift=drift)
    assert is_supported(found)
    assert found.chosen.variables == (variable,)
    before, after = (np.sqrt(float(t.held_out.covariance[0, 0])) for t in (found.before, found.trial))
    # The held-out stretch is the last one, so that a drift in time is extrapolated.
    assert before > 2 * NOISE
    assert after < 1.2 * NOISE
    best = shapes(curve_of(found)).closest[0]
    # A straight line about the mean, where the drift need not be zero.
    assert variable in best.expression and best.explained > 0.9


def test_periodic_torque_in_time_is_learned_with_its_frequency():
    omega, size = 0.71 * rig.OMEGA_0, 3 * NOISE * rig.OMEGA_0**2
    found = learned_from(lambda x, v: 0.0, drift=size * np.sin(omega * TIME))
    assert is_supported(found) and found.chosen.variables == ("time",)
    before, after = (np.sqrt(float(t.held_out.covariance[0, 0])) for t in (found.before, found.trial))
    assert before > 2 * NOISE and after < 1.1 * NOISE
    estimates = uncertainty(found.trial.training).estimates["learned_mesh_torque.omega"]
    assert abs(estimates.value - omega) < 4 * estimates.std < 1e-2 * omega
    curve = curve_of(found)
    assert curve.period == pytest.approx(2 * np.pi / omega, rel=1e-2)
    # A torque that is held between samples is half a sample late.
    error, inside = misfit(curve, size * np.sin(omega * (curve.at[:, 0] - 0.5 * STEP)))
    assert error < 0.03 and inside > 0.8
    best = shapes(curve).closest[0]
    assert best.expression.count("time)") == 2 and best.explained > 0.95


@pytest.mark.slow
def test_mesh_error_is_distinguished_from_a_torque():
    amplitude = 3e-4
    experiment = rig.drive_experiment(COUNT, kinematic=(amplitude, 0.0))
    data = {"zero-order": split([experiment])}
    study = Study(data, SETTING)
    trial = attempt(rig.drive_model(), study, "zero-order")
    found = learn(trial, study)
    assert found is not None and is_supported(found)
    assert found.chosen.form is LearnedMeshError and found.chosen.variables == ("theta_m",)
    assert found.trial.held_out.principal_std < 0.1 * trial.held_out.principal_std
    curve = curve_of(found)
    assert (curve.place, curve.quantity) == ("mesh angle", "error")
    error, inside = misfit(curve, amplitude * np.cos(2 * curve.at[:, 0]))
    assert error < 0.05 and inside > 0.8
    best = shapes(curve).closest[0]
    assert best.families == ("kinematic_error",) and "cos(2 theta_m)" in best.expression
    drawn = learned_plot(curve, unit="rad", units={"theta_m": "rad"})
    assert drawn.title == "The learned error of the mesh's angle"
    # The true effect explains the term, another one does not.
    right = rig.drive_model().with_effects(KinematicError(cos_2=amplitude))
    wrong = rig.drive_model().with_effects(CoulombFriction(T_c=2.0, v_0=0.01))
    assert share_of(right, found) > 0.95
    assert share_of(wrong, found) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "name", "angle", "motor_amplitude", "load_amplitude"),
    [
        (LearnedMotorReading, "motor encoder", "theta_m", 6e-3, 0.0),
        (LearnedLoadReading, "load encoder", "theta_l", 0.0, 2e-4),
    ],
)
def test_encoder_error_is_distinguished_from_a_torque_and_a_mesh_error(
    form: type, name: str, angle: str, motor_amplitude: float, load_amplitude: float
):
    """An error of third order, which no form of the catalogue has and no resonance amplifies."""
    states, torque = rig.drive_motion(rig.drive_torque(COUNT)), rig.drive_torque(COUNT)
    read = states.copy()
    read[:, 0] += motor_amplitude * np.cos(3 * states[:, 0])
    read[:, 1] += load_amplitude * np.cos(3 * states[:, 1])
    log = rig.drive_log(read, torque, noise=1.0, seed=0)
    data = {"zero-order": split([experiment_from_log(log, hold="zero-order", N=rig.N)])}
    study = Study(data, SETTING)
    trial = attempt(rig.drive_model(), study, "zero-order")
    found = learn(trial, study)
    assert found is not None and is_supported(found)
    assert (found.chosen.form, found.chosen.variables) == (form, (angle,))
    noise = np.log(rig.MOTOR_NOISE / rig.N) + np.log(rig.LOAD_NOISE)
    before, after = (t.held_out.objective for t in (trial, found.trial))
    # A few powers of the load angle approximate the cosine over the small arc, but not to the noise.
    assert before > noise + 2.0 and after < noise + (0.1 if form is LearnedMotorReading else 1.0)
    curve = curve_of(found)
    assert (curve.place, curve.quantity) == (name, "error")
    error, _ = misfit(curve, (motor_amplitude + load_amplitude) * np.cos(3 * curve.at[:, 0]))
    assert error < 0.1
    alike = [shape for shape in shapes(curve).closest if f"cos(3 {angle})" in shape.expression]
    # Over a load arc of 0.4 rad, an order is also similar to a power.
    assert alike and alike[0].families == ("encoder_eccentricity",) and alike[0].explained > 0.95
    # The true effect explains the term, two others do not.
    right = {
        "motor encoder": MotorEncoderEccentricity(cosine=motor_amplitude, n=3.0),
        "load encoder": LoadEncoderEccentricity(cosine=load_amplitude, n=3.0),
    }[name]
    assert share_of(rig.drive_model().with_effects(right), found) > 0.95
    for wrong in (KinematicError(cos_2=1e-4), CoulombFriction(T_c=2.0, v_0=0.01)):
        assert share_of(rig.drive_model().with_effects(wrong), found) < 0.3


@pytest.mark.slow
def test_amplifier_saturation_is_learned_as_a_function_of_motor_torque():
    torque = rig.drive_torque(COUNT)
    missing = torque / np.sqrt(1.0 + (0.5 * torque) ** 2) - torque
    log = rig.drive_log(rig.drive_motion(torque + missing), torque)
    data = {"zero-order": split([experiment_from_log(log, hold="zero-order", N=rig.N)])}
    study = Study(data, SETTING)
    trial = attempt(rig.drive_model(), study, "zero-order")
    found = learn(trial, study)
    assert found is not None and is_supported(found)
    assert (found.chosen.form, found.chosen.variables) == (LearnedMotorTorque, ("T_m",))
    before, after = (t.held_out.objective for t in (trial, found.trial))
    noise = np.log(rig.MOTOR_NOISE / rig.N) + np.log(rig.LOAD_NOISE)
    # A few powers approximate it to an eighth of the noise in each output.
    assert before > noise + 5.0 and after < noise + 0.5
    curve = curve_of(found)
    error, inside = misfit(curve, curve.at[:, 0] / np.sqrt(1.0 + (0.5 * curve.at[:, 0]) ** 2) - curve.at[:, 0])
    assert error < 0.05 and inside > 0.8
    # A gain error explains part of the saturation, as a line does of a cubic, but not all of it.
    gain = rig.drive_model().with_effects(TorqueGain(gain_error=-0.1))
    wrong = rig.drive_model().with_effects(CoulombFriction(T_c=2.0, v_0=0.01))
    assert 0.5 < share_of(gain, found) < 0.75
    assert share_of(wrong, found) < 0.3


@pytest.mark.slow
def test_function_of_two_variables_is_recovered():
    strength = 3e3

    def torque(x, v):
        return strength * x * x * v

    found = learned_from(torque)
    assert is_supported(found)
    assert found.chosen.variables == ("x", "v")
    # Damping that depends on the twist.
    assert [type(axis) for axis in found.chosen.effect.axes] == [SplineAxis, LinearAxis]
    before, after = (np.sqrt(float(t.held_out.covariance[0, 0])) for t in (found.before, found.trial))
    assert before > 10 * NOISE
    assert after < 1.3 * NOISE
    curve = curve_of(found)
    # Along an oscillation, functions of twist and of rate are correlated, so that their sum is better determined than
    # the surface.
    error, _ = misfit(curve, torque(curve.at[:, 0], curve.at[:, 1]))
    assert error < 0.5
    best = shapes(curve).closest[0]
    assert best.expression.split(" ", 1)[1] == "x^2 v"
    assert best.families == ("nonlinear_damping",)


@pytest.mark.slow
def test_no_learned_term_is_supported_by_noise():
    for seed in range(3):
        assert not is_supported(learn(*base_trial(lambda x, v: 0.0, seed)))
