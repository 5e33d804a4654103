"""Least-squares problem of a fit: segments, initial states, solver steps and free parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.engines import with_engine
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import free_parameters
from fitting.estimation.observed_states import observed_states
from fitting.estimation.residual import Engine, Problem, Unknowns
from fitting.estimation.scales import scales
from fitting.estimation.segments import Segments, cut
from hdjax import Drive, Model, TwoInertiaModel
from hdjax.dynamics import BOTH_ANGLES
from hdjax.engine.pointwise import at_instants
from hdjax.lanes import spread

# Longest segment; longer simulations join several, which run in parallel.
_LONGEST_SEGMENT = 256
# Natural periods in a short simulation.
_PERIODS = 6.0
# Longest solver step in settling times of a bristle; above 2.8 it is unstable.
_SETTLINGS = 2.0
STEP_ANGLE = 0.15
"""A step of Tsit5 turns the fastest oscillation by at most this angle [rad]: it shifts K by less than 1e-6."""
_AT_CORNERS = 8
"""Multiple of the suggested number of steps that only corners of a nonsmooth model ask for: there a method's
order does not count, so that Bosh3 errs as much as Tsit5 does in twice the time."""


@dataclass(frozen=True)
class Segmentation:
    """Segment lengths and solver steps of a fit.

    Attributes:
        horizon: samples of one simulation. Short ones converge from far away, long ones are more accurate.
        length: samples in a segment; see [`segment_length`][] where not given.
        halo: intervals of torque before each segment, for delays.
        substeps: solver steps in a sample interval; from the natural frequency where not given.
        count: number of segments, see [`fitting.estimation.segments.cut`][].
    """

    horizon: int
    length: int | None = None
    halo: int = 0
    substeps: int | None = None
    count: int | None = None

    def of(self, stretches: Sequence[Stretch]) -> Segments:
        """The segments of the data."""
        length = segment_length(self.horizon) if self.length is None else self.length
        return cut(stretches, length, horizon=self.horizon, halo=self.halo, count=self.count)


def pose(
    model: Model,
    stretches: Sequence[Stretch],
    paths: Sequence[str],
    segmentation: Segmentation,
    *,
    hold_parameters: bool | tuple[str, ...] = False,
    states: Float[Array | np.ndarray, "segments states"] | None = None,
    engine: Engine | None = None,
) -> tuple[Problem, Unknowns]:
    """Set up a fit: the problem without output weights, and the initial unknowns.

    Args:
        model: equations and starting values.
        stretches: the data.
        paths: dotted paths of the free parameters.
        segmentation: how the data are cut into segments.
        hold_parameters: whether only the initial states are free; or the dotted paths of the fixed parameters.
        states: initial states of the segments; from their first samples where not given.
        engine: that evaluates the residual, see [`fitting.estimation.estimate.fit`][].
    """
    segments, suggested = segmentation.of(stretches), suggested_substeps(model, stretches)
    substeps = segmentation.substeps or suggested
    substeps = max(substeps, stable_substeps(model, max(s.experiment.time_step for s in stretches)))
    solver = dfx.Bosh3() if substeps >= _AT_CORNERS * suggested else dfx.Tsit5()
    free = free_parameters(model, paths, typical_scales(model, stretches))
    if states is None:
        states = initial_states(model, segments)
    unknowns = Unknowns(free.pack(model), states)
    if isinstance(hold_parameters, bool):
        hold_parameters = tuple(paths) if hold_parameters else ()
    active = jnp.asarray(np.array([0.0 if path in hold_parameters else 1.0 for path in paths]))
    outputs = segments.measured.shape[-1]
    unweighed = jnp.asarray(np.eye(outputs)), active, jnp.asarray(np.ones(states.shape[1]))
    problem = Problem(model, free, segments, *unweighed, solver, substeps, engine=engine)
    return on_all_devices(with_engine(problem), unknowns)


def on_all_devices(problem: Problem, unknowns: Unknowns) -> tuple[Problem, Unknowns]:
    """The same problem, its segments distributed over the devices where XLA evaluates the residual."""
    if problem.kernel is not None:
        return problem, unknowns
    return spread((problem, unknowns), unknowns.states.shape[0])


def segment_length(horizon: int) -> int:
    """Samples in a segment, for simulations of `horizon` samples."""
    return min(horizon, _LONGEST_SEGMENT)


def initial_states(model: Model, segments: Segments) -> Float[Array, "segments states"]:
    """Each segment's initial state from a cubic through its first samples and, where possible, the last ones of the
    preceding segment. Hidden states are in steady state with this motion.

    The cubic spans a quarter of a natural period; with fewer samples noise would dominate the rate. States that are not
    measured follow from the equations.
    """
    if isinstance(model, TwoInertiaModel) and model.measured != BOTH_ANGLES:
        return with_hidden_states(model, observed_states(model, segments))
    length = segments.measured.shape[1]
    measured, knots = np.asarray(segments.measured), segments.knots
    step = float(np.median(np.diff(knots)))
    quarter = int(min(np.ceil(0.5 * np.pi / float(model.drive.omega_0) / step), _LONGEST_SEGMENT))
    time = knots[:, :-1] - knots[:, :1]
    ahead = slice(min(length, max(quarter, 5)))
    value, rate = _value_and_rate(time[:, ahead], measured[:, ahead])
    around = min(length - 1, max(quarter, 2))
    if around >= 2:
        before, previous = np.roll(knots, 1, axis=0), np.roll(measured, 1, axis=0)
        earlier = before[:, -1 - around : -1] - knots[:, :1]
        goes_on = np.asarray(segments.goes_on)
        both = _value_and_rate(
            np.hstack([earlier, time[:, : around + 1]]),
            np.hstack([previous[:, -around:], measured[:, : around + 1]]),
        )
        value, rate = (np.where(goes_on[:, None], b, a) for a, b in zip((value, rate), both, strict=True))
    if isinstance(model, TwoInertiaModel):
        N = float(model.drive.N)
        columns = [N * value[:, 0], value[:, 0] - value[:, 1]]
        columns += [N * rate[:, 0], rate[:, 0] - rate[:, 1]]
    else:
        columns = [value[:, 0], rate[:, 0]]
    return with_hidden_states(model, np.stack(columns, axis=1))


def with_hidden_states(
    model: Model, motion: Float[np.ndarray, "segments motion_states"]
) -> Float[Array, "segments states"]:
    """The mechanical states with hidden states in steady state."""
    hidden = any(e.states for e in model.effects)
    return jnp.asarray(at_instants(_settled, (motion, 1), (model, 0)) if hidden else motion)


def states_from(
    model: Model, near: Model, states: Float[Array | np.ndarray, "segments near_states"]
) -> Float[Array, "segments states"]:
    """Initial states from those of another model on the same segments; new hidden states are in steady state. Poor
    initial states would make the first step move the parameters far away.

    Args:
        model: the new model, of the same mechanical states.
        near: the other model.
        states: its initial states.
    """
    names, states = near.state_names, np.asarray(states)
    if names == model.state_names:
        return jnp.asarray(states)
    found = np.asarray(with_hidden_states(model, states[:, : len(model.motion_states)]))
    columns = [states[:, names.index(n)] if n in names else found[:, i] for i, n in enumerate(model.state_names)]
    return jnp.asarray(np.stack(columns, axis=1))


def _settled(motion: Array, model: Model) -> Array:
    return model.settled(motion)


def _value_and_rate(time: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value and slope at time zero of the cubic through samples of each segment."""
    span = np.max(np.abs(time), axis=1, keepdims=True)
    basis = (time / span)[:, :, None] ** np.arange(4)[None, None, :]
    coefficients = np.linalg.pinv(basis) @ measured
    return coefficients[:, 0], coefficients[:, 1] / span


