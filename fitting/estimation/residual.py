"""Measured minus simulated on every segment, and its derivatives: the one program that all fits run."""

from dataclasses import replace
from typing import Literal

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.estimation.experiment import Segments
from fitting.estimation.free_parameters import FreeParameters
from hdjax import Model
from hdjax.compilation import library_of
from hdjax.engine import Kernel
from hdjax.simulate import march, simulate
from hdjax.where import where

# A simulation that runs away, or leaves the numbers, is this many standard deviations off: a rejected step. (Its own
# size would overflow where it is squared.)
LOST = 1e8
RUNAWAY = 1e-3 * LOST
"""Standard deviations beyond which a simulation has lost its way; the weights may have changed since."""

Engine = Literal["XLA", "diffrax"]
"""What evaluates a residual in place of machine code: the same steps as a program of XLA, or `diffrax.diffeqsolve` with
adaptive steps."""


def _as_integer(value: int | Int[Array, ""]) -> Int[Array, ""]:
    return jnp.asarray(np.asarray(value) if isinstance(value, int) else value, dtype=int)


class Problem(eqx.Module):
    """Everything that the residual depends on except what is fitted.

    Attributes:
        model: supplies the parameters that are not free.
        free: what is free.
        segments: the data.
        whitening: `whitening @ e` has unit covariance for an output error e.
        active: 1 for a parameter that may move, 0 for one that is held; one program fits and evaluates.
        gap_weight: what a unit of each state counts where a joined segment does not yet start where the one before
            it ends.
        solver: explicit Runge-Kutta solver of diffrax.
        substeps: its steps in each sample interval; data, so that finer steps need no other program.
        kernel: machine code that does the same faster, see [`fitting.estimation.machine_code`][]; None where XLA does
            it.
        engine: what evaluates the residual, where it is not to be machine code if that can be.
    """

    model: Model
    free: FreeParameters
    segments: Segments
    whitening: Float[Array, "outputs outputs"]
    active: Float[Array, " parameters"]
    gap_weight: Float[Array, " states"]
    solver: dfx.AbstractERK = dfx.Tsit5()
    substeps: Int[Array, ""] = eqx.field(converter=_as_integer, default=1)
    kernel: Kernel | None = None
    engine: Engine | None = eqx.field(static=True, default=None)


class Unknowns(eqx.Module):
    """What is fitted: the free parameters, and the initial state of each segment."""

    parameters: Float[Array | np.ndarray, " parameters"]
    states: Float[Array | np.ndarray, "segments states"]


class Blocks(eqx.Module):
    """Residual and Jacobian: a segment's rows and its end depend on the shared parameters and on its own initial
    state only.

    Attributes:
        residual: see [`residual`][].
        by_parameter: derivative of the residual.
        by_state: likewise.
        gap: how far each joined segment starts from where the one before it ends; zero where a segment starts anew.
        before_by_parameter: derivative of the end of the segment before; zero where a segment starts anew.
        before_by_state: likewise, with respect to the initial state of the segment before.
    """

    residual: Float[Array | np.ndarray, "segments rows"]
    by_parameter: Float[Array | np.ndarray, "segments rows parameters"]
    by_state: Float[Array | np.ndarray, "segments rows states"]
    gap: Float[Array | np.ndarray, "segments states"]
    before_by_parameter: Float[Array | np.ndarray, "segments states parameters"]
    before_by_state: Float[Array | np.ndarray, "segments states states"]


