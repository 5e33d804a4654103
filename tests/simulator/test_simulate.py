"""Simulated motions against closed forms, scipy, and one another."""

import inspect

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.signal import cont2discrete, lsim

from hdjax import (
    Drive,
    Ending,
    Harmonic,
    PiecewisePolynomial,
    ReducedDrive,
    ReducedModel,
    SimulationError,
    TwoInertiaModel,
    hdc_40_050,
    sampled,
    simulate,
)
from hdjax.effects.actuation import TorqueBias
from hdjax.simulate import Trajectory, march

MU, OMEGA_0, GAIN = 3.0, 50.0, 2.0
TIMES = np.linspace(0.2, 0.7, 101)  # a start that is not zero
STEP = 5e-3
# The same everywhere: a tolerance is compiled in.
TIGHT = {"rtol": 1e-11, "atol": 1e-15}
REST = jnp.zeros(2)


def duffing(alpha: float = 0.0, mu: float = MU) -> ReducedModel:
    return ReducedModel(ReducedDrive(mu=mu, omega_0=OMEGA_0, alpha=alpha, gain=GAIN))


def constant(value: float) -> Harmonic:
    return Harmonic(0.0, 0.0, 0.0, value)


def decay(t: np.ndarray, x: float, v: float) -> np.ndarray:
    """Free motion of the linear, underdamped error equation."""
    omega = np.sqrt(OMEGA_0**2 - MU**2 / 4)
    return np.exp(-MU * t / 2) * (x * np.cos(omega * t) + (v + MU * x / 2) / omega * np.sin(omega * t))


# Tolerances of tight simulations below: some 100 steps that each err by 1e-11 of motions of order one.


def test_free_decay_of_a_linear_drive_agrees_with_the_closed_form():
    found = simulate(duffing(), constant(0.0), TIMES, jnp.asarray([0.8, -11.0]), **TIGHT)
    np.testing.assert_allclose(found.dynamic_error, decay(TIMES - TIMES[0], 0.8, -11.0), atol=1e-9)


def test_step_response_of_a_linear_drive_agrees_with_the_closed_form():
    """From rest towards gain u / omega_0^2."""
    end = GAIN * 900.0 / OMEGA_0**2
    found = simulate(duffing(), constant(900.0), TIMES, **TIGHT)
    np.testing.assert_allclose(found.dynamic_error, end + decay(TIMES - TIMES[0], -end, 0.0), atol=1e-9)


def test_default_tolerances_err_below_1e_6():
    found = simulate(duffing(), constant(0.0), TIMES, jnp.asarray([0.8, -11.0]))
    np.testing.assert_allclose(found.dynamic_error, decay(TIMES - TIMES[0], 0.8, -11.0), atol=1e-6)


def test_duffing_motion_agrees_with_scipy():
    alpha, amplitude, omega = 0.7, 1500.0, 43.0

    def rates(t, y):
        u = amplitude * np.cos(omega * t + 0.4)
        return [y[1], GAIN * u - MU * y[1] - OMEGA_0**2 * (y[0] + alpha * y[0] ** 3)]

    other = solve_ivp(rates, TIMES[[0, -1]], [0.5, 0.0], "DOP853", TIMES, rtol=1e-12, atol=1e-13)
    found = simulate(duffing(alpha), Harmonic(amplitude, omega, 0.4, 0.0), TIMES, jnp.asarray([0.5, 0.0]), **TIGHT)
    assert np.abs(other.y[0]).max() > 1.0  # the cubic term outweighs the linear one's half
    np.testing.assert_allclose(found.states, other.y.T, atol=1e-7)  # rates are 50 times the twist
    np.testing.assert_allclose(found.dynamic_error, other.y[0], atol=2e-9)


# -- two inertias --


class ErrorForcing(eqx.Module):
    """What motor and load torque together do to the dynamic error, as motor torque of the reduced drive."""

    drive: Drive
    motor: Harmonic
    load: Harmonic

    def __call__(self, t: Array) -> Array:
        forcing = self.drive.error_forcing(self.motor(t), self.load(t))
        return forcing * self.drive.N * self.drive.J_m


SHORT = np.linspace(0.0, 0.1, 101)
MOTOR = Harmonic(4.0, 300.0, 0.3, 1.0)
LOAD = Harmonic(5.0, 170.0, 1.1, -2.0)


