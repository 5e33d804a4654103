"""Simulation of the equations of motion: by diffrax, and by a march in fixed steps for fits.

Other integrators are specialised: machine code for fits and sweeps (`hdjax.engine`), steady motions (`hdjax.response`),
many lanes (`hdjax.sweep`) and random torque (`hdjax.stochastic`).
"""

import functools
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from hdjax.dynamics import BOTH_ANGLES, Inputs, Model, State
from hdjax.effects import ActuatorEffect, Conditions
from hdjax.results import Ending, SimulationError
from hdjax.rubbing import over_step
from hdjax.signals import PiecewisePolynomial, polynomial
from hdjax.where import where


class Trajectory(eqx.Module):
    """A simulated motion.

    Attributes:
        time: where the states were saved [s].
        states: states by row; names in `Model.state_names`.
        outputs: of the sensors, see `Model.outputs`.
        ending: an [`Ending`][] as an integer.
        measured: names of the outputs.
    """

    time: Float[Array, " n"]
    states: Float[Array, "n states"]
    outputs: Float[Array, "n outputs"]
    ending: Array
    measured: tuple[str, ...] = eqx.field(static=True, default=BOTH_ANGLES)

    @property
    def dynamic_error(self) -> Float[Array, " n"]:
        """The measured dynamic error [rad].

        Raises:
            ValueError: no sensor measures it.
        """
        if "dynamic_error" not in self.measured:
            raise ValueError(f"the outputs are {', '.join(self.measured)}; give the model `measured` with both angles")
        return self.outputs[..., self.measured.index("dynamic_error")]


def no_torque(t: Array) -> Array:
    """No torque at any time."""
    return jnp.zeros_like(t)


def simulate(
    model: Model,
    forcing: Callable[[Array], Array],
    times: Float[Array | np.ndarray, " n"],
    initial_state: State | None = None,
    *,
    load_torque: Callable[[Array], Array] = no_torque,
    temperature: Callable[[Array], Array] | None = None,
    solver: dfx.AbstractSolver | None = None,
    step_size: float | None = None,
    rtol: float = 1e-8,
    atol: float = 1e-10,
    max_steps: int = 1_000_000,
    adjoint: dfx.AbstractAdjoint | None = None,
    progress_meter: dfx.AbstractProgressMeter | None = None,
    throw: bool = True,
) -> Trajectory:
    """Simulate a drive under a torque.

    **Main arguments:**

    Args:
        model: the equations.
        forcing: motor torque [N m] (or a reduced drive's forcing) as a function of time. Sampled signals come from
            [`hdjax.sampled`][]; the solver resolves their jumps.
        times: where to save [s], rising; the first is the start.
        initial_state: state at `times[0]`; at rest where not given.

    **Other arguments:**

    Args:
        load_torque: torque on the load along +theta_l [N m].
        temperature: of the drive [K], for effects that depend on it.
        solver: any diffrax solver; Tsit5 where not given.
        step_size: a fixed step [s]; adaptive where not given.
        rtol: relative tolerance of adaptive steps.
        atol: absolute tolerance of adaptive steps.
        max_steps: largest number of steps.
        adjoint: how to differentiate: diffrax's default is reverse mode, `diffrax.ForwardMode()` is forward.
        progress_meter: silent where not given; `diffrax.TqdmProgressMeter()` or `TextProgressMeter()` show progress.
        throw: whether a simulation that did not reach its end raises an error. With False each lane of a vmap keeps its
            ending, and its states are finite until it failed.

    Returns:
        The trajectory.

    Raises:
        ValueError: an effect acts on the logged torque, but the forcing is not a sampled signal; the times do not rise,
            or the initial state is not one of the model.
        SimulationError: with the [`Ending`][] that names cause and mend.
    """
    require_sampled(model, forcing)
    times = jnp.asarray(times, dtype=float)
    if initial_state is None:
        initial_state = model.rest()
    require_start(model, times, initial_state)
    trajectory = _simulate(
        model,
        forcing,
        times,
        initial_state,
        load_torque,
        temperature,
        dfx.Tsit5() if solver is None else solver,
        step_size,
        rtol,
        atol,
        max_steps,
        dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        dfx.NoProgressMeter() if progress_meter is None else progress_meter,
    )
    return raise_failure(trajectory) if throw else trajectory


