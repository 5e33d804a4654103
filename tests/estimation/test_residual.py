"""The residual is zero at the truth, and its Jacobian equals finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation.engines import residual_with_blocks
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import base_paths, effect_paths, free_parameters
from fitting.estimation.residual import Problem, Unknowns, blocks, residual, simulate_segments
from fitting.estimation.segments import cut
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.hysteresis import BoucWen
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.load import GravityLoad

COUNT, LENGTH = 100, 40  # three segments, the last one half padding
WHITENING = jnp.asarray([[1e5, 0.0], [-3e4, 1e6]])


def problem_of(experiment, model, paths, *, length=LENGTH, substeps=1, halo=0) -> Problem:
    segments = cut([Stretch(experiment, 0, len(experiment))], length, halo=halo)
    outputs = segments.measured.shape[-1]
    whitening = WHITENING if outputs == 2 else jnp.asarray([[1e4]])
    free = free_parameters(model, paths, {"alpha": 2e4})
    gap_weight = jnp.ones(len(model.state_names))
    return Problem(model, free, segments, whitening, jnp.ones(len(paths)), gap_weight, substeps=substeps)


def output_error(problem: Problem, unknowns: Unknowns) -> jnp.ndarray:
    """Measured minus simulated outputs, zero on padding."""
    outputs, _ = simulate_segments(problem, unknowns)
    return (problem.segments.measured - outputs) * problem.segments.weight[:, :, None]


def first_states(motion: np.ndarray, length: int = LENGTH) -> jnp.ndarray:
    return jnp.asarray(motion[::length])


def test_residual_of_a_reduced_log_is_zero_at_the_truth():
    forcing = rig.reduced_forcing(COUNT)
    experiment = rig.reduced_experiment(COUNT)
    model = rig.reduced_model()
    problem = problem_of(experiment, model, base_paths(model), substeps=8)
    truth = Unknowns(problem.free.pack(model), first_states(rig.reduced_motion(forcing)))
    error = np.asarray(output_error(problem, truth))
    # Both solvers turn omega_0 h = 0.045 a step: the rig's errs by some 1e-7 of the twist over the record.
    assert np.max(np.abs(error)) < 1e-6 * np.max(np.abs(experiment.measured))


def test_simulation_stops_after_the_last_sample_with_weight():
    """With the later samples masked, the simulation stops early and weighted samples keep their residual.

    Joined segments are simulated to their ends.
    """
    model = rig.reduced_model()
    whole = problem_of(rig.reduced_experiment(COUNT), model, base_paths(model), substeps=2)
    start = Unknowns(whole.free.pack(model), first_states(rig.reduced_motion(rig.reduced_forcing(COUNT))))
    mask = (jnp.arange(LENGTH) < 11).astype(float)[None, :]
    masked = eqx.tree_at(lambda p: p.segments.weight, whole, whole.segments.weight * mask)
    joined = eqx.tree_at(lambda p: p.segments.joined, masked, jnp.asarray([False, True, True]))
    rows = np.asarray(masked.segments.weight) > 0
    full, part, gaps = (blocks(p, start) for p in (whole, masked, joined))
    for name in ("residual", "by_parameter", "by_state"):
        wanted = np.where(rows.reshape(*rows.shape, *[1] * (getattr(full, name).ndim - 2)), getattr(full, name), 0.0)
        np.testing.assert_allclose(getattr(part, name), wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())
    _, end = simulate_segments(whole, start)
    np.testing.assert_allclose(gaps.gap[1:], start.states[1:] - end[:-1], rtol=1e-12)
    _, stopped = simulate_segments(whole, start, jnp.asarray(10))
    # The state stays constant after the last weighted sample, unlike the full simulation.
    assert np.abs(np.asarray(stopped - end)).max() > 1e-3 * np.abs(np.asarray(end)).max()


PHYSICS = {"mesh_friction": (0.8, 0.05), "torque_bias": 0.03, "kinematic": (1.5e-4, -1e-4), "gravity": 2.0}
EFFECTS = (
    CoulombFriction(T_c=0.8, v_0=0.05),
    TorqueBias(bias=0.03),
    KinematicError(cos_2=1.5e-4, sin_2=-1e-4),
    GravityLoad(sine=2.0),
)


def test_residual_of_a_drive_with_several_effects_is_zero_at_the_truth():
    start = (0.5, 0.009, 10.0, 0.3)
    torque = rig.drive_torque(COUNT)
    motion = rig.drive_motion(torque, state=start, substeps=12, **PHYSICS)
    experiment = rig.drive_experiment(COUNT, noise=0.0, state=start, substeps=12, **PHYSICS)
    model = rig.drive_model().with_effects(*EFFECTS)
    problem = problem_of(experiment, model, ("K",), substeps=4)
    truth = Unknowns(problem.free.pack(model), first_states(motion))
    error = np.asarray(output_error(problem, truth))
    assert error.shape == (3, LENGTH, 2)
    twist = np.max(np.abs(experiment.measured[:, 1]))
    assert np.max(np.abs(error)) < 1e-6 * twist
    # The padding is simulated, but has no error.
    assert (error[2, 20:] == 0).all()
    wrong = eqx.tree_at(lambda u: u.parameters, truth, truth.parameters + 0.01)
    assert np.max(np.abs(output_error(problem, wrong))) > 1e-4 * twist


@pytest.fixture(scope="module")
def drive_problem() -> tuple[Problem, Unknowns]:
    """A drive with two effects, one of which has a hidden state, away from any optimum."""
    experiment = rig.drive_experiment(COUNT)
    effects = (CoulombFriction(T_c=0.5, v_0=0.1), BoucWen(k=900.0, memory_twist=4e-4, n=1.5))
    model = rig.drive_model(K=6500.0, alpha=1e4).with_effects(*effects)
    paths = base_paths(model) + effect_paths(effects[0]) + effect_paths(effects[1])
    problem = problem_of(experiment, model, paths, halo=2)
    motion = rig.drive_motion(rig.drive_torque(COUNT))[::LENGTH]
    z = np.array([[1e-4], [-2e-4], [0.5e-4]])
    states = motion + np.array([1e-3, -3e-5, 0.1, 1e-3])
    return problem, Unknowns(problem.free.pack(model), jnp.asarray(np.hstack([states, z])))


@pytest.fixture(scope="module")
def drive_blocks(drive_problem):
    return eqx.filter_jit(blocks)(*drive_problem)


_residual = eqx.filter_jit(residual)


def difference(problem: Problem, unknowns: Unknowns, change: Unknowns, step: float = 1e-6, part: int = 0) -> np.ndarray:
    """Central difference of the residual or of the gaps. The step is small because the derivative of |v| in the
    hysteresis jumps."""
    up, down = (
        _residual(problem, jax.tree.map(lambda u, c, s=s: u + s * step * c, unknowns, change))[part] for s in (1, -1)
    )
    return (np.asarray(up) - np.asarray(down)) / (2 * step)


def assert_column(found, expected):
    """Without the prior's row, whose scale is taken as fixed."""
    found, expected = np.asarray(found)[:, :-1], expected[:, :-1]
    # Residuals of some 1e3 are rounded to 1e-13, over the step 1e-6 that is 1e-7; the jump adds as much.
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.max(np.abs(expected)))
    assert np.max(np.abs(expected)) > 0