@pytest.mark.parametrize("alpha", (0.1, 3e5))
def test_two_inertias_and_the_error_equation_agree(alpha):
    drive = eqx.tree_at(lambda d: d.alpha, hdc_40_050(), jnp.asarray(alpha))
    two = simulate(TwoInertiaModel(drive), MOTOR, SHORT, load_torque=LOAD, **TIGHT)
    one = simulate(ReducedModel(drive.reduced()), ErrorForcing(drive, MOTOR, LOAD), SHORT, **TIGHT)
    largest = np.abs(one.dynamic_error).max()
    if alpha > 1:
        assert alpha * largest**2 > 1  # far from linear
    # The twist is the small difference of two angles of up to 1e3 times its size: 1e-11 becomes 1e-8.
    np.testing.assert_allclose(two.dynamic_error, one.dynamic_error, atol=1e-8 * largest)
    np.testing.assert_allclose(two.outputs[:, 0] * drive.N, two.states[:, 0], rtol=1e-14)


def energy(drive: Drive, states: np.ndarray) -> np.ndarray:
    theta_m, theta_l, omega_m, omega_l = np.asarray(states).T
    x = theta_m / float(drive.N) - theta_l
    kinetic = 0.5 * float(drive.J_m) * omega_m**2 + 0.5 * float(drive.J_l) * omega_l**2
    return kinetic + float(drive.K) * (x**2 / 2 + float(drive.alpha) * x**4 / 4)


SPRUNG = jnp.asarray([0.3, 0.003, 2.0, -0.4])
NOTHING = constant(0.0)


def test_energy_is_kept_without_damping_and_torque():
    drive = Drive(N=50, J_m=5.26e-4, J_l=5e-2, K=7160, alpha=3e5)
    free = simulate(TwoInertiaModel(drive), NOTHING, SHORT, SPRUNG, load_torque=NOTHING, **TIGHT)
    found = energy(drive, free.states)
    np.testing.assert_allclose(found, found[0], rtol=1e-8)


def test_energy_falls_by_the_work_of_the_damper():
    """The work is the integral of B_sp x'^2."""
    drive = Drive(N=50, J_m=5.26e-4, J_l=5e-2, K=7160, alpha=3e5, B_sp=1.5)
    times = np.linspace(0.0, 0.02, 101)
    states = simulate(TwoInertiaModel(drive), NOTHING, times, SPRUNG, load_torque=NOTHING, **TIGHT).states
    found = energy(drive, states)
    v = np.asarray(states[:, 2]) / 50 - np.asarray(states[:, 3])
    taken = cumulative_simpson(1.5 * v**2, x=times, initial=0.0)
    assert np.all(np.diff(found) < 1e-12)
    assert taken[-1] > 0.3 * found[0]
    # Simpson's rule at 0.2 rad a step: 0.2^4 / 180 = 1e-5, of an integrand that has harmonics.
    np.testing.assert_allclose(found + taken, found[0], rtol=1e-4)


def test_momentum_is_kept_without_torque():
    """N theta_m and theta_l turn against each other: J_m omega_m N + J_l omega_l does not change."""
    free = simulate(TwoInertiaModel(hdc_40_050()), NOTHING, SHORT, SPRUNG, load_torque=NOTHING, **TIGHT)
    momentum = np.asarray(free.states) @ [0.0, 0.0, 50 * 5.26e-4, 5e-2]
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-9)


# -- sampled torques --


def rough(seed: int = 1) -> np.ndarray:
    return 800.0 * np.random.default_rng(seed).normal(size=TIMES.size)


def exact_hold(values: np.ndarray) -> np.ndarray:
    """The linear drive under a held torque, by the matrix exponential."""
    A = np.array([[0.0, 1.0], [-(OMEGA_0**2), -MU]])
    Ad, Bd, *_ = cont2discrete((A, np.array([[0.0], [GAIN]]), np.eye(2), np.zeros((2, 1))), STEP)
    states = [np.zeros(2)]
    for value in values[:-1]:
        states.append(Ad @ states[-1] + Bd[:, 0] * value)
    return np.array(states)


def test_held_torque_is_integrated_exactly():
    values = rough()
    found = simulate(duffing(), sampled(TIMES, values, hold="zero-order"), TIMES, **TIGHT)
    np.testing.assert_allclose(found.dynamic_error, exact_hold(values)[:, 0], atol=1e-9)


