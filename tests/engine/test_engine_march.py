"""The march by machine code against that by XLA: data, ways of calling, and diverging segments."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_engine_equations import models

import rig
from fitting.estimation.engines import linearise, residual_at, residual_with_blocks, simulate, with_engine
from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.free_parameters import fitted_paths, free_parameters
from fitting.estimation.machine_code import _gap, lanes_of, task
from fitting.estimation.residual import LOST, Blocks, Problem, Products, Unknowns, blocks
from fitting.estimation.segments import cut
from hdjax import Hold, Model, ReducedDrive, ReducedModel, TwoInertiaModel, sampled
from hdjax.effects import CATALOGUE, DryFriction
from hdjax.effects.effect import MeshTorqueEffect, Motion
from hdjax.effects.learned_memory import LEARNED_WITH_MEMORY
from hdjax.engine import march_lanes
from hdjax.engine.kernel import march_arrays
from hdjax.parameters import Scalar, parameter
from hdjax.signals import HOLDS

COUNT, LENGTH, HALO = 330, 32, 3  # eleven segments: a whole block, and one that is not full; the last is part padding
FIELDS = tuple(f.name for f in dataclasses.fields(Blocks))
SETTINGS = np.arange(3)
SUBSTEPS, WHOLE, THREADS = SETTINGS


def experiment(
    model: Model, *, hold: Hold = "zero-order", loaded: bool = False, warm: bool = False, jitter: float = 0.0
) -> Experiment:
    """A log of a base drive; its signals need not be consistent for two engines to agree."""
    random = np.random.default_rng(5)
    torque = rig.drive_torque(COUNT)
    stamps = rig.STEP * (np.arange(COUNT) + jitter * random.uniform(-1, 1, COUNT))
    if isinstance(model, TwoInertiaModel):
        motion = rig.drive_motion(torque, state=(0.5, 0.009, 10.0, 0.3), substeps=2)
        measured = np.stack([motion[:, 0] / rig.N, motion[:, 0] / rig.N - motion[:, 1]], axis=1)
    else:
        forcing = rig.reduced_forcing(COUNT)
        torque, measured = forcing, rig.reduced_motion(forcing, step=rig.STEP)[:, :1]
    smooth = np.cumsum(random.normal(size=COUNT))
    load = sampled(stamps, 0.3 * smooth, hold="linear") if loaded else None
    warmth = sampled(stamps, 303.0 + smooth, hold="linear") if warm else None
    return Experiment("log", stamps, sampled(stamps, torque, hold=hold), load, measured, None, temperature=warmth)


def problem_of(
    model: Model, *, joined: bool = False, substeps: int = 1, missing: float = 0.0, **data
) -> tuple[Problem, Unknowns]:
    """A fitting problem away from its optimum, with random initial states."""
    record = experiment(model, **data)
    segments = cut([Stretch(record, 0, len(record))], LENGTH, halo=HALO)
    random = np.random.default_rng(7)
    count = len(segments.joined)
    if joined:
        segments = eqx.tree_at(lambda s: s.joined, segments, jnp.arange(count) % 4 != 0)
    keep = random.uniform(size=segments.weight.shape) >= missing
    segments = eqx.tree_at(lambda s: s.weight, segments, segments.weight * keep.astype(float))
    outputs, paths = segments.measured.shape[-1], fitted_paths(model)
    whitening = jnp.asarray([[1e5, 0.0], [-3e4, 1e6]])[:outputs, :outputs]
    free = free_parameters(model, paths, {"alpha": 2e4})
    states = np.asarray(segments.measured)[:, 0]
    if isinstance(model, TwoInertiaModel):
        rates = random.normal(size=(count, 2)) * [5.0, 0.1]
        motion = np.stack([rig.N * states[:, 0], states[:, 0] - states[:, 1], *rates.T], axis=1)
    else:
        motion = np.stack([states[:, 0], 30.0 * random.normal(size=count)], axis=1)
    own = jax.vmap(model.settled)(jnp.asarray(motion))
    scale = np.concatenate([np.zeros(motion.shape[1]), *(e.state_scale() for e in model.effects if e.states)])
    unknowns = Unknowns(free.pack(model), own + 0.2 * scale * random.normal(size=own.shape))
    active = jnp.asarray(np.ones(len(paths)))
    gap_weight = jnp.asarray(np.ones(own.shape[1]))
    return Problem(model, free, segments, whitening, active, gap_weight, substeps=substeps), unknowns


_blocks_by_xla = eqx.filter_jit(blocks)


def relative_differences(problem: Problem, unknowns: Unknowns) -> dict[str, np.ndarray]:
    """Differences of machine code from XLA, each relative to the largest value of its column."""
    wanted, found = _blocks_by_xla(problem, unknowns), linearise(with_engine(problem), unknowns)
    result = {}
    for name in FIELDS:
        ours, theirs = (np.asarray(getattr(b, name)) for b in (found, wanted))
        assert ours.shape == theirs.shape and np.isfinite(ours).all()
        size = np.max(np.abs(theirs), axis=(0, 1) if theirs.ndim == 3 else None, keepdims=True, initial=0.0)
        if name == "before_by_state":
            # It is the identity at the segment's start: errors of a decayed state are relative to one.
            size = np.maximum(size, 1.0)
        result[name] = np.abs(ours - theirs) / np.where(size > 0, size, 1.0)
    return result


def is_steep(model: Model) -> bool:
    """Whether slopes change so fast that they depend on the rounding of a state.

    They do where a drive comes to rest within a step, at the edge of a gap, and in a learned function whose knots are
    dense near standstill.
    """
    axes = (axis for effect in model.effects for axis in getattr(effect, "axes", ()))
    dense = any(getattr(axis, "bend", None) is not None for axis in axes)
    return dense or any(isinstance(e, DryFriction) or e.family == "backlash" for e in model.effects)


def assert_agreement(problem: Problem, unknowns: Unknowns):
    """Of all samples but the few that rounding may move across a corner."""
    found = relative_differences(problem, unknowns)
    bounds = {name: 1e-9 if "by" in name and is_steep(problem.model) else 1e-12 for name in FIELDS}
    off = {name: int(np.sum(d > bounds[name])) for name, d in found.items()}
    total = {name: max(d.size, 1) for name, d in found.items()}
    worst = {name: float(d.max(initial=0.0)) for name, d in found.items()}
    assert all(off[n] <= max(5, 1e-3 * total[n]) for n in FIELDS), f"{off} of {total}, worst {worst}"


TYPICAL = {
    "kinematic_error": {"loaded": True, "joined": True, "substeps": 2, "hold": "band-limited"},
    "motor_friction": {"jitter": 0.2, "missing": 0.3},
    "maxwell_slip": {"joined": True, "hold": "linear"},
    "input_delay": {"loaded": True, "hold": "cubic", "jitter": 0.1},
    "joint torque read late": {"loaded": True, "warm": True, "hold": "cubic", "jitter": 0.1},
    "learned_mesh_torque of SplineAxis(x) x SplineAxis(v)": {"substeps": 2},
    "learned_mesh_torque of SignAxis(v) x AngleAxis(theta_m)": {"joined": True, "hold": "linear"},
}
# The equations of these are compared in test_engine_equations.py, and their holds beside others here.
LONG = ("maxwell_slip", "input_delay", "learned_mesh_torque of SplineAxis(x) x SplineAxis(v)")


# A corner that no step resolves: the drive comes to rest within one step.
SHARP = {"motor_friction.transition": 2e-3, "motor_friction.T_c": 0.1}


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in TYPICAL])
def test_march_of_typical_models_agrees_with_xla(name: str):
    model = models()[name]
    model = model.replace({path: value for path, value in SHARP.items() if path in model.parameters()})
    assert_agreement(*problem_of(model, **TYPICAL[name]))


@pytest.mark.slow
@pytest.mark.parametrize("loaded", [False, True])
@pytest.mark.parametrize("name", models())
def test_march_of_every_effect_agrees_with_xla(name: str, loaded: bool):
    model = models()[name]
    if loaded and isinstance(model, ReducedModel):
        pytest.skip("a reduced drive has no load torque")
    warm = any(e.needs_temperature for e in model.effects) or loaded
    assert_agreement(*problem_of(model, loaded=loaded, warm=warm, joined=loaded, substeps=2 if loaded else 1))


@pytest.mark.slow
@pytest.mark.parametrize("jitter", [0.0, 0.2])
@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("name", ["stribeck_motor_friction", "input_delay", "input_lag", "several at once"])
def test_march_under_every_hold_agrees_with_xla(name: str, hold: Hold, jitter: float):
    assert_agreement(*problem_of(models()[name], hold=hold, jitter=jitter, joined=True, missing=0.1))


def test_every_effect_of_the_catalogue_is_compared():
    named = set(models())
    assert {form.name for form in (*CATALOGUE, *LEARNED_WITH_MEMORY)} <= named


@pytest.mark.parametrize("name", ["dahl_motor_friction", "lugre_load_friction"])
def test_derivatives_of_the_prior_rows_agree_with_differences(name: str):
    """Expected hidden states may depend on parameters, which change by their logarithm."""
    problem, unknowns = problem_of(models()[name])
    ready = with_engine(problem)
    index = problem.free.paths.index(f"{name}.bend")
    step = 1e-6

    def rows(by: float) -> np.ndarray:
        moved = eqx.tree_at(lambda u: u.parameters, unknowns, unknowns.parameters.at[index].add(by))
        effect = problem.free.unpack(problem.model, moved.parameters).effects[-1]
        return np.asarray(linearise(ready, moved).residual)[:, 2 * LENGTH :] * np.asarray(effect.state_scale())

    # The prior's width is taken as fixed.
    wanted = (rows(step) - rows(-step)) / (2 * step) / np.asarray(problem.model.effects[-1].state_scale())
    found = np.asarray(linearise(ready, unknowns).by_parameter)[:, 2 * LENGTH :, index]
    # Rows of order one, rounded to 1e-16, over the step; and what differences err by.
    np.testing.assert_allclose(found, wanted, atol=1e-8)
    assert np.abs(found).max() > 0


# -- ways of calling ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def problem_of_several_effects() -> tuple[Problem, Unknowns]:
    """A problem of a drive with frictions, hysteresis, a kinematic error and errors of the logged torque."""
    problem, unknowns = problem_of(models()["several at once"], joined=True, missing=0.1)
    return with_engine(problem, values=True), unknowns


def assert_equal(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def with_setting(lanes, place: int, value: int):
    settings = np.array(lanes.settings)
    settings[place] = value
    return eqx.tree_at(lambda s: s.settings, lanes, settings)


def test_march_is_bitwise_equal_for_any_number_of_threads(problem_of_several_effects):
    problem, unknowns = problem_of_several_effects
    lanes = lanes_of(problem, unknowns, problem.kernel)
    found = [
        march_lanes(problem.kernel.jacobian, with_setting(lanes, THREADS, n), problem.kernel.hidden, "jacobian")
        for n in (1, 2, 5, 1000)
    ]
    assert np.abs(found[0].rows).max() > 0
    for other in found[1:]:
        assert_equal(found[0], other)


def test_march_is_equal_with_and_without_jit(problem_of_several_effects):
    """Called from Python, and from JAX with and without `jit`, the address being data; and without derivatives."""
    problem, unknowns = problem_of_several_effects
    kernel = problem.kernel
    lanes = lanes_of(problem, unknowns, kernel)
    plain = march_lanes(kernel.jacobian, lanes, kernel.hidden, "jacobian")
    jitted = eqx.filter_jit(lambda address, lanes: march_lanes(address, lanes, kernel.hidden, "jacobian"))
    assert_equal(plain, jitted(kernel.jacobian, lanes))
    assert_equal(plain, march_arrays(kernel.jacobian, lanes, kernel.hidden, "jacobian"))
    signals = lanes.signals[: len(lanes.signals) - len(kernel.acting)]
    values = march_lanes(kernel.values, dataclasses.replace(lanes, signals=signals), kernel.hidden, "values")
    np.testing.assert_allclose(values.rows, plain.rows, rtol=1e-12, atol=1e-12 * np.abs(plain.rows).max())
    np.testing.assert_allclose(values.end, plain.end, rtol=1e-12)
    assert values.by_parameter is None


def test_vmap_of_the_linearisation_equals_a_loop(problem_of_several_effects):
    problem, unknowns = problem_of_several_effects
    points = [eqx.tree_at(lambda u: u.parameters, unknowns, unknowns.parameters + 0.01 * k) for k in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *points)
    together = eqx.filter_jit(lambda p, u: jax.vmap(lambda one: linearise(p, one))(u))(problem, stacked)
    for k, point in enumerate(points):
        # JAX and numpy differ in the last digit of exponentials of parameters.
        for found, wanted in zip(jax.tree.leaves(together), jax.tree.leaves(linearise(problem, point)), strict=True):
            np.testing.assert_allclose(found[k], wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())


def test_jvp_of_the_residual_is_a_product_with_its_blocks(problem_of_several_effects):
    problem, unknowns = problem_of_several_effects
    random = np.random.default_rng(3)
    tangent = jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape)) * jnp.abs(leaf), unknowns)
    along = eqx.filter_jit(lambda p, u, t: jax.jvp(lambda w: residual_with_blocks(w, p), (u,), (t,)))
    value, slope = along(problem, unknowns, tangent)
    found = linearise(problem, unknowns)
    rows = np.einsum("srp,p->sr", found.by_parameter, tangent.parameters)
    rows += np.einsum("srq,sq->sr", found.by_state, tangent.states)
    np.testing.assert_allclose(value.rows, found.residual, rtol=0, atol=1e-12 * np.abs(found.residual).max())
    np.testing.assert_allclose(slope.rows, rows, atol=1e-12 * np.abs(rows).max())
    back = np.roll(np.asarray(tangent.states), 1, axis=0)
    gap = np.where(np.asarray(problem.segments.joined)[:, None], tangent.states, 0.0)
    gap -= np.einsum("sqp,p->sq", found.before_by_parameter, tangent.parameters)
    gap -= np.einsum("sqk,sk->sq", found.before_by_state, back)
    np.testing.assert_allclose(slope.gap, gap, rtol=0, atol=1e-12 * np.abs(gap).max())


def test_simulated_outputs_are_measured_minus_residual(problem_of_several_effects):
    problem, unknowns = problem_of_several_effects
    outputs, end = simulate(problem, unknowns)
    counts = np.asarray(problem.segments.weight) > 0
    rows = np.asarray(linearise(problem, unknowns).residual)[:, : 2 * LENGTH].reshape(*counts.shape, 2)
    error = np.einsum("ij,snj->sni", problem.whitening, problem.segments.measured - outputs)
    np.testing.assert_allclose(rows[counts], error[counts], atol=1e-10 * np.abs(rows).max())
    lanes = lanes_of(problem, unknowns, problem.kernel)
    marched = march_lanes(problem.kernel.jacobian, lanes, problem.kernel.hidden, "jacobian")
    np.testing.assert_array_equal(np.asarray(_gap(lanes, marched))[0], 0.0)
    np.testing.assert_allclose(marched.end, end, rtol=1e-13)


def products(found: Blocks, count: int) -> np.ndarray:
    """Inner products of a segment's columns and its residual."""
    columns = np.concatenate([found.by_parameter[..., :count], found.by_state, found.residual[..., None]], axis=2)
    return np.einsum("srp,srq->spq", columns, columns)


