"""The residual by machine code: the same numbers as [`fitting.estimation.residual`][] gives by XLA, without compiling a
program for each model."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from fitting.estimation.free_parameters import LARGEST_LOG
from fitting.estimation.residual import LOST, Blocks, Problem, Products, Unknowns
from hdjax import PiecewisePolynomial
from hdjax.effects import ActuatorEffect
from hdjax.engine import Kernel, Lanes, Marched, march_lanes, threads
from hdjax.engine.equations import split_model
from hdjax.engine.kernel import Mode, Wanted, march_arrays, result_shapes

# The model's constants come in tables of so many, so that few sizes of them make few programs.
_CONSTANTS = 32


def lanes_of(problem: Problem, unknowns: Unknowns, kernel: Kernel, width: int | None = None) -> Lanes:
    """What the machine code needs of a problem; arguments as in [`_as_logged`][]."""
    acting = _acting(problem, kernel)
    lanes = _as_logged(problem, unknowns, kernel, width)
    return lanes if acting is None else acting.on(lanes)


def _as_logged(problem: Problem, unknowns: Unknowns, kernel: Kernel, width: int | None) -> Lanes:
    """What the machine code needs of a problem, with the torque as it was logged.

    Args:
        problem: what is solved.
        unknowns: where.
        kernel: of the problem's model.
        width: columns of the derivatives by parameters, those behind the last parameter zero; one each where None.
    """
    segments, free = problem.segments, problem.free
    # Outside a program of JAX numpy does this, for which nothing is compiled.
    library: Any = jnp if _is_traced((problem, unknowns)) else np
    values = free.values(unknowns.parameters)
    model = problem.model.replace(dict(zip(free.paths, values, strict=True))) if free.paths else problem.model
    slopes = free.slopes(model) * library.asarray(problem.active)
    _, others, _ = split_model(problem.model, kernel.paths)
    constants = library.concatenate([np.zeros(0), *(library.ravel(library.asarray(a)) for a in others)])
    more = 0 if width is None else width - len(free.paths)
    whole = library.any(library.asarray(segments.joined))
    numbers = [library.asarray(problem.substeps), whole, threads()]
    named = {"load torque": segments.load_torque, "temperature": segments.temperature}
    beside = [named[name] for name in kernel.signals]
    return Lanes(
        free=library.pad(library.asarray(values, dtype=float).reshape(-1), (0, more)),
        slopes=library.pad(library.asarray(slopes), (0, more)),
        constants=library.pad(constants, (0, -constants.size % _CONSTANTS)),
        states=unknowns.states,
        knots=segments.torque.knots,
        measured=segments.measured,
        weight=segments.weight,
        joined=library.asarray(segments.joined, dtype=float),
        whitening=problem.whitening,
        settings=library.stack([library.asarray(n, dtype=np.int64) for n in numbers]),
        signals=(segments.torque.coefficients, *(s.coefficients for s in beside if s is not None)),
    )


def _is_traced(tree: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


class Acting(eqx.Module):
    """Effects on the logged torque.

    Attributes:
        effects: in order.
        paths: their free parameters.
        places: where these are among all free parameters.
        torque: what was logged.
    """

    effects: tuple[ActuatorEffect, ...]
    paths: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    torque: PiecewisePolynomial

    def on(self, lanes: Lanes) -> Lanes:
        """Lanes with the torque that acts, and its derivatives by the parameters at the paths, in the place of what was
        logged."""
        values = jnp.asarray(lanes.free[np.array(self.places, dtype=int)])
        torque, slopes = actuated(self.effects, self.paths, values, self.torque)
        return eqx.tree_at(lambda s: s.signals, lanes, (torque, *lanes.signals[1:], *slopes))


def _acting(problem: Problem, kernel: Kernel) -> Acting | None:
    """The effects on a problem's logged torque; None where there are none."""
    effects = tuple(e for e in problem.model.effects if isinstance(e, ActuatorEffect))
    paths = tuple(kernel.paths[i] for i in kernel.acting)
    return Acting(effects, paths, kernel.acting, problem.segments.torque) if effects else None


class _Actuators(eqx.Module):
    """Effects on the torque, on their own."""

    effects: tuple[ActuatorEffect, ...]


