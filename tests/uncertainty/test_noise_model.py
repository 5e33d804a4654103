"""Noise of sensors and torque estimated from innovations, compared with the noise of the simulated log."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

import rig
from fitting.attribution.candidate_fit import Trial
from fitting.attribution.rules import RULES
from fitting.attribution.support import Standing, is_noise, noise_of_torque, shows_noise
from fitting.estimation.engines import with_engine
from fitting.estimation.estimate import Fit, Start, fit
from fitting.estimation.experiment import Experiment, experiment_from_log, whole
from fitting.estimation.free_parameters import base_paths, fitted_paths
from fitting.estimation.problem import Segmentation
from fitting.estimation.residual import Unknowns
from fitting.loop import close_loop
from fitting.uncertainty.innovations import SensorNoise, Steps, filtered
from fitting.uncertainty.measurement_noise import MeasurementNoise, measurement_noise
from fitting.uncertainty.noise_model import NoiseModel, noise_model, spread_by_torque
from fitting.uncertainty.prediction_band import prediction_bands
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Hold, Model
from hdjax.effects import CATALOGUE, Effect
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.learned_memory import LaggingMeshTorque
from hdjax.effects.load import GravityLoad
from hdjax.effects.sensing import LoadEncoderEccentricity

COUNT, STD = 3000, 0.01
OUTPUTS = np.array([[1.0, 1.0], [1.0, 1.0]]) * (rig.MOTOR_NOISE / rig.N) ** 2 + np.diag([0.0, rig.LOAD_NOISE**2])
# Standard deviation of correlated noise of the motor's and of the load's encoder [rad].
SIZES = 3.0 * np.array([rig.MOTOR_NOISE, rig.LOAD_NOISE])
TWIST = float(np.hypot(SIZES[0] / rig.N, SIZES[1]))


def noisy_experiment(
    *,
    seed: int = 0,
    count: int = COUNT,
    std: float = STD,
    correlation: float | None = None,
    load: bool = True,
    **physics: Any,
) -> Experiment:
    """A log with noise of the logged torque and, with `correlation`, correlated noise of the encoders."""
    acting = rig.drive_torque(count, seed=seed)
    motion = rig.drive_motion(acting, **physics)
    if correlation is not None:
        motion[:, :2] += correlated_noise(correlation, count) * SIZES
    log = rig.drive_log(motion, acting, seed=seed, noise=1.0 if correlation is None else 0.0)
    logged = acting + std * np.random.default_rng(seed + 7).normal(size=count)
    seen = replace(log, motor_torque=logged) if load else replace(log, motor_torque=logged, load_angle=None)
    return experiment_from_log(seen, hold="zero-order", N=rig.N)


def correlated_noise(correlation: float, count: int) -> Float[np.ndarray, "samples encoders"]:
    """Noise of unit variance, each sample correlated with the one before."""
    pushed = np.random.default_rng(5).normal(size=(count, 2))
    pushed[1:] *= np.sqrt(1.0 - correlation**2)
    return np.asarray(lfilter([1.0], [1.0, -correlation], pushed, axis=0))


def fitted(experiment: Experiment) -> Fit:
    model = replace(rig.drive_model(), measured=experiment.outputs)
    return fit(model, whole([experiment]), base_paths(model), Segmentation(128))


def noise_model_of(found: Fit) -> NoiseModel:
    return _noise_model(found, measurement_noise(found).covariance)


def _noise_model(found: Fit, outputs: Any) -> NoiseModel:
    made = noise_model(found, outputs, predictable=RULES.innovations)
    assert made is not None
    return made


@pytest.fixture(scope="module")
def noisy() -> Fit:
    return fitted(noisy_experiment())


def test_torque_noise_is_estimated_with_its_true_size(noisy: Fit):
    found = _noise_model(noisy, OUTPUTS)
    assert found.std == pytest.approx(STD, rel=0.05)
    assert found.size == pytest.approx(1.0, abs=0.05)
    assert found.predictable < 0.02 and found.sensors.memory(rig.STEP) is None
    assert noise_of_torque(found) == found.std


def test_torque_noise_is_estimated_from_the_motor_angle_alone():
    """The initial state of the load, which no sensor measures, is free in each segment."""
    found = noise_model_of(fitted(noisy_experiment(load=False)))
    assert is_noise(found) and found.sensors.memory(rig.STEP) is None
    assert noise_of_torque(found) == pytest.approx(STD, rel=0.1)


def test_torque_noise_is_estimated_despite_overrated_sensor_noise(noisy: Fit):
    found = _noise_model(noisy, 1e5 * OUTPUTS)
    assert found.std == pytest.approx(STD, rel=0.1) and np.isfinite(found.likelihood)


def test_sensors_without_noise_have_no_noise_model():
    """By rounding, the filter's variances are not positive."""
    torque = rig.drive_torque(1000)
    log = rig.drive_log(rig.drive_motion(torque), torque, noise=0.0)
    found = fitted(experiment_from_log(log, hold="zero-order", N=rig.N))
    least = 1e-8 * np.asarray(measurement_noise(found).covariance)
    assert noise_model(found, least, predictable=RULES.innovations) is None