def test_held_load_torque_is_integrated_exactly():
    """The solver steps to its jumps too: the rate of a load of inertia 1 on a soft mesh is the sum of torques."""
    drive = Drive(N=1, J_m=1, J_l=1, K=1e-9)
    values = rough(2)
    trajectory = simulate(
        TwoInertiaModel(drive), constant(0.0), TIMES, load_torque=sampled(TIMES, values, hold="zero-order")
    )
    rates = np.concatenate([[0.0], np.cumsum(values[:-1]) * STEP])
    np.testing.assert_allclose(trajectory.states[:, 3], rates, atol=1e-7)


def test_actuator_effect_acts_on_sampled_torques_only():
    values = rough()
    biased = duffing().with_effects(TorqueBias(bias=100.0))
    found = simulate(biased, sampled(TIMES, values, hold="zero-order"), TIMES, **TIGHT)
    np.testing.assert_allclose(found.dynamic_error, exact_hold(values + 100.0)[:, 0], atol=1e-9)
    with pytest.raises(ValueError, match="`forcing` must be a sampled signal .*torque_bias.* but is Harmonic"):
        simulate(biased, constant(1.0), TIMES)


# -- march: fixed steps from sample to sample --


@eqx.filter_jit
def marched(model, torque, load_torque, state, solver, substeps):
    return march(model, torque, load_torque, state, solver=solver, substeps=substeps)[0]


@pytest.mark.parametrize("hold", ("zero-order", "band-limited"))
def test_march_agrees_with_simulate(hold):
    torque = sampled(TIMES, rough(), hold=hold)
    model = duffing(0.7)
    exact = simulate(model, torque, TIMES, **TIGHT).states
    found = marched(model, torque, None, REST, dfx.Tsit5(), 8)
    # 8 steps of 0.03 rad in each interval: 0.03^5 times Tsit5's small constant.
    np.testing.assert_allclose(found[:, 0], exact[:, 0], atol=1e-8)


def test_march_under_a_load_torque_agrees_with_scipy():
    """Two linear inertias under torques that are linear between samples, which scipy's lsim integrates exactly."""
    drive = Drive(N=2, J_m=1, J_l=3, K=2000, B_sp=1)
    values = np.stack([rough(1), rough(2)], axis=1)
    motor, load = (sampled(TIMES, column, hold="linear") for column in values.T)
    found = marched(TwoInertiaModel(drive), motor, load, jnp.zeros(4), dfx.Tsit5(), 8)
    mesh = np.array([2000 / 2, -2000, 1 / 2, -1.0])  # torque from theta_m, theta_l, omega_m, omega_l
    A = np.stack([[0, 0, 1, 0], [0, 0, 0, 1], -mesh / 2, mesh / 3])
    B = np.array([[0, 0], [0, 0], [1, 0], [0, 1 / 3]])
    _, exact, _ = lsim((A, B, np.eye(4), np.zeros((4, 2))), values, TIMES - TIMES[0])
    np.testing.assert_allclose(found[:, :2], exact[:, :2], atol=1e-8)
    assert np.abs(exact[:, 0] / 2 - exact[:, 1]).max() > 0.1


@pytest.mark.parametrize(("solver", "order"), ((dfx.Tsit5(), 5), (dfx.Dopri5(), 5), (dfx.Bosh3(), 3)))
def test_march_has_the_order_of_its_solver(solver, order):
    """Steps 8 times smaller divide the error by 8^order, for a torque that jumps from sample to sample, too.

    Tsit5's leading error is small enough that the next one shows: its order wavers by 2 from one halving to the next,
    and by 0.15 over three.
    """
    torque = sampled(TIMES, rough(), hold="zero-order")
    model = duffing(0.7)
    exact = simulate(model, torque, TIMES, **TIGHT).states[:, 0]
    errors = [np.abs(marched(model, torque, None, REST, solver, n)[:, 0] - exact).max() for n in (1, 8)]
    assert np.log2(errors[0] / errors[1]) / 3 == pytest.approx(order, abs=0.3)


