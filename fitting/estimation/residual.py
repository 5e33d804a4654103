"""Measured minus simulated outputs on every segment and their Jacobian, as all fits compute them."""

from dataclasses import replace
from typing import Literal

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.estimation.free_parameters import FreeParameters
from fitting.estimation.segments import Segments
from fitting.record import Record
from hdjax import Model
from hdjax.compilation import library_of
from hdjax.engine import Kernel
from hdjax.simulate import march, read, simulate
from hdjax.where import where

# Residual of a diverged simulation, in standard deviations, so that the step is rejected. (Its own square would
# overflow.)
LOST = 1e8
RUNAWAY = 1e-3 * LOST
"""Standard deviations beyond which a simulation counts as diverged; smaller than its residual, as weights may have
changed since."""

Engine = Literal["XLA", "diffrax"]
"""Engines other than machine code: the same solver steps by XLA, or `diffrax.diffeqsolve` with adaptive steps."""


def _as_integer(value: int | Int[Array, ""]) -> Int[Array, ""]:
    return jnp.asarray(np.asarray(value) if isinstance(value, int) else value, dtype=int)


class Problem(eqx.Module):
    """All that the residual depends on except the unknowns.

    Attributes:
        model: supplies the fixed parameters.
        free: the free parameters.
        segments: the data.
        whitening: `whitening @ e` has unit covariance for an output error e.
        active: 1 for a free parameter, 0 for a fixed one; as data, so that one program serves both.
        gap_weight: weight of each state in the gaps between joined segments.
        solver: explicit Runge-Kutta solver of diffrax.
        substeps: its steps in each sample interval; data, so that finer steps need no other program.
        kernel: machine code that computes the same faster, see [`fitting.estimation.machine_code`][]; None where XLA is
            used.
        engine: requested in place of machine code; None for machine code where possible.
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


class Unknowns(Record):
    """Unknowns of a fit: the free parameters, and the initial state of each segment."""

    parameters: Float[Array | np.ndarray, " parameters"]
    states: Float[Array | np.ndarray, "segments states"]


class Blocks(eqx.Module):
    """Residual and Jacobian. A segment's rows and final state depend only on the shared parameters and its own initial
    state.

    Attributes:
        residual: see [`residual`][].
        by_parameter: derivative of the residual.
        by_state: likewise.
        gap: initial state of each joined segment minus the preceding segment's final state; zero where a segment is not
            joined.
        before_by_parameter: derivative of the preceding segment's final state; zero where a segment is not joined.
        before_by_state: likewise, with respect to the initial state of the segment before.
    """

    residual: Float[Array | np.ndarray, "segments rows"]
    by_parameter: Float[Array | np.ndarray, "segments rows parameters"]
    by_state: Float[Array | np.ndarray, "segments rows states"]
    gap: Float[Array | np.ndarray, "segments states"]
    before_by_parameter: Float[Array | np.ndarray, "segments states parameters"]
    before_by_state: Float[Array | np.ndarray, "segments states states"]


class Products(Record):
    """Products of residual and Jacobian for the normal equations.

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
        """Products of a residual and its Jacobian."""
        library = library_of(found.residual, found.by_state)
        columns = library.concatenate([found.by_parameter, found.by_state, found.residual[:, :, None]], axis=2)
        ends = found.gap, found.before_by_parameter, found.before_by_state
        return Products(library.swapaxes(columns, 1, 2) @ columns, *ends)

    def beside_prior(
        self, off: Float[Array | np.ndarray, " parameters"], slope: Float[Array | np.ndarray, " parameters"]
    ) -> "Products":
        """Add the parameters' prior as rows of the first segment.

        Args:
            off: deviation of each parameter's entry from its prior mean, in standard deviations.
            slope: its derivative by the entry; zero for a fixed parameter.
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
    """Simulated outputs and final state of each segment; `intervals` as in [`hdjax.simulate.march`][]."""
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
        return read(model, own.knots[:-1], states, own, load_torque, temperature), end

    one = solved if problem.engine == "diffrax" else marched
    return jax.vmap(one)(segments.torque, segments.load_torque, temperature, unknowns.states)


def residual(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array, "segments rows"], Float[Array, "segments states"]]:
    """Whitened output error of each segment, then its hidden initial states in units of their prior; and the gap before
    each joined segment."""
    weight = problem.segments.weight[:, :, None]
    outputs, end = simulate_segments(problem, unknowns, _needed(problem.segments))
    # A simulation may diverge where weights are zero; infinity times zero is not zero.
    error = where(weight > 0, (problem.segments.measured - outputs) * weight, 0.0)
    white = jnp.einsum("ij,snj->sni", problem.whitening, error)
    rows = white.reshape(white.shape[0], -1)
    rows = where(jnp.abs(rows) < LOST, rows, LOST)
    joined = problem.segments.joined[:, None]
    rows = jnp.concatenate([rows, where(joined, 0.0, _state_prior(problem, unknowns))], axis=1)
    gap = unknowns.states - jnp.roll(end, 1, axis=0)
    gap = where(jnp.abs(gap) < LOST, gap, LOST)
    return rows, where(joined, gap, 0.0)


def slopes_by_zero(problem: Problem) -> Float[np.ndarray, "segments rows"]:
    """Derivative of the residual by what is subtracted from the dynamic error, the last output."""
    by_sample = -np.asarray(problem.segments.weight)[:, :, None] * np.asarray(problem.whitening)[:, -1]
    hidden = len(problem.model.state_names) - len(problem.model.motion_states)
    return np.pad(by_sample.reshape(len(by_sample), -1), ((0, 0), (0, hidden)))


def _needed(segments: Segments) -> Int[Array, ""]:
    """Number of sample intervals to simulate: up to the last valid sample of any segment; all where segments are
    joined."""
    length = segments.weight.shape[1]
    counts = jnp.any(segments.weight > 0, axis=0)
    last = jnp.max(where(counts, jnp.arange(length), 0))
    return where(jnp.any(segments.joined), length, last)


def _state_prior(problem: Problem, unknowns: Unknowns) -> Float[Array, "segments hidden"]:
    """Hidden initial states need a prior: some are not observable from the data."""
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
    """Residual and Jacobian from one simulation, vectorised over segments and sensitivities (forward mode)."""

    def along(tangent: Unknowns):
        return jax.jvp(lambda u: residual(problem, u), (unknowns,), (tangent,))

    (value, gap), (columns, slopes) = jax.vmap(along, out_axes=(None, -1))(seeds(unknowns))
    active = jnp.concatenate([problem.active, jnp.ones(unknowns.states.shape[1])])[None, None, :]
    columns = where(jnp.isfinite(columns), columns, 0.0) * active
    slopes = where(jnp.isfinite(slopes), slopes, 0.0)
    return blocks_of_columns(value, gap, columns, slopes * active, problem.segments.joined)


def seeds(unknowns: Unknowns) -> Unknowns:
    """Tangents, by row, of one parameter, or of the same state in every segment: no row of the residual depends on two
    segments' states."""
    parameters = unknowns.parameters.shape[0]
    segments, states = unknowns.states.shape

    def seed(unit: Array) -> Unknowns:
        return Unknowns(unit[:parameters], jnp.broadcast_to(unit[None, parameters:], (segments, states)))

    return jax.vmap(seed)(jnp.eye(parameters + states))


