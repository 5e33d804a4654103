"""A learned torque finds what was hidden: the right place and variables, the function itself within its band."""

import json
import math
from dataclasses import replace
from pathlib import Path

import equinox as eqx
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
from fitting.loop import close_loop
from fitting.outcome import Loop
from fitting.report import Report, report_dict
from fitting.report.plots import learned_plot
from fitting.search_options import SearchOptions
from fitting.stored_model import read_model
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Model
from hdjax.effects.actuation import TorqueBias, TorqueGain
from hdjax.effects.damping import QuadraticDamping
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
WARMTH = 300.0 + 4.0 * np.sin(4.0 * np.pi * TIME / TIME[-1])


def hidden_motion(forcing: np.ndarray, torque) -> np.ndarray:
    """Twist of the reduced rig with a torque of twist and rate that no model knows of."""

    def rates(y, u):
        x, v = y
        spring = rig.OMEGA_0**2 * (x + rig.REDUCED_ALPHA * x**3)
        return v, rig.GAIN * u - rig.MU * v - spring - torque(x, v)

    return rig.rk4(rates, (0.0, 0.0), forcing, STEP, 10)[:, 0]


def base_trial(torque, seed: int = 0, *, drift: np.ndarray | None = None) -> tuple[Trial, Study]:
    """The base model's fit of a motion with a hidden torque, from the truth of everything else."""
    forcing = rig.reduced_forcing(COUNT, seed=seed)
    felt = forcing if drift is None else forcing - drift / rig.GAIN
    log = rig.reduced_log(hidden_motion(felt, torque), forcing, noise=NOISE, seed=seed)
    log = replace(log, temperature=WARMTH)
    study = Study({"zero-order": split([experiment_from_log(log, hold="zero-order")])}, SETTING, seed)
    return attempt(TRUTH, study, "zero-order"), study


def found_of(torque, **drifting) -> Unknown:
    found = learn(*base_trial(torque, **drifting))
    assert found is not None
    return found


def curve_of(found: Unknown) -> LearnedCurve:
    return learned_curve(found, found.trial.model, uncertainty(found.trial.training))


def misfit(curve: LearnedCurve, wanted: np.ndarray) -> tuple[float, float]:
    """Rms difference from the truth, both without what the drive's own parameters can do, over the truth's rms; and
    the share of the data at which the truth is inside the 95 % band."""
    left = wanted - curve.known @ np.linalg.lstsq(curve.known, wanted, rcond=None)[0]
    difference = curve.value - left
    inside = np.mean(np.abs(difference) < 1.96 * curve.std + 0.02 * np.std(left))
    return float(np.sqrt(np.mean(difference**2) / np.mean(left**2))), float(inside)


@pytest.fixture(scope="module")
def rubbing() -> Unknown:
    return found_of(lambda x, v: FRICTION[0] * math.tanh(v / FRICTION[1]))


def test_a_function_of_one_variable_is_recovered(rubbing: Unknown):
    assert is_supported(rubbing)
    assert rubbing.chosen.variables == ("v",)
    curve = curve_of(rubbing)
    assert (curve.place, curve.known.shape[1]) == ("mesh", 1)
    # No powers turn so sharply.
    assert [type(axis) for axis in rubbing.chosen.effect.axes] == [SplineAxis]
    error, inside = misfit(curve, FRICTION[0] * np.tanh(curve.at[:, 0] / FRICTION[1]))
    assert error < 0.15
    assert inside > 0.8


def test_unseen_data_are_explained_down_to_the_noise(rubbing: Unknown):
    before, after = (np.sqrt(float(t.held_out.covariance[0, 0])) for t in (rubbing.before, rubbing.trial))
    assert before > 2 * NOISE
    assert after < 1.2 * NOISE
    assert rubbing.gain == pytest.approx(np.log(before / after), rel=1e-3)


def test_the_shape_is_named(rubbing: Unknown):
    found = shapes(curve_of(rubbing))
    best = found.closest[0]
    assert best.expression.split(" ", 1)[1] == "sgn(v)"
    assert best.families == ("coulomb_friction",)
    assert best.explained > 0.95
    assert [s.explained for s in found.closest] == sorted((s.explained for s in found.closest), reverse=True)


