"""A free run takes its initial state from fifty samples only, and then follows the true motion."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import fitting.estimation.free_run as module
import rig
from fitting.estimation.estimate import fit
from fitting.estimation.experiment import Experiment, Stretch, experiment_from_log
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.free_run import FreeRun, free_run, rms_error
from fitting.estimation.initial_states import WINDOW
from fitting.estimation.problem import Segmentation
from hdjax import Model

COUNT = 600
X_NOISE = np.hypot(rig.MOTOR_NOISE / rig.N, rig.LOAD_NOISE)
MOTOR = (rig.MOTOR_NOISE / rig.N) ** 2
NOISE = jnp.asarray([[MOTOR, MOTOR], [MOTOR, X_NOISE**2]])
MOVING = (20.0, 0.4003, 30.0, 0.7)


def run(experiment: Experiment, model: Model | None = None, start: int = 0) -> FreeRun:
    # Always two stretches, so that all tests share one compiled program.
    stretches = [Stretch(experiment, start, start + n) for n in (COUNT, COUNT // 2)]
    found, half = free_run(model or rig.drive_model(), stretches, covariance=NOISE, substeps=1)
    np.testing.assert_array_equal(half.predicted, found.predicted[: COUNT // 2])
    return found


@pytest.fixture(scope="module")
def moving() -> Experiment:
    return rig.drive_experiment(COUNT + 40, state=MOVING)


def test_free_run_of_the_true_model_follows_the_true_motion(moving: Experiment):
    found = run(moving)
    truth = rig.drive_motion(rig.drive_torque(COUNT + 40), state=MOVING)[:COUNT]
    x = truth[:, 0] / rig.N - truth[:, 1]
    # Two angles and two rates from fifty samples: the error of the start is below that of one sample.
    assert np.sqrt(np.mean((found.predicted - x) ** 2)) < 1.5 * X_NOISE
    assert np.std(x) > 100 * X_NOISE
    assert found.rmse == pytest.approx(np.sqrt(np.mean((found.measured - found.predicted) ** 2)), rel=1e-12)
    assert found.rmse < 2.0 * X_NOISE
    # The free motor drifts with the error of its initial rate.
    assert np.max(np.abs(found.motor_angle - truth[:, 0])) < 0.02
    drift = np.sqrt(np.mean((moving.motor_angle[:COUNT] - found.motor_angle) ** 2))
    assert rms_error((found,), "motor_angle") == pytest.approx(drift, rel=1e-9)
    np.testing.assert_array_equal(found.time, moving.time[:COUNT])


def test_free_run_of_a_wrong_model_has_a_large_error(moving: Experiment):
    assert run(moving, rig.drive_model(K=1.1 * rig.K)).rmse > 30 * X_NOISE


def test_free_run_uses_only_outputs_of_the_initial_state_window(moving: Experiment):
    measured, motor = moving.measured.copy(), moving.motor_angle.copy()
    measured[WINDOW:] = np.nan
    motor[WINDOW:] = np.nan
    blind = run(dataclasses.replace(moving, measured=measured, motor_angle=motor))
    seeing = run(moving)
    np.testing.assert_array_equal(blind.predicted, seeing.predicted)
    np.testing.assert_array_equal(blind.motor_angle, seeing.motor_angle)
    # The outputs of the window do matter.
    measured[WINDOW - 1, 1] += 20 * X_NOISE
    assert np.any(run(dataclasses.replace(moving, measured=measured)).predicted != seeing.predicted)
    assert blind.rmse == np.inf


def test_free_run_by_the_machine_code_of_a_fit_is_the_same(moving: Experiment):
    stretches = [Stretch(moving, 0, COUNT)]
    found = fit(rig.drive_model(), stretches, base_paths(rig.drive_model()), Segmentation(COUNT, substeps=1))
    plain, like = (
        free_run(found.model, stretches, covariance=NOISE, substeps=1, like=given)[0] for given in (None, found)
    )
    # The initial state goes through the fit's scaled parameters, which rounds them.
    np.testing.assert_allclose(like.predicted, plain.predicted, rtol=0, atol=1e-6 * X_NOISE)


def test_free_run_may_start_inside_a_log(moving: Experiment):
    found = run(moving, start=40)
    assert found.rmse < 2.0 * X_NOISE
    np.testing.assert_array_equal(found.measured, moving.measured[40:, 1])


def test_free_run_of_a_drive_at_rest_does_not_drift():
    # At rest for the window and 20 samples more, then the torque starts.
    torque = rig.drive_torque(COUNT)
    torque[: WINDOW + 20] = 0.0
    resting = (1.0, 1.0 / rig.N, 0.0, 0.0)
    motion = rig.drive_motion(torque, state=resting)
    experiment = experiment_from_log(rig.drive_log(motion, torque), hold="zero-order", N=rig.N)
    found = run(experiment)
    # At rest exactly: without torque, and with the twist of a few micro-radians that the noise leaves, nothing turns.
    drift = np.abs(np.diff(found.motor_angle[: WINDOW + 20]))
    assert np.max(drift) < 1e-5
    assert found.rmse < 1.5 * X_NOISE
    assert np.max(np.abs(found.motor_angle - motion[:, 0])) < 5e-4


@pytest.mark.parametrize("state", [MOVING, (1.0, 1.0 / rig.N, 0.0, 0.0)])
def test_zero_of_a_log_is_estimated_with_its_initial_state(state: tuple[float, ...]):
    torque = rig.drive_torque(COUNT)
    motion = rig.drive_motion(torque, state=state)
    log = rig.drive_log(motion, torque)
    zeroed = experiment_from_log(log, hold="zero-order", N=rig.N)
    log = dataclasses.replace(log, load_angle=log.load_angle - 9e-3, dynamic_error=log.dynamic_error + 9e-3)
    shared = experiment_from_log(log, hold="zero-order", N=rig.N)
    own = experiment_from_log(dataclasses.replace(log, has_own_zero=True), hold="zero-order", N=rig.N)
    assert run(shared).rmse > 1e-3
    # The window determines the zero less well than the states alone.
    found = run(own)
    np.testing.assert_allclose(found.predicted, run(zeroed).predicted + 9e-3, rtol=0, atol=5 * X_NOISE)
    assert found.rmse < 2.0 * X_NOISE


def at_rest(noise: float) -> Experiment:
    torque = np.zeros(COUNT)
    motion = rig.drive_motion(torque, state=(1.0, 1.0 / rig.N, 0.0, 0.0))
    return experiment_from_log(rig.drive_log(motion, torque, noise=noise), hold="zero-order", N=rig.N)


def test_initial_rates_are_exactly_zero_only_at_rest(moving: Experiment, monkeypatch: pytest.MonkeyPatch):
    starts = []
    simulate = module.simulate

    def spy(problem, unknowns):
        starts.append(np.asarray(unknowns.states))
        return simulate(problem, unknowns)

    monkeypatch.setattr(module, "simulate", spy)
    run(at_rest(1.0))
    run(moving)
    assert (starts[0][:, 2:] == 0.0).all()
    # The angles move along with the rates: a mean of fifty samples.
    np.testing.assert_allclose(starts[0][:, 0], 1.0, atol=5 * rig.MOTOR_NOISE / np.sqrt(WINDOW))
    np.testing.assert_allclose(starts[1][:, 2:], [[30.0, 0.7]] * 2, rtol=0.01)


def test_free_run_stays_at_rest_for_noiseless_encoders():
    found = run(at_rest(0.0))
    np.testing.assert_array_equal(found.motor_angle, found.motor_angle[0])


def test_free_run_accepts_stretches_of_different_length(moving: Experiment):
    stretches = [Stretch(moving, 0, COUNT), Stretch(moving, 100, 400)]
    first, second = free_run(rig.drive_model(), stretches, covariance=NOISE, substeps=1)
    assert (first.predicted.size, second.predicted.size) == (COUNT, 300)
    np.testing.assert_allclose(first.predicted, run(moving).predicted, atol=1e-3 * X_NOISE)
    assert second.rmse < 2.0 * X_NOISE
    both = np.concatenate([first.measured - first.predicted, second.measured - second.predicted])
    assert rms_error((first, second)) == pytest.approx(np.sqrt(np.mean(both**2)), rel=1e-12)


def test_rms_error_of_a_diverged_free_run_is_infinite(moving: Experiment):
    found = run(moving)
    lost = dataclasses.replace(found, predicted=np.where(np.arange(COUNT) > 300, np.nan, found.predicted))
    assert rms_error((found, lost)) == np.inf
