"""Discrimination of two models by an experiment: their difference after the rival is refitted.

If one model is right, and a rival is fitted to its response, the rival's sum of squares in units of the noise is twice
the expected log-likelihood ratio: the T-optimality of Atkinson and Fedorov (1975, Biometrika 62, "The design of
experiments for discriminating between two rival models"). Summed over both cases of the right model it is the
divergence of Box and Hill (1967, Technometrics 9, "Discrimination among mechanistic models").

At the refit's minimum the gradient by parameters vanishes, so that the derivative of the sum of squares by the command
is that at fixed parameters (envelope theorem).
"""

from collections.abc import Sequence

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.free_parameters import FreeParameters, free_parameters
from fitting.estimation.late_readings import unaligned
from fitting.estimation.weighing import whitening
from fitting.next_experiment.excitation import Excitation, Limits
from hdjax import Hold, Model, PiecewisePolynomial, TwoInertiaModel, sampled
from hdjax.lanes import jit_lanes
from hdjax.simulate import march, read

# A refit has converged if another step would decrease its sum of squares by less than this share, or this value.
_ARRIVED, _NOTHING = 1e-2, 1e-2
_STEPS = 6
_HALVINGS = 3
# Largest step of a logarithmic parameter.
_LONGEST = 1.0
# Residual of a diverged simulation (or one with diverged derivatives), in units of the noise.
_LOST = 1e15
# A parameter that could change by more than a factor of twenty within the noise is damped.
_DAMPING = 0.1
# Singular values below this share: weakly observable directions of the unknowns.
_BLIND = 1e-10


class Explanation(eqx.Module):
    """A model that may be right.

    Attributes:
        name: that distinguishes it from its rivals.
        model: with fitted values.
        free: the free parameters of its refit.
        hold: inter-sample behaviour of the torque.
    """

    name: str = eqx.field(static=True)
    model: Model
    free: FreeParameters
    hold: Hold = eqx.field(static=True)


def explanation(
    name: str, model: Model, paths: Sequence[str], *, scale: dict[str, float] | None = None, hold: Hold
) -> Explanation:
    """An explanation with free parameters at `paths`; `scale` as in
    [`fitting.estimation.free_parameters.free_parameters`][]."""
    return Explanation(name, unaligned(model), free_parameters(model, paths, scale or {}), hold)


class Bench(eqx.Module):
    """Settings of a simulated experiment.

    Attributes:
        motor_angle: of the motor at rest at the start [rad].
        noise: covariance of the measurement noise of the outputs.
        limits: the units of the motion.
        halo: intervals of zero torque before the start, for delays.
        substeps: solver steps in a sample interval.
        temperature: of the drive [K], where an effect depends on it.
    """

    motor_angle: float
    noise: Float[Array, "outputs outputs"]
    limits: Limits
    halo: int
    substeps: int
    temperature: float | None


class Signals(eqx.Module):
    """A command's shapes as functions of time."""

    knots: Float[Array, " knots"]
    shapes: Float[Array, "intervals powers shapes"]


class Response(eqx.Module):
    """A model's response to a command, and its derivatives.

    Attributes:
        outputs: in units of the noise.
        by_unknown: derivative with respect to the unknowns of a refit: free parameters, then initial motion state.
        by_command: derivative with respect to the command's coefficients.
        motion: motor speed and the output's travel (two-inertia model only), then the dynamic error; in units of the
            limits.
        motion_by_command: its derivative by the command's coefficients.
        twist: the dynamic error [rad].
    """

    outputs: Float[np.ndarray, " rows"]
    by_unknown: Float[np.ndarray, "rows unknowns"]
    by_command: Float[np.ndarray, "rows shapes"]
    motion: Float[np.ndarray, "samples quantities"]
    motion_by_command: Float[np.ndarray, "samples quantities shapes"]
    twist: Float[np.ndarray, " samples"]

    @property
    def usable(self) -> bool:
        """Whether neither the simulation nor its derivatives diverge."""
        return all(bool(np.all(np.abs(a) < _LOST)) for a in (self.outputs, self.by_unknown, self.by_command))