@pytest.mark.slow
def test_a_jump_is_told_from_a_slope():
    """Along a motion without friction both explain as much; the second look and its refits tell them apart."""
    level, corner = 10.0, 0.01
    found = found_of(lambda x, v: level * math.tanh(v / corner))
    assert is_supported(found) and found.chosen.variables == ("v",)
    (axis,) = found.chosen.effect.axes
    assert isinstance(axis, SignAxis) and len(found.chosen.effect.c) <= 4
    assert np.sqrt(float(found.trial.held_out.covariance[0, 0])) < 1.2 * NOISE
    curve = curve_of(found)
    error, inside = misfit(curve, level * np.tanh(curve.at[:, 0] / corner))
    # The jump is known to a few percent, as it is where the form is known.
    assert error < 0.15 and inside > 0.8
    (best, *_) = shapes(curve).closest
    assert best.families == ("coulomb_friction",) and best.explained > 0.99


@pytest.mark.slow
def test_powers_go_on_beyond_the_data():
    """A lopsided spring, and a log that twists it half as far again."""

    def lopsided(x: float, v: float) -> float:
        return 0.2 * rig.OMEGA_0**2 * x**2

    found = found_of(lopsided)
    assert is_supported(found) and found.chosen.variables == ("x",)
    assert [type(axis) for axis in found.chosen.effect.axes] == [PowerAxis]
    forcing = 1.5 * rig.reduced_forcing(COUNT, seed=1)
    motion = hidden_motion(forcing, lopsided)
    assert np.ptp(motion) > 1.3 * np.ptp(found.motion.x)
    experiment = experiment_from_log(rig.reduced_log(motion, forcing, noise=NOISE, seed=1), hold="zero-order")

    def error(trial: Trial) -> float:
        (run,) = free_run(trial.model, [Stretch(experiment, 0, COUNT)], covariance=trial.training.covariance, halo=4)
        return run.rmse

    assert error(found.before) > 5 * NOISE
    assert error(found.trial) < 2 * NOISE
    # Most of what is left is how well any fit knows its parameters.
    _, study = base_trial(lopsided)
    true_form = attempt(TRUTH.with_effects(QuadraticStiffness(k2=0.1)), study, "zero-order")
    assert error(found.trial) < 1.1 * error(true_form)


def test_a_learned_torque_knows_the_effect_that_it_has_come_out_as(rubbing: Unknown):
    right = TRUTH.with_effects(CoulombFriction(T_c=8.0, v_0=FRICTION[1]))
    wrong = TRUTH.with_effects(QuadraticStiffness(k2=1.0))
    assert share_of(right, rubbing) > 0.95
    assert share_of(wrong, rubbing) < 0.3
    # An error of the torque counts: here one that is not in the data.
    biased = right.with_effects(TorqueBias(bias=1.0))
    assert share_of(biased, rubbing) < 0.8 * share_of(right, rubbing)


@pytest.mark.parametrize(
    ("variable", "values"),
    [("time", TIME / TIME[-1] - 0.4), pytest.param("temperature", (WARMTH - 300) / 4, marks=pytest.mark.slow)],
)
def test_what_drifts_is_told_from_what_moves(variable: str, values: np.ndarray):
    drift = 10 * NOISE * rig.OMEGA_0**2 * values
    found = found_of(lambda x, v: 0.0, drift=drift)
    assert is_supported(found)
    assert found.chosen.variables == (variable,)
    before, after = (np.sqrt(float(t.held_out.covariance[0, 0])) for t in (found.before, found.trial))
    # The held-out stretch is the last one, so that a drift in time is extrapolated.
    assert before > 2 * NOISE
    assert after < 1.2 * NOISE
    best = shapes(curve_of(found)).closest[0]
    # A straight line about the mean, which need not be where the drift is zero.
    assert variable in best.expression and best.explained > 0.9


def test_what_comes_back_in_time_is_learned_with_its_frequency():
    omega, size = 0.71 * rig.OMEGA_0, 3 * NOISE * rig.OMEGA_0**2
    found = found_of(lambda x, v: 0.0, drift=size * np.sin(omega * TIME))
    assert is_supported(found) and found.chosen.variables == ("time",)
    before, after = (np.sqrt(float(t.held_out.covariance[0, 0])) for t in (found.before, found.trial))
    assert before > 2 * NOISE and after < 1.1 * NOISE
    estimates = uncertainty(found.trial.training).estimates["learned_mesh_torque.omega"]
    assert abs(estimates.value - omega) < 4 * estimates.std < 1e-2 * omega
    curve = curve_of(found)
    assert curve.period == pytest.approx(2 * np.pi / omega, rel=1e-2)
    # A torque that is held between samples comes half a sample late.
    error, inside = misfit(curve, size * np.sin(omega * (curve.at[:, 0] - 0.5 * STEP)))
    assert error < 0.03 and inside > 0.8
    best = shapes(curve).closest[0]
    assert best.expression.count("time)") == 2 and best.explained > 0.95


