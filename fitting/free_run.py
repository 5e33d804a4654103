"""Free runs: the initial state from a short window, then the model alone."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.arrow import normal_equations
from fitting.estimate import fit, suggested_substeps
from fitting.experiment import Stretch, cut
from fitting.free import free_parameters
from fitting.residual import Problem, Unknowns, blocks, simulate_segments
from hdjax import Model, TwoInertiaModel

WINDOW = 50
"""Samples from which the initial state is taken."""

# 99 % point of chi-squared with as many degrees of freedom as there are rates (one or two).
_REST_LIMIT = {1: 6.63, 2: 9.21}


class FreeRun(eqx.Module):
    """A model's free run along a stretch.

    Attributes:
        name: the log's name.
        time: sample stamps [s].
        predicted: dynamic error [rad].
        measured: likewise.
        motor_angle: predicted motor angle [rad], or None for a reduced model.
    """

    name: str = eqx.field(static=True)
    time: Float[np.ndarray, " n"]
    predicted: Float[np.ndarray, " n"]
    measured: Float[np.ndarray, " n"]
    motor_angle: Float[np.ndarray, " n"] | None

    @property
    def rmse(self) -> float:
        """Rms of measured minus predicted [rad]."""
        return rms_error((self,))


def rms_error(runs: Sequence[FreeRun]) -> float:
    """Rms of measured minus predicted over several runs [rad]; infinite where a run left the numbers."""
    square = np.concatenate([(r.measured - r.predicted) ** 2 for r in runs])
    return float(np.sqrt(np.mean(square))) if np.isfinite(square).all() else np.inf


def free_run(
    model: Model,
    stretches: Sequence[Stretch],
    *,
    covariance: Float[Array, "outputs outputs"],
    halo: int = 0,
    substeps: int | None = None,
    window: int = WINDOW,
) -> tuple[FreeRun, ...]:
    """Simulate each stretch from its first `window` samples on.

    Args:
        model: the equations with their values.
        stretches: where to run. Measured outputs beyond the window are not looked at.
        covariance: of the measurement noise of the outputs.
        halo: intervals of torque before the start, for delays.
        substeps: solver steps in a sample interval.
        window: samples for the initial state.
    """
    if substeps is None:
        substeps = suggested_substeps(model, stretches)
    windows = [Stretch(s.experiment, s.start, min(s.start + window, s.stop)) for s in stretches]
    starts = fit(
        model,
        windows,
        (),
        horizon=window,
        halo=halo,
        substeps=substeps,
        covariance=covariance,
        reweigh=False,
        count=len(stretches),
    )
    states = _rest_where_at_rest(model, starts.problem, starts.unknowns)
    length = max(len(s) for s in stretches)
    segments = cut(stretches, length, halo=halo, count=len(stretches))
    problem = Problem(
        model,
        free_parameters(model, (), {}),
        segments,
        jnp.eye(segments.measured.shape[-1]),
        jnp.zeros(0),
        substeps=substeps,
    )
    outputs = np.asarray(_simulate(problem, Unknowns(jnp.zeros(0), states)))
    runs = []
    for stretch, output in zip(stretches, outputs, strict=True):
        n = len(stretch)
        part = slice(stretch.start, stretch.stop)
        motor = output[:n, 0] * float(model.drive.N) if isinstance(model, TwoInertiaModel) else None
        runs.append(
            FreeRun(
                name=stretch.name,
                time=stretch.experiment.time[part],
                predicted=output[:n, -1],
                measured=stretch.experiment.measured[part, -1],
                motor_angle=motor,
            )
        )
    return tuple(runs)


@eqx.filter_jit
def _simulate(problem: Problem, unknowns: Unknowns) -> Array:
    return simulate_segments(problem, unknowns)


@eqx.filter_jit
def _window_system(problem: Problem, unknowns: Unknowns) -> tuple[Array, Array]:
    found = blocks(problem, unknowns)
    rows = found.residual.shape[1] - found.by_state.shape[2]
    excess = jnp.sum(found.residual**2, axis=1) / rows
    return normal_equations(found).own, jnp.maximum(excess, 1.0)


def _rest_where_at_rest(model: Model, problem: Problem, unknowns: Unknowns) -> Array:
    """Initial states, with rates set to zero where the window can't tell them from zero.

    A short window knows a rate poorly, and the error grows with time. A log that begins at rest is common; where
    that is compatible with the window (1 % level), rest is taken.
    """
    information, excess = _window_system(problem, unknowns)
    rates = np.array([i for i, n in enumerate(model.motion_states) if n in ("omega_m", "omega_l", "v")])
    states = np.array(unknowns.states)
    for lane in range(states.shape[0]):
        matrix = np.asarray(information[lane])
        scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        scaled = matrix * scale[:, None] * scale[None, :]
        covariance = np.linalg.pinv(scaled, hermitian=True) * scale[:, None] * scale[None, :]
        block = covariance[np.ix_(rates, rates)] * float(excess[lane])
        rate = states[lane, rates]
        towards = np.linalg.solve(block, rate)
        if rate @ towards < _REST_LIMIT[rates.size]:
            states[lane] -= covariance[:, rates] @ towards * float(excess[lane])
            states[lane, rates] = 0.0
    return jnp.asarray(states)