@eqx.filter_jit
def actuated(
    actuators: Sequence[ActuatorEffect], paths: tuple[str, ...], values: Array, torque: PiecewisePolynomial
) -> tuple[Array, tuple[Array, ...]]:
    """The torque that acts, and its derivatives by the parameters at the paths."""

    def places(own: tuple[ActuatorEffect, ...]) -> list[Any]:
        by_name = {e.name: e for e in own}
        return [getattr(by_name[name], field) for name, field in (p.split(".") for p in paths)]

    def acts(values: Array) -> Array:
        own = tuple(actuators)
        if paths:
            own = eqx.tree_at(places, own, list(values))

        def one(torque: PiecewisePolynomial) -> Array:
            for effect in own:
                torque = effect.actuate(torque)
            return torque.coefficients

        return jax.vmap(one)(torque)

    if not paths:
        return acts(values), ()
    found, moved = jax.vmap(lambda unit: jax.jvp(acts, (values,), (unit,)), out_axes=(None, 0))(jnp.eye(len(paths)))
    return found, tuple(moved)


def blocks_by_machine_code(problem: Problem, unknowns: Unknowns, width: int | None = None) -> Blocks:
    """[`fitting.estimation.residual.blocks`][] by machine code; arguments as in [`lanes_of`][]."""
    kernel = problem.kernel
    assert kernel is not None
    lanes = lanes_of(problem, unknowns, kernel, width)
    found = _march(kernel.jacobian, lanes, kernel.hidden, "jacobian")
    gap, before_by_parameter, before_by_state = _ends(lanes, found)
    return Blocks(
        residual=jnp.asarray(found.rows),
        by_parameter=jnp.asarray(found.by_parameter),
        by_state=jnp.asarray(found.by_state),
        gap=gap,
        before_by_parameter=before_by_parameter,
        before_by_state=before_by_state,
    )


def rows_by_machine_code(problem: Problem, unknowns: Unknowns) -> Float[np.ndarray, "segments rows"]:
    """The rows of [`fitting.estimation.residual.residual`][] by the machine code that has derivatives, without
    computing them."""
    kernel = problem.kernel
    assert kernel is not None
    return np.asarray(
        _march(kernel.jacobian, lanes_of(problem, unknowns, kernel), kernel.hidden, "jacobian", "rows").rows
    )


def _march(address: Array | np.ndarray, lanes: Lanes, hidden: int, mode: Mode, wanted: Wanted = "jacobian") -> Marched:
    """Outside a program of JAX none is compiled."""
    return (march_lanes if _is_traced((address, lanes)) else march_arrays)(address, lanes, hidden, mode, wanted)


