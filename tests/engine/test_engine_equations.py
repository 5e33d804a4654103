"""Translated equations of every effect and their derivatives against those that JAX takes from the same model."""

import functools
import zlib
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation.free_parameters import fitted_paths
from hdjax import Drive, Model, ReducedDrive, ReducedModel, TwoInertiaModel
from hdjax.dynamics import Inputs
from hdjax.effects import CATALOGUE, Conditions, DryFriction, Effect, Rubbing, Scales
from hdjax.effects.actuation import TorqueBias, TorqueGain
from hdjax.effects.friction import CoulombFriction, LoadFriction, MotorFriction
from hdjax.effects.hysteresis import BoucWen
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.learned import LEARNED, LEARNED_TORQUES, Learned, LearnedMeshTorque, LearnedMotorTorque
from hdjax.effects.learned_axes import Axis, PeriodicAxis, SignAxis, axes_over
from hdjax.effects.learned_memory import LEARNED_WITH_MEMORY
from hdjax.effects.sensing import JointTorqueBias, JointTorqueDelay
from hdjax.effects.stiffness import QuadraticStiffness
from hdjax.effects.thermal import ThermalStiffness
from hdjax.engine.equations import LOAD, TEMPERATURE, Equations, Part, equations, split_model
from hdjax.engine.graph import Graph
from hdjax.engine.translate import traced, translated
from hdjax.rubbing import over_step

SCALES = Scales(
    x=1e-3,
    x_max=3e-3,
    v=0.3,
    omega_m=12.0,
    omega_l=0.2,
    time_step=5e-4,
    duration=2.0,
    reduction_ratio=rig.N,
    omega_0=380.0,
    temperature=303.0,
    temperature_change=3.0,
    residual_frequencies=(120.0, 260.0),
)
RANGES = {
    "x": (-2e-3, 3e-3),
    "v": (-0.8, 0.9),
    "theta_m": (-3.0, 3.0),
    "omega_m": (-20.0, 25.0),
    "theta_l": (-0.1, 0.1),
    "omega_l": (-0.7, 0.6),
    "T_m": (-0.8, 0.9),
    "time": (0.0, 2.0),
    "temperature": (298.0, 310.0),
}
# Torque [N m] or angle [rad] that a coefficient of a learned function stands for.
_SIZES = {"learned_mesh_torque": 0.5, "learned_load_torque": 0.5, "learned_motor_torque": 0.01}
# Dry friction [N m] by what it opposes.
_FRICTION = {"v": 0.5, "omega_m": 0.02, "omega_l": 0.3}


def with_nonzero_strengths(model: Model, seed: int = 1) -> Model:
    """The model with zero parameters of its effects set to random values, so that every term counts."""
    random = np.random.default_rng(seed)
    own = {path: float(v) for path, (v, _) in model.parameters().items() if "." in path}
    changed = {path: 10 ** random.uniform(-5, -3) for path, value in own.items() if value == 0.0}
    # The sign of friction too weak to change a rate within a step is determined by rounding.
    dry = {e.name: e.opposes for e in model.effects if isinstance(e, DryFriction)}
    changed |= {f"{name}.T_c": _FRICTION[rate] for name, rate in dry.items() if f"{name}.T_c" in own}
    return model.replace(changed) if changed else model


def proposed(form: type[Effect]) -> Effect:
    return (form.typical(SCALES) or form.proposals(SCALES))[0]


def learned(form: type[Learned], axes: tuple[Axis, ...]) -> Effect:
    """A learned effect with some function of the axes; several coefficients, each of several functions."""
    count = int(np.prod([axis.count for axis in axes]))
    random = np.random.default_rng(count)
    kept = min(count, 5)
    mixing = random.normal(size=(count, kept)) / np.sqrt(count)
    c = _SIZES.get(form.name, 1e-4) * random.normal(size=kept)
    if isinstance(axes[0], SignAxis):
        # The torque opposes its rate, at least where the other axes' first function is large.
        c *= np.sign(mixing[0] @ c) * (1.0 if form is LearnedMeshTorque else -1.0)
    return form.made_of(axes, mixing, c)


