"""Periodic motions by shooting: Newton's method on the map over one forcing period, and their Floquet multipliers."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Complex, Float

from hdjax.dynamics import Model, ReducedModel, State
from hdjax.fourier import FourierSeries, fourier_series
from hdjax.simulate import Trajectory, no_torque, simulate
from hdjax.where import where


class PeriodicOrbit(eqx.Module):
    """A motion that repeats after `periods` forcing periods.

    A lane that did not converge keeps its guess, with the identity as its monodromy and an infinite residual where
    the motion escapes: no number is NaN.

    Attributes:
        omega: forcing frequency [rad/s].
        periods: forcing periods after which it repeats.
        state: state at t = 0; names in `Model.state_names`.
        monodromy: derivative of the state after `periods` periods with respect to the state at t = 0.
        multipliers: Floquet multipliers, the eigenvalues of the monodromy.
        residual: difference of the state after the periods, relative to the motion's size (see [`shoot`][]).
        converged: whether Newton's method met its tolerance.
    """

    omega: Float[Array, "*lanes"]
    state: Float[Array, "*lanes states"]
    monodromy: Float[Array, "*lanes states states"]
    multipliers: Complex[Array, "*lanes states"]
    residual: Float[Array, "*lanes"]
    converged: Bool[Array, "*lanes"]
    periods: int = eqx.field(static=True, default=1)

    @property
    def stable(self) -> Bool[Array, "*lanes"]:
        """Whether small disturbances die out: a converged orbit with all multipliers inside the unit circle."""
        return self.converged & jnp.all(jnp.abs(self.multipliers) < 1.0, axis=-1)


def period_map(
    model: Model,
    forcing: FourierSeries,
    state: State,
    *,
    periods: int = 1,
    load_torque: Callable[[Array], Array] = no_torque,
    solver: dfx.AbstractSolver | None = None,
    rtol: float = 1e-10,
    atol: float = 1e-14,
    max_steps: int = 10_000,
    throw: bool = True,
) -> State:
    """The state after `periods` forcing periods, `periods 2 pi / omega`.

    Derivatives with respect to anything (state, parameters, forcing, omega) are in forward mode: `jax.jvp` or
    `jax.jacfwd`.

    Args:
        model: the equations.
        forcing: motor torque [N m] (or a reduced drive's forcing).
        state: the state at t = 0.
        periods: number of forcing periods.
        load_torque: torque on the load along +theta_l [N m]; ignored by a reduced drive.
        solver: any diffrax solver; Dopri8 where not given.
        rtol: relative tolerance of the steps.
        atol: absolute tolerance of the steps.
        max_steps: steps until the motion counts as escaped.
        throw: whether a motion that did not reach the end raises an error; never inside a trace, where it is not
            finite.

    Raises:
        SimulationError: with the [`hdjax.Ending`][] that names cause and mend.
    """
    times = jnp.asarray([0.0, 1.0]) * period(forcing, periods)
    options: dict[str, Any] = {"rtol": rtol, "atol": atol, "max_steps": max_steps, "throw": throw}
    return _run(model, forcing, times, state, load_torque=load_torque, solver=solver, **options).states[-1]


def monodromy(model: Model, forcing: FourierSeries, state: State, **options: Any) -> Float[Array, "states states"]:
    """Derivative of [`period_map`][] with respect to the state.

    Args:
        model: the equations.
        forcing: motor torque [N m] (or a reduced drive's forcing).
        state: the state at t = 0.
        **options: of [`period_map`][].
    """
    return jax.jacfwd(lambda s: period_map(model, forcing, s, **options))(state)


def shoot(
    model: Model,
    forcing: FourierSeries,
    guess: State,
    *,
    periods: int = 1,
    solver: dfx.AbstractSolver | None = None,
    rtol: float = 1e-10,
    atol: float = 1e-14,
    max_steps: int = 10_000,
    tolerance: float = 1e-9,
    max_iterations: int = 30,
) -> PeriodicOrbit:
    """The periodic motion near a guess, stable or not, by Newton's method on the period map.

    Sub-harmonics repeat after several `periods`; so does the harmonic motion, so that the result depends on the guess.
    The unknowns are measured in the motion's size, `L` for x and `omega L` for v, with `L` from the guess and the
    forcing. Derivatives of the orbit with respect to the model and the forcing are those of the implicit function
    theorem, in forward mode (`jax.jvp`, `jax.jacfwd`). Works under `jax.vmap`: each lane keeps its own `converged`.

    Args:
        model: a reduced model. A load torque is part of its forcing, see [`hdjax.Drive.error_forcing`][].
        forcing: the reduced drive's forcing.
        guess: state at t = 0 from which to start.
        periods: forcing periods after which the motion repeats.
        solver: any diffrax solver; Dopri8 where not given.
        rtol: relative tolerance of the steps.
        atol: absolute tolerance of the steps.
        max_steps: steps until a motion counts as escaped.
        tolerance: of the last Newton step and of the residual, relative to the motion's size.
        max_iterations: Newton steps until it counts as not converged.

    Raises:
        ValueError: for a model with two inertias. Its angles turn freely, so that the period map less the identity is
            singular; shoot for the dynamic error of `ReducedModel(drive.reduced())`.

    References:
        Nayfeh, A. H., Balachandran, B. (1995). Applied Nonlinear Dynamics, chapters 3 and 6.
    """
    require_reduced(model)
    solver = dfx.Dopri8() if solver is None else solver
    options: dict[str, Any] = {"solver": solver, "rtol": rtol, "atol": atol, "max_steps": max_steps, "throw": False}
    # The number of periods is data, so that sub-harmonics need no further compilation.
    found = _shoot(model, forcing, guess, jnp.asarray(periods, dtype=float), options, tolerance, max_iterations)
    return PeriodicOrbit(forcing.omega, *found, periods=periods)


def steady_series(
    model: Model,
    forcing: FourierSeries,
    orbit: PeriodicOrbit,
    *,
    harmonics: int = 16,
    samples: int | None = None,
    rtol: float = 1e-10,
    atol: float = 1e-14,
) -> FourierSeries:
    """The dynamic error of a periodic motion as a Fourier series with fundamental `omega / periods`.

    Args:
        model: the equations.
        forcing: the forcing that the orbit was found under.
        orbit: from [`shoot`][].
        harmonics: the highest multiple of `omega / periods` to keep.
        samples: of one repetition; what the motion holds above half of them is folded down. Where not given, four for
            each harmonic, and at least 64.
        rtol: relative tolerance of the steps.
        atol: absolute tolerance of the steps.
    """
    samples = max(64, 4 * harmonics) if samples is None else samples
    times = jnp.arange(samples) / samples * period(forcing, orbit.periods)
    found = _run(model, forcing, times, orbit.state, rtol=rtol, atol=atol)
    return fourier_series(forcing.omega / orbit.periods, found.dynamic_error, harmonics)


def period(forcing: FourierSeries, periods: int | Float[Array, ""] = 1) -> Float[Array, ""]:
    """Duration of `periods` forcing periods [s]."""
    return 2.0 * jnp.pi * periods / forcing.omega


def require_reduced(model: Model) -> None:
    """Refuse a model whose motion includes a free rotation.

    Raises:
        ValueError: where the model is not a [`hdjax.ReducedModel`][].
    """
    if not isinstance(model, ReducedModel):
        raise ValueError(
            "`model` must be a ReducedModel, whose states can repeat, but is "
            f"{type(model).__name__}, whose angles turn freely: use ReducedModel(drive.reduced())"
        )


def motion_size(model: ReducedModel, forcing: FourierSeries, state: State) -> Float[Array, ""]:
    """A twist [rad] that a motion through `state` under the forcing is at least comparable to."""
    drive = model.drive
    push = jnp.abs(forcing.mean) + jnp.sum(forcing.amplitudes)
    size = jnp.abs(state[0]) + jnp.abs(state[1]) / forcing.omega
    size = size + jnp.abs(drive.gain) * push / (forcing.omega**2 + drive.omega_0**2)
    return where(size > 0.0, size, 1.0)


def _run(model: Model, forcing: FourierSeries, times: Array, state: State, **options: Any) -> Trajectory:
    """[`hdjax.simulate`][] with a solver for tight tolerances and derivatives in forward mode."""
    solver = options.pop("solver", None)
    solver = dfx.Dopri8() if solver is None else solver
    return simulate(model, forcing, times, state, solver=solver, adjoint=dfx.ForwardMode(), **options)


@eqx.filter_jit
def _shoot(model, forcing, guess, periods, options, tolerance, max_iterations) -> tuple[Array, ...]:
    """State, monodromy, multipliers, residual and convergence of [`shoot`][]."""
    size = motion_size(model, forcing, guess)
    own = [effect.state_scale() for effect in model.effects if effect.states]
    scale = lax.stop_gradient(jnp.concatenate([jnp.stack([size, forcing.omega * size]), *own]))

    def miss(scaled, args):
        model, forcing = args
        times = jnp.asarray([0.0, 1.0]) * period(forcing, periods)
        return _run(model, forcing, times, scale * scaled, **options).states[-1] / scale - scaled

    def miss_twice(scaled):
        found = miss(scaled, (model, forcing))
        return found, found

    start = guess / scale
    newton = optx.Newton(rtol=tolerance, atol=tolerance)
    root = optx.root_find(miss, newton, start, (model, forcing), max_steps=max_iterations, throw=False)
    finite = jnp.all(jnp.isfinite(root.value))
    scaled = where(finite, root.value, start)
    slope, residual = jax.jacfwd(miss_twice, has_aux=True)(scaled)
    usable = jnp.all(jnp.isfinite(slope)) & jnp.all(jnp.isfinite(residual))
    matrix = jnp.eye(scale.size) + where(usable, slope, 0.0)
    return (
        scale * scaled,
        matrix * scale[:, None] / scale[None, :],
        jnp.linalg.eigvals(matrix),
        where(usable, jnp.max(jnp.abs(residual)), jnp.inf),
        (root.result == optx.RESULTS.successful) & finite & usable,
    )