@pytest.mark.parametrize("correlation, std", [(0.8, 0.0), (0.98, 0.0), (0.8, STD), (0.98, STD)])
def test_sensor_noise_is_estimated_with_its_memory_and_size(correlation: float, std: float):
    drive = fitted(noisy_experiment(correlation=correlation, std=std, count=8000))
    found = noise_model_of(drive)
    assert is_noise(found)
    memory = found.sensors.memory(rig.STEP)
    assert memory is not None and memory == pytest.approx(-rig.STEP / np.log(correlation), rel=0.4)
    # Number of white samples with the same information as the samples that are used.
    counts = 12 * 128 * (1.0 - correlation) / (1.0 + correlation)
    assert found.sensors.covariance[-1, -1] ** 0.5 == pytest.approx(TWIST, rel=3.0 / np.sqrt(2.0 * counts))
    assert shows_noise(found, drive)
    # Noise of which a chaotic motion lets the filter see only the increments.
    assert not shows_noise(replace(found, sensors=replace(found.sensors, slow=100.0 * found.sensors.slow)), drive)
    torque = noise_of_torque(found)
    assert torque is None if std == 0.0 else torque == pytest.approx(std, rel=0.1)


@pytest.mark.parametrize(
    "missing",
    [
        {"motor_friction": (2e-3, 1.0)},
        {"mesh_friction": (0.5, 1e-2)},
        {"tether": 20.0},
        {"kinematic": (1e-4, 0.0)},
        {"gap": 5e-5},
    ],
    ids=lambda missing: next(iter(missing)),
)
def test_missing_effect_is_not_explained_as_noise(missing: dict[str, Any]):
    assert not is_noise(noise_model_of(fitted(noisy_experiment(correlation=0.95, std=0.0, count=8000, **missing))))


@pytest.mark.slow
def test_hidden_states_fitted_to_each_segment_do_not_explain_slow_noise():
    """A lag of no strength to speak of oscillates freely in each segment, with an amplitude and phase of its own."""
    experiment = noisy_experiment(correlation=0.85, std=0.0, count=8000)
    found = fitted(experiment)
    span = {"lag_span": 1e-2, "rate_span": 1.0}
    lag = LaggingMeshTorque(k=-1e-4 * rig.K, omega=2.0 * np.pi / (128 * rig.STEP), zeta=0.2, **span)
    model = found.model.with_effects(lag)
    more = fit(model, whole([experiment]), fitted_paths(model), Segmentation(128), start=Start(found.covariance))
    known = {"predictable": RULES.innovations, "residual": found.covariance}
    before, after = (noise_model(f, measurement_noise(found).covariance, **known) for f in (found, more))
    assert before is not None and after is not None
    assert found.objective - more.objective > 0.05 and after.likelihood < before.likelihood


