"""Simulation of drives under random torque."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from hdjax.dynamics import Model, State
from hdjax.effects import Conditions
from hdjax.noise import Noise, WhiteNoise
from hdjax.results import Ending
from hdjax.signals import PiecewisePolynomial
from hdjax.simulate import Trajectory, no_torque, raise_failure, read, require_sampled, require_start

_SPREAD = np.sqrt(1.0 / 8.0)
# A class that diffrax documents but doesn't export.
_AdditiveCoeffs: Any = type(dfx.ShARK.tableau.coeffs_w)


class AdditiveRK4(dfx.AbstractSRK, dfx.AbstractStratonovichSolver):
    """The classical fourth-order Runge-Kutta method, extended to additive noise.

    A lightly damped drive needs it. The energy of the noise is dissipated at the small rate mu, so a solver's energy
    error must be smaller. With `z = omega_0 h`, a step h of diffrax's two-stage ShARK and SRA1 raises the energy at the
    rate `omega_0 z^3/4` (above mu for a damping ratio of 5e-4 and z = 0.16, where a stationary motion then grows for
    ever); RK4 lowers it at `omega_0 z^5/72`. diffrax's Langevin solvers (ALIGN, ShOULD, QUICSORT) assume a damping
    `gamma v` and a force of x alone: no forcing in time, no friction or hidden state of an effect, no coloured noise.

    Stage i evaluates the drift at `y + h sum_j a_ij f_j + g (u_i W + H)`, W and H being the step's increment and
    space-time Levy area, with `u = (0, 1/2 + s, 1/2 - s, 1)` and `s^2 = 1/8`. That makes

        sum b_i u_i = 1/2        sum b_i a_ij u_j = 1/6        sum b_i (u_i^2 + 1/12) = 1/2

    (and sums of 1 and 1/2 for H): the increments that the drift's slope carries are exact to second order, and so is
    the mean that its curvature makes. Hence strong order 1.5 and weak order 2, as ShARK, but order 4 in the drift.

    References:
        Conditions: Roessler, SIAM J. Numer. Anal. 48 (2010) 922; Foster, dos Reis, Strange, arXiv:2210.17543. The
        coefficients are ours; `tests/simulator/test_stochastic.py` tests them against the exact law of one step.
    """

    tableau: ClassVar[dfx.StochasticButcherTableau] = dfx.StochasticButcherTableau(
        a=[np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])],
        b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
        b_error=None,
        c=np.array([0.5, 0.5, 1.0]),
        coeffs_w=_AdditiveCoeffs(a=np.array([0.0, 0.5 + _SPREAD, 0.5 - _SPREAD, 1.0]), b_sol=np.array(1.0)),
        coeffs_hh=_AdditiveCoeffs(a=np.ones(4), b_sol=np.array(0.0)),
        coeffs_kk=None,
        ignore_stage_f=None,
        ignore_stage_g=None,
    )

    def order(self, terms):
        return 4

    def strong_order(self, terms):
        return 1.5


class _StepwiseBrownianPath(dfx.AbstractBrownianPath):
    """Brownian motion for steps known beforehand: step k draws from the key folded with k.

    diffrax's `UnsafeBrownianPath` folds in the bits of the times instead, so that rounding, which differs between a
    compiled program and a plain one, would give another motion. Its tree serves any times, at
    the cost of a descent at each step.
    """

    key: PRNGKeyArray
    steps: Float[Array, " steps"]
    levy_area: ClassVar[Any] = dfx.SpaceTimeLevyArea

    @property
    def t0(self):
        return self.steps[0]

    @property
    def t1(self):
        return self.steps[-1]

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True, use_levy: bool = False) -> Any:
        t0, dt = jnp.asarray(t0), jnp.asarray(t1 - t0)
        step = jnp.searchsorted(self.steps, t0 + 0.5 * dt)
        w, h = jnp.sqrt(dt) * jax.random.normal(jax.random.fold_in(self.key, step), (2, 2), dt.dtype)
        return dfx.SpaceTimeLevyArea(dt=dt, W=w, H=h / np.sqrt(12.0)) if use_levy else w


def simulate_noisy(
    model: Model,
    noise: Noise,
    times: Float[Array | np.ndarray, " n"],
    key: PRNGKeyArray,
    initial_state: State | None = None,
    *,
    forcing: Callable[[Array], Array] = no_torque,
    load_torque: Callable[[Array], Array] = no_torque,
    substeps: int = 10,
    solver: dfx.AbstractSolver | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    throw: bool = True,
) -> Trajectory:
    """Simulate a drive under a torque that is partly random.

    Use `jax.vmap` over keys for many motions. The same key and steps give the same motion.

    Args:
        model: the equations, with all effects.
        noise: the random torque, added to `forcing` and `load_torque` (behind any actuator effect).
        times: where to save [s], rising; the first is the start.
        key: source of the noise.
        initial_state: the model's state at `times[0]`; at rest where not given. Coloured noise starts stationary.
        forcing: motor torque [N m] (or a reduced drive's forcing) as a function of time. Steps don't look for its
            jumps: put them on `times`.
        load_torque: torque on the load along +theta_l [N m].
        substeps: steps from one saved time to the next. Steps of `z/omega_0` lower a stationary variance by the
            part `omega_0 z^5/(72 mu)`; let z be 0.2, or 0.1 for a damping ratio below 1e-3, and a step no longer than
            half the noise's correlation time.
        solver: a diffrax solver for additive noise that needs no more than space-time Levy areas, for instance
            `diffrax.ShARK()`; [`AdditiveRK4`][] where not given.
        adjoint: how to differentiate, see [`hdjax.simulate`][].
        throw: whether a simulation that did not reach its end raises. With False each lane of a vmap keeps its own
            ending.

    Returns:
        The trajectory. Behind the model's states, those under coloured noise show its motor and load torque [N m].

    Raises:
        ValueError: where an effect acts on the logged torque, but the forcing is not a sampled signal; where an effect
            is a function of the motor torque and that is white noise; where the times are fewer than two or do not
            rise, or the initial state is not one of the model.
        SimulationError: with the [`Ending`][] that names cause and mend.
    """
    require_sampled(model, forcing)
    if substeps < 1:
        raise ValueError(f"`substeps` must be at least 1, but is {substeps}")
    if isinstance(noise, WhiteNoise):
        for effect in model.effects:
            if effect.follows_torque:
                raise ValueError(
                    f"`{effect.name}` is a function of the motor torque, which white noise has no value of"
                )
    times = jnp.asarray(times, dtype=float)
    initial_state = model.rest() if initial_state is None else initial_state
    require_start(model, times, initial_state)
    # Two equal times have no step between them that noise could act in.
    if times.size < 2 or not (isinstance(times, Tracer) or np.all(np.diff(times) > 0.0)):
        raise ValueError("`times` must be two or more, each later than the one before")
    trajectory = _simulate_noisy(
        model,
        noise,
        times,
        key,
        initial_state,
        forcing,
        load_torque,
        substeps,
        AdditiveRK4() if solver is None else solver,
        dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
    )
    return raise_failure(trajectory) if throw else trajectory


def _drift(t, state, args):
    model, noise, torque, load_torque, _ = args
    own = state[len(model.state_names) :]
    motor, load = noise.torques(own)
    torques = torque(t) + motor, load_torque(t) + load
    motion = model.rates(state[: len(model.state_names)], *torques, Conditions(time=t))
    return jnp.concatenate([motion, noise.rates(own)])


def _diffusion(t, state, args):
    return args[-1]


@eqx.filter_jit
def _simulate_noisy(
    model, noise, times, key, initial_state, forcing, load_torque, substeps, solver, adjoint
) -> Trajectory:
    torque = model.actuate(forcing) if isinstance(forcing, PiecewisePolynomial) else forcing
    start_key, path_key = jax.random.split(key)
    # Torque enters the accelerations linearly and independently of the state, so any state will do.
    acceleration = jax.jacfwd(lambda u: model.rates(model.rest(), u[0], u[1], Conditions(time=times[0])))(jnp.zeros(2))
    fractions = jnp.arange(substeps, dtype=times.dtype) / substeps
    steps = times[:-1, None] + jnp.diff(times)[:, None] * fractions[None, :]
    steps = jnp.concatenate([jnp.ravel(steps), times[-1:]])
    solution = dfx.diffeqsolve(
        dfx.MultiTerm(dfx.ODETerm(_drift), dfx.ControlTerm(_diffusion, _StepwiseBrownianPath(path_key, steps))),
        solver,
        times[0],
        times[-1],
        None,
        jnp.concatenate([initial_state, noise.start(start_key)]),
        args=(model, noise, torque, load_torque, noise.diffusion(acceleration)),
        saveat=dfx.SaveAt(ts=times),
        stepsize_controller=dfx.StepTo(steps),
        adjoint=adjoint,
        max_steps=steps.size,
        throw=False,
    )
    states = jnp.asarray(solution.ys)
    ending = jnp.where(jnp.all(jnp.isfinite(states)), int(Ending.successful), int(Ending.not_finite))
    ending = jnp.where(solution.result == dfx.RESULTS.successful, ending, int(Ending.solver_failed))
    outputs = read(model, times, states[:, : len(model.state_names)], torque, load_torque, None)
    return Trajectory(times, states, outputs, ending, model.measured)