def test_fixed_parameters_have_no_slope_and_change_no_other(problem_of_several_effects):
    """Their tangents are left out where all parameters are fixed."""
    problem, unknowns = problem_of_several_effects
    held = dataclasses.replace(problem, active=jnp.zeros_like(problem.active))
    found, other = linearise(held, unknowns), linearise(problem, unknowns)
    for name in ("residual", "by_state", "gap", "before_by_state"):
        np.testing.assert_array_equal(getattr(found, name), getattr(other, name))
    assert (np.asarray(found.by_parameter) == 0).all() and (np.asarray(found.before_by_parameter) == 0).all()


@pytest.mark.parametrize("name", ["two inertias", "maxwell_slip", "bouc_wen", "input_delay"])
def test_normal_products_agree_with_the_jacobian(name: str):
    """Products are formed without the Jacobian; a linearly dependent column is allowed."""
    problem, unknowns = problem_of(models()[name], missing=0.1)
    free = np.array(problem.active)
    for active in (free, np.where(np.arange(free.size) == 1, 0.0, free), np.zeros_like(free)):
        problem = eqx.tree_at(lambda p: p.active, problem, jnp.asarray(active))
        ready = with_engine(problem)
        full = linearise(ready, unknowns)
        found, rows = task(ready, unknowns).look(unknowns)
        np.testing.assert_allclose(rows, full.residual, rtol=0, atol=1e-13 * np.abs(full.residual).max())
        np.testing.assert_array_equal(residual_at(ready, unknowns)[0], full.residual)
        products, wanted = np.asarray(found.products), np.asarray(Products.of(full).products)
        size = np.sqrt(np.einsum("spp->sp", wanted))
        bound = size[:, :, None] * size[:, None, :]
        assert np.all(np.abs(products - wanted) <= 1e-12 * bound)
        np.testing.assert_allclose(found.gap, full.gap, rtol=1e-12, atol=1e-12 * np.abs(full.gap).max())