@pytest.mark.slow
def test_effect_against_noise_is_judged_alike_with_a_poor_noise_estimate():
    """What is missing may inflate and correlate the noise that is estimated beside the base model."""
    torque = rig.drive_torque(4000)
    motion = rig.drive_motion(torque, state=(0.0, 0.0, 0.3 * rig.N, 0.3))
    motion[:, 1] += 3e-5 * np.cos(motion[:, 1])
    experiment = experiment_from_log(rig.drive_log(motion, torque), hold="zero-order", N=rig.N)

    def trial(model: Model) -> Trial:
        found = fit(model, whole([experiment]), fitted_paths(model), Segmentation(128))
        return Trial(found.model, found, found, "zero-order")

    before = trial(rig.drive_model())
    better = trial(rig.drive_model().with_effects(LoadEncoderEccentricity(cosine=3e-5)))
    poor = OUTPUTS + np.outer([1e-7, 3e-6], [1e-7, 3e-6])
    good, bad = (
        Standing(before, before, MeasurementNoise(jnp.asarray(c), ())).over_noise(better) for c in (OUTPUTS, poor)
    )
    assert np.isfinite(good) and good > 100.0 and bad == pytest.approx(good, abs=1.0)


def test_response_to_torque_noise_is_not_assigned_to_the_sensors():
    """Short pieces assign the motor's response to a very noisy torque to the noise of its encoder."""
    found = fitted(noisy_experiment(std=10.0 * STD, count=8000))
    known = measurement_noise(found).covariance
    assert known[0, 0] > 2.0 * OUTPUTS[0, 0]
    seen = _noise_model(found, known)
    assert seen.std == pytest.approx(10.0 * STD, rel=0.05)
    assert np.sqrt(np.diag(seen.sensors.covariance)) == pytest.approx(np.sqrt(np.diag(OUTPUTS)), rel=0.2)


def test_noise_model_of_a_noiseless_log_is_finite():
    """The residual of the model is the solver's error alone."""
    acting = rig.drive_torque(COUNT)
    log = rig.drive_log(rig.drive_motion(acting), acting, noise=0.0)
    found = fitted(experiment_from_log(log, hold="zero-order", N=rig.N))
    known = np.asarray(measurement_noise(found).covariance)
    assert np.all(np.diag(np.asarray(found.covariance)) < RULES.excess**2 * np.diag(known))
    assert known[-1, -1] ** 0.5 < 1e-3 * rig.LOAD_NOISE
    seen = _noise_model(found, known)
    assert np.isfinite([seen.std, seen.size, seen.predictable, seen.likelihood]).all()


def test_a_diverging_model_has_no_noise_model(noisy: Fit):
    softening = noisy.model.replace({"alpha": -1e12})
    lost = eqx.tree_at(lambda f: (f.model, f.unknowns.parameters), noisy, (softening, noisy.free.pack(softening)))
    assert noise_model(lost, OUTPUTS, predictable=RULES.innovations) is None


def test_likelihood_of_innovations_equals_the_gaussian_density_of_all_samples():
    """The reference density is that of all samples at once, with their covariance."""
    random = np.random.default_rng(0)
    samples, size, std = 40, 2, 0.3
    transition = np.array([[0.9, 0.2], [-0.2, 0.9]])
    push, readout = np.array([0.3, 1.0]), np.array([[1.0, 0.0], [0.5, -1.0]])
    sensors = SensorNoise(
        np.array([[1.0, 0.0], [0.4, 0.8]]), np.array([0.2, 0.5]), np.array([0.7, 0.1]), np.full(2, 0.9)
    )
    error = random.normal(size=(samples, 2, 1, 1))
    shapes = {"transition": transition, "push": push, "readout": readout}
    stacked = {name: np.broadcast_to(v[..., None], (samples, *v.shape, 1)) for name, v in shapes.items()}
    start = random.normal(size=(size, 1))
    one = {"log": np.zeros(1, int), "start": start, "prior": np.eye(size), "torque": np.ones(1), "lead": 0}
    steps = Steps(**stacked, error=error, counts=np.ones((samples, 1), bool), **one)
    innovations, logarithms = filtered(steps, np.array([[std]]), sensors)
    spread = np.zeros((samples, size, samples, size))
    variance = np.eye(size)
    for i in range(samples):
        forward = variance
        for k in range(i, samples):
            spread[i, :, k], spread[k, :, i] = forward, forward.T
            forward = forward @ transition.T
        variance = transition @ variance @ transition.T + std**2 * np.outer(push, push)
    seen = np.einsum("oa,iakb,qb->iokq", readout, spread, readout)
    lags = np.abs(np.subtract.outer(np.arange(samples), np.arange(samples)))
    own = sensors.slow * 0.9 ** lags[..., None] + sensors.white * (lags == 0)[..., None]
    seen += np.einsum("od,ikd,qd->iokq", sensors.combined, own, sensors.combined)
    expected = [readout @ np.linalg.matrix_power(transition, i) @ start[:, 0] for i in range(samples)]
    law = multivariate_normal(mean=np.ravel(expected), cov=seen.reshape(2 * samples, -1))
    # In units of the sensors' independent combinations.
    units = samples * np.log(np.linalg.det(sensors.combined)) + samples * np.log(2.0 * np.pi)
    likelihood = -np.sum(0.5 * innovations**2 + logarithms) - units
    assert likelihood == pytest.approx(law.logpdf(error.ravel()), rel=1e-9)


