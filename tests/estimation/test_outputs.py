"""Starting values, initial states, fits and reports of logs with any subset of the outputs."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import joints
from fitting.estimation.base_fit import base_fit, is_held
from fitting.estimation.beside_friction import fits_of_starts
from fitting.estimation.driven_load import friction_from_motor, starts_from_motor, through_load, twist
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.linear_drive import over_a_step, readings
from fitting.estimation.linear_response import readout
from fitting.estimation.observed_states import observed_states
from fitting.estimation.problem import Segmentation
from fitting.estimation.starting_values import starting_models
from fitting.estimation.weighing import Shown
from fitting.fit_drive import fit_only
from fitting.report.content import report_dict
from fitting.report.plots.gallery import fit_plots
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, TwoInertiaModel
from hdjax.drive import Prior
from hdjax.dynamics import OUTPUTS
from hdjax.effects import ThermalStiffness

JOINT = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, rms=0.05)
COUNT = 2500
SUBSETS = [
    ("motor_angle",),
    ("motor_velocity",),
    ("motor_angle", "joint_torque"),
    ("motor_velocity", "joint_torque"),
    ("motor_velocity", "load_velocity"),
    ("motor_angle", "load_velocity"),
]


def stretches_of(joint: joints.Joint, sensors: Sequence[str], *, noise: float = 1e-3) -> tuple[Stretch, ...]:
    log = joints.log_of_sensors(joint, sensors, count=COUNT, noise=noise)
    return whole([experiment_from_log(log, hold="zero-order", N=joint.N)])


def model_of(stretches: Sequence[Stretch], *, free: bool = False, K: float = 1.0) -> TwoInertiaModel:
    """Model of the joint with known or entirely free inertias."""
    priors = (Prior("J_m", 1.0, np.inf), Prior("J_l", 1.0, np.inf)) if free else ()
    own = {"J_m": 1.0, "J_l": 1.0} if free else {"J_m": JOINT.J_m, "J_l": JOINT.J_l}
    return TwoInertiaModel(Drive(N=JOINT.N, K=K, priors=priors, **own), measured=stretches[0].experiment.outputs)


def true_model(measured: tuple[str, ...]) -> TwoInertiaModel:
    drive = Drive(N=JOINT.N, J_m=JOINT.J_m, J_l=JOINT.J_l, K=JOINT.K, B_sp=JOINT.B_sp)
    return TwoInertiaModel(drive, measured=measured)


@pytest.fixture(scope="module")
def rubbing() -> joints.Joint:
    """The joint with strong friction of the motor."""
    return joints.with_friction(JOINT, 0.5, 0.4)


@pytest.fixture(scope="module")
def motor_of_rubbing(rubbing: joints.Joint) -> tuple[Stretch, ...]:
    """Its motor angle."""
    return stretches_of(rubbing, ("motor_angle",))


@pytest.mark.parametrize(
    ("sensors", "free"),
    [
        *(pytest.param(s, True, id=f"{'+'.join(s)}-free") for s in SUBSETS),
        # Knowing the inertias makes the fit easier.
        *(
            pytest.param(s, False, id=f"{'+'.join(s)}-known", marks=pytest.mark.slow if s != SUBSETS[0] else ())
            for s in SUBSETS
        ),
    ],
)
def test_base_fit_recovers_stiffness_and_inertias_from_any_outputs(sensors: tuple[str, ...], free: bool):
    stretches = stretches_of(JOINT, sensors)
    found = base_fit(model_of(stretches, free=free), stretches).fit
    estimates = uncertainty(found).estimates
    assert not is_held(found) and estimates["K"].std < 1e-3 * JOINT.K
    for path in ("K", "B_sp", *(("J_m", "J_l") if free else ())):
        assert abs(estimates[path].value - getattr(JOINT, path)) < 4.0 * estimates[path].std, (path, estimates[path])


def test_fit_without_twist_is_unbiased_under_motor_friction(motor_of_rubbing: tuple[Stretch, ...]):
    found, told = base_fit(model_of(motor_of_rubbing, free=True), motor_of_rubbing)
    assert is_held(found) and told is not None
    estimates = uncertainty(told).estimates
    for path in ("K", "J_m", "J_l"):
        assert estimates[path].std < 0.005 * getattr(JOINT, path)
        assert abs(float(found.model.get(path)) - getattr(JOINT, path)) < 4.0 * estimates[path].std


def test_starting_values_are_near_the_truth_under_strong_motor_friction(motor_of_rubbing: tuple[Stretch, ...]):
    starts = starting_models(model_of(motor_of_rubbing, free=True), motor_of_rubbing)
    off = [max(abs(float(s.get(p)) / getattr(JOINT, p) - 1.0) for p in ("K", "J_m", "J_l")) for s in starts]
    assert min(off) < 0.2, off


def test_friction_of_the_motor_follows_from_its_momentum(rubbing: joints.Joint, motor_of_rubbing: tuple[Stretch, ...]):
    T_c, b = friction_from_motor(true_model(("motor_angle",)), motor_of_rubbing)
    assert T_c == pytest.approx(rubbing.coulomb, rel=0.05) and b == pytest.approx(rubbing.viscous, rel=0.05)


def test_one_wrong_start_does_not_decide_the_length_of_simulations(motor_of_rubbing: tuple[Stretch, ...]):
    near = true_model(("motor_angle",)).replace({"K": 1.05 * JOINT.K})
    wrong = near.replace({"K": 15.0 * JOINT.K})
    _, beside, _ = fits_of_starts((near, near, wrong), motor_of_rubbing, 0)
    assert float(beside.model.get("K")) == pytest.approx(JOINT.K, rel=0.02)


@given(st.floats(1.0, 30.0), st.floats(0.01, 3.0))
@settings(max_examples=20, deadline=None)
def test_load_response_to_a_sinusoid_equals_its_transfer_function(omega: float, damping: float):
    step, c_K, s = 1e-3, 100.0, 1j * omega
    time = step * np.arange(40_000)
    found = through_load(np.sin(omega * time), c_K, damping + 0.5, step)[-5000:]
    gain = (c_K + (damping + 0.5) * s) / (s**2 + (damping + 0.5) * s + c_K)
    expected = np.imag(gain * np.exp(s * time[-5000:]))
    # Error of straight lines between samples, and the remaining transient.
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(gain) + 1e-3)


def test_output_matrix_of_the_linear_drive_equals_that_of_the_model():
    model = true_model(tuple(OUTPUTS))
    np.testing.assert_allclose(readings(model), readout(model, model.rest()), rtol=1e-12)


@pytest.mark.parametrize("sensors", [*SUBSETS, ("load_angle",)], ids="+".join)
def test_observed_initial_states_equal_the_true_motion(sensors: tuple[str, ...]):
    (stretch,) = stretches_of(JOINT, sensors, noise=0.0)
    segments = Segmentation(256).of([stretch])
    found = observed_states(true_model(sensors), segments)
    motion = joints.motion_of(JOINT, joints.torque_of(JOINT, count=COUNT))[::256]
    x, v = (states[:, i] / JOINT.N - states[:, i + 1] for states in (motion,) for i in (0, 2))
    assert np.max(np.abs(found[: len(x), 0] / JOINT.N - found[: len(x), 1] - x)) < 1e-3 * np.max(np.abs(x))
    assert np.max(np.abs(found[: len(x), 2] / JOINT.N - found[: len(x), 3] - v)) < 1e-3 * np.max(np.abs(v))


def test_observed_initial_states_of_logs_with_different_sample_rates_are_those_of_each():
    sensors = ("motor_velocity", "load_velocity")
    (fast,) = stretches_of(JOINT, sensors, noise=0.0)
    experiment, segmentation, model = fast.experiment, Segmentation(128), true_model(sensors)
    # The same samples read as those of a log that took three times as long.
    slow = dataclasses.replace(
        fast,
        experiment=dataclasses.replace(
            experiment,
            time=3.0 * experiment.time,
            torque=dataclasses.replace(experiment.torque, knots=3.0 * experiment.torque.knots),
        ),
    )
    alone = [observed_states(model, segmentation.of([s])) for s in (fast, slow)]
    together = observed_states(model, segmentation.of([fast, slow]))
    whole_ones = COUNT // 128
    for found, own in zip((together[:whole_ones], together[-(-COUNT // 128) :][:whole_ones]), alone, strict=True):
        np.testing.assert_allclose(found, own[:whole_ones], rtol=0.05, atol=1e-3 * np.abs(own).max())


def test_starting_values_of_both_velocities_hold_where_the_load_is_pushed():
    """The load's answer to a torque of its own is not that to the motor's motion."""
    step, drive = joints.STEP, true_model(("motor_angle",)).drive
    pushed = 20.0 * JOINT.N * joints.torque_of(JOINT, count=COUNT, seed=3)
    torque = joints.torque_of(JOINT, count=COUNT)
    across, pushes = over_a_step(drive, step)
    states = np.zeros((COUNT, 4))
    for i in range(COUNT - 1):
        states[i + 1] = across @ states[i] + pushes[:, 0] * torque[i] + pushes[:, 2] * pushed[i]
    log = joints.log_of_sensors(JOINT, ("motor_velocity", "load_velocity"), count=COUNT)
    log = dataclasses.replace(log, motor_velocity=states[:, 2], load_velocity=states[:, 3], load_torque=pushed)
    stretches = whole([experiment_from_log(log, hold="zero-order", N=JOINT.N)])
    starts = starts_from_motor(model_of(stretches), stretches)
    assert starts and all(start["K"] == pytest.approx(JOINT.K, rel=0.1) for start in starts)


@pytest.mark.parametrize("sensors", SUBSETS, ids="+".join)
def test_twist_estimated_without_load_angle_has_the_true_size(sensors: tuple[str, ...]):
    (stretch,) = stretches_of(JOINT, sensors)
    motion = joints.motion_of(JOINT, joints.torque_of(JOINT, count=COUNT))
    x = motion[:, 0] / JOINT.N - motion[:, 1]
    assert np.std(twist(stretch, true_model(sensors))) == pytest.approx(np.std(x), rel=0.05)


def test_report_states_each_output_in_its_unit():
    stretches = stretches_of(JOINT, ("motor_angle", "joint_torque"))
    experiments = {"zero-order": tuple(s.experiment for s in stretches)}
    report = report_dict(fit_only(model_of(stretches), experiments, hold="zero-order"))
    assert report["output"] == "joint_torque" and report["units"]["joint_torque"] == "N m"
    assert set(report["before"]["rmse_of_outputs"]) == {"joint_torque", "motor_angle"}
    for output, values in report["before"]["rmse_of_outputs"].items():
        assert values["training"] == pytest.approx(report["noise"][output], rel=0.1)
        assert report["goodness"]["error_over_noise"][output.replace("_", " ")] == pytest.approx(1.0, rel=0.1)
    assert report["before"]["rmse"]["training"] == report["before"]["rmse_of_outputs"]["joint_torque"]["training"]
    assert "joint torque" in report["frequency_response"]["says"][0]


def test_report_of_a_motor_only_log_states_the_antiresonance():
    stretches = stretches_of(JOINT, ("motor_angle",))
    found = fit_only(model_of(stretches), {"zero-order": (stretches[0].experiment,)}, hold="zero-order")
    response = report_dict(found)["frequency_response"]
    assert response["antiresonance"] == pytest.approx(np.sqrt(JOINT.K / JOINT.J_l) / (2 * np.pi), rel=1e-3)
    assert any("antiresonance" in sentence for sentence in response["says"])
    (picture,) = (plot for plot in fit_plots(found, units={}) if plot.key == "frequency-response")
    assert "antiresonance" in str(picture.figure["layout"]["annotations"])


def test_joint_torque_output_equals_the_mesh_torque():
    model = true_model(("joint_torque",))
    state = jnp.array([1.0, 0.018, 5.0, 0.03])
    assert float(model.outputs(state)[0]) == pytest.approx(JOINT.K * 0.002 + JOINT.B_sp * 0.07, rel=1e-12)


def test_joint_torque_is_weighed_beside_an_effect_of_temperature():
    """At rest, where no temperature is known."""
    measured = ("motor_angle", "joint_torque")
    warm = true_model(measured).with_effects(ThermalStiffness(k_T=-1e-3, T_0=300.0))
    bare, found = Shown.of(true_model(measured), 1.0), Shown.of(warm, 1.0)
    np.testing.assert_array_equal(found.angles, bare.angles)
    np.testing.assert_array_equal(found.rates, bare.rates)