@pytest.mark.slow
def test_an_error_of_the_mesh_is_told_from_a_torque():
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
    # The effect that it is, and one that it is not.
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
def test_an_error_of_an_encoder_is_told_from_what_moves_the_drive(
    form: type, name: str, angle: str, motor_amplitude: float, load_amplitude: float
):
    """The third order, which no form of the catalogue has, and which is not amplified at resonance."""
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
    assert found.chosen.of == (form, (angle,))
    noise = np.log(rig.MOTOR_NOISE / rig.N) + np.log(rig.LOAD_NOISE)
    before, after = (t.held_out.objective for t in (trial, found.trial))
    # A few powers of the load's angle come near the cosine over so small an arc, and no nearer.
    assert before > noise + 2.0 and after < noise + (0.1 if form is LearnedMotorReading else 1.0)
    curve = curve_of(found)
    assert (curve.place, curve.quantity) == (name, "error")
    error, _ = misfit(curve, (motor_amplitude + load_amplitude) * np.cos(3 * curve.at[:, 0]))
    assert error < 0.1
    alike = [shape for shape in shapes(curve).closest if f"cos(3 {angle})" in shape.expression]
    # Over an arc of 0.4 rad of the load an order is a power as well.
    assert alike and alike[0].families == ("encoder_eccentricity",) and alike[0].explained > 0.95
    # The effect that it is, and two that it is not.
    right = {
        "motor encoder": MotorEncoderEccentricity(cosine=motor_amplitude, n=3.0),
        "load encoder": LoadEncoderEccentricity(cosine=load_amplitude, n=3.0),
    }[name]
    assert share_of(rig.drive_model().with_effects(right), found) > 0.95
    for wrong in (KinematicError(cos_2=1e-4), CoulombFriction(T_c=2.0, v_0=0.01)):
        assert share_of(rig.drive_model().with_effects(wrong), found) < 0.3


@pytest.mark.slow
def test_an_amplifier_that_saturates_is_a_function_of_its_torque():
    torque = rig.drive_torque(COUNT)
    missing = torque / np.sqrt(1.0 + (0.5 * torque) ** 2) - torque
    log = rig.drive_log(rig.drive_motion(torque + missing), torque)
    data = {"zero-order": split([experiment_from_log(log, hold="zero-order", N=rig.N)])}
    study = Study(data, SETTING)
    trial = attempt(rig.drive_model(), study, "zero-order")
    found = learn(trial, study)
    assert found is not None and is_supported(found)
    assert found.chosen.of == (LearnedMotorTorque, ("T_m",))
    before, after = (t.held_out.objective for t in (trial, found.trial))
    noise = np.log(rig.MOTOR_NOISE / rig.N) + np.log(rig.LOAD_NOISE)
    # A few powers come near it, to an eighth of the noise in each output.
    assert before > noise + 5.0 and after < noise + 0.5
    curve = curve_of(found)
    error, inside = misfit(curve, curve.at[:, 0] / np.sqrt(1.0 + (0.5 * curve.at[:, 0]) ** 2) - curve.at[:, 0])
    assert error < 0.05 and inside > 0.8
    # A torque sensor's gain is a part of it, as the torque is of its cube; it has not come out as that.
    gain = rig.drive_model().with_effects(TorqueGain(gain_error=-0.1))
    wrong = rig.drive_model().with_effects(CoulombFriction(T_c=2.0, v_0=0.01))
    assert 0.5 < share_of(gain, found) < 0.75
    assert share_of(wrong, found) < 0.3


@pytest.mark.slow
def test_a_function_of_two_variables_is_found():
    strength = 3e3

    def torque(x, v):
        return strength * x * x * v

    found = found_of(torque)
    assert is_supported(found)
    assert found.chosen.variables == ("x", "v")
    # Damping that depends on the twist.
    assert [type(axis) for axis in found.chosen.effect.axes] == [SplineAxis, LinearAxis]
    before, after = (np.sqrt(float(t.held_out.covariance[0, 0])) for t in (found.before, found.trial))
    assert before > 10 * NOISE
    assert after < 1.3 * NOISE
    curve = curve_of(found)
    # Along an oscillation functions of twist and rate trade off against each other, so that the sum is known better
    # than the surface.
    error, _ = misfit(curve, torque(curve.at[:, 0], curve.at[:, 1]))
    assert error < 0.5
    best = shapes(curve).closest[0]
    assert best.expression.split(" ", 1)[1] == "x^2 v"
    assert best.families == ("nonlinear_damping",)