def test_spread_by_torque_noise_equals_the_scatter_of_simulations(noisy: Fit):
    """The reference is the rig: the same motion under new draws of the torque noise."""
    count, draws = 300, 60
    torque = rig.drive_torque(count)
    silent = rig.drive_motion(torque)
    random = np.random.default_rng(0)
    moved = [rig.drive_motion(torque + STD * random.normal(size=count)) for _ in range(draws)]
    scatter = np.std([(m - silent)[:, 0] / rig.N - (m - silent)[:, 1] for m in moved], axis=0)
    experiment = rig.drive_experiment(count)
    model = rig.drive_model()
    problem = fit(model, whole([experiment]), (), Segmentation(count, length=count, substeps=4)).problem
    states = jnp.asarray(silent[:1, :4])
    found = spread_by_torque(with_engine(problem), Unknowns(jnp.zeros(0), states), STD)[0]
    # 60 draws determine a standard deviation to 9 %; the median of the ratio over all samples is more accurate.
    assert np.median(scatter[20:] / found[20:count]) == pytest.approx(1.0, abs=0.1)


def test_prediction_bands_with_torque_noise_cover_95_percent(noisy: Fit):
    unseen = whole([noisy_experiment(seed=seed, count=600) for seed in (3, 4, 5, 6)])
    options = {"noise": jnp.asarray(OUTPUTS), "halo": noisy.problem.segments.halo}
    blind, wide = (
        prediction_bands(noisy, uncertainty(noisy), unseen, torque_noise=std, **options) for std in (0.0, STD)
    )
    assert np.mean([band.inside[50:] for band in blind]) < 0.8
    # The response is a line at the resonance, so that four runs determine the share to some per cent.
    assert np.mean([band.inside[50:] for band in wide]) == pytest.approx(0.95, abs=0.05)


# One form for each place in the equations and on the sensors.
SOME_FORMS = (CoulombFriction, KinematicError, GravityLoad, TorqueBias, LoadEncoderEccentricity)


@pytest.mark.parametrize("catalogue", [SOME_FORMS, pytest.param(CATALOGUE, marks=pytest.mark.slow)], ids=["few", "all"])
def test_loop_reports_model_sufficient_and_torque_noise(catalogue: Sequence[type[Effect]]):
    data: dict[Hold, tuple[Experiment, ...]] = {"zero-order": (noisy_experiment(count=COUNT),)}
    begun = rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0)
    loop = close_loop(begun, data, hold="zero-order", catalogue=catalogue)
    assert loop.decision == "model_sufficient" and loop.unknown is None
    assert loop.torque_noise == pytest.approx(STD, rel=0.1)
    for path, truth in {"K": rig.K, "alpha": rig.ALPHA, "B_sp": rig.B_SP}.items():
        low, high = loop.after.uncertainty.estimates[path].ci95
        assert low < truth < high, path