def test_jacobian_by_parameter_equals_central_differences(drive_problem, drive_blocks):
    problem, unknowns = drive_problem
    count = unknowns.parameters.size
    assert count == 8
    for i in range(count):
        change = Unknowns(jnp.eye(count)[i], jnp.zeros_like(unknowns.states))
        expected = difference(problem, unknowns, change)
        assert_column(drive_blocks.by_parameter[:, :, i], expected)


def test_jacobian_by_initial_state_equals_central_differences(drive_problem, drive_blocks):
    problem, unknowns = drive_problem
    scale = np.array([1e-1, 2e-3, 5.0, 0.1, 1e-4])
    for i in range(5):
        own = np.zeros(unknowns.states.shape)
        own[:, i] = scale[i]
        expected = difference(problem, unknowns, Unknowns(jnp.zeros(8), jnp.asarray(own)))
        assert_column(drive_blocks.by_state[:, :, i] * scale[i], expected)


def test_residual_of_a_segment_depends_only_on_its_initial_state(drive_problem):
    problem, unknowns = drive_problem
    moved = eqx.tree_at(lambda u: u.states, unknowns, unknowns.states.at[1].add(jnp.asarray([0, 1e-4, 0, 0, 0.0])))
    changed = np.any(np.asarray(_residual(problem, moved)[0]) != np.asarray(_residual(problem, unknowns)[0]), axis=1)
    np.testing.assert_array_equal(changed, [False, True, False])


