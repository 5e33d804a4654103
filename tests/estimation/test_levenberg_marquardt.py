"""Elimination by segments gives the steps and the minimum of dense least squares."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares

import rig
from fitting.estimation.arrow_system import normal_equations, project
from fitting.estimation.engines import residual_and_products
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import base_paths, free_parameters
from fitting.estimation.levenberg_marquardt import ArrowLevenbergMarquardt
from fitting.estimation.problem import initial_states
from fitting.estimation.residual import Blocks, Problem, Products, Unknowns, blocks, residual
from fitting.estimation.segments import cut
from fitting.estimation.solve import evaluate
from fitting.estimation.solve import solve as solve_by_steps

SEGMENTS, ROWS, PARAMETERS, STATES = 4, 11, 3, 2


def random_blocks(seed: int = 0) -> Blocks:
    random = np.random.default_rng(seed)
    # Columns of very different norm, as those of K and of an angle.
    by_parameter = random.normal(size=(SEGMENTS, ROWS, PARAMETERS)) * np.array([1e3, 1.0, 1e-4])
    by_state = random.normal(size=(SEGMENTS, ROWS, STATES)) * np.array([1e5, 1e-2])
    r = random.normal(size=(SEGMENTS, ROWS))
    gap = random.normal(size=(SEGMENTS, STATES)) * np.array([1e-5, 1e2])
    before_by_parameter = random.normal(size=(SEGMENTS, STATES, PARAMETERS)) * np.array([1e-2, 1e-5, 1e-9])
    before_by_state = 0.7 * np.array([[1.0, 1e-7], [1e7, 1.0]]) * random.normal(size=(SEGMENTS, STATES, STATES))
    leaves = (r, by_parameter, by_state, gap, before_by_parameter, before_by_state)
    return Blocks(*(jnp.asarray(leaf) for leaf in leaves))


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


APART = jnp.zeros(SEGMENTS, dtype=bool)
JOINED = jnp.asarray([False, True, True, False])


@eqx.filter_jit
def take_step(found: Blocks, damping, joined=APART) -> Unknowns:
    return normal_equations(Products.of(found), joined).step(damping)


def flat(step: Unknowns) -> np.ndarray:
    return np.concatenate([np.asarray(step.parameters), np.asarray(step.states).ravel()])


@pytest.mark.parametrize("damping", [0.0, 1e-3, 1.0, 1e4])
def test_step_equals_that_of_dense_least_squares(damping: float):
    found = random_blocks()
    jacobian, r = dense(found)
    # Damping relative to the diagonal: rows that hold each unknown in units of its own column.
    length = np.linalg.norm(jacobian, axis=0)
    rows = np.vstack([jacobian / length, np.sqrt(damping) * np.eye(length.size)])
    right = np.concatenate([-r, np.zeros(length.size)])
    expected = np.linalg.lstsq(rows, right, rcond=None)[0] / length
    step = flat(take_step(found, jnp.asarray(damping)))
    # Normal equations square the condition of the scaled columns (about 10), and solve_scaled adds 1e-13.
    np.testing.assert_allclose(step * length, expected * length, atol=1e-10)
    assert np.max(np.abs(step * length)) > (1e-3 if damping < 10 else 1e-5)


def test_other_unknowns_adapt_to_a_parameter_with_limited_step():
    found = random_blocks()
    jacobian, r = dense(found)
    free = flat(take_step(found, jnp.asarray(0.0)))
    longest = np.array([np.inf, 0.3 * abs(free[1]), np.inf])
    step = flat(normal_equations(Products.of(found), APART).step(jnp.asarray(0.0), jnp.asarray(longest)))
    assert step[1] == pytest.approx(0.3 * free[1])
    others = np.delete(np.arange(free.size), 1)
    length = np.linalg.norm(jacobian, axis=0)[others]
    expected = np.linalg.lstsq(jacobian[:, others] / length, -r - jacobian[:, 1] * step[1], rcond=None)[0]
    np.testing.assert_allclose(step[others] * length, expected, atol=1e-9)


def closed(found: Blocks) -> tuple[np.ndarray, np.ndarray]:
    """Rows and right-hand side of the conditions that close the gaps of joined segments."""
    rows, right = [], []
    for s in np.flatnonzero(JOINED):
        row = np.zeros((STATES, PARAMETERS + SEGMENTS * STATES))
        row[:, :PARAMETERS] = -found.before_by_parameter[s]
        row[:, PARAMETERS + (s - 1) * STATES :][:, :STATES] = -found.before_by_state[s]
        row[:, PARAMETERS + s * STATES :][:, :STATES] = np.eye(STATES)
        rows.append(row)
        right.append(-np.asarray(found.gap)[s])
    return np.concatenate(rows), np.concatenate(right)


def test_step_of_joined_segments_closes_gaps_with_least_residual():
    found = random_blocks()
    jacobian, r = dense(found)
    length = np.linalg.norm(jacobian, axis=0)
    condition, right = closed(found)
    condition = condition * (1 / length)
    # Reference: any solution of the conditions, and the best change in their null space.
    particular = np.linalg.lstsq(condition, right, rcond=None)[0]
    free = np.linalg.svd(condition)[2][len(right) :].T
    scaled = jacobian / length
    expected = particular + free @ np.linalg.lstsq(scaled @ free, -r - scaled @ particular, rcond=None)[0]
    step = flat(take_step(found, jnp.zeros(()), JOINED)) * length
    np.testing.assert_allclose(step, expected, atol=1e-8 * np.max(np.abs(expected)))


def test_large_damping_makes_the_step_of_joined_segments_small():
    step = take_step(random_blocks(), jnp.asarray(1e12), JOINED)
    assert np.max(np.abs(step.parameters)) < 1e-6
    assert np.max(np.abs(np.asarray(step.states) / np.array([1e-5, 1e2]))) < 1e-4


def test_projected_columns_are_orthogonal_to_those_of_initial_states():
    found = random_blocks()
    jacobian, _ = dense(found)
    condition, _ = closed(found)
    # Changes of the states alone that leave the gaps unchanged.
    states = np.linalg.svd(condition[:, PARAMETERS:])[2][condition.shape[0] :].T
    columns = np.asarray(project(found, JOINED)).reshape(-1, PARAMETERS)
    against = (jacobian[:, PARAMETERS:] @ states).T @ columns
    scale = np.linalg.norm(jacobian[:, PARAMETERS:] @ states, axis=0)[:, None] * np.linalg.norm(columns, axis=0)
    assert np.max(np.abs(against / scale)) < 1e-6


def test_unknowns_without_information_have_a_zero_step():
    found = random_blocks()
    blind = eqx.tree_at(
        lambda b: (b.by_parameter, b.by_state),
        found,
        (found.by_parameter.at[:, :, 1].set(0.0), found.by_state.at[2, :, 0].set(0.0)),
    )
    for damping in (0.0, 1e-3):
        step = take_step(blind, jnp.asarray(damping))
        assert float(step.parameters[1]) == 0.0
        assert float(step.states[2, 0]) == 0.0
        others = np.delete(flat(step), [1, PARAMETERS + 2 * STATES])
        assert np.isfinite(others).all()
        assert (others != 0).all()


def test_segment_without_weight_does_not_change_the_step():
    found = random_blocks()
    padded = jax.tree.map(lambda leaf: jnp.concatenate([leaf, jnp.zeros((1, *leaf.shape[1:]))]), found)
    wanted = take_step(found, jnp.asarray(1e-3))
    step = take_step(padded, jnp.asarray(1e-3), jnp.zeros(SEGMENTS + 1, dtype=bool))
    np.testing.assert_allclose(step.parameters, wanted.parameters, rtol=1e-10)
    np.testing.assert_array_equal(step.states[-1], 0.0)


@pytest.fixture(scope="module")
def small_problem() -> tuple[Problem, Unknowns]:
    """A noisy reduced log in four segments, and a start that is 10 % wrong."""
    experiment = rig.reduced_experiment(160, noise=2e-3)
    model = rig.reduced_model(omega_0=0.95 * rig.OMEGA_0, mu=6.0, alpha=0.0)
    segments = cut([Stretch(experiment, 0, 160)], 40)
    free = free_parameters(model, base_paths(model), {"alpha": 1.0})
    problem = Problem(model, free, segments, jnp.asarray([[1 / 2e-3]]), jnp.ones(4), jnp.ones(2), substeps=2)
    return problem, Unknowns(free.pack(model), initial_states(model, segments))


TIGHT: dict[str, float] = {"xtol": 1e-13, "ftol": 1e-13, "gtol": 1e-13}


def solve(problem: Problem, start: Unknowns) -> optx.Solution:
    joined, gap_weight = problem.segments.joined, problem.gap_weight
    rows = jnp.asarray(float(problem.segments.measured.size))
    return optx.least_squares(
        residual_and_products,
        ArrowLevenbergMarquardt(joined, gap_weight, jnp.asarray(1e-3), jnp.asarray(60), rows, rtol=1e-9),
        start,
        args=problem,
        has_aux=True,
        max_steps=None,
        throw=False,
    )


def assert_minimum_equals_that_of_peer(rows, found: np.ndarray, peer, unknowns: int):
    """Sum of squares, and unknowns in units of their standard errors."""
    assert np.sum(np.asarray(rows) ** 2) == pytest.approx(2 * peer.cost, rel=1e-9)
    spread = np.sqrt(np.diag(np.linalg.inv(peer.jac.T @ peer.jac)))
    # Much closer to each other than to the truth.
    np.testing.assert_allclose((found - peer.x) / spread, 0.0, atol=1e-3)
    assert 2 * peer.cost == pytest.approx(160 - unknowns, rel=0.4)


def test_normal_equations_of_a_diverged_simulation_are_finite(small_problem):
    problem, start = small_problem
    softening = start.parameters.at[2].set(-5.0)
    beyond = Unknowns(softening, start.states.at[1].set(jnp.asarray([3.0, 0.0])))
    found = eqx.filter_jit(blocks)(problem, beyond)
    assert np.max(np.abs(found.residual)) == 1e8
    system = normal_equations(Products.of(found), jnp.zeros(4, dtype=bool))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(system))


def test_diverged_segment_without_data_has_zero_residual(small_problem):
    problem, start = small_problem
    softening = start.parameters.at[2].set(-5.0)
    lost = Unknowns(softening, start.states.at[3].set(jnp.asarray([3.0, 0.0])))
    empty = eqx.tree_at(lambda p: p.segments.weight, problem, problem.segments.weight.at[3].set(0.0))
    found = eqx.filter_jit(blocks)(empty, lost)
    np.testing.assert_array_equal(found.residual[3], 0.0)
    np.testing.assert_array_equal(found.by_parameter[3], 0.0)
    assert np.isfinite(np.asarray(found.residual)).all()


def test_solver_of_separate_steps_reaches_the_minimum_of_the_compiled_loop(small_problem):
    problem, start = small_problem
    whole, stepped = solve(problem, start), solve_by_steps(problem, start, 60, 1e-3)
    assert stepped.success
    system = normal_equations(Products.of(eqx.filter_jit(blocks)(problem, whole.value)), problem.segments.joined)
    information, _, _, _ = system.eliminate(jnp.zeros(()), jnp.ones(()))
    spread = np.sqrt(np.diag(np.linalg.inv(np.asarray(information))))
    # It ends where the predicted decrease is below a thousandth of what one more parameter explains of noise.
    difference = np.asarray(stepped.unknowns.parameters - whole.value.parameters) / spread
    assert np.max(np.abs(difference)) < 0.05
    rows = np.asarray(residual(problem, stepped.unknowns)[0])
    np.testing.assert_allclose(np.sum(rows**2, axis=1), stepped.left_over.squares, rtol=1e-9)
    assert np.sum(rows**2) == pytest.approx(float(whole.state.rows), rel=1e-4)


def test_solver_reports_failure_when_its_steps_are_used_up(small_problem):
    problem, start = small_problem
    got = solve_by_steps(problem, start, 2, 1e-3)
    assert not got.success and got.steps == 2
    assert float(jnp.sum(got.left_over.squares)) < float(jnp.sum(evaluate(problem, start).squares))


def test_minimum_equals_that_of_scipy(small_problem):
    problem, start = small_problem
    segments, states = start.states.shape
    run = eqx.filter_jit(residual)
    jacobian = eqx.filter_jit(blocks)

    def unflatten(y: np.ndarray) -> Unknowns:
        return Unknowns(jnp.asarray(y[:4]), jnp.asarray(y[4:].reshape(segments, states)))

    peer = least_squares(
        lambda y: np.asarray(run(problem, unflatten(y))[0]).ravel(),
        flat(start),
        jac=lambda y: dense(jacobian(problem, unflatten(y)))[0],
        x_scale="jac",
        **TIGHT,
    )
    solution = solve(problem, start)
    assert solution.result == optx.RESULTS.successful
    # The start was far: hundreds of times the final sum of squares.
    assert np.sum(np.asarray(run(problem, start)[0]) ** 2) > 20 * 2 * peer.cost
    assert_minimum_equals_that_of_peer(run(problem, solution.value)[0], flat(solution.value), peer, flat(start).size)


def test_minimum_of_joined_segments_equals_that_of_one_simulation(small_problem):
    problem, start = small_problem
    joined = eqx.tree_at(lambda p: p.segments.joined, problem, jnp.asarray([False, True, True, True]))
    joined = eqx.tree_at(lambda p: p.gap_weight, joined, 3.0 / 2e-3 / jnp.asarray([1.0, rig.OMEGA_0]))
    whole = cut([Stretch(rig.reduced_experiment(160, noise=2e-3), 0, 160)], 160)
    single = eqx.tree_at(lambda p: p.segments, problem, whole)
    run = eqx.filter_jit(residual)

    def unflatten(y: np.ndarray) -> Unknowns:
        return Unknowns(jnp.asarray(y[:4]), jnp.asarray(y[None, 4:]))

    peer = least_squares(
        lambda y: np.asarray(run(single, unflatten(y))[0]).ravel(),
        np.concatenate([np.asarray(start.parameters), np.asarray(start.states)[0]]),
        x_scale="jac",
        jac="3-point",
        **TIGHT,
    )
    solution = solve(joined, start)
    assert solution.result == optx.RESULTS.successful
    rows, gap = run(joined, solution.value)
    np.testing.assert_allclose(np.asarray(gap) * np.asarray(joined.gap_weight), 0.0, atol=1e-9)
    # Also from the segments' own minima, with gap weights so small that closing the gaps raises the objective.
    light = eqx.tree_at(lambda p: p.gap_weight, joined, 0.1 * joined.gap_weight)
    closed = solve(light, solve(problem, start).value)
    assert closed.result == optx.RESULTS.successful
    np.testing.assert_allclose(closed.value.parameters, solution.value.parameters, rtol=1e-6)
    found = np.concatenate([np.asarray(solution.value.parameters), np.asarray(solution.value.states)[0]])
    assert_minimum_equals_that_of_peer(rows, found, peer, found.size)


def test_gaps_close_where_a_model_cannot_follow_the_log(small_problem):
    """Separate segments then fit far better than one simulation."""
    problem, start = small_problem
    wrong = start.parameters.at[0].set(jnp.log(0.6 * rig.OMEGA_0))
    held = eqx.tree_at(lambda p: p.active, problem, jnp.zeros_like(problem.active))
    joined = eqx.tree_at(lambda p: p.segments.joined, held, jnp.asarray([False, True, True, True]))
    joined = eqx.tree_at(lambda p: p.gap_weight, joined, 0.1 / 2e-3 / jnp.asarray([1.0, rig.OMEGA_0]))
    whole = cut([Stretch(rig.reduced_experiment(160, noise=2e-3), 0, 160)], 160)
    single = eqx.tree_at(lambda p: p.segments, held, whole)
    apart, one = Unknowns(wrong, start.states), Unknowns(wrong, start.states[:1])
    separate, expected = (solve_by_steps(*pair, 60, 1e-3) for pair in ((held, apart), (single, one)))
    found = solve_by_steps(joined, separate.unknowns, 60, 1e-3)
    assert found.success and np.sum(expected.left_over.squares) > 3.0 * np.sum(separate.left_over.squares)
    assert np.sum(found.left_over.squares) == pytest.approx(np.sum(expected.left_over.squares), rel=1e-3)