# -- divergence --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [1e200, np.inf, np.nan, -3e6])
def test_diverged_segment_is_marked_and_changes_no_other(problem_of_several_effects, start: float):
    """Its rows have the value of lost samples, with no slope. Other segments of its block are bitwise unchanged."""
    problem, unknowns = problem_of_several_effects
    kernel = problem.kernel
    lost = eqx.tree_at(lambda u: u.states, unknowns, unknowns.states.at[2, 1].set(start))
    before, after = (
        march_lanes(kernel.jacobian, lanes_of(problem, u, kernel), kernel.hidden, "jacobian") for u in (unknowns, lost)
    )
    others = np.arange(len(before.rows)) != 2
    for name in ("rows", "by_parameter", "by_state", "end", "end_by_parameter", "end_by_state"):
        np.testing.assert_array_equal(
            np.asarray(getattr(after, name))[others], np.asarray(getattr(before, name))[others]
        )
    counts = np.repeat(np.asarray(problem.segments.weight)[2] > 0, 2)
    rows = np.asarray(after.rows)[2, : 2 * LENGTH]
    # The first row, of the motor's encoder, does not depend on the load's angle.
    assert (rows[counts][1:] == LOST).all() and (rows[~counts] == 0).all()
    lost_rows = np.flatnonzero(rows == LOST)
    for slopes in (after.by_parameter, after.by_state):
        assert (np.asarray(slopes)[2, lost_rows] == 0).all()
    for leaf in jax.tree.leaves(linearise(problem, lost)):
        assert np.isfinite(leaf).all()