def blocks_of_columns(value: Array, gap: Array, columns: Array, slopes: Array, joined: Array) -> Blocks:
    """The Jacobian's blocks from the derivatives of residual (columns) and gaps (slopes) along [`seeds`][], on the last
    axis."""
    states = gap.shape[1]
    parameters = columns.shape[2] - states
    # A gap is a segment's initial state minus the preceding segment's final state.
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
    """Residual and weighted gaps, whose squares the solver of optimistix minimises.
    ([`fitting.estimation.engines.residual_with_blocks`][] supplies derivatives.)"""

    rows: Float[Array | np.ndarray, "segments rows"]
    gap: Float[Array | np.ndarray, "segments states"]


def seen_residual(found: Blocks, gap_weight: Float[Array, " states"]) -> LinearisedResidual:
    """Value of [`fitting.estimation.engines.residual_with_blocks`][] at the blocks' point."""
    return LinearisedResidual(found.residual, found.gap * gap_weight[None])


def moved_residual(
    found: Blocks, gap_weight: Float[Array, " states"], joined: Bool[Array, " segments"], tangent: Unknowns
) -> LinearisedResidual:
    """Derivative of [`fitting.estimation.engines.residual_with_blocks`][] along a tangent, parts of which may be
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
    """Derivative of the gaps along a tangent, parts of which may be None."""
    library = library_of(found.gap, tangent.parameters, tangent.states)
    gap = library.zeros_like(found.gap)
    if tangent.parameters is not None:
        gap = gap - found.before_by_parameter @ tangent.parameters
    if tangent.states is not None:
        before = library.roll(tangent.states, 1, axis=0)
        own = library.where(joined[:, None], tangent.states, 0.0)
        gap = gap + own - (found.before_by_state @ before[:, :, None])[:, :, 0]
    return gap