def learned_effects() -> dict[str, Effect]:
    """Every learned form, over every kind of axis that it may have."""
    found: dict[str, Effect] = {}

    def add(form: type[Learned], axes: tuple[Axis, ...]) -> None:
        kinds = " x ".join(f"{type(a).__name__}({a.variable})" for a in axes)
        found[f"{form.name} of {kinds}"] = learned(form, axes)

    opposes = dict(zip(LEARNED_TORQUES, ("v", "omega_m", "omega_l"), strict=True))
    for form in LEARNED_TORQUES:
        own = opposes[form]
        for axes in axes_over({own: RANGES[own]}, jumps_with=own):
            add(form, axes)
    for variable in ("x", "theta_l", "time", "temperature"):
        for axes in axes_over({variable: RANGES[variable]}, lines=(30.0,)):
            add(LearnedMeshTorque, axes)
    for pair in (("v", "theta_m"), ("x", "v")):
        for axes in axes_over({n: RANGES[n] for n in pair}, jumps_with="v"):
            add(LearnedMeshTorque, axes)
    for axes in axes_over({"T_m": RANGES["T_m"]}):
        add(LearnedMotorTorque, axes)
    add(LearnedMotorTorque, (PeriodicAxis("time", 25.0),))
    for form in LEARNED[len(LEARNED_TORQUES) :]:
        variable = "theta_l" if form.name == "learned_load_reading" else "theta_m"
        add(form, axes_over({variable: RANGES[variable]})[0])
    return found


DRIVE = Drive(N=rig.N, J_m=rig.J_M, J_l=rig.J_L, K=rig.K, alpha=rig.ALPHA, B_sp=2.0)
SEVERAL = (
    MotorFriction(T_c=0.02, transition=0.5),
    CoulombFriction(T_c=0.5, v_0=0.01),
    LoadFriction(T_c=0.3, transition=0.02),
    KinematicError(cos_2=1e-4),
    BoucWen(k=900.0, memory_twist=4e-4, n=1.5),
    TorqueGain(gain_error=0.05),
    TorqueBias(bias=0.03),
)
# A late sensor of the joint torque reads what the torque of the motor, friction and temperature did before.
LATE = (
    ThermalStiffness(k_T=-1e-3, T_0=303.0),
    MotorFriction(T_c=0.02, transition=0.5),
    TorqueGain(gain_error=0.05),
    JointTorqueBias(bias=0.3),
    JointTorqueDelay(delay=3e-4),
)


@functools.cache
def models() -> dict[str, Model]:
    """The base models, each with every form: the catalogue's, the learned ones, and several at once."""
    base, reduced = TwoInertiaModel(DRIVE), ReducedModel(ReducedDrive(mu=3.0, omega_0=380.0, alpha=2e4, gain=20.0))
    found: dict[str, Model] = {"two inertias": base, "reduced": reduced}
    found |= {form.name: with_nonzero_strengths(base.with_effects(proposed(form))) for form in CATALOGUE}
    found |= {name: base.with_effects(effect) for name, effect in learned_effects().items()}
    found |= {form.name: with_nonzero_strengths(base.with_effects(proposed(form))) for form in LEARNED_WITH_MEMORY}
    found["several at once"] = with_nonzero_strengths(base.with_effects(*SEVERAL))
    late = TwoInertiaModel(DRIVE, LATE, ("motor_turn", "joint_torque"))
    found["joint torque read late"] = with_nonzero_strengths(late)
    for form in (QuadraticStiffness, CoulombFriction, BoucWen, TorqueBias):
        found[f"reduced, {form.name}"] = with_nonzero_strengths(reduced.with_effects(proposed(form)))
    return found


# All but every fifth learned form are slow: they are products of the same axes.
_LEARNED = tuple(learned_effects())
_LONG = {name for i, name in enumerate(_LEARNED) if i % 5}
NAMES = tuple(pytest.param(n, marks=pytest.mark.slow if n in _LONG else ()) for n in models())
POINTS = 16


def signals_of(model: Model) -> tuple[str, ...]:
    warm = any(e.needs_temperature for e in model.effects)
    return ((LOAD,) if isinstance(model, TwoInertiaModel) else ()) + ((TEMPERATURE,) if warm else ())