def test_march_refuses_an_implicit_solver():
    """Without the test suite's type checker, which refuses it earlier."""
    with pytest.raises(ValueError, match="`solver` must be an explicit Runge-Kutta solver"):
        torque = sampled(TIMES, rough(), hold="linear")
        inspect.unwrap(march)(duffing(), torque, None, REST, solver=dfx.ImplicitEuler(), substeps=1)


# -- endings --


@pytest.mark.parametrize(
    ("times", "start", "words"),
    (
        ([0.0, 0.2, 0.1], [0.0, 0.0], "`times` must rise"),
        ([0.0, np.nan], [0.0, 0.0], "`times` must rise"),
        ([], [0.0, 0.0], "`times` must rise"),
        ([0.0, 0.1], [0.0, 0.0, 0.0], "a number for each of x, v, but has the shape .3,."),
    ),
)
def test_times_that_do_not_rise_and_foreign_states_are_refused(times, start, words):
    with pytest.raises(ValueError, match=words):
        simulate(duffing(), constant(0.0), jnp.asarray(times), jnp.asarray(start))


def test_every_ending_has_its_own_message():
    messages = [ending.message for ending in Ending]
    assert len(set(messages)) == len(messages)
    assert str(SimulationError(Ending.step_limit)) == Ending.step_limit.message


def test_step_limit_is_reported():
    with pytest.raises(SimulationError, match="raise max_steps") as caught:
        simulate(duffing(), constant(1.0), TIMES, max_steps=7)
    assert caught.value.ending == Ending.step_limit
    kept = simulate(duffing(), constant(1.0), TIMES, max_steps=7, throw=False)
    assert int(kept.ending) == Ending.step_limit


def test_diverging_simulation_is_reported():
    """Beyond the saddle of a softening drive, in steps that can't shrink."""
    with pytest.raises(SimulationError, match="alpha") as caught:
        simulate(duffing(-1.0), constant(0.0), TIMES, jnp.asarray([1.5, 0.0]), step_size=2e-3)
    assert caught.value.ending == Ending.not_finite


ALPHAS = jnp.asarray([0.0, -1.0, 0.7])  # the middle one escapes from 1.5
START = jnp.asarray([1.5, 0.0])


def lane(alpha: Array):
    return simulate(duffing().replace({"alpha": alpha}), constant(0.0), TIMES, START, max_steps=500, throw=False)


lanes = jax.jit(jax.vmap(lane))


def test_each_lane_keeps_its_own_ending():
    found = lanes(ALPHAS)
    assert [int(e) == Ending.successful for e in found.ending] == [True, False, True]
    good = np.asarray(found.states)[[0, 2]]
    assert np.isfinite(good).all()
    np.testing.assert_allclose(good[0, :, 0], decay(TIMES - TIMES[0], 1.5, 0.0), atol=1e-6)


def test_simulation_in_lanes_equals_a_loop():
    found = lanes(ALPHAS)
    for k in (0, 2):
        alone = lane(ALPHAS[k])
        assert int(alone.ending) == Ending.successful
        # The same steps up to rounding.
        np.testing.assert_allclose(found.states[k], alone.states, atol=1e-9)


# -- jit, gradients, steps, progress --


def test_jit_does_not_change_the_simulation():
    start = jnp.asarray([0.4, 0.0])
    plain = simulate(duffing(0.7), constant(300.0), TIMES, start)
    compiled = eqx.filter_jit(simulate)(duffing(0.7), constant(300.0), TIMES, start)
    np.testing.assert_allclose(compiled.states, plain.states, rtol=1e-10, atol=1e-10)
    torque = sampled(TIMES[:4], rough()[:4], hold="linear")
    with jax.disable_jit():
        slow, _ = march(duffing(0.7), torque, None, start, solver=dfx.Tsit5(), substeps=2)
    np.testing.assert_allclose(marched(duffing(0.7), torque, None, start, dfx.Tsit5(), 2), slow, rtol=1e-12, atol=1e-12)


PATHS = ("mu", "omega_0", "alpha", "gain")
AT = np.array([MU, OMEGA_0, 0.7, GAIN, 0.5, -3.0])