def require_sampled(model: Model, forcing: Callable[[Array], Array]) -> None:
    """Refuse a forcing that the model's effects on the logged torque can't act on."""
    actuators = [effect.name for effect in model.effects if isinstance(effect, ActuatorEffect)]
    if actuators and not isinstance(forcing, PiecewisePolynomial):
        raise ValueError(
            f"`forcing` must be a sampled signal for {actuators} to act on, but is {type(forcing).__name__}"
        )


def require_start(model: Model, times: Array, initial_state: Array) -> None:
    """Refuse times that do not rise, and a state that is not one of the model."""
    if times.ndim != 1 or times.size == 0 or not (isinstance(times, Tracer) or np.all(np.diff(times) >= 0.0)):
        raise ValueError("`times` must rise from the start of the simulation on, but do not")
    if np.shape(initial_state) != (len(model.state_names),):
        names, shape = ", ".join(model.state_names), np.shape(initial_state)
        raise ValueError(f"`initial_state` must have a number for each of {names}, but has the shape {shape}")


def raise_failure(trajectory: Trajectory) -> Trajectory:
    """The trajectory, if it reached its end; inside a transformation it is not checked."""
    if not isinstance(trajectory.ending, Tracer):
        worst = int(np.max(trajectory.ending))
        if worst != Ending.successful:
            raise SimulationError(Ending(worst))
    return trajectory


@eqx.filter_jit
def _simulate(
    model,
    forcing,
    times,
    initial_state,
    load_torque,
    temperature,
    solver,
    step_size,
    rtol,
    atol,
    max_steps,
    adjoint,
    progress_meter,
) -> Trajectory:
    torque = model.actuate(forcing) if isinstance(forcing, PiecewisePolynomial) else forcing

    def field(t, state, args):
        model, torque, load_torque, temperature = args
        conditions = Conditions(time=t, temperature=None if temperature is None else temperature(t))
        return model.rates(state, torque(t), load_torque(t), conditions)

    if step_size is None:
        controller: Any = dfx.PIDController(rtol=rtol, atol=atol)
        jumps = [
            signal.knots for signal in (torque, load_torque, temperature) if isinstance(signal, PiecewisePolynomial)
        ]
        if jumps:
            controller = dfx.ClipStepSizeController(controller, jump_ts=jnp.sort(jnp.concatenate(jumps)))
    else:
        controller = dfx.ConstantStepSize()
    solution = dfx.diffeqsolve(
        dfx.ODETerm(field),
        solver,
        times[0],
        times[-1],
        step_size,
        initial_state,
        args=(model, torque, load_torque, temperature),
        saveat=dfx.SaveAt(ts=times),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        progress_meter=progress_meter,
        throw=False,
    )
    states = jnp.asarray(solution.ys)
    finite = jnp.all(jnp.isfinite(states))
    result = solution.result
    ending = jnp.where(finite, int(Ending.successful), int(Ending.not_finite))
    for diffrax_result, ours in (
        (dfx.RESULTS.max_steps_reached, Ending.step_limit),
        (dfx.RESULTS.dt_min_reached, Ending.step_too_small),
    ):
        ending = jnp.where(result == diffrax_result, int(ours), ending)
    failed = (result != dfx.RESULTS.successful) & (ending == int(Ending.successful))
    ending = jnp.where(failed, int(Ending.solver_failed), ending)
    outputs = read(model, times, states, torque, load_torque, temperature)
    return Trajectory(times, states, outputs, ending, model.measured)


def read(
    model: Model,
    times: Float[Array, " n"],
    states: Float[Array, "n states"],
    torque: Callable[[Array], Array],
    load_torque: Callable[[Array], Array] | None,
    temperature: Callable[[Array], Array] | None,
) -> Float[Array, "n outputs"]:
    """Outputs of a model's sensors along a motion.

    Args:
        model: the equations.
        times: of the states [s].
        states: by row.
        torque: torque after `Model.actuate`.
        load_torque: on the load; zero where None.
        temperature: of the drive [K], or None.
    """

    def before(signal: Any, t: Array) -> Array:
        return signal.before(t) if isinstance(signal, PiecewisePolynomial) else signal(t)

    def one(t: Array, state: State) -> Array:
        load = jnp.zeros_like(t) if load_torque is None else before(load_torque, t)
        warmth = None if temperature is None else before(temperature, t)
        return model.outputs(state, Inputs(before(torque, t), load, Conditions(time=t, temperature=warmth)))

    return jax.vmap(one)(times, states)


