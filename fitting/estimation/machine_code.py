"""The residual by machine code: equal to that of [`fitting.estimation.residual`][] by XLA, without compilation per
model."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.free_parameters import LARGEST_LOG
from fitting.estimation.residual import LOST, Blocks, Problem, Products, Unknowns
from fitting.record import Record
from hdjax import PiecewisePolynomial
from hdjax.compilation import is_traced, library_of, on_host
from hdjax.effects import ActuatorEffect
from hdjax.engine import Kernel, Lanes, Marched, march_lanes, threads
from hdjax.engine.equations import numbers_of
from hdjax.engine.kernel import Mode, Wanted, march_arrays

# Sizes of the tables of model constants are multiples of this, so that few programs suffice.
_CONSTANTS = 32
# A complex step: its square vanishes beside any parameter.
_TINY = 1e-60


def lanes_of(problem: Problem, unknowns: Unknowns, kernel: Kernel) -> Lanes:
    """Input of the machine code for a problem."""
    acting = _acting(problem, kernel)
    lanes = _as_logged(problem, unknowns, kernel)
    return lanes if acting is None else acting.on(lanes)


def _as_logged(problem: Problem, unknowns: Unknowns, kernel: Kernel) -> Lanes:
    """Input of the machine code for a problem, with the logged torque.

    Args:
        problem: the least-squares problem.
        unknowns: point of evaluation.
        kernel: machine code of the problem's model.
    """
    free = problem.free
    # numpy outside a JAX program, to compile nothing.
    library = jnp if is_traced(problem, unknowns) else np
    values = free.values(unknowns.parameters)
    model = problem.model.replace(dict(zip(free.paths, values, strict=True))) if free.paths else problem.model
    slopes = library.asarray(free.slopes(model)) * library.asarray(problem.active)
    own = library.asarray(values, dtype=float).reshape(-1), slopes, unknowns.states
    return _data(problem, kernel, *own, library=library)


def _data(problem: Problem, kernel: Kernel, free: Any, slopes: Any, states: Any, *, library: Any) -> Lanes:
    """The same for given free parameters and initial states."""
    segments = problem.segments
    own = numbers_of(problem.model)
    constants = library.concatenate([np.zeros(0), *(library.ravel(library.asarray(a)) for a in own)])
    whole = library.any(library.asarray(segments.joined))
    numbers = [library.asarray(problem.substeps), whole, threads()]
    named = {"load torque": segments.load_torque, "temperature": segments.temperature}
    beside = [signal for name in kernel.signals if (signal := named[name]) is not None]
    assert len(beside) == len(kernel.signals)
    return Lanes(
        free=free,
        slopes=slopes,
        constants=library.pad(constants, (0, -constants.size % _CONSTANTS)),
        states=states,
        knots=segments.torque.knots,
        measured=segments.measured,
        weight=segments.weight,
        joined=library.asarray(segments.joined, dtype=float),
        whitening=problem.whitening,
        settings=library.stack([library.asarray(n, dtype=np.int64) for n in numbers]),
        signals=(segments.torque.coefficients, *(s.coefficients for s in beside)),
    )


class Acting(eqx.Module):
    """Effects on the logged torque.

    Attributes:
        effects: in order.
        paths: their free parameters.
        places: their indices among all free parameters.
        torque: the logged torque.
    """

    effects: tuple[ActuatorEffect, ...]
    paths: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    torque: PiecewisePolynomial

    def on(self, lanes: Lanes) -> Lanes:
        """Lanes with the torque after actuator effects, and its derivatives by the parameters at the paths, in place of
        the logged one."""
        values = lanes.free[np.array(self.places, dtype=int)]
        torque, slopes = actuated(self.effects, self.paths, values, self.torque)
        return replace(lanes, signals=(torque, *lanes.signals[1:], *slopes))


def _acting(problem: Problem, kernel: Kernel) -> Acting | None:
    """The actuator effects of a problem; None where there are none."""
    effects = tuple(e for e in problem.model.effects if isinstance(e, ActuatorEffect))
    paths = tuple(kernel.paths[i] for i in kernel.acting)
    return Acting(effects, paths, kernel.acting, problem.segments.torque) if effects else None


def actuated(
    actuators: Sequence[ActuatorEffect], paths: tuple[str, ...], values: Any, torque: PiecewisePolynomial
) -> tuple[Any, tuple[Any, ...]]:
    """The torque after actuator effects, and its derivatives by the parameters at the paths."""
    if is_traced(values, torque) or not all(effect.takes_numpy for effect in actuators):
        values, torque = jax.tree.map(jnp.asarray, (values, torque))
        acts = jax.vmap(functools.partial(_after, tuple(actuators), paths), in_axes=(None, 0))
        along = jax.vmap(lambda unit: jax.jvp(lambda v: acts(v, torque), (values,), (unit,))[1])
        return acts(values, torque), tuple(along(jnp.eye(len(paths)))) if paths else ()
    # Outside JAX programs by complex steps (Squire and Trapp 1998): exact, and nothing is compiled.
    effects, logged = jax.tree.map(np.asarray, (tuple(actuators), torque))
    steps = np.asarray(values) + 1j * _TINY * np.eye(len(paths))
    moved = [_after(effects, paths, step, logged) for step in steps]
    found = moved[0].real if moved else _after(effects, paths, (), logged)
    return found, tuple(each.imag / _TINY for each in moved)


def _after(
    actuators: tuple[ActuatorEffect, ...], paths: tuple[str, ...], values: Any, torque: PiecewisePolynomial
) -> Any:
    """Coefficients of the torque after actuator effects with given parameters at the paths."""

    def places(own: tuple[ActuatorEffect, ...]) -> list[Any]:
        by_name = {e.name: e for e in own}
        return [getattr(by_name[name], field) for name, field in (p.split(".") for p in paths)]

    for effect in eqx.tree_at(places, actuators, list(values)) if paths else actuators:
        torque = effect.actuate(torque)
    return torque.coefficients


def blocks_by_machine_code(problem: Problem, unknowns: Unknowns) -> Blocks:
    """[`fitting.estimation.residual.blocks`][] by machine code."""
    kernel = problem.kernel
    assert kernel is not None
    lanes = lanes_of(problem, unknowns, kernel)
    found = _march(kernel.jacobian, lanes, kernel.hidden, "jacobian")
    gap, before_by_parameter, before_by_state = _ends(lanes, found)
    assert found.by_parameter is not None and found.by_state is not None
    return Blocks(
        residual=found.rows,
        by_parameter=found.by_parameter,
        by_state=found.by_state,
        gap=gap,
        before_by_parameter=before_by_parameter,
        before_by_state=before_by_state,
    )


def plain_residual_by_machine_code(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[np.ndarray, "segments rows"], Float[np.ndarray, "segments states"]]:
    """[`fitting.estimation.residual.residual`][] by the machine code with derivatives, without computing these."""
    kernel = problem.kernel
    assert kernel is not None
    lanes = lanes_of(problem, unknowns, kernel)
    found = _march(kernel.jacobian, lanes, kernel.hidden, "jacobian", "rows")
    return np.asarray(found.rows), np.asarray(_gap(lanes, found))


def _march(address: Array | np.ndarray, lanes: Lanes, hidden: int, mode: Mode, wanted: Wanted = "jacobian") -> Marched:
    """Run the machine code; outside a JAX program nothing is compiled."""
    return (march_lanes if is_traced(address, lanes) else march_arrays)(address, lanes, hidden, mode, wanted)


class Task(Record):
    """A problem that can be evaluated at any point outside JAX programs.

    Attributes:
        address: of the machine code.
        lanes: the logged data; free parameters and states are replaced.
        acting: effects on the logged torque; None where there are none.
        logarithmic: which parameters are represented by their logarithm.
        scale: unit of each of the others.
        active: 1 for a free parameter, 0 for a fixed one.
        centre: prior mean of each parameter's entry, see [`fitting.estimation.free_parameters.FreeParameters`][].
        precision: inverse of the prior's standard deviation.
        hidden: number of hidden states.
    """

    address: Array | np.ndarray
    lanes: Lanes
    acting: Acting | None
    logarithmic: np.ndarray
    scale: np.ndarray
    active: np.ndarray
    centre: np.ndarray
    precision: np.ndarray
    hidden: int = eqx.field(static=True)

    def look(self, unknowns: Unknowns) -> tuple[Products, Float[np.ndarray, "segments rows"]]:
        """Normal equations and rows of the residual at a point."""
        vector = unknowns.parameters
        with np.errstate(over="ignore"):
            power = np.exp(np.clip(vector, -LARGEST_LOG, LARGEST_LOG))
        value = np.where(self.logarithmic, power, vector * self.scale)
        slope = np.where(self.logarithmic, value, self.scale) * self.active
        lanes = replace(self.lanes, free=value, slopes=slope, states=unknowns.states)
        if self.acting is not None:
            lanes = self.acting.on(lanes)
        found = march_arrays(self.address, lanes, self.hidden, "jacobian", "products")
        assert found.products is not None
        products = Products(found.products, *_ends(lanes, found))
        off = self.precision * (vector - self.centre)
        return products.beside_prior(off, self.precision * self.active), np.asarray(found.rows)


def task(problem: Problem, unknowns: Unknowns) -> Task | None:
    """A problem prepared for evaluation by machine code; None without machine code."""
    kernel, free = problem.kernel, problem.free
    if kernel is None:
        return None
    acting, values = _acting(problem, kernel), np.asarray([*free.values(unknowns.parameters)], dtype=float)
    lanes = on_host(_data(problem, kernel, values, np.zeros(values.size), unknowns.states, library=np))
    # Without free actuator parameters the torque is the same at all points.
    if acting is not None and not np.asarray(problem.active).any():
        lanes, acting = acting.on(lanes), None
    return Task(
        address=kernel.jacobian,
        lanes=lanes,
        acting=acting,
        logarithmic=np.array(free.logarithmic, dtype=bool),
        scale=np.asarray(free.scale),
        active=np.asarray(problem.active),
        centre=np.asarray(free.centre),
        precision=np.asarray(free.precision),
        hidden=kernel.hidden,
    )


def _ends(lanes: Lanes, found: Marched) -> tuple[Any, Any, Any]:
    """The gap before each segment, and the derivatives of the preceding segment's final state."""
    library = library_of(lanes.states, found.end)
    joined, gap = library.asarray(lanes.joined)[:, None] > 0, _gap(lanes, found)
    near = library.abs(gap) < LOST
    slopes = (library.roll(slope, 1, axis=0) for slope in (found.end_by_parameter, found.end_by_state))
    by_parameter, by_state = (
        library.where((joined & near)[:, :, None] & library.isfinite(slope), slope, 0.0) for slope in slopes
    )
    # A diverged state has no derivative: the gap does not depend on what precedes it.
    own = library.where((joined & ~near)[:, :, None], library.eye(gap.shape[1]), 0.0)
    return gap, by_parameter, by_state + own