class Refit(eqx.Module):
    """A rival refitted to another model's response.

    Attributes:
        unknowns: the rival's free parameters and initial motion state.
        response: at these unknowns.
        left: remaining difference, in units of the noise.
    """

    unknowns: Float[np.ndarray, " unknowns"]
    response: Response
    left: Float[np.ndarray, " rows"]

    @property
    def squares(self) -> float:
        """Its sum of squares, twice the expected log-likelihood ratio."""
        return float(self.left @ self.left)

    def slope(self, truth: Response) -> Float[np.ndarray, " shapes"]:
        """Derivative of the sum of squares by the command's coefficients."""
        return 2.0 * self.left @ (truth.by_command - self.response.by_command)


def signals(excitation: Excitation, *, hold: Hold, bench: Bench) -> Signals:
    """A command's shapes as functions of time."""
    step = bench.limits.time_step
    time = np.arange(-bench.halo, excitation.shapes.shape[0]) * step
    made = []
    for shape in excitation.shapes.T:
        values = np.concatenate([np.zeros(bench.halo), excitation.torque * shape])
        made.append(np.asarray(sampled(time, values, hold=hold).coefficients))
    knots = np.arange(-bench.halo, excitation.shapes.shape[0] + 1) * step
    return Signals(jnp.asarray(knots), jnp.asarray(np.stack(made, axis=-1)))


def in_own_units(white: Float[np.ndarray, " rows"], bench: Bench) -> Float[np.ndarray, "samples outputs"]:
    """Outputs in physical units, from those in units of the noise."""
    colour = np.linalg.inv(np.asarray(whitening(bench.noise)))
    return white.reshape(-1, colour.shape[0]) @ colour.T


def start(of: Explanation) -> Float[np.ndarray, " unknowns"]:
    """The unknowns of an explanation at its current values."""
    return np.concatenate([np.asarray(of.free.pack(of.model)), np.zeros(len(of.model.motion_states))])


def respond(
    of: Explanation,
    unknowns: Float[np.ndarray, " unknowns"],
    command: Float[np.ndarray, " shapes"],
    *,
    signals: Signals,
    bench: Bench,
) -> Response:
    """Simulate an experiment from rest, with all derivatives."""
    model = of.model
    drive = isinstance(model, TwoInertiaModel)
    rest = np.zeros(len(model.motion_states))
    if drive:
        rest[0], rest[1] = bench.motor_angle, bench.motor_angle / float(model.drive.N)
    warm = any(e.needs_temperature for e in model.effects)
    limits = bench.limits
    units = np.array([*([limits.speed, limits.travel * float(model.drive.N)] if drive else []), limits.twist])
    setup = _Setup(
        rest=jnp.asarray(rest),
        white=jnp.asarray(whitening(bench.noise)),
        temperature=jnp.asarray(np.asarray(bench.temperature if warm and bench.temperature is not None else 0.0)),
        substeps=jnp.asarray(np.asarray(bench.substeps)),
        halo=bench.halo,
    )
    found = _respond(model, of.free, signals, setup, jnp.asarray(np.concatenate([unknowns, command])))
    outputs, motion, columns, motion_columns = (np.asarray(a) for a in found)
    with np.errstate(invalid="ignore"):  # a diverging simulation without a limit
        moved, by_command = motion / units, motion_columns[..., unknowns.size :] / units[:, None]
    return Response(
        outputs.ravel(),
        columns[..., : unknowns.size].reshape(outputs.size, -1),
        columns[..., unknowns.size :].reshape(outputs.size, -1),
        moved,
        by_command,
        motion[:, -1],
    )


class _Setup(eqx.Module):
    """Settings of an experiment as arrays for the compiled program.

    Attributes:
        rest: motion state at the start.
        white: whitening of the outputs.
        temperature: of the drive [K].
        substeps: solver steps in a sample interval.
        halo: intervals of zero torque before the start.
    """

    rest: Array
    white: Array
    temperature: Array
    substeps: Array
    halo: int = eqx.field(static=True)