def by_jax(model: Model, paths: Sequence[str], signals: Sequence[str], acting: Sequence[int]):
    """The parts of the equations as functions of free parameters, state, surrounding signals and held friction."""
    free, others, joined = split_model(model, paths)
    names: list[str] = []

    def around(free, surrounding):
        torque, time, step, *beside = surrounding
        found = dict(zip(signals, beside, strict=False))
        slopes = beside[len(signals) :]
        # An actuator's parameter changes the torque at a rate that is given.
        for i, slope in zip(acting, slopes, strict=True):
            torque = torque + slope * (free[i] - jax.lax.stop_gradient(free[i]))
        conditions = Conditions(time=time, temperature=found.get(TEMPERATURE))
        return torque, found.get(LOAD, jnp.zeros_like(torque)), conditions, step

    def held(free, state, surrounding, held):
        own = joined([free[i] for i in range(len(paths))], others)
        *rest, step = around(free, surrounding)
        found = over_step(own, list(state), *rest, step) or {}
        names[:] = sorted(found)
        return jnp.stack([part for n in names for part in (found[n].sign, found[n].reach)] or [jnp.zeros(())])

    def rates(free, state, surrounding, held):
        own = joined([free[i] for i in range(len(paths))], others)
        torque, load, conditions, _ = around(free, surrounding)
        rubbing = {n: Rubbing(held[2 * i], held[2 * i + 1]) for i, n in enumerate(names)}
        conditions = Conditions(conditions.time, conditions.temperature, rubbing or None)
        return jnp.stack(own.component_rates(list(state), torque, load, conditions))

    def outputs(free, state, surrounding, held):
        torque, load, conditions, _ = around(free, surrounding)
        return joined([free[i] for i in range(len(paths))], others).outputs(state, Inputs(torque, load, conditions))

    def prior(free, state, surrounding, held):
        own, motion = joined([free[i] for i in range(len(paths))], others), len(model.motion_states)
        scale = [e.state_scale() for e in own.effects if e.states]
        if not scale:
            return jnp.zeros(1)
        expected = own.settled(state[:motion])[motion:]
        return (state[motion:] - expected) / jax.lax.stop_gradient(jnp.concatenate(scale))

    return {"held": held, "rates": rates, "outputs": outputs, "prior": prior}


def points_of(model: Model, signals: Sequence[str], acting: int, held: int, seed: int) -> tuple[np.ndarray, ...]:
    """States, surrounding signals and held friction by row, at random in the usual range."""
    random = np.random.default_rng(seed)
    normal = functools.partial(random.normal, size=POINTS)
    x, v = 1e-3 * normal(), 0.3 * normal()
    if isinstance(model, TwoInertiaModel):
        theta_m, omega_m = 3.0 * normal(), 12.0 * normal()
        columns = [theta_m, theta_m / rig.N - x, omega_m, omega_m / rig.N - v]
    else:
        columns = [x, v]
    for effect in model.effects:
        if effect.states:
            columns += [0.7 * s * normal() for s in np.asarray(effect.state_scale())]
    around = [0.4 * normal(), random.uniform(0, 2, POINTS), np.full(POINTS, 5e-4)]
    around += [{LOAD: 2.0 * normal(), TEMPERATURE: 303.0 + 3.0 * normal()}[name] for name in signals]
    around += [0.5 * normal() for _ in range(acting)]
    # Mean signs and reaches of held friction.
    rubbing = [random.uniform(-1, 1, POINTS) if i % 2 == 0 else random.uniform(0, 9, POINTS) for i in range(held)]
    return np.stack(columns, 1), np.stack(around, 1), np.stack(rubbing, 1) if held else np.zeros((POINTS, 0))


def friction_reaches(model: Model, states: np.ndarray, surroundings: np.ndarray) -> np.ndarray:
    """Whether the dry friction of every effect can change its rate within a step, and slows it down."""

    def reach(state, surrounding):
        dry = [e for e in model.effects if isinstance(e, DryFriction)]
        # Thermal effects need a temperature.
        motion = model.motion(state, Conditions(time=surrounding[1], temperature=surrounding[-1]))
        moved = [model.mobility(e.opposes, e.opposes) * e.level(motion, model.drive) for e in dry]
        return surrounding[2] * jnp.stack(moved)

    return np.all(np.asarray(jax.vmap(reach)(states, surroundings)) > 1e-6, axis=1)


def evaluated(found: Equations, part: Part, free, others, state, surrounding, held) -> list[np.ndarray]:
    """Values of a part, and their derivatives by free parameters, state and held friction."""
    graph = found.graph
    leaves: dict = {("parameter", i): p for i, p in enumerate(free)}
    leaves |= {("constant", i): c for i, c in enumerate(np.concatenate([np.ravel(o) for o in [*others, []]]))}
    leaves |= {("state", i): s for i, s in enumerate(state.T)}
    leaves |= {("held", i): h for i, h in enumerate(held.T)}
    torque, time, step, *beside = surrounding.T
    leaves |= {("signal", 0): torque, ("time",): time, ("step",): step}
    leaves |= {("signal", 1 + i): s for i, s in enumerate(beside)}
    zero = graph.constant(0.0)

    def at(nodes):
        values = [np.broadcast_to(np.asarray(v, dtype=float), (POINTS,)) for v in graph.evaluate(nodes, leaves)]
        return np.stack(values, axis=-1) if values else np.zeros((POINTS, 0))

    results = [at(part.values)]
    for kind, count in (("parameter", len(free)), ("state", state.shape[1]), ("held", held.shape[1])):
        nodes = [slopes.get((kind, i), zero) for slopes in part.slopes for i in range(count)]
        results.append(at(nodes).reshape(POINTS, len(part.values), count))
    return results