def last_twist(values: Array, adjoint: dfx.AbstractAdjoint) -> Array:
    """A value that depends on every parameter and on the initial state."""
    model = duffing(0.7).replace(dict(zip(PATHS, values[:4], strict=True)))
    forcing = Harmonic(1500.0, 43.0)
    trajectory = simulate(model, forcing, TIMES, values[4:], rtol=1e-10, atol=1e-12, max_steps=4096, adjoint=adjoint)
    return trajectory.states[-1, 0] + trajectory.states[TIMES.size // 2, 0]


@jax.jit
def forward_gradient(values: Array) -> Array:
    return jax.jacfwd(lambda v: last_twist(v, dfx.ForwardMode()))(values)


@jax.jit
def reverse_gradients(values: Array) -> Array:
    return jax.vmap(jax.grad(lambda v: last_twist(v, dfx.RecursiveCheckpointAdjoint())))(values)


@jax.jit
def last_twists(values: Array) -> Array:
    return jax.vmap(lambda v: last_twist(v, dfx.ForwardMode()))(values)


def test_forward_and_reverse_gradients_agree_with_differences():
    h = 1e-4 * np.abs(AT)
    ends = np.asarray(last_twists(jnp.asarray(np.concatenate([AT + np.diag(h), AT - np.diag(h)]))))
    differences = (ends[:6] - ends[6:]) / (2 * h)
    # Relative to the value: simulation noise of 1e-10 over steps of 1e-4, and 1e-8 times third derivatives of up to
    # some (omega_0 t)^2 = 600 times the first.
    weight = np.abs(AT)
    assert np.abs(differences * weight).min() > 3e-3
    forward = forward_gradient(jnp.asarray(AT))
    np.testing.assert_allclose(forward * weight, differences * weight, atol=1e-4, rtol=1e-4)
    # In lanes: one that diverges does not affect the gradient of another.
    escaping = np.where(np.array(PATHS + ("x", "v")) == "alpha", -1.0, AT)
    reverse = reverse_gradients(jnp.asarray(np.stack([AT, escaping, 1.01 * AT])))
    assert not np.isfinite(float(last_twists(jnp.asarray(np.tile(escaping, (12, 1))))[0]))
    np.testing.assert_allclose(reverse[0], forward, rtol=1e-5)
    assert np.isfinite(np.asarray(reverse[2])).all()


def test_fixed_steps_have_the_order_of_the_solver():
    """Twice the steps, 2^5 times less error."""
    start = jnp.asarray([0.8, -11.0])
    exact = decay(TIMES - TIMES[0], 0.8, -11.0)
    errors = []
    for step in (STEP, STEP / 2):
        found = simulate(duffing(), constant(0.0), TIMES, start, step_size=step)
        errors.append(np.abs(found.dynamic_error - exact).max())
    assert errors[0] < 1e-4
    assert np.log2(errors[0] / errors[1]) == pytest.approx(5, abs=0.5)


def test_other_solver_agrees_with_the_closed_form():
    found = simulate(duffing(), constant(0.0), TIMES, START, solver=dfx.Dopri8(), **TIGHT)
    np.testing.assert_allclose(found.dynamic_error, decay(TIMES - TIMES[0], 1.5, 0.0), atol=1e-9)


def test_progress_is_shown_on_request_only(capsys):
    simulate(duffing(), constant(1.0), TIMES)
    silent = capsys.readouterr()
    assert silent.out == silent.err == ""
    simulate(duffing(), constant(1.0), TIMES, progress_meter=dfx.TextProgressMeter())
    shown = capsys.readouterr()
    assert "100" in shown.out + shown.err


def test_trajectory_has_consistent_fields():
    torque: PiecewisePolynomial = sampled(TIMES, rough(), hold="linear")
    found = simulate(duffing(), torque, TIMES, **TIGHT)
    np.testing.assert_array_equal(found.time, TIMES)
    assert found.states.shape == (TIMES.size, 2)
    np.testing.assert_allclose(found.states[0], REST, atol=1e-12)
    np.testing.assert_array_equal(found.dynamic_error, found.states[:, 0])


def test_dynamic_error_is_found_among_other_outputs():
    outputs = jnp.asarray(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    measured = ("motor_turn", "dynamic_error", "joint_torque")
    found = Trajectory(jnp.arange(2.0), outputs, outputs, jnp.asarray(0), measured)
    np.testing.assert_array_equal(found.dynamic_error, [2.0, 5.0])
    with pytest.raises(ValueError, match="the outputs are motor_turn; "):
        _ = Trajectory(jnp.arange(2.0), outputs, outputs[:, :1], jnp.asarray(0), measured[:1]).dynamic_error