def march(
    model: Model,
    torque: PiecewisePolynomial,
    load_torque: PiecewisePolynomial | None,
    initial_state: State,
    *,
    solver: dfx.AbstractERK,
    substeps: int | Int[Array, ""],
    intervals: Int[Array, ""] | None = None,
    temperature: PiecewisePolynomial | None = None,
) -> tuple[Float[Array, "n states"], State]:
    """Simulate for a fit, by fixed steps of an explicit Runge-Kutta solver from sample to sample.

    Agrees with [`simulate`][] to the order of the solver; dry friction that turns within less than a step is taken over
    the step (see [`hdjax.rubbing`][]). It uses the solver's tableau inside one scan, so that segments, sensitivities
    and candidates are lanes of one program, without overhead per sample. A signal's polynomial belongs to one sample
    interval, so no step crosses a jump.

    Args:
        model: the equations.
        torque: torque after `Model.actuate`; its knots are the samples, and supply the time.
        load_torque: likewise on the load; zero where None.
        initial_state: state at the first knot.
        solver: an explicit Runge-Kutta solver of diffrax; its tableau is used.
        substeps: steps in each sample interval. An array is data, so that one compiled program serves any number.
        intervals: number of simulated intervals, from the first on; in the others the state is constant, at little
            cost. Data, as `substeps`; all where None.
        temperature: of the drive [K] on the same knots; None where no effect depends on it.

    Returns:
        States at each knot but the last, by row, and the state at the last.
    """
    tableau = solver.tableau if isinstance(solver, dfx.AbstractERK) else None
    if not isinstance(tableau, dfx.ButcherTableau):
        raise ValueError(f"`solver` must be an explicit Runge-Kutta solver, but is {type(solver).__name__}")
    lower = [np.asarray(row) for row in tableau.a_lower]
    nodes = np.concatenate([[0.0], np.asarray(tableau.c)])
    weights = np.asarray(tableau.b_sol)

    def interval(state, inputs):
        index, coefficients, load_coefficients, warmth, knot, width = inputs
        h = width / jnp.asarray(substeps, dtype=width.dtype)

        def around(s, rubbing=None):
            load = jnp.zeros_like(s) if load_coefficients is None else polynomial(load_coefficients, s)
            conditions = Conditions(knot + s, None if warmth is None else polynomial(warmth, s), rubbing)
            return polynomial(coefficients, s), load, conditions

        # Compiled once and called by every stage, to avoid repeated tracing.
        @jax.jit
        def rates_within(y, s, rubbing):
            return model.component_rates(y, *around(s, rubbing))

        def step(y, start):
            rates = functools.partial(rates_within, rubbing=over_step(model, y, *around(start), h))
            slopes = [rates(y, start)]
            for row, node in zip(lower, nodes[1:], strict=True):
                slopes.append(rates(_advanced(y, h, row, slopes), start + float(node) * h))
            return _advanced(y, h, weights, slopes)

        # A loop rather than unrolled steps: the program, and its compile time, stay the same size.
        steps = substeps if intervals is None else where(index < intervals, substeps, 0)
        end = jax.lax.fori_loop(0, steps, lambda j, y: step(y, jnp.asarray(j, dtype=h.dtype) * h), state)
        return end, state

    load_coefficients, warmth = (None if s is None else s.coefficients for s in (load_torque, temperature))
    width = jnp.diff(torque.knots)
    inputs = (jnp.arange(width.size), torque.coefficients, load_coefficients, warmth, torque.knots[:-1], width)
    # The state is carried as separate numbers: under vmap each is one contiguous row of lanes.
    end, states = jax.lax.scan(interval, tuple(initial_state), inputs)
    return jnp.stack(states, axis=-1), jnp.stack(end)


def _advanced(state: tuple[Array, ...], h: Array, weights: np.ndarray, slopes: list[list[Array]]) -> tuple[Array, ...]:
    """`state + h sum_i weights[i] slopes[i]`, skipping zero weights."""
    used = [(float(w), k) for w, k in zip(weights, slopes, strict=False) if w != 0.0]
    return tuple(y + h * sum(w * k[i] for w, k in used) for i, y in enumerate(state))