class Products(eqx.Module):
    """What the normal equations need of residual and Jacobian.

    Attributes:
        products: of each segment's columns with each other: derivatives by parameters, by states, and the residual.
        gap: as in [`Blocks`][].
        before_by_parameter: likewise.
        before_by_state: likewise.
    """

    products: Float[Array | np.ndarray, "segments columns columns"]
    gap: Float[Array | np.ndarray, "segments states"]
    before_by_parameter: Float[Array | np.ndarray, "segments states parameters"]
    before_by_state: Float[Array | np.ndarray, "segments states states"]

    @staticmethod
    def of(found: Blocks) -> "Products":
        """Those of a residual with its Jacobian."""
        library = library_of(found.residual, found.by_state)
        columns = library.concatenate([found.by_parameter, found.by_state, found.residual[:, :, None]], axis=2)
        ends = found.gap, found.before_by_parameter, found.before_by_state
        return Products(library.swapaxes(columns, 1, 2) @ columns, *ends)

    def beside_prior(
        self, off: Float[Array | np.ndarray, " parameters"], slope: Float[Array | np.ndarray, " parameters"]
    ) -> "Products":
        """With what is known of the parameters beforehand as rows of the first segment.

        Args:
            off: how many standard deviations each parameter's entry is off.
            slope: derivative of that by the entry; zero for a parameter that is held.
        """
        library = library_of(self.products, off, slope)
        more = self.products.shape[1] - off.size - 1
        rows = library.concatenate([library.diag(slope), library.zeros((off.size, more)), off[:, None]], axis=1)
        first = (library.arange(self.products.shape[0]) == 0).astype(float)[:, None, None]
        return replace(self, products=self.products + first * (rows.T @ rows)[None])

    @property
    def square(self) -> Float[Array | np.ndarray | np.float64, ""]:
        """Sum of squares of the residual."""
        return library_of(self.products).sum(self.products[:, -1, -1])


@eqx.filter_jit
def simulate_segments(
    problem: Problem, unknowns: Unknowns, intervals: Int[Array, ""] | None = None
) -> tuple[Float[Array, "segments samples outputs"], Float[Array, "segments states"]]:
    """The outputs that the model gives on each segment, and the state it ends in; `intervals` as in
    [`hdjax.simulate.march`][]."""
    model = problem.free.unpack(problem.model, unknowns.parameters)
    segments = problem.segments
    temperature = segments.temperature if any(e.needs_temperature for e in model.effects) else None

    def solved(torque, load_torque, temperature, state):
        times = torque.knots[segments.halo :]
        beside = {} if load_torque is None else {"load_torque": load_torque}
        options = {"temperature": temperature, "solver": problem.solver, "adjoint": dfx.ForwardMode(), "throw": False}
        found = simulate(model, torque, times, state, **beside, **options)
        return found.outputs[:-1], found.states[-1]

    def marched(torque, load_torque, temperature, state):
        acting = model.actuate(torque)
        halo = segments.halo
        own = eqx.tree_at(
            lambda t: (t.knots, t.coefficients),
            acting,
            (acting.knots[halo:], acting.coefficients[halo:]),
        )
        states, end = march(
            model,
            own,
            load_torque,
            state,
            solver=problem.solver,
            substeps=problem.substeps,
            intervals=intervals,
            temperature=temperature,
        )
        return jax.vmap(model.outputs)(states), end

    one = solved if problem.engine == "diffrax" else marched
    return jax.vmap(one)(segments.torque, segments.load_torque, temperature, unknowns.states)


def residual(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array, "segments rows"], Float[Array, "segments states"]]:
    """Whitened output error of each segment by row, then its hidden initial states in units of their prior; and the
    gap before each joined segment."""
    weight = problem.segments.weight[:, :, None]
    outputs, end = simulate_segments(problem, unknowns, _needed(problem.segments))
    # A simulation may run away where there are no data; infinity times zero is no zero.
    error = where(weight > 0, (problem.segments.measured - outputs) * weight, 0.0)
    white = jnp.einsum("ij,snj->sni", problem.whitening, error)
    rows = white.reshape(white.shape[0], -1)
    rows = where(jnp.abs(rows) < LOST, rows, LOST)
    joined = problem.segments.joined[:, None]
    rows = jnp.concatenate([rows, where(joined, 0.0, _state_prior(problem, unknowns))], axis=1)
    gap = unknowns.states - jnp.roll(end, 1, axis=0)
    gap = where(jnp.abs(gap) < LOST, gap, LOST)
    return rows, where(joined, gap, 0.0)


def _needed(segments: Segments) -> Int[Array, ""]:
    """How many sample intervals have to be simulated: up to the last sample that counts in any segment, all where
    segments are joined at their ends."""
    length = segments.weight.shape[1]
    counts = jnp.any(segments.weight > 0, axis=0)
    last = jnp.max(where(counts, jnp.arange(length), 0))
    return where(jnp.any(segments.joined), length, last)


def _state_prior(problem: Problem, unknowns: Unknowns) -> Float[Array, "segments hidden"]:
    """Hidden states start unseen: without a prior they could take any value where the data say nothing."""
    model = problem.free.unpack(problem.model, unknowns.parameters)
    motion = len(model.motion_states)
    scale = [e.state_scale() for e in model.effects if e.states]
    states = jnp.asarray(unknowns.states)
    hidden = states[:, motion:]
    if not scale:
        return hidden
    expected = jax.vmap(model.settled)(states[:, :motion])[:, motion:]
    return (hidden - expected) / jax.lax.stop_gradient(jnp.concatenate(scale))[None, :]