def _leaves_of(graph: Graph, name: int, count: int) -> np.ndarray:
    return np.array([graph.leaf((name, i)) for i in range(count)] + [None], dtype=object)[:-1]


def differentiated(function, free, points: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Values and derivatives by JAX' forward mode.

    The program is evaluated by numpy, one call for each operation: compiling it would take seconds for each effect.
    """
    arguments = (np.stack(free), *(p[0] for p in points))

    def moved(arguments, tangents):
        return jax.jvp(function, arguments, tangents)

    program = traced(moved, arguments, arguments)
    graph = Graph()
    nodes = [_leaves_of(graph, k, len(a)) for k, a in enumerate(arguments * 2)]
    value, slope = translated(graph, program, nodes, values_only=True)
    rows = [np.tile(arguments[0], (POINTS, 1)), *points]
    at = {(k, i): column for k, p in enumerate(rows) for i, column in enumerate(p.T)}

    def evaluated(wanted, k, i):
        leaves = at | {(4 + m, n): float((m, n) == (k, i)) for m, a in enumerate(arguments) for n in range(len(a))}
        rows = [np.broadcast_to(np.asarray(v, dtype=float), (POINTS,)) for v in graph.evaluate(list(wanted), leaves)]
        return np.stack(rows, axis=-1) if rows else np.zeros((POINTS, 0))

    found = [evaluated(value, 0, 0)]
    for k in (0, 1, 3):
        columns = [evaluated(slope, k, i) for i in range(len(arguments[k]))]
        found.append(np.stack(columns, axis=-1) if columns else np.zeros((POINTS, len(value), 0)))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_equations_and_derivatives_agree_with_jax(name: str):
    """At random points; errors are relative to the largest value of a column."""
    model = models()[name]
    paths, signals = fitted_paths(model), signals_of(model)
    found = equations(model, paths, signals)
    assert found.signals == signals and found.paths == paths
    free, others, _ = split_model(model, paths)
    free, others = [np.asarray(f) for f in free], [np.asarray(o) for o in others]
    seed = zlib.crc32(name.encode())
    points = points_of(model, signals, len(found.acting), len(found.held.values), seed)
    for part_name, function in by_jax(model, paths, signals, found.acting).items():
        part = getattr(found, part_name)
        if not part.values:
            continue
        mine, wanted = evaluated(found, part, free, others, *points), differentiated(function, free, points)
        assert all(np.isfinite(w).all() for w in wanted)
        tolerance, clear = 1e-12, np.ones(POINTS, dtype=bool)
        if part_name == "held":
            # The mean sign over a step is a small difference of rates over the reach of friction. Where friction
            # drives, as a learned one may, the sign is determined by rounding and has no effect.
            tolerance, clear = 1e-9, friction_reaches(model, *points[:2])
            assert clear.any()
        row = np.max(np.abs(wanted[0]), axis=0)
        for i, arguments in enumerate([None, np.stack(free)[None], points[0], points[2]]):
            bound = np.max(np.abs(wanted[i]), axis=0, initial=0.0)
            if arguments is not None:
                # Some derivatives are rounding alone: a sign's, where it is one.
                bound = bound + np.multiply.outer(row, 1.0 / np.maximum(np.abs(arguments).max(axis=0), 1e-300))
            apart = np.abs(mine[i] - wanted[i])[clear]
            np.testing.assert_array_less(apart, np.broadcast_to(tolerance * bound + 1e-300, apart.shape))


def test_equations_do_not_depend_on_parameter_values():
    """Models of one structure have the same graph."""
    model = models()["kinematic_error"]
    paths, signals = fitted_paths(model), signals_of(model)
    other = model.replace({"K": 123.0, "kinematic_error.cos_2": 0.7, "N": 99.0})
    ours, theirs = (equations(m, paths, signals) for m in (model, other))
    assert ours.graph.nodes == theirs.graph.nodes


def test_zero_derivatives_are_left_out_of_the_equations():
    """The rate of an angle depends on one speed alone, and outputs on no free parameter."""
    found = equations(models()["two inertias"], ("K", "alpha", "B_sp"), ())
    assert [set(t) for t in found.rates.slopes[:2]] == [{("state", 2)}, {("state", 3)}]
    assert all(found.graph.known(t[d]) == 1.0 for t in found.rates.slopes[:2] for d in t)
    assert {d for d in found.rates.slopes[2] if d[0] == "parameter"} == {("parameter", i) for i in range(3)}
    assert not any(d[0] == "parameter" for t in found.outputs.slopes for d in t)
    assert found.held.values == found.prior.values == ()