class Task(eqx.Module):
    """A problem that can be looked at from any point, by numpy or within a program of JAX.

    Attributes:
        address: of the machine code.
        lanes: the data as logged; what is free and the states are replaced.
        acting: effects on the logged torque; None where there are none.
        logarithmic: which parameters move by their logarithm.
        scale: unit of each of the others.
        active: 1 for a parameter that may move, 0 for one that is held, or that there is not.
        centre: what is known beforehand of each parameter's entry, see
            [`fitting.estimation.free_parameters.FreeParameters`][].
        precision: likewise.
        hidden: how many states are effects' own.
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

    def look(self, unknowns: Unknowns) -> tuple[Products, Float[Array, "segments rows"]]:
        """The normal equations of the residual at a point, and its rows."""
        vector = unknowns.parameters
        library: Any = jnp if _is_traced((self, unknowns)) else np
        if library is np:
            vector = np.asarray(vector)
        power = library.exp(library.clip(vector, -LARGEST_LOG, LARGEST_LOG))
        value = library.where(self.logarithmic, power, vector * self.scale)
        slope = library.where(self.logarithmic, value, self.scale) * self.active
        lanes = eqx.tree_at(lambda s: (s.free, s.slopes, s.states), self.lanes, (value, slope, unknowns.states))
        if self.acting is not None:
            lanes = self.acting.on(lanes)
        found = _march(self.address, lanes, self.hidden, "jacobian", "products")
        assert found.products is not None
        products = Products(found.products, *_ends(lanes, found))
        off = self.precision * (vector - self.centre)
        return products.beside_prior(off, self.precision * self.active), jnp.asarray(found.rows)

    def blank(self) -> tuple[Products, Float[np.ndarray, "segments rows"]]:
        """Zeros like what a look finds."""
        shapes = result_shapes(self.lanes, self.hidden, "jacobian", "products")
        rows, end, _, _, by_parameter, by_state, products = map(np.zeros, shapes)
        return Products(products, end, by_parameter, by_state), rows


def task(problem: Problem, unknowns: Unknowns, width: int) -> Task | None:
    """A problem ready to be looked at by machine code; None where there is none.

    Args:
        problem: what is solved.
        unknowns: any.
        width: room for the parameters.
    """
    kernel = problem.kernel
    if kernel is None:
        return None
    free = problem.free
    more = (0, width - len(free.paths))
    return Task(
        address=kernel.jacobian,
        lanes=_as_logged(problem, unknowns, kernel, width),
        acting=_acting(problem, kernel),
        logarithmic=np.pad(np.array(free.logarithmic, dtype=bool), more),
        scale=np.pad(np.asarray(free.scale), more, constant_values=1.0),
        active=np.pad(np.asarray(problem.active), more),
        centre=np.pad(np.asarray(free.centre), more),
        precision=np.pad(np.asarray(free.precision), more),
        hidden=kernel.hidden,
    )


def _ends(lanes: Lanes, found: Marched) -> tuple[Array, Array, Array]:
    """The gap before each segment, and the derivatives of the end of the segment before."""
    library: Any = jnp if _is_traced((lanes, found)) else np
    joined, gap = library.asarray(lanes.joined)[:, None] > 0, _gap(lanes, found)
    near = library.abs(gap) < LOST

    def before(slope: Any) -> Any:
        moved = library.roll(slope, 1, axis=0)
        return library.where((joined & near)[:, :, None] & library.isfinite(moved), moved, 0.0)

    # A state that has run away stands for itself: nothing before it moves the gap.
    own = library.where((joined & ~near)[:, :, None], library.eye(gap.shape[1]), 0.0)
    by_parameter, by_state = before(found.end_by_parameter), before(found.end_by_state) + own
    return jnp.asarray(gap), jnp.asarray(by_parameter), jnp.asarray(by_state)


def residual_by_machine_code(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array, "segments rows"], Float[Array, "segments states"]]:
    """[`fitting.estimation.residual.residual`][] by machine code that has no derivatives."""
    kernel = problem.kernel
    assert kernel is not None and kernel.values is not None
    lanes = lanes_of(problem, unknowns, kernel)
    found = _march(kernel.values, lanes, kernel.hidden, "values")
    return jnp.asarray(found.rows), _gap(lanes, found)


def _gap(lanes: Lanes, found: Marched) -> Array:
    """How far each joined segment starts from where the one before it ends."""
    library: Any = jnp if _is_traced((lanes, found)) else np
    with np.errstate(invalid="ignore"):
        gap = library.asarray(lanes.states) - library.roll(found.end, 1, axis=0)
    joined = library.asarray(lanes.joined)[:, None] > 0
    return jnp.asarray(library.where(joined, library.where(library.abs(gap) < LOST, gap, LOST), 0.0))


def simulated(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array, "segments samples outputs"], Float[Array, "segments states"]]:
    """[`fitting.estimation.residual.simulate_segments`][] by machine code that has no derivatives."""
    kernel = problem.kernel
    assert kernel is not None and kernel.values is not None
    lanes = lanes_of(problem, unknowns, kernel)
    library: Any = jnp if _is_traced(lanes) else np
    segments, samples, outputs = lanes.measured.shape
    settings = library.asarray(lanes.settings) * np.array([1, 0, 1]) + np.array([0, 1, 0])
    plain = np.zeros(lanes.measured.shape), np.ones(lanes.weight.shape), -np.eye(outputs), settings
    lanes = eqx.tree_at(lambda s: (s.measured, s.weight, s.whitening, s.settings), lanes, plain)
    found = _march(kernel.values, lanes, kernel.hidden, "values")
    rows = found.rows[:, : samples * outputs].reshape(segments, samples, outputs)
    return jnp.asarray(library.where(library.abs(rows) < LOST, rows, np.inf)), jnp.asarray(found.end)
