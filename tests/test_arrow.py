"""Elimination by segments takes the same steps as dense least squares, to the same minimum."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares

import rig
from fitting.arrow import ArrowLevenbergMarquardt, normal_equations
from fitting.estimate import initial_states
from fitting.experiment import Stretch, cut
from fitting.free import base_paths, free_parameters
from fitting.residual import Blocks, Problem, Unknowns, blocks, residual, residual_with_blocks

SEGMENTS, ROWS, PARAMETERS, STATES = 4, 11, 3, 2


def random_blocks(seed: int = 0) -> Blocks:
    random = np.random.default_rng(seed)
    # Columns of very different length, as those of K and of an angle.
    by_parameter = random.normal(size=(SEGMENTS, ROWS, PARAMETERS)) * np.array([1e3, 1.0, 1e-4])
    by_state = random.normal(size=(SEGMENTS, ROWS, STATES)) * np.array([1e5, 1e-2])
    r = random.normal(size=(SEGMENTS, ROWS))
    return Blocks(jnp.asarray(r), jnp.asarray(by_parameter), jnp.asarray(by_state))


def dense(found: Blocks) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian and residual with all columns: the parameters, then each segment's states."""
    segments, rows, parameters = found.by_parameter.shape
    states = found.by_state.shape[2]
    jacobian = np.zeros((segments * rows, parameters + segments * states))
    jacobian[:, :parameters] = np.asarray(found.by_parameter).reshape(-1, parameters)
    for s in range(segments):
        columns = parameters + s * states + np.arange(states)
        jacobian[s * rows : (s + 1) * rows, columns] = found.by_state[s]
    return jacobian, np.asarray(found.residual).ravel()


@eqx.filter_jit
def take_step(found: Blocks, damping) -> Unknowns:
    return normal_equations(found).step(damping)


def flat(step: Unknowns) -> np.ndarray:
    return np.concatenate([np.asarray(step.parameters), np.asarray(step.states).ravel()])


@pytest.mark.parametrize("damping", [0.0, 1e-3, 1.0, 1e4])
def test_the_step_is_that_of_dense_least_squares(damping: float):
    found = random_blocks()
    jacobian, r = dense(found)
    # Damping relative to the diagonal: rows that hold each unknown in units of its own column.
    length = np.linalg.norm(jacobian, axis=0)
    rows = np.vstack([jacobian / length, np.sqrt(damping) * np.eye(length.size)])
    right = np.concatenate([-r, np.zeros(length.size)])
    expected = np.linalg.lstsq(rows, right, rcond=None)[0] / length
    step = flat(take_step(found, jnp.asarray(damping)))
    # Normal equations square the condition of the scaled columns (about 10), and _solve_scaled adds 1e-13.
    np.testing.assert_allclose(step * length, expected * length, atol=1e-10)
    assert np.max(np.abs(step * length)) > (1e-3 if damping < 10 else 1e-5)


def test_a_direction_without_information_does_not_move():
    found = random_blocks()
    blind = Blocks(found.residual, found.by_parameter.at[:, :, 1].set(0.0), found.by_state.at[2, :, 0].set(0.0))
    for damping in (0.0, 1e-3):
        step = take_step(blind, jnp.asarray(damping))
        assert float(step.parameters[1]) == 0.0
        assert float(step.states[2, 0]) == 0.0
        others = np.delete(flat(step), [1, PARAMETERS + 2 * STATES])
        assert np.isfinite(others).all()
        assert (others != 0).all()


def test_a_segment_without_weight_does_not_matter():
    found = random_blocks()
    padded = Blocks(*(jnp.concatenate([leaf, jnp.zeros((1, *leaf.shape[1:]))]) for leaf in leaves(found)))
    step, wanted = (take_step(b, jnp.asarray(1e-3)) for b in (padded, found))
    np.testing.assert_allclose(step.parameters, wanted.parameters, rtol=1e-10)
    np.testing.assert_array_equal(step.states[-1], 0.0)


def leaves(found: Blocks):
    return found.residual, found.by_parameter, found.by_state


@pytest.fixture(scope="module")
def small() -> tuple[Problem, Unknowns]:
    """A noisy reduced log in four segments, and a start that is 10 % wrong."""
    experiment = rig.reduced_experiment(160, noise=2e-3)
    model = rig.reduced_model(omega_0=0.95 * rig.OMEGA_0, mu=6.0, alpha=0.0)
    segments = cut([Stretch(experiment, 0, 160)], 40)
    free = free_parameters(model, base_paths(model), {"alpha": 1.0})
    problem = Problem(model, free, segments, jnp.asarray([[1 / 2e-3]]), jnp.ones(4), substeps=2)
    return problem, Unknowns(free.pack(model), initial_states(model, segments))


def test_the_minimum_is_that_of_scipy(small):
    problem, start = small
    segments, states = start.states.shape
    run = eqx.filter_jit(residual)
    jacobian = eqx.filter_jit(blocks)

    def unflatten(y: np.ndarray) -> Unknowns:
        return Unknowns(jnp.asarray(y[:4]), jnp.asarray(y[4:].reshape(segments, states)))

    peer = least_squares(
        lambda y: np.asarray(run(problem, unflatten(y))).ravel(),
        flat(start),
        jac=lambda y: dense(jacobian(problem, unflatten(y)))[0],
        x_scale="jac",
        xtol=1e-13,
        ftol=1e-13,
        gtol=1e-13,
    )
    solution = optx.least_squares(
        residual_with_blocks,
        ArrowLevenbergMarquardt(rtol=1e-8, atol=1e-8),
        start,
        args=problem,
        max_steps=60,
        throw=False,
    )
    assert solution.result == optx.RESULTS.successful
    found = flat(solution.value)
    # The start was far: hundreds of times the final sum of squares.
    assert np.sum(np.asarray(run(problem, start)) ** 2) > 20 * 2 * peer.cost
    rows = np.asarray(run(problem, solution.value))
    assert np.sum(rows**2) == pytest.approx(2 * peer.cost, rel=1e-9)
    spread = np.sqrt(np.diag(np.linalg.inv(peer.jac.T @ peer.jac)))
    # Much closer to each other than to the truth.
    np.testing.assert_allclose((found - peer.x) / spread, 0.0, atol=1e-3)
    assert 2 * peer.cost == pytest.approx(160 - found.size, rel=0.4)