def test_hidden_states_have_a_prior(drive_problem, drive_blocks):
    _, unknowns = drive_problem
    rows = np.asarray(drive_blocks.residual)
    assert rows.shape == (3, 2 * LENGTH + 1)
    np.testing.assert_allclose(rows[:, -1], unknowns.states[:, 4] / 4e-4, rtol=1e-12)
    np.testing.assert_allclose(drive_blocks.by_state[:, -1, 4], 1 / 4e-4, rtol=1e-12)
    assert (np.asarray(drive_blocks.by_parameter)[:, -1] == 0).all()


def test_jvp_of_the_residual_is_a_product_with_its_blocks(drive_problem, drive_blocks):
    problem, unknowns = drive_problem
    random = np.random.default_rng(3)
    change = Unknowns(
        jnp.asarray(random.normal(size=8)),
        jnp.asarray(random.normal(size=(3, 5)) * np.array([1e-1, 2e-3, 5.0, 0.1, 1e-4])),
    )
    value, slope = eqx.filter_jit(lambda p, u, c: jax.jvp(lambda w: residual_with_blocks(w, p), (u,), (c,)))(
        problem, unknowns, change
    )
    np.testing.assert_allclose(value.rows, _residual(problem, unknowns)[0], rtol=1e-12)
    expected = np.einsum("srp,p->sr", drive_blocks.by_parameter, change.parameters)
    expected += np.einsum("srq,sq->sr", drive_blocks.by_state, change.states)
    np.testing.assert_allclose(slope.rows, expected, atol=1e-9 * np.max(np.abs(expected)))
    assert_column(slope.rows, difference(problem, unknowns, change))


@pytest.fixture(scope="module")
def joined(drive_problem) -> tuple[Problem, Unknowns]:
    """The second and third segments are joined to the one before, with gaps between them."""
    problem, unknowns = drive_problem
    segments = eqx.tree_at(lambda s: s.joined, problem.segments, jnp.asarray([False, True, True]))
    weight = jnp.asarray([1e2, 1e5, 1.0, 1e2, 1e3])
    return eqx.tree_at(lambda p: (p.segments, p.gap_weight), problem, (segments, weight)), unknowns


def test_gap_is_the_start_minus_the_end_of_the_previous_segment(joined, drive_blocks):
    problem, unknowns = joined
    rows, gap = (np.asarray(part) for part in _residual(problem, unknowns))
    np.testing.assert_array_equal(gap[0], 0.0)
    # One long segment passes the second start where the first segment ends.
    experiment = rig.drive_experiment(COUNT)
    whole = cut([Stretch(experiment, 0, COUNT)], COUNT, halo=2)
    single = eqx.tree_at(lambda p: p.segments, problem, whole)
    through = np.asarray(output_error(single, eqx.tree_at(lambda u: u.states, unknowns, unknowns.states[:1])))
    measured = np.asarray(whole.measured)[0, LENGTH]
    N = float(problem.model.drive.N)
    start = np.asarray(unknowns.states)[1]
    outputs = np.array([start[0] / N, start[0] / N - start[1]])
    moved = np.array([gap[1, 0] / N, gap[1, 0] / N - gap[1, 1]])
    np.testing.assert_allclose(outputs - (measured - through[0, LENGTH]), moved, rtol=1e-9)
    # Joined segments inherit their hidden states: only the first has a prior.
    np.testing.assert_array_equal(rows[1:, -1], 0.0)
    np.testing.assert_allclose(rows[0], np.asarray(drive_blocks.residual)[0], rtol=1e-12)