def residual_by_machine_code(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array, "segments rows"], Float[Array, "segments states"]]:
    """[`fitting.estimation.residual.residual`][] by machine code without derivatives."""
    kernel = problem.kernel
    assert kernel is not None and kernel.values is not None
    lanes = lanes_of(problem, unknowns, kernel)
    found = _march(kernel.values, lanes, kernel.hidden, "values")
    return jnp.asarray(found.rows), _gap(lanes, found)


def _gap(lanes: Lanes, found: Marched) -> Any:
    """Initial state of each joined segment minus the final state of the one before."""
    library = library_of(lanes.states, found.end)
    with np.errstate(invalid="ignore"):
        gap = library.asarray(lanes.states) - library.roll(found.end, 1, axis=0)
    joined = library.asarray(lanes.joined)[:, None] > 0
    return library.where(joined, library.where(library.abs(gap) < LOST, gap, LOST), 0.0)


def simulated(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array, "segments samples outputs"], Float[Array, "segments states"]]:
    """[`fitting.estimation.residual.simulate_segments`][] by the machine code with derivatives, without computing
    these."""
    kernel = problem.kernel
    assert kernel is not None
    lanes = lanes_of(problem, unknowns, kernel)
    library = jnp if is_traced(lanes) else np
    segments, samples, outputs = lanes.measured.shape
    settings = library.asarray(lanes.settings) * np.array([1, 0, 1]) + np.array([0, 1, 0])
    plain = np.zeros(lanes.measured.shape), np.ones(lanes.weight.shape), -np.eye(outputs), settings
    lanes = eqx.tree_at(lambda s: (s.measured, s.weight, s.whitening, s.settings), lanes, plain)
    found = _march(kernel.jacobian, lanes, kernel.hidden, "jacobian", "rows")
    rows = found.rows[:, : samples * outputs].reshape(segments, samples, outputs)
    return jnp.asarray(library.where(library.abs(rows) < LOST, rows, np.inf)), jnp.asarray(found.end)