def blocks(problem: Problem, unknowns: Unknowns) -> Blocks:
    """Residual and Jacobian from one simulation whose lanes are segments x sensitivities (forward mode)."""

    def along(tangent: Unknowns):
        return jax.jvp(lambda u: residual(problem, u), (unknowns,), (tangent,))

    (value, gap), (columns, slopes) = jax.vmap(along, out_axes=(None, -1))(seeds(unknowns))
    active = jnp.concatenate([problem.active, jnp.ones(unknowns.states.shape[1])])[None, None, :]
    columns = where(jnp.isfinite(columns), columns, 0.0) * active
    slopes = where(jnp.isfinite(slopes), slopes, 0.0)
    return blocks_of_columns(value, gap, columns, slopes * active, problem.segments.joined)


def seeds(unknowns: Unknowns) -> Unknowns:
    """Tangents, by row, that move one parameter, or one and the same state of every segment: no row of the residual
    depends on the states of two segments."""
    parameters = unknowns.parameters.shape[0]
    segments, states = unknowns.states.shape

    def seed(unit: Array) -> Unknowns:
        return Unknowns(unit[:parameters], jnp.broadcast_to(unit[None, parameters:], (segments, states)))

    return jax.vmap(seed)(jnp.eye(parameters + states))


def blocks_of_columns(value: Array, gap: Array, columns: Array, slopes: Array, joined: Array) -> Blocks:
    """The blocks behind what [`seeds`][], along the last axis, do to residual (columns) and gaps (slopes)."""
    states = gap.shape[1]
    parameters = columns.shape[2] - states
    # A gap is a segment's own initial state minus the end of the one before.
    own = where(joined[:, None, None], jnp.eye(states), 0.0)
    return Blocks(
        residual=value,
        by_parameter=columns[..., :parameters],
        by_state=columns[..., parameters:],
        gap=gap,
        before_by_parameter=-slopes[..., :parameters],
        before_by_state=own - slopes[..., parameters:],
    )


class LinearisedResidual(eqx.Module):
    """What the least squares solver of optimistix minimises the squares of: residual and weighted gaps. (Their
    derivatives are carried along by [`fitting.estimation.engines.residual_with_blocks`][].)"""

    rows: Float[Array | np.ndarray, "segments rows"]
    gap: Float[Array | np.ndarray, "segments states"]


def seen_residual(found: Blocks, gap_weight: Float[Array, " states"]) -> LinearisedResidual:
    """What [`fitting.estimation.engines.residual_with_blocks`][] is where the blocks are of."""
    return LinearisedResidual(found.residual, found.gap * gap_weight[None])


def moved_residual(
    found: Blocks, gap_weight: Float[Array, " states"], joined: Bool[Array, " segments"], tangent: Unknowns
) -> LinearisedResidual:
    """How [`fitting.estimation.engines.residual_with_blocks`][] changes there along a tangent, parts of which may be
    None."""
    rows = jnp.zeros_like(found.residual)
    if tangent.parameters is not None:
        rows = rows + jnp.einsum("srp,p->sr", found.by_parameter, tangent.parameters)
    if tangent.states is not None:
        rows = rows + jnp.einsum("srq,sq->sr", found.by_state, tangent.states)
    return LinearisedResidual(rows, moved_gap(found, joined, tangent) * gap_weight[None])


def moved_gap(
    found: Blocks | Products, joined: Bool[Array | np.ndarray, " segments"], tangent: Unknowns
) -> Float[Array | np.ndarray, "segments states"]:
    """How the gaps change along a tangent, parts of which may be None."""
    library = library_of(found.gap, tangent.parameters, tangent.states)
    gap = library.zeros_like(found.gap)
    if tangent.parameters is not None:
        gap = gap - found.before_by_parameter @ tangent.parameters
    if tangent.states is not None:
        before = library.roll(tangent.states, 1, axis=0)
        own = library.where(joined[:, None], tangent.states, 0.0)
        gap = gap + own - (found.before_by_state @ before[:, :, None])[:, :, 0]
    return gap