def test_jacobian_of_gaps_equals_central_differences(joined):
    problem, unknowns = joined
    found = eqx.filter_jit(blocks)(problem, unknowns)
    scale = np.array([1e-1, 2e-3, 5.0, 0.1, 1e-4])
    for i in range(8):
        change = Unknowns(jnp.eye(8)[i], jnp.zeros_like(unknowns.states))
        expected = -difference(problem, unknowns, change, part=1) / scale
        slopes = np.asarray(found.before_by_parameter)[:, :, i] / scale
        np.testing.assert_allclose(slopes, expected, atol=1e-5 * np.max(np.abs(expected)))
    for i in range(5):
        # Only the first segment moves: the gap behind it shows its end.
        own = np.zeros(unknowns.states.shape)
        own[0, i] = scale[i]
        expected = -difference(problem, unknowns, Unknowns(jnp.zeros(8), jnp.asarray(own)), part=1) / scale
        slopes = np.asarray(found.before_by_state)[1, :, i] * scale[i] / scale
        np.testing.assert_allclose(slopes, expected[1], atol=1e-5 * np.max(np.abs(expected)))
    assert (np.asarray(found.before_by_state)[0] == 0).all()


def test_jvp_of_weighted_gaps_equals_central_differences(joined):
    problem, unknowns = joined
    random = np.random.default_rng(4)
    scale = np.array([1e-1, 2e-3, 5.0, 0.1, 1e-4])
    change = Unknowns(jnp.asarray(random.normal(size=8)), jnp.asarray(random.normal(size=(3, 5)) * scale))
    value, slope = eqx.filter_jit(lambda p, u, c: jax.jvp(lambda w: residual_with_blocks(w, p), (u,), (c,)))(
        problem, unknowns, change
    )
    weight = np.asarray(problem.gap_weight)
    np.testing.assert_allclose(value.gap, np.asarray(_residual(problem, unknowns)[1]) * weight, rtol=1e-12)
    expected = difference(problem, unknowns, change, part=1) * weight
    np.testing.assert_allclose(slope.gap, expected, atol=1e-5 * np.max(np.abs(expected)))


def test_padding_does_not_change_the_residual_or_its_jacobian(drive_problem, drive_blocks):
    problem, unknowns = drive_problem
    measured = problem.segments.measured.at[2, 20:].add(7.0)
    spoiled = eqx.tree_at(lambda p: p.segments.measured, problem, measured)
    found = eqx.filter_jit(blocks)(spoiled, unknowns)
    np.testing.assert_array_equal(found.residual, drive_blocks.residual)
    assert (np.asarray(drive_blocks.by_parameter)[2, 40:80] == 0).all()
    assert (np.asarray(drive_blocks.residual)[2, 40:80] == 0).all()


def test_jacobian_column_of_an_inactive_parameter_is_zero(drive_problem, drive_blocks):
    problem, unknowns = drive_problem
    held = eqx.tree_at(lambda p: p.active, problem, problem.active.at[1].set(0.0))
    found = eqx.filter_jit(blocks)(held, unknowns)
    assert (np.asarray(found.by_parameter)[:, :, 1] == 0).all()
    np.testing.assert_array_equal(found.by_parameter[:, :, 2], drive_blocks.by_parameter[:, :, 2])


def test_diverged_simulation_has_a_large_finite_residual(drive_problem):
    problem, unknowns = drive_problem
    lost = eqx.tree_at(lambda u: u.states, unknowns, unknowns.states.at[0].set(jnp.inf))
    found = eqx.filter_jit(blocks)(problem, lost)
    for leaf in jax.tree.leaves((found.residual[:, :-1], found.by_parameter, found.by_state, found.gap)):
        assert np.isfinite(leaf).all()
    assert np.max(np.abs(found.residual[0, :-1])) >= 1e8
    np.testing.assert_allclose(found.residual[1], _residual(problem, unknowns)[0][1], rtol=1e-9)