@pytest.mark.slow
def test_nothing_is_learned_from_noise():
    for seed in range(3):
        assert not is_supported(learn(*base_trial(lambda x, v: 0.0, seed)))


@pytest.fixture(scope="module")
def loop() -> Loop:
    """A loop whose catalogue lacks the family of what is hidden."""
    experiment = rig.reduced_experiment(COUNT, noise=NOISE, friction=FRICTION)
    catalogue = (QuadraticStiffness, QuadraticDamping)
    placeholder: Model = rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0)
    options = {"catalogue": catalogue, "search": SearchOptions(1)}
    return close_loop(placeholder, {"zero-order": (experiment,)}, hold="zero-order", **options)


def test_what_the_catalogue_lacks_is_unexplained(loop: Loop):
    assert loop.decision == "unexplained"
    assert [f.family for f in loop.findings] == ["unknown"]
    assert loop.unknown is not None and "v" in loop.unknown.chosen.variables
    assert loop.after.rmse["selection"] < 2 * NOISE < loop.before.rmse["selection"]
    assert loop.findings[0].p_value <= 0.01
    assert float(loop.after.model.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=1e-3)


def test_the_report_tells_it(loop: Loop, tmp_path: Path):
    units = {"dynamic_error": "V", "forcing": "<b>V</b>"}
    paths = Report.of(loop, units=units).write(tmp_path)
    report = json.loads(paths["report.json"].read_text())
    told = report["unknown"]
    assert told["family"] == "unknown" and told["place"] == "mesh" and "v" in told["variables"]
    assert told["rmse"]["before"] > 2 * told["rmse"]["after"]
    assert told["shapes"][0]["r_squared"] <= 1.0
    assert [e["family"] for e in report["after"]["effects"]] == ["unknown"]
    assert "does not explain" in report["summary"] and "twist rate" in report["summary"]
    page = paths["report.html"].read_text()
    assert "What the learned torque looks like" in page and 'id="learned-torque"' in page
    assert "<b>V</b>" not in page
    # What was written predicts what the loop predicted.
    read = read_model(paths["model.json"])
    options = {"covariance": loop.noise, "halo": loop.setting.halo, "substeps": loop.after_substeps}
    (run,) = free_run(read.model, loop.stretches[1], **options)
    assert run.rmse == pytest.approx(loop.after.rmse["selection"], rel=0.05)


@pytest.mark.slow
def test_a_name_that_is_right_stands_beside_what_has_none(tmp_path: Path):
    """Friction and a lopsided spring; the catalogue knows friction alone. A function of the rate in its place, free to
    be anything, explains no more than friction does, and a function of the twist beside it all of the rest."""
    experiment = rig.reduced_experiment(COUNT, noise=NOISE, friction=(25.0, 0.3), quadratic=0.15)
    placeholder: Model = rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0)
    options = {"catalogue": (CoulombFriction,), "search": SearchOptions(1)}
    loop = close_loop(placeholder, {"zero-order": (experiment,)}, hold="zero-order", **options)
    assert loop.decision == "effect_found" and not loop.doubted
    assert [f.name for f in loop.findings] == ["coulomb_friction", "learned_mesh_torque"]
    assert loop.unknown is not None and loop.unknown.chosen.variables == ("x",)
    assert float(loop.after.model.get("coulomb_friction.T_c")) == pytest.approx(25.0, rel=0.05)
    assert loop.after.rmse["selection"] < 1.2 * NOISE
    # Of the gains the second begins where the first ends.
    left = loop.before.rmse["selection"] * np.prod([1.0 - f.gain for f in loop.findings])
    assert left == pytest.approx(loop.after.rmse["selection"], rel=1e-6)
    units = {"dynamic_error": "V", "forcing": "V"}
    paths = Report.of(loop, units=units).write(tmp_path)
    report = json.loads(paths["report.json"].read_text())
    assert "friction" in report["summary"] and "Something unknown is also missing" in report["summary"]
    assert report["unexplained"] is None and report["unknown"]["variables"] == ["x"]
    assert "What the learned torque looks like" in paths["report.html"].read_text()
    assert eqx.tree_equal(read_model(paths["model.json"]).model, loop.after.model, rtol=1e-12)


def test_a_report_without_one_says_so(loop: Loop):
    assert report_dict(Loop(**(vars(loop) | {"unknown": None, "findings": ()})))["unknown"] is None