def typical_scales(model: Model, stretches: Sequence[Stretch]) -> dict[str, float]:
    """Units of parameters that may be zero: values at which each term matters at the measured twist."""
    motion = scales(stretches, model)
    drive = model.drive
    stiffness = float(drive.stiffness)
    damping = stiffness * motion.x / motion.v if motion.v > 0 else 1.0
    typical = {"alpha": 0.1 / motion.x_max**2} if motion.x_max > 0 else {}
    typical |= {"B_sp": 0.01 * damping} if isinstance(drive, Drive) else {"mu": 0.01 * damping}
    return typical


def natural_frequency(model: Model, stretches: Sequence[Stretch]) -> float:
    """Natural frequency of the dynamic error [rad/s], with hardening at the largest twist."""
    drive = model.drive
    stiffening = max(0.0, 3.0 * float(drive.alpha) * scales(stretches, model).x_max ** 2)
    return float(drive.omega_0) * float(np.sqrt(1.0 + stiffening))


def suggested_substeps(model: Model, stretches: Sequence[Stretch], *, step_angle: float = STEP_ANGLE) -> int:
    """Steps of Tsit5 in a sample interval that resolve the fastest oscillation, and in which bristles are stable.

    Args:
        model: supplies the natural frequency.
        stretches: supply the longest sample interval and the largest twist.
        step_angle: largest phase advance of the oscillation per step [rad].
    """
    time_step = max(stretch.experiment.time_step for stretch in stretches)
    angle = natural_frequency(model, stretches) * time_step
    return max(int(np.clip(np.ceil(angle / step_angle), 1, 16)), stable_substeps(model, time_step))


def stable_substeps(model: Model, time_step: float) -> int:
    """Solver steps in a sample interval at which the fastest bristles stay stable."""
    settling = [getattr(effect, "settling", np.inf) for effect in model.effects]
    steps = time_step / (_SETTLINGS * float(min(settling, default=np.inf)))
    return max(1, int(np.ceil(steps - 1e-9)))


def short_horizon(model: Model, stretches: Sequence[Stretch]) -> int:
    """Samples in a segment of about six natural periods at the lowest sample rate, as a power of two (few shapes, few
    programs)."""
    slowest = max(stretch.experiment.time_step for stretch in stretches)
    period = 2 * np.pi / natural_frequency(model, stretches) / slowest
    return int(2 ** np.clip(np.round(np.log2(_PERIODS * period)), 5, 11))