def test_segment_diverging_midway_is_valid_until_then():
    """A drive with a softening spring diverges where it is twisted too far."""
    model = TwoInertiaModel(rig.drive_model(alpha=-5e4).drive)
    problem, unknowns = problem_of(model)
    wild = eqx.tree_at(lambda u: u.states, unknowns, unknowns.states.at[4, 1].add(-8e-3))
    found = relative_differences(problem, wild)
    rows = np.asarray(linearise(with_engine(problem), wild).residual)
    lost = np.abs(rows[4]) >= LOST
    assert 0 < lost.sum() < lost.size and not lost[0] and (np.abs(np.delete(rows, 4, axis=0)) < LOST).all()
    slopes = np.asarray(linearise(with_engine(problem), wild).by_parameter)[4]
    assert (slopes[lost] == 0).all() and np.isfinite(slopes).all()
    # The other segments; in the diverging one, errors grow as the motion does.
    assert all(np.delete(d, 4, axis=0).max(initial=0.0) < 1e-12 for d in (found["residual"], found["by_state"]))


class SteepTorque(MeshTorqueEffect):
    """A torque whose slope is infinite at zero twist."""

    family = "unknown"
    name = "steep_torque"

    k: Scalar = parameter(0.1, unit="N m", doc="size", role="strength")

    @classmethod
    def proposals(cls, scales):
        return (cls(),)

    def torque(self, motion: Motion, drive, state):
        return self.k * jnp.sqrt(jnp.abs(motion.x))


def test_infinite_slope_is_replaced_by_zero():
    """The motion is finite and its derivative infinite: results are finite."""
    problem, unknowns = problem_of(rig.drive_model().with_effects(SteepTorque()))
    still = eqx.tree_at(lambda u: u.states, unknowns, jnp.zeros_like(unknowns.states))
    found = linearise(with_engine(problem), still)
    assert np.abs(np.asarray(found.residual)).max() < LOST
    for leaf in jax.tree.leaves(found):
        assert np.isfinite(leaf).all()
    # Slopes of the last sample are zero: they are invalid after the first one.
    assert (np.asarray(found.by_state)[:, 2 * LENGTH - 2 : 2 * LENGTH] == 0).all()


def test_march_of_a_reduced_drive_agrees_with_xla():
    drive = ReducedDrive(mu=rig.MU, omega_0=rig.OMEGA_0, alpha=rig.REDUCED_ALPHA, gain=rig.GAIN)
    assert_agreement(*problem_of(ReducedModel(drive), joined=True))