@jit_lanes
def _respond(
    model: Model, free: FreeParameters, signals: Signals, setup: _Setup, at: Array
) -> tuple[Array, Array, Array, Array]:
    own, motions = len(free.paths), len(model.motion_states)

    def simulated(entries: Array) -> tuple[Array, Array]:
        drive = free.unpack(model, entries[:own])
        torque = PiecewisePolynomial(signals.knots, signals.shapes @ entries[own + motions :])
        acting = drive.actuate(torque)
        acting = PiecewisePolynomial(acting.knots[setup.halo :], acting.coefficients[setup.halo :])
        steady = jnp.broadcast_to(setup.temperature, (acting.coefficients.shape[0], 1))
        warmth = PiecewisePolynomial(acting.knots, steady)
        state = drive.settled(setup.rest + entries[own : own + motions])
        states, _ = march(drive, acting, None, state, solver=dfx.Tsit5(), substeps=setup.substeps, temperature=warmth)
        outputs = read(drive, jnp.asarray(acting.knots)[:-1], states, acting, None, warmth)
        moved = [states[:, 0]]
        if isinstance(drive, TwoInertiaModel):
            moved = [states[:, 2], states[:, 0] - setup.rest[0], states[:, 0] / drive.drive.N - states[:, 1]]
        return outputs @ setup.white.T, jnp.stack(moved, axis=1)

    def along(tangent: Array):
        return jax.jvp(simulated, (at,), (tangent,))

    (outputs, motion), (columns, motion_columns) = jax.vmap(along, out_axes=(None, -1))(jnp.eye(at.size))
    return outputs, motion, columns, motion_columns


def refit(
    rival: Explanation,
    target: Response,
    command: Float[np.ndarray, " shapes"],
    *,
    signals: Signals,
    bench: Bench,
    begin: Float[np.ndarray, " unknowns"] | None = None,
) -> Refit:
    """Fit a rival to another model's response, by Gauss-Newton steps.

    Args:
        rival: the fitted explanation.
        target: the other model's response.
        command: the command's coefficients.
        signals: the command's shapes, under the rival's hold.
        bench: settings of the simulation.
        begin: starting values of the unknowns; the rival's where not given.
    """
    unknowns = start(rival) if begin is None else begin
    logarithmic = np.append(rival.free.logarithmic, np.zeros(len(rival.model.motion_states))) > 0
    response = respond(rival, unknowns, command, signals=signals, bench=bench)
    if not (target.usable and response.usable):
        return Refit(unknowns, response, np.full(target.outputs.size, np.nan))
    for _ in range(_STEPS):
        error = target.outputs - response.outputs
        step, left = _solved(response.by_unknown, error, logarithmic)
        gained = float(error @ error - left @ left)
        if gained <= _ARRIVED * float(left @ left) + _NOTHING:
            break
        size = min(1.0, _LONGEST / max(float(np.max(np.abs(step[logarithmic]), initial=0.0)), 1e-300))
        for _ in range(_HALVINGS):
            tried = respond(rival, unknowns + size * step, command, signals=signals, bench=bench)
            after = target.outputs - tried.outputs
            if tried.usable and float(after @ after) < float(error @ error):
                break
            size *= 0.5
        else:
            break
        unknowns, response = unknowns + size * step, tried
    return Refit(unknowns, response, _solved(response.by_unknown, target.outputs - response.outputs, logarithmic)[1])


def _solved(columns: np.ndarray, error: np.ndarray, logarithmic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least-squares step, damped in directions that noise dominates, and the remaining residual."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-150)
    scaled = columns / size
    damping = np.where(logarithmic, _DAMPING / size**2, 0.0)
    values, vectors = np.linalg.eigh(scaled.T @ scaled + np.diag(np.minimum(damping, 1.0)))
    inverse = np.where(values > _BLIND, 1.0 / np.maximum(values, _BLIND), 0.0)
    step = vectors @ (inverse * (vectors.T @ (scaled.T @ error)))
    return step / size, error - scaled @ step
