"""Effects of a fit receive the time and temperature of the log."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rig
from fitting.estimation.experiment import Experiment, Stretch, experiments_from_log
from fitting.estimation.free_parameters import free_parameters
from fitting.estimation.residual import Problem, Unknowns, simulate_segments
from fitting.estimation.scales import scales
from fitting.estimation.segments import cut
from fitting.logs.log import Log
from hdjax.effects.load import LoadDisturbance
from hdjax.effects.thermal import ThermalStiffness

COUNT, LATE, GAP = 240, 1000.0, (100, 140)
TIME = rig.STEP * np.arange(COUNT)


def temperature_at(t):
    return 300.0 + 50.0 * t


def motion() -> np.ndarray:
    """Free vibration from an initial twist, with an unlogged load torque and a rising temperature."""

    def rates(t, y):
        x, v = y[0] / rig.N - y[1], y[2] / rig.N - y[3]
        tau = rig.K * (1 - 0.01 * (temperature_at(t) - 303.0)) * (x + rig.ALPHA * x**3) + rig.B_SP * v
        load = 0.5 + 2.0 * np.cos(150.0 * t) - np.sin(150.0 * t)
        return [y[2], y[3], -tau / rig.N / rig.J_M, (tau + load) / rig.J_L]

    start = [0.05, 0.0, 0.0, 0.0]
    return solve_ivp(rates, TIME[[0, -1]], start, "DOP853", TIME, rtol=1e-11, atol=1e-14).y.T


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    return motion()


def log_with_gap(states: np.ndarray, temperature: np.ndarray | None) -> Log:
    """A log with one gap, whose time starts at 1000 s."""
    log = rig.drive_log(states, np.zeros(COUNT), noise=0.0)
    return dataclasses.replace(log, time=LATE + TIME, temperature=temperature, pieces=((0, GAP[0]), (GAP[1], COUNT)))


def whole(experiments: tuple[Experiment, ...]) -> tuple[Stretch, ...]:
    return tuple(Stretch(e, 0, len(e)) for e in experiments)


def test_true_model_has_zero_residual_before_and_after_a_gap(states: np.ndarray):
    experiments = experiments_from_log(log_with_gap(states, temperature_at(TIME)), hold="zero-order", N=rig.N)
    model = rig.drive_model().with_effects(
        LoadDisturbance(constant=0.5, cosine=2.0, sine=-1.0, omega=150.0), ThermalStiffness(k_T=-0.01, T_0=303.0)
    )
    segments = cut(whole(experiments), 50, halo=4)
    # Segments start at rows 0 and 50, then 140 and 190.
    starts = jnp.asarray(states[[0, 50, 140, 190]])
    problem = Problem(
        model, free_parameters(model, (), {}), segments, jnp.eye(2), jnp.zeros(0), jnp.ones(4), substeps=4
    )
    outputs, _ = simulate_segments(problem, Unknowns(jnp.zeros(0), starts))
    weight = np.asarray(segments.weight)[..., None]
    error = (np.asarray(outputs) - np.asarray(segments.measured)) * weight
    # Tsit5 with steps of 0.05 rad of the natural oscillation errs by 1e-9 of the twist.
    assert np.abs(error[..., 1]).max() < 1e-7 * np.abs(segments.measured[..., 1]).max()


def test_scales_include_temperature_and_duration_of_the_log(states: np.ndarray):
    temperature = temperature_at(TIME)
    experiments = experiments_from_log(log_with_gap(states, temperature), hold="zero-order", N=rig.N)
    found = scales(whole(experiments), rig.drive_model())
    first = temperature[: GAP[0]]
    both = np.concatenate([first, temperature[GAP[1] :]])
    assert found.temperature == pytest.approx(first.mean())
    assert found.temperature_change == pytest.approx(np.sqrt(np.mean((both - first.mean()) ** 2)))
    assert found.duration == pytest.approx(99 * rig.STEP)
    assert found.reduction_ratio == rig.N
    assert found.natural_frequency == pytest.approx(float(rig.drive_model().drive.omega_0))


def test_temperature_is_dropped_if_one_of_several_logs_lacks_it(states: np.ndarray):
    warm = experiments_from_log(log_with_gap(states, temperature_at(TIME)), hold="zero-order", N=rig.N)
    cold = experiments_from_log(log_with_gap(states, None), hold="zero-order", N=rig.N)
    assert cut(whole(warm), 50).temperature is not None
    assert cut(whole(warm + cold), 50).temperature is None
    assert scales(whole(warm + cold)).temperature is None


def test_load_torque_is_zero_for_logs_that_lack_it(states: np.ndarray):
    """A log without load torque is simulated with a load torque of zero."""
    bare = log_with_gap(states, None)
    loaded = dataclasses.replace(bare, load_torque=np.full(COUNT, 3.0))
    experiments = [e for log in (loaded, bare) for e in experiments_from_log(log, hold="zero-order", N=rig.N)]
    found = cut(whole(tuple(experiments)), 50).load_torque
    assert found is not None
    first = np.asarray(found.coefficients)[:, 0, 0]
    np.testing.assert_array_equal(first, [3.0] * 4 + [0.0] * 4)
