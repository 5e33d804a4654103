"""The fit recovers the parameters of an independent simulation from several far starting values."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.errors import DataError
from fitting.estimation.estimate import Fit, Start, Strategy, fit, half_log_determinant, lost
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import base_paths
from fitting.estimation.problem import Segmentation
from fitting.estimation.segments import cut
from fitting.estimation.solver_steps import needed_substeps
from fitting.estimation.weighing import whitening
from fitting.uncertainty.standard_errors import uncertainty
from hdjax.effects.backlash import Backlash
from hdjax.effects.friction import CoulombFriction

COUNT, HORIZON = 2000, 256
REDUCED_COUNT, REDUCED_HORIZON = 1000, 128
PATHS = ("K", "alpha", "B_sp")
TRUTH = {"K": rig.K, "alpha": rig.ALPHA, "B_sp": rig.B_SP}
REDUCED_TRUTH = {"mu": rig.MU, "omega_0": rig.OMEGA_0, "alpha": rig.REDUCED_ALPHA, "gain": rig.GAIN}
X_NOISE = np.hypot(rig.MOTOR_NOISE / rig.N, rig.LOAD_NOISE)
NOISE = jnp.asarray([[(rig.MOTOR_NOISE / rig.N) ** 2, (rig.MOTOR_NOISE / rig.N) ** 2], [0.0, X_NOISE**2]])
NOISE = NOISE.at[1, 0].set(NOISE[0, 1])


def whole(*experiments) -> list[Stretch]:
    return [Stretch(e, 0, len(e)) for e in experiments]


def drive_fit(model, stretches, **options) -> Fit:
    """Fit with the same shapes in all tests, so that they share one compiled program."""
    return fit(model, stretches, PATHS, Segmentation(HORIZON, substeps=1, count=8), **options)


def reduced_fit(model, stretches) -> Fit:
    return fit(model, stretches, base_paths(model), Segmentation(REDUCED_HORIZON, substeps=2, count=8))


def assert_recovered(found: Fit, truth: dict[str, float], *, within: float = 4.0):
    estimates = uncertainty(found).estimates
    assert set(estimates) == set(truth)
    for path, value in truth.items():
        estimate = estimates[path]
        assert abs(estimate.value - value) < within * estimate.std, (path, estimate)


@pytest.fixture(scope="module")
def stretches() -> list[Stretch]:
    return whole(rig.drive_experiment(COUNT))


@pytest.fixture(scope="module")
def found(stretches) -> Fit:
    return drive_fit(rig.drive_model(K=0.9 * rig.K, alpha=0.0, B_sp=1.0), stretches)


def test_fit_recovers_the_parameters_of_a_drive(found: Fit):
    assert found.converged
    assert_recovered(found, TRUTH)
    estimates = uncertainty(found).estimates
    # The start was hundreds of standard errors away, and the log determines all three parameters.
    assert 0.1 * rig.K > 100 * estimates["K"].std
    assert rig.ALPHA > 10 * estimates["alpha"].std
    assert 0.7 > 10 * estimates["B_sp"].std
    # Only the encoders' noise remains (2000 samples: 1.6 % of a standard deviation).
    assert found.principal_std == pytest.approx(X_NOISE, rel=0.06)
    assert float(np.sqrt(found.covariance[0, 0])) == pytest.approx(rig.MOTOR_NOISE / rig.N, rel=0.06)


@pytest.mark.parametrize(("K", "alpha", "B_sp"), [(1.1, 0.0, 0.05), (1.1, 3e4, 2.0), (0.93, -2e4, 0.3)])
def test_other_starts_reach_the_same_minimum(found: Fit, stretches, K: float, alpha: float, B_sp: float):
    other = drive_fit(rig.drive_model(K=K * rig.K, alpha=alpha, B_sp=B_sp), stretches)
    estimates = uncertainty(found).estimates
    for path in PATHS:
        # The iteration stops at a change of 1e-4 in an entry of the vector, far below a standard error.
        assert abs(float(other.model.get(path)) - estimates[path].value) < 0.1 * estimates[path].std, path
    assert other.objective == pytest.approx(found.objective, abs=1e-4)


def test_fixed_parameters_keep_their_values(found: Fit):
    for path, value in {"N": rig.N, "J_m": rig.J_M, "J_l": rig.J_L}.items():
        assert float(found.model.get(path)) == value


def test_covariance_and_objective_follow_from_the_residual(found: Fit, stretches):
    segments = cut(stretches, HORIZON, count=8)
    error = np.asarray(found.error)[np.asarray(segments.weight) > 0]
    assert error.shape == (COUNT, 2)
    np.testing.assert_allclose(found.covariance, error.T @ error / COUNT, rtol=1e-6)
    assert found.objective == pytest.approx(0.5 * np.log(np.linalg.det(found.covariance)), abs=1e-9)


def test_fit_with_held_parameters_estimates_initial_states_only(found: Fit, stretches):
    wrong = rig.drive_model(K=1.02 * rig.K)
    held = drive_fit(wrong, stretches, strategy=Strategy(hold_parameters=True))
    for path in PATHS:
        assert float(held.model.get(path)) == pytest.approx(float(wrong.get(path)), rel=1e-14)
    assert held.objective > found.objective + 0.5
    # The states did move: at the truth, they bring the error down to the noise.
    right = drive_fit(rig.drive_model(), stretches, strategy=Strategy(hold_parameters=True))
    assert right.principal_std == pytest.approx(found.principal_std, rel=0.02)


def test_joint_fit_of_two_logs_reduces_standard_errors(found: Fit):
    logs = whole(*(rig.drive_experiment(1000, seed=s, name=f"log {s}") for s in (3, 4)))
    joint = drive_fit(rig.drive_model(K=0.9 * rig.K, alpha=0.0), logs)
    assert_recovered(joint, TRUTH)
    alone = drive_fit(joint.model, logs[:1])
    gain = uncertainty(alone).estimates["K"].std / uncertainty(joint).estimates["K"].std
    # Twice the data: standard errors shrink by about the square root of two.
    assert 1.1 < gain < 2.2


def test_output_that_never_changes_is_refused():
    """Its weight would be infinite."""
    experiment = rig.drive_experiment(COUNT)
    still = experiment.measured.copy()
    still[:, 0] = still[0, 0]
    with pytest.raises(DataError, match="motor_angle does not change"):
        drive_fit(rig.drive_model(), whole(replace(experiment, measured=still)))


def test_output_with_large_model_error_is_down_weighted():
    # Unmodelled friction gives the motor angle an error of a thousand times its encoder's noise.
    spoiled = whole(rig.drive_experiment(COUNT, motor_friction=(0.05, 0.5)))
    weighed = drive_fit(rig.drive_model(K=0.93 * rig.K), spoiled)
    assert float(weighed.model.get("K")) == pytest.approx(rig.K, rel=0.01)
    assert float(np.sqrt(weighed.covariance[0, 0])) > 1e3 * rig.MOTOR_NOISE / rig.N
    kept = {"start": Start(NOISE), "strategy": Strategy(reweigh=False)}
    trusting = drive_fit(rig.drive_model(K=0.93 * rig.K), spoiled, **kept)
    off = [abs(float(m.get("K")) / rig.K - 1.0) for m in (weighed.model, trusting.model)]
    assert off[0] < 0.5 * off[1]


@pytest.mark.parametrize(("omega_0", "mu", "gain"), [(1.04, 10.0, 1.5), (0.96, 0.5, 0.7)])
def test_fit_recovers_the_parameters_of_a_reduced_log(omega_0: float, mu: float, gain: float):
    reduced = whole(rig.reduced_experiment(REDUCED_COUNT, noise=1e-3))
    start = rig.reduced_model(omega_0=omega_0 * rig.OMEGA_0, mu=mu, alpha=0.0, gain=gain * rig.GAIN)
    result = reduced_fit(start, reduced)
    assert_recovered(result, REDUCED_TRUTH)
    estimates = uncertainty(result).estimates
    for path, value in REDUCED_TRUTH.items():
        assert abs(float(start.get(path)) - value) > 10 * estimates[path].std, path
    assert result.principal_std == pytest.approx(1e-3, rel=0.1)


def test_solver_steps_are_finer_for_a_more_accurate_log():
    needed = {}
    for noise in (1e-3, 1e-8):
        stretches = whole(rig.reduced_experiment(REDUCED_COUNT, noise=noise, substeps=30))
        result = reduced_fit(rig.reduced_model(), stretches)
        needed[noise] = needed_substeps(result)
        assert needed_substeps(result, tolerance=1e9) == 2
    # Two steps to a sample turn 0.18 each and err by some 1e-6 of the twist: below a noise of 1e-3, not one of 1e-8.
    assert needed[1e-3] == 2
    assert needed[1e-8] > 2


@pytest.mark.slow
def test_solver_steps_are_finer_for_sharp_friction():
    needed = {}
    for name, sharpness in (("smooth", 5.0), ("sharp", 0.02)):
        friction = (150.0, sharpness)
        experiment = rig.reduced_experiment(400, noise=1e-5, friction=friction, substeps=60)
        model = rig.reduced_model().with_effects(CoulombFriction(T_c=150.0, v_0=sharpness))
        result = fit(model, whole(experiment), (), Segmentation(64, substeps=2), strategy=Strategy(max_steps=15))
        needed[name] = needed_substeps(result)
        assert needed_substeps(result, tolerance=1e9) == 2
    assert needed["sharp"] > needed["smooth"] >= 2


@pytest.mark.slow
def test_backlash_is_recovered_from_a_far_start():
    """Long segments of a nonsmooth drive have many minima; growing windows avoid them."""
    gap = 1.5e-4
    logged = whole(rig.drive_experiment(COUNT, gap=gap))
    start = rig.drive_model(K=0.7 * rig.K, alpha=0.0).with_effects(Backlash(b=jnp.asarray(3e-5)))
    found = fit(
        start,
        logged,
        (*PATHS, "backlash.b"),
        Segmentation(HORIZON, substeps=2, count=8),
        strategy=Strategy(max_steps=25),
    )
    assert found.converged
    assert_recovered(found, TRUTH | {"backlash.b": gap})


def test_segment_in_a_wrong_minimum_is_started_again():
    """One segment that starts 200 rad/s too slow ends in a wrong minimum and biases the parameters."""
    gap = 1.5e-4
    logged = whole(rig.drive_experiment(COUNT, gap=gap))
    model = rig.drive_model().with_effects(Backlash(b=jnp.asarray(gap)))
    segmentation = Segmentation(HORIZON, substeps=2, count=8)
    right = fit(model, logged, (*PATHS, "backlash.b"), segmentation, strategy=Strategy(25))
    start = Start(states=right.unknowns.states.at[3, 2].add(-200.0))
    astray, mended = (
        fit(right.model, logged, right.free.paths, segmentation, start=start, strategy=strategy)
        for strategy in (Strategy(25, begin_anew_above=np.inf, retry_states=r) for r in (False, True))
    )
    assert astray.objective > right.objective + 1.0
    assert mended.objective == pytest.approx(right.objective, abs=1e-3)


def test_fit_from_nan_states_does_not_converge(found: Fit, stretches):
    nowhere = found.unknowns.states * np.nan
    strategy = Strategy(begin_anew_above=np.inf, retry_states=False)
    got = drive_fit(found.model, stretches, start=Start(states=nowhere), strategy=strategy)
    assert not got.converged and got.objective > found.objective + 3.0


def test_whitening_inverts_the_covariance():
    W = np.asarray(whitening(NOISE))
    np.testing.assert_allclose(W @ np.asarray(NOISE) @ W.T, np.eye(2), atol=1e-9)


def test_diverged_segments_are_detected(found: Fit):
    assert not lost(found).any()
    error = np.array(found.error)
    error[1, 5, 0] = np.nan
    error[2, 7, 1] = 1e7 * found.principal_std
    assert np.flatnonzero(lost(replace(found, error=jnp.asarray(error)))).tolist() == [1, 2]


@pytest.mark.parametrize(
    "covariance", [np.diag([1.0, np.nan]), np.full((2, 2), np.inf), np.ones((2, 2)), np.zeros((1, 1))]
)
def test_objective_of_a_simulation_that_diverged_is_infinite(covariance: np.ndarray):
    assert half_log_determinant(covariance) == np.inf
